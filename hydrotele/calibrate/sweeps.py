"""Trajectories of a measurement with a calibrator: one link sweeps, held ones drift."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.calibrate.loop import Loop, calibrator_angles, frame_of


class Sweep(NamedTuple):
    """How one link is moved, there and back once, while the others are held [deg, K's signs].

    Attributes:
        moving: range of the moving link.
        held: link -> where it stands.
        drift: link -> by how much it has drifted when the last pose is taken.
        wander: by how much the grapple is turned about the place where it points at the ball.
        poses: number of poses.
    """

    moving: tuple[float, float]
    held: Mapping[str, float]
    drift: Mapping[str, float]
    wander: float = 20.0
    poses: int = 300


SWEEPS: Mapping[str, Sweep] = {
    "pitch": Sweep((20.0, 80.0), {"swing": 0.0, "boom": -27.5, "stick": 80.0},
                   {"boom": -0.2, "stick": 0.3}, 40.0),
    "stick": Sweep((45.0, 145.0), {"swing": 0.0, "boom": -27.5, "pitch": 42.9}, {"boom": -0.4}),
    "boom": Sweep((-48.0, -4.0), {"swing": 0.0, "stick": 80.2, "pitch": 42.9}, {"stick": 0.6}),
    "swing": Sweep((-95.0, 60.0), {"boom": -26.8, "stick": 81.0, "pitch": 42.9},
                   {"boom": -0.4, "stick": 0.8}, 10.0, 400),
}  # fmt: skip
"""Ranges, drifts and numbers of poses of Khoshzaban 1992 Figs 16 to 18, and of link 4 alike (A)."""

_HELD = {"swing": 0.0, "boom": -27.8, "stick": 80.6, "pitch": 42.9}  # K Table 2

STILL = {name: sweep._replace(drift={}, held=_HELD) for name, sweep in SWEEPS.items()}
"""The same with held links that stay where they are from the first stage to the last."""


class Clean(NamedTuple):
    """Poses of a stage without any error.

    Attributes:
        link: moving link.
        theta: (M, N) true angles with offsets [rad].
        reached: part of the asked poses that the calibrator reaches [1].
    """

    link: str
    theta: np.ndarray
    reached: float


def sweep_poses(loop: Loop, link: str, sweep: Sweep, seed: int = 0) -> Clean:
    """True poses while a link sweeps its range and held links drift.

    Args:
        loop: the true chain.
        link: moving link.
        sweep: its trajectory.
        seed: of the grapple's wandering.

    Returns:
        The poses that the calibrator reaches.
    """
    rng, count = np.random.default_rng([seed, len(link)]), 2 * sweep.poses
    u = np.linspace(0.0, 1.0, count)
    low, high = np.radians(sweep.moving)
    theta = np.tile(loop.values[:, 0], (count, 1))
    for name, angle in sweep.held.items():
        theta[:, loop.links.index(name)] = np.radians(angle + sweep.drift.get(name, 0.0) * u)
    moving = loop.links.index(link)
    theta[:, moving] = 0.5 * (low + high) - 0.5 * (high - low) * np.cos(2.0 * np.pi * u)
    pointing = _pointing(loop, theta)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = sum(
        np.sin(2.0 * np.pi * f * u + p) for f, p in zip((3.7, 7.3, 11.9), phases, strict=True)
    )
    theta[:, loop.moved] = pointing + np.radians(sweep.wander) * wave / 3.0 * 1.6
    theta, reached = calibrator_angles(loop, theta)
    good = theta[reached]
    rows = np.linspace(0, len(good) - 1, min(sweep.poses, len(good))).astype(int)
    return Clean(link, good[rows], float(reached.mean()))


def _pointing(loop: Loop, theta: np.ndarray) -> np.ndarray:
    """Grapple's angle at which its yoke's axis is square to the line towards the ball."""
    place, turn = frame_of(loop, loop.moved, theta)
    x, y, _ = np.einsum("mji,mj->im", turn, loop.ball - place)
    return np.arctan2(y, x)
