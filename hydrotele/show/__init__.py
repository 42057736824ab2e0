"""Pictures, recordings and plots of what has been run. Computes nothing new."""
