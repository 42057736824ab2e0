"""The facts of a scenario: motion, surroundings, teleoperation."""
