"""Friction near zero speed: deviations from the friction law, drives at rest, and the friction force by speed.

`add_low_speed_friction_deviations` adds parameters for the error of a friction law near zero speed. Without
them an error of the law there, such as that of a smooth or elastic contact, biases the friction at all speeds.
`compute_friction_forces` evaluates the identified friction at round speeds, with its standard deviation.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hydrotele.identify.joint_motion import Processing, compute_joint_motion, estimate_resolution
from hydrotele.identify.linear_least_squares import Estimate
from hydrotele.identify.record import IdentificationRecord
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.multibody.regressor import DEVIATION_TERMS

_DEVIATION_SPEEDS = (1 / 32, 1 / 16, 1 / 8, 1 / 4)  # of the RMS speed: widths of the deviations near zero speed
_REST_SPEED = 0.002  # of the RMS speed: smaller than any speed but for an instant at a reversal
_MAX_ROWS = 4000  # rows of a run from which its speeds are computed
_ROUND_SPEEDS = np.array([float(f"{digit}e{power}") for power in range(-6, 4) for digit in (1, 3)])  # rad/s or m/s


class FrictionForce(NamedTuple):
    """Friction of a drive at a constant speed.

    Attributes:
        drive: name of the drive.
        speed: speed [rad/s] or [m/s], positive.
        force: friction force [N] or [N m], without the part that differs between the directions.
        std: its standard deviation.
        ci95: its 95 % interval.
        unit: unit of the force.
    """

    drive: str
    speed: float
    force: float
    std: float
    ci95: tuple[float, float]
    unit: str


def compute_drive_speeds(fit: Sequence[IdentificationRecord], setup: RegressorSetup) -> dict[str, tuple[float, float]]:
    """Compute the RMS and the maximum speed of each moving drive over all runs [rad/s] or [m/s].

    Args:
        fit: the fitted runs.
        setup: definition of the regressor.

    Returns:
        Drive -> RMS and maximum speed; drives at rest are omitted.
    """
    square, highest, count = np.zeros(len(setup.chain.joints)), np.zeros(len(setup.chain.joints)), 0
    is_moving = np.zeros(len(setup.given_joints), bool)
    for record in fit:
        resolved = estimate_resolution(record.position, record.period, record.position_noise)
        motion = compute_joint_motion(record.position, record.period, resolved, Processing("optimal"))
        thin = max(1, len(record.force) // _MAX_ROWS)
        rate = setup.project_motion_on_drives(
            motion.value[::thin], motion.rate[::thin], motion.acceleration[::thin]
        ).rate
        square, count = square + np.sum(rate**2, axis=0), count + len(rate)
        highest = np.maximum(highest, np.abs(rate).max(axis=0))
        is_moving |= resolved.is_moving
    out = {}
    for drive in setup.chain.drives if is_moving.any() else ():
        if drive in setup.given_joints and not is_moving[setup.given_joints.index(drive)]:
            continue
        j = setup.chain.index(drive)
        if square[j] > 0.0:
            out[drive] = (float(np.sqrt(square[j] / count)), float(highest[j]))
    return out


def set_rest_speeds(setup: RegressorSetup, speeds: dict[str, tuple[float, float]]) -> RegressorSetup:
    """Set the speed below which each drive counts as at rest, 0.2 % of its RMS speed.

    At rest the dry friction of a drive is unknown. Drives without a speed are unchanged.

    Args:
        setup: definition of the regressor.
        speeds: drive -> RMS and maximum speed [rad/s] or [m/s].

    Returns:
        The setup with these rest speeds.
    """
    terms = tuple(
        replace(term, rest_speed=_REST_SPEED * speeds[term.location][0]) if term.location in speeds else term
        for term in setup.friction_terms
    )
    return replace(setup, friction_terms=terms)


def add_low_speed_friction_deviations(setup: RegressorSetup, speeds: dict[str, tuple[float, float]]) -> RegressorSetup:
    """Add parameters for deviations of the drives' friction from its law near zero speed.

    Every moving drive with Coulomb friction gets deviations of four widths, 1/32 to 1/4 of its RMS
    speed.

    Args:
        setup: definition of the regressor.
        speeds: drive -> RMS and maximum speed [rad/s] or [m/s], which set the widths of the deviations.

    Returns:
        The setup with these parameters, whose given values are 0.
    """
    terms = []
    for term in setup.friction_terms:
        if term.location in speeds and "coulomb" in term.nominal:
            widths = tuple(part * speeds[term.location][0] for part in _DEVIATION_SPEEDS)
            more = {f"{kind}_{k + 1}": 0.0 for kind in DEVIATION_TERMS for k in range(len(widths))}
            term = replace(term, nominal={**term.nominal, **more}, low_speeds=widths)
        terms.append(term)
    return replace(setup, friction_terms=tuple(terms))


def compute_friction_forces(
    setup: RegressorSetup, speeds: dict[str, tuple[float, float]], names: Sequence[str], value: np.ndarray,
    base: np.ndarray, estimate: Estimate,
) -> tuple[FrictionForce, ...]:  # fmt: skip
    """Compute the identified friction force of each drive at round speeds, with 95 % intervals.

    The speeds are 1 or 3 times a power of ten (rad/s or m/s), from 1/32 of the RMS speed to the
    maximum speed of the drive in the fitted runs. The force is half the difference of the forces in
    both directions.

    Args:
        setup: definition of the regressor.
        speeds: drive -> RMS and maximum speed in the fitted runs [rad/s] or [m/s].
        names: names of the m parameters.
        value: (m,) identified values.
        base: (r,) indices of the base parameters.
        estimate: estimate of the base parameters.

    Returns:
        The friction forces by drive and speed; none for drives whose Coulomb friction is not identifiable.
    """
    first = {place: group[0] for group in setup.equal_groups for place in group}
    out = []
    for term in setup.friction_terms:
        place = first.get(term.location, term.location)
        if term.location not in speeds or f"coulomb.{place}" not in {names[b] for b in base}:
            continue
        rms, highest = speeds[term.location]
        unit = "N" if setup.chain.tree.is_slide[setup.chain.index(term.location)] else "N m"
        for speed in _ROUND_SPEEDS[(_ROUND_SPEEDS >= _DEVIATION_SPEEDS[0] * rms) & (_ROUND_SPEEDS <= highest)]:
            sides = [term.unit_forces(np.array(side * speed)) for side in (1.0, -1.0)]
            weights = np.zeros(len(names))
            for kind in term.nominal:
                if f"{kind}.{place}" in names:
                    weights[list(names).index(f"{kind}.{place}")] = 0.5 * float(sides[0][kind] - sides[1][kind])
            force, std = float(weights @ value), float(np.sqrt(weights[base] @ estimate.covariance @ weights[base]))
            reach = estimate.interval_factor * std
            out.append(FrictionForce(term.location, float(speed), force, std, (force - reach, force + reach), unit))
    return tuple(out)
