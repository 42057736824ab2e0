"""Logs of machines, real or simulated: channels, files, cleaning, and data sets to learn from."""
