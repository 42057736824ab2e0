"""Kinematic calibration: parameters of mechanisms from poses, joint angles and closed chains."""
