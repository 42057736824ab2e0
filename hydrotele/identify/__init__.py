"""Dynamic identification from logs: signal processing first, then the force regressor."""
