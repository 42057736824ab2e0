"""Logs of one machine, in order for learning: clocks, channels, gaps, the held-out run."""
