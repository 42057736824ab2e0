"""Teleoperation: what an operator feels, and whether master, slave, hand and task are stable."""
