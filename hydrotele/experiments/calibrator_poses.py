"""Simulated measurements with a calibrator: links that move one at a time, sensors as they are.

The kinematics of the closed chain, for studies of many seeds; `models/calibrator` is the same chain
with masses and hydraulics in MuJoCo.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hydrotele.calibrate.arm_poses import Poses
from hydrotele.calibrate.loop import Loop, calibrator_angles, frame_of

RESOLVER = np.radians(0.1)
"""Bound of a resolver's error, uniform [rad]; Khoshzaban 1992 section 2.5."""


class Sweep(NamedTuple):
    """How one link is moved while the others are held [deg, K's signs].

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
    "stick": Sweep((50.0, 140.0), {"swing": 0.0, "boom": -27.5, "pitch": 42.9}, {"boom": -0.4}),
    "boom": Sweep((-48.0, -5.0), {"swing": 0.0, "stick": 80.2, "pitch": 42.9}, {"stick": 0.6}),
    "swing": Sweep((-95.0, 95.0), {"boom": -26.8, "stick": 81.0, "pitch": 42.9},
                   {"boom": -0.4, "stick": 0.8}, 10.0, 400),
}  # fmt: skip
"""Trajectories in kind of Khoshzaban 1992 Figs 16 to 18 (stick, boom, swing), and of link 4."""

STILL = {name: sweep._replace(drift={}, held={**{"boom": -27.8, "stick": 80.6, "pitch": 42.9,
         "swing": 0.0}, **{}}) for name, sweep in SWEEPS.items()}  # fmt: skip
"""The same with held links that stay where they are from the first stage to the last."""


@dataclass(frozen=True)
class Clean:
    """Poses of a stage without any error.

    Attributes:
        link: moving link.
        theta: (M, N) true angles with offsets [rad].
    """

    link: str
    theta: np.ndarray


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
    theta[:, moving] = 0.5 * (low + high) + 0.5 * (high - low) * np.sin(4.0 * np.pi * u - 1.2)
    pointing = _pointing(loop, theta)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = sum(np.sin(2.0 * np.pi * f * u + p) for f, p in zip((3.7, 7.3, 11.9), phases, strict=True))
    theta[:, loop.moved] = pointing + np.radians(sweep.wander) * wave / 3.0 * 1.6
    theta, reached = calibrator_angles(loop, theta)
    good = theta[reached]
    return Clean(link, good[np.linspace(0, len(good) - 1, min(sweep.poses, len(good))).astype(int)])


def _pointing(loop: Loop, theta: np.ndarray) -> np.ndarray:
    """Grapple's angle at which its yoke's axis is square to the line towards the ball."""
    place, turn = frame_of(loop, loop.moved, theta)
    x, y, _ = np.einsum("mji,mj->im", turn, loop.ball - place)
    return np.arctan2(y, x)


def readings(
    loop: Loop, clean: Clean, rng: np.random.Generator | None, accuracy: float = RESOLVER,
    extra: np.ndarray | None = None,
) -> Poses:  # fmt: skip
    """What the sensors read.

    Args:
        loop: the true chain; its offsets are those of the sensors.
        clean: true poses.
        rng: of the errors, uniform within +-accuracy; None for none.
        accuracy: of every angle sensor [rad].
        extra: (M, N) errors to add, such as those of bent joints [rad].

    Returns:
        The poses as they are measured.
    """
    shown = clean.theta - loop.values[:, 0]
    if extra is not None:
        shown = shown + extra
    if rng is not None:
        shown = shown + rng.uniform(-accuracy, accuracy, shown.shape)
    sigma = np.full(len(loop) - loop.moved, accuracy / np.sqrt(3.0))
    return Poses(
        clean.link, shown[:, loop.moved :], sigma,
        {name: shown[:, k] for k, name in enumerate(loop.links[: loop.moved]) if name != "pitch"},
        accuracy / np.sqrt(3.0), f"simulated {clean.link}",
    )  # fmt: skip


def stressed(loop: Loop, clean: Clean, rng: np.random.Generator, degrees: float = 1.0,
             share: float = 0.35) -> np.ndarray:  # fmt: skip
    """Errors of bent joints as Khoshzaban 1992 section 3.7.3 makes them.

    N(0, 1 deg) is added to grapple and yoke where gravity bends them most: in the poses in which
    the calibrator's arm lies most nearly level.

    Args:
        loop: the true chain.
        clean: true poses.
        rng: of the errors.
        degrees: their standard deviation.
        share: of the poses that are stressed.

    Returns:
        (M, N) errors [rad].
    """
    _, turn = frame_of(loop, len(loop) - 2, clean.theta)
    level = np.abs(turn[:, 2, 2])  # of the arm's direction along the vertical
    stress = level <= np.quantile(level, share)
    extra = np.zeros_like(clean.theta)
    places = [loop.moved, loop.moved + 1]
    extra[np.ix_(stress, places)] = np.radians(degrees) * rng.standard_normal((stress.sum(), 2))
    return extra


def perturbed(loop: Loop, rng: np.random.Generator, length: float = 0.03, angle: float = 1.0) -> Loop:
    """A true chain that differs from the nominal one as a machine built and worn does.

    Lengths of the manipulator and the ball's place differ by N(0, length) [m], its twists and the
    offsets of grapple, yoke and twist by N(0, angle) [deg]. The calibrator's own links, known from
    the laboratory, do not.
    """
    values, m = loop.values.copy(), loop.moved
    for k in range(m + 1):
        values[k, 2] += length * rng.standard_normal()
        values[k, 1] += np.radians(angle) * rng.standard_normal()
        if k < m and loop.parallel[k]:
            values[k, 4] += np.radians(angle) * rng.standard_normal()
    values[1, 3] += length * rng.standard_normal()
    values[m, 3] += length * rng.standard_normal()
    values[m : m + 3, 0] += np.radians(angle) * rng.standard_normal(3)
    ball = loop.ball + np.array([1.0, 0.0, 1.0]) * length * rng.standard_normal(3)
    return replace(loop, values=values, ball=ball)
