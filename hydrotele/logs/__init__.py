"""Machine logs: channels, files, cleaning, and data sets for identification."""
