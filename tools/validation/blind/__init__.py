"""Run blind trials: add a hidden effect to the simulated machine and test whether it is found."""
