"""Prediction errors of a machine along measured runs, and effects fitted to them."""
