"""Blind trials: plant an effect in the simulated machine, hide it, let the workflow look for it."""
