"""Cylinder linkages in the plane of the arm: joint angle to pin-to-pin cylinder length and back.

Two kinds with one small interface: `length(theta)` [m], `rate(theta)` = d(length)/d(theta) [m/rad]
and `angle(length)` [rad]. The plane is x-z with z up; angles are counter-clockwise in that picture,
so a positive angle raises the outboard end. Angles and lengths are floats (math module, fast) or
arrays of any shape (NumPy); the result has the same shape.

By virtual work a cylinder force F [N], positive when it pushes, makes the joint torque
F * rate(theta) [N m], and the cylinder moves with the velocity rate(theta) * d(theta)/dt.
"""

from hydrotele.kinematics.four_bar import FourBar, FourBarPose
from hydrotele.kinematics.triangle import LoopOpen
from hydrotele.kinematics.two_bar import TwoBar, two_bar_from_points

Linkage = TwoBar | FourBar

__all__ = ["FourBar", "FourBarPose", "Linkage", "LoopOpen", "TwoBar", "two_bar_from_points"]
