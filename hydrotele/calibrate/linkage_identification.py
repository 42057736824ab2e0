"""Identification of cylinder linkages from joint angles and piston displacements.

The closed form is `l_p = sqrt(l_l^2 + l_u^2 - 2 l_l l_u cos(theta + theta_off)) - l_c`
(K Eqs 3.26 and 3.27). The angle is measured by the joint's own sensor, or identified from the
calibrator.

Source: Khoshzaban 1992, sections 3.4.4 and 3.8.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hydrotele.calibrate.arm_identification import ArmFit, StageEquations
from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.calibration_loop import ball_position_from_axis, frame_after_links
from hydrotele.calibrate.estimation import ParameterFit, least_squares
from hydrotele.core.errors import InputError
from hydrotele.effects.effect import with_value
from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.kinematics.linkages import TwoBar
from hydrotele.machine.machine import Machine

AngleSource = Literal["measured", "identified"]

PARAMETER_NAMES = ("theta_off", "l_l", "l_c", "l_u")
"""Offset of the included angle [rad], lower pin distance, closed length, upper pin distance [m]."""

_PARAMETER_SCALES = np.array([np.radians(10.0), 0.2, 0.2, 0.2])
_MIN_ANGLE_RANGE = np.radians(5.0)  # minimum range of the joint angle
_VALIDATION_STRIDE = 5  # every fifth sample is used for validation
_MAX_REWEIGHTINGS = 3


@dataclass(frozen=True)
class AxisStrokes:
    """Joint angles and piston displacements of one axis.

    Attributes:
        axis: name of the axis.
        angle: (n,) joint angles, machine's sign [rad].
        length: (n,) piston displacements [m].
        angle_sigma: standard deviation of an angle [rad].
        length_sigma: standard deviation of a displacement [m].
        angle_source: origin of the angles.
        source: the file.
    """

    axis: str
    angle: np.ndarray
    length: np.ndarray
    angle_sigma: float
    length_sigma: float
    angle_source: AngleSource = "measured"
    source: str = "memory"


@dataclass(frozen=True)
class LinkageFit:
    """Result of the calibration of one linkage.

    Attributes:
        axis: name of the axis.
        angle_source: origin of the angles.
        nominal: (4,) nominal parameters, in the order of `PARAMETER_NAMES`.
        fit: fit of the free parameters.
        fixed: names of the fixed parameters.
        direction: +1 if the cylinder extends as the angle increases, otherwise -1.
        rms: root mean square displacement error of the validation samples [m].
        vaf: variance of these samples accounted for by the linkage [%].
        rms_before: RMS error with the nominal parameters [m].
        samples: number n of all samples, fitted and validation.
        residual: (n,) fitted minus measured displacement of each sample [m].
        angle: (n,) joint angle of each sample [rad].
    """

    axis: str
    angle_source: AngleSource
    nominal: np.ndarray
    fit: ParameterFit
    fixed: tuple[str, ...]
    direction: int
    rms: float
    vaf: float
    rms_before: float
    samples: int
    residual: np.ndarray
    angle: np.ndarray


def piston_displacement(values: np.ndarray, direction: int, angle: np.ndarray) -> np.ndarray:
    """Return the piston displacements (n,) [m] of a cylinder at joint angles (n,) [rad].

    `values` are the angle offset, lower pin distance, closed length and upper pin distance of its
    triangle. `direction` is +1 if the cylinder extends as the angle increases, otherwise -1.
    """
    offset, lower, closed, upper = values
    return TwoBar(lower, upper, offset, direction).length(angle) - closed


def identify_linkage(machine: Machine, strokes: AxisStrokes, fixed: Sequence[str] | None = None) -> LinkageFit:
    """Identify the triangle of a cylinder linkage by fitting piston displacements over joint angles.

    Its parameters are both pin distances, the angle offset and the closed length of the cylinder.

    Args:
        machine: the nominal machine.
        strokes: angles and displacements.
        fixed: parameters that keep their nominal values. The default is none for measured angles
            and the longer of the two pin distances for identified angles, as in Khoshzaban 1992
            Table 11.

    Returns:
        The fit, validated on every fifth sample, which is not fitted.

    Raises:
        InputError: the axis has no cylinder across its joint, or moves by less than 5 deg.

    Examples:
        The triangle of the boom cylinders from joint angles and piston displacements:

        >>> import numpy as np
        >>> import hydrotele as ht
        >>> from hydrotele.kinematics.drive_linkage import axis_linkage
        >>> machine = ht.load_machine("cat215", "bucket")
        >>> triangle, closed = axis_linkage(machine, "boom"), machine.axes["boom"].cylinder.closed_length
        >>> angle = np.linspace(-0.4, 0.9, 200)
        >>> measured = triangle.length(angle) - closed + np.random.default_rng(1).normal(0.0, 1e-4, 200)
        >>> found = identify_linkage(machine, AxisStrokes("boom", angle, measured, 1e-5, 1e-4))
        >>> for name, value, sd in zip(found.fit.names, found.fit.values, found.fit.standard_deviations):
        ...     print(f"{name} {value:.3f} +- {sd:.3f}")
        theta_off 1.373 +- 0.002
        l_l 0.625 +- 0.000
        l_c 1.454 +- 0.017
        l_u 2.007 +- 0.016

        The errors of the parameters are correlated; the predicted displacement is accurate.

        >>> f"{1e3 * found.rms:.2f} mm"  # at samples that were not fitted
        '0.08 mm'
    """
    linkage = axis_linkage(machine, strokes.axis)
    cylinder = machine.axes[strokes.axis].cylinder
    if not isinstance(linkage, TwoBar) or cylinder is None:
        raise InputError(f"axis {strokes.axis}", "has no cylinder across its joint (two-bar)")
    if np.ptp(strokes.angle) < _MIN_ANGLE_RANGE:
        moved = np.degrees(np.ptp(strokes.angle))
        raise InputError(
            strokes.source,
            f"{strokes.axis} moves by {moved:.2g} deg only: move it through its range, by at least"
            " 5 deg; theta_off, l_l, l_c and l_u are not identifiable",
        )
    nominal = np.array([linkage.angle_offset, linkage.lower, cylinder.closed_length, linkage.upper])
    if fixed is None:
        longer = "l_u" if linkage.upper > linkage.lower else "l_l"
        fixed = (longer,) if strokes.angle_source == "identified" else ()
    free = [k for k, name in enumerate(PARAMETER_NAMES) if name not in fixed]
    judged = np.arange(len(strokes.angle)) % _VALIDATION_STRIDE == _VALIDATION_STRIDE // 2
    angle, length = strokes.angle[~judged], strokes.length[~judged]
    values, fit = nominal.copy(), None
    for _ in range(_MAX_REWEIGHTINGS):
        offset, lower, _, upper = values
        arm = TwoBar(lower, upper, offset, linkage.direction).rate(angle)
        sigma = np.hypot(strokes.length_sigma, np.asarray(arm) * strokes.angle_sigma)

        def residual(x):
            full = nominal.copy()
            full[free] = x
            full[[1, 3]] = np.maximum(full[[1, 3]], 1.0e-3)
            return piston_displacement(full, linkage.direction, angle) - length

        fit = least_squares(
            residual,
            values[free],
            [PARAMETER_NAMES[k] for k in free],
            _PARAMETER_SCALES[free],
            sigma=sigma,
        )
        values[free] = fit.values
    assert fit is not None
    error = piston_displacement(values, linkage.direction, strokes.angle) - strokes.length
    before = piston_displacement(nominal, linkage.direction, strokes.angle) - strokes.length
    kept = strokes.length[judged]
    return LinkageFit(
        strokes.axis, strokes.angle_source, nominal, fit, tuple(fixed), linkage.direction,
        float(np.sqrt(np.mean(error[judged] ** 2))),
        100.0 * float(1.0 - np.sum(error[judged] ** 2) / np.sum((kept - kept.mean()) ** 2)),
        float(np.sqrt(np.mean(before[judged] ** 2))), len(strokes.angle), error, strokes.angle,
    )  # fmt: skip


def linkage_parameters(found: LinkageFit) -> np.ndarray:
    """Return all parameters (4,) of a fitted linkage: angle offset, lower pin, closed length, upper pin.

    Parameters that were not fitted are nominal.
    """
    values = found.nominal.copy()
    for name, value in zip(found.fit.names, found.fit.values, strict=True):
        values[PARAMETER_NAMES.index(name)] = value
    return values


def machine_with_linkage(machine: Machine, found: LinkageFit) -> Machine:
    """Return a machine whose cylinder pins and closed length are those of an identified linkage.

    Both pins get the identified distances from the joint axis. The pin on the link inside the joint
    keeps its direction from the joint. The pin on the link that the joint moves is rotated about the
    joint axis by the change of the angle offset.

    Args:
        machine: the machine.
        found: fit of one axis.

    Returns:
        The machine.
    """
    axis = machine.axes[found.axis]
    assert axis.cylinder
    outboard = machine.link_of(axis.joint)
    link = machine.links[outboard]
    assert link.joint
    offset, lower, closed, upper = linkage_parameters(found)
    turn = found.direction * (offset - found.nominal[0])
    way, ends = np.array(link.joint.axis), {}
    for part in ("base_pin", "rod_pin"):
        pin = getattr(axis.cylinder, part)
        origin = np.zeros(3) if pin.link == outboard else np.array(link.position)
        arm = np.array(pin.position) - origin
        along = way * (way @ arm)
        across = arm - along
        if pin.link == outboard:
            size = upper
            across = across * np.cos(turn) + np.cross(way, across) * np.sin(turn)
        else:
            size = lower
        across = across * size / np.linalg.norm(across)
        position = tuple(map(float, origin + along + across))
        ends[part] = pin.model_copy(update={"position": position})
    cylinder = axis.cylinder.model_copy(update={**ends, "closed_length": float(closed)})
    return with_value(machine, f"axes.{found.axis}.cylinder", cylinder)


def compute_angles_from_calibrator(fit: ArmFit, poses: Poses) -> np.ndarray:
    """Compute the moving joint's angle at every pose from the calibrator's readings alone.

    The ball's direction relative to the joint's axis rotates opposite to the joint. The zero of the
    angle depends on the links between chassis and joint, whose errors shift all angles equally; the
    angle offset of a linkage fitted later absorbs this shift.

    Args:
        fit: fit of the arm.
        poses: poses of the link's stage.

    Returns:
        (M,) angles, machine's sign [rad], with the number of turns nearest to the nominal home
        angle.
    """
    loop = fit.nominal
    equations = StageEquations(loop, poses)
    seen, theta = equations.chain_and_angles(fit.parameters)
    s = ball_position_from_axis(seen, equations.place, theta)
    angle = -np.unwrap(np.arctan2(s[:, 1], s[:, 0]))
    origin, turn = frame_after_links(fit.loop, equations.place, loop.home[None])
    ball = turn[0].T @ (fit.loop.ball - origin[0])
    angle = angle + np.arctan2(ball[1], ball[0])
    angle = angle - 2.0 * np.pi * np.round((angle.mean() - loop.home[equations.place]) / (2 * np.pi))
    return (angle - loop.values[equations.place, 0]) * loop.signs[equations.place]
