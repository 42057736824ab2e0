"""Closed forms used on both sides of the wall: arm kinematics and cylinder linkages."""
