"""Hydraulic laws, the circuit that combines them, and the parameters of a machine's actuators.

Simulation and estimation use the same functions.
"""
