"""Simulation of a machine in MuJoCo: mechanism, hydraulics, sensors and recorded states."""
