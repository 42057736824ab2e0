"""Calibrator poses while one link sweeps its range and the others are held.

Khoshzaban 1992, Figs 16 to 18 and section 5.3.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.calibrate.calibration_loop import (
    CalibrationLoop,
    frame_after_links,
    solve_calibrator_angles,
)


class Sweep(NamedTuple):
    """Reciprocating motion of one link while the others are held.

    Angles are in degrees, with the signs of Khoshzaban's D-H convention.

    Attributes:
        moving: lowest and highest angle of the moving link [deg].
        held: angle of each held link at the first pose, by name [deg].
        drift: change of each held link's angle from the first to the last pose, by name [deg].
        wander: amplitude of the grapple's rotation about the angle at which it points at the ball
            [deg].
        poses: number of poses.
        cycles: number of back-and-forth cycles of the moving link.
        phase: phase of the first pose within a cycle, 0 at the lower end [rad].
    """

    moving: tuple[float, float]
    held: Mapping[str, float]
    drift: Mapping[str, float]
    wander: float = 20.0
    poses: int = 300
    cycles: float = 1.0
    phase: float = 0.0


PUBLISHED_SWEEPS: Mapping[str, Sweep] = {
    "pitch": Sweep((20.0, 80.0), {"swing": 0.0, "boom": -27.5, "stick": 80.0},
                   {"boom": -0.2, "stick": 0.3}, 40.0),
    "stick": Sweep((45.0, 145.0), {"swing": 0.0, "boom": -27.5, "pitch": 42.9}, {"boom": -0.4}),
    "boom": Sweep((-48.0, -4.0), {"swing": 0.0, "stick": 80.2, "pitch": 42.9}, {"stick": 0.6}),
    "swing": Sweep((-95.0, 60.0), {"boom": -26.8, "stick": 81.0, "pitch": 42.9},
                   {"boom": -0.4, "stick": 0.8}, 10.0, 400),
}  # fmt: skip
"""Ranges, drifts and numbers of poses of Khoshzaban 1992 Figs 16 to 18; link 4 is an assumption."""
_HELD_ANGLES = {"swing": 0.0, "boom": -27.8, "stick": 80.6, "pitch": 42.9}  # K Table 2
DRIFT_FREE_SWEEPS = {name: sweep._replace(drift={}, held=_HELD_ANGLES) for name, sweep in PUBLISHED_SWEEPS.items()}
"""The same sweeps without drift, with each held link at one angle in all stages."""


class SweepPoses(NamedTuple):
    """Error-free poses of the chain of manipulator and calibrator while one link moves.

    Attributes:
        link: moving link.
        theta: (M, N) true angles of all N joints of the chain, with offsets [rad].
        reached_fraction: fraction of the requested poses that the calibrator reaches [1].
    """

    link: str
    theta: np.ndarray
    reached_fraction: float


def generate_sweep_poses(loop: CalibrationLoop, link: str, sweep: Sweep, seed: int = 0) -> SweepPoses:
    """Generate error-free poses of the chain while a link sweeps its range and held links drift linearly.

    Args:
        loop: the true chain.
        link: moving link.
        sweep: its trajectory.
        seed: seed of the random rotation of the grapple about the angle at which it points at the ball.

    Returns:
        At most `sweep.poses` poses, evenly spaced among those that the calibrator reaches.
    """
    rng, count = np.random.default_rng([seed, len(link)]), 2 * sweep.poses
    u = np.linspace(0.0, 1.0, count)
    low, high = np.radians(sweep.moving)
    theta = np.tile(loop.values[:, 0], (count, 1))
    for name, angle in sweep.held.items():
        theta[:, loop.links.index(name)] = np.radians(angle + sweep.drift.get(name, 0.0) * u)
    moving = loop.links.index(link)
    turn = 2.0 * np.pi * sweep.cycles * u + sweep.phase
    theta[:, moving] = 0.5 * (low + high) - 0.5 * (high - low) * np.cos(turn)
    pointing = _grapple_angle_to_ball(loop, theta)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = sum(np.sin(2.0 * np.pi * f * u + p) for f, p in zip((3.7, 7.3, 11.9), phases, strict=True))
    theta[:, loop.powered_count] = pointing + np.radians(sweep.wander) * wave / 3.0 * 1.6
    theta, reached = solve_calibrator_angles(loop, theta)
    good = theta[reached]
    rows = np.linspace(0, len(good) - 1, min(sweep.poses, len(good))).astype(int)
    return SweepPoses(link, good[rows], float(reached.mean()))


def _grapple_angle_to_ball(loop: CalibrationLoop, theta: np.ndarray) -> np.ndarray:
    """Return the grapple joint's angles (M,) [rad] at which the calibrator's arm can point at the ball."""
    place, turn = frame_after_links(loop, loop.powered_count, theta)
    x, y, _ = np.einsum("mji,mj->im", turn, loop.ball - place)
    return np.arctan2(y, x)
