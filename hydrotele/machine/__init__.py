"""Machine data: geometry, drives, sensors and joystick, with parameter uncertainties."""
