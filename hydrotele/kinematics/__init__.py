"""Kinematics of arms, cylinder linkages, serial robots and serial-parallel robots."""
