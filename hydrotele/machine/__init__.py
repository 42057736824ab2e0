"""The facts of a machine: geometry, drives, sensors, joystick, and how well they are known."""
