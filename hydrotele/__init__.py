"""Simulation and teleoperation testbed for heavy hydraulic machines, built on MuJoCo."""

__version__ = "0.1.0"
