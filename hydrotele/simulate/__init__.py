"""The machine side: hydraulics, mechanism, sensors, and their states."""
