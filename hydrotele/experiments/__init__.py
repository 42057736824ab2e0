"""Repeat published experiments in simulation, with one or more modules per publication."""
