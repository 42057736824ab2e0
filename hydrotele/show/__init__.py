"""Reports, plots, images and recordings of results; nothing is simulated or estimated here."""
