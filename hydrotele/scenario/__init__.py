"""Specification of a scenario: motion, surroundings, teleoperation."""
