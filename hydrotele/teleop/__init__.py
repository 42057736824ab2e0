"""Teleoperation: stability and transparency of master, slave, operator and task."""
