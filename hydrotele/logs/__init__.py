"""Logs of machines: reading and writing files, cleaning, and data sets for identification."""
