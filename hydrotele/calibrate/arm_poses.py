"""Poses of a manipulator that a calibrator measured while one link moved."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hydrotele.calibrate.loop import Loop, frame_of


class Drift(NamedTuple):
    """How held links move while another link is measured.

    Attributes:
        held: link -> (M,) deviation from its mean angle, of links beyond the moving one [rad].
        ball: (M, 3) how the ball moves away from, along and around the moving joint's axis [m],
            because links inside it drift.
    """

    held: Mapping[str, np.ndarray]
    ball: np.ndarray


@dataclass(frozen=True)
class Poses:
    """Readings while one link moved and the others were held; K's signs.

    Attributes:
        link: the moving link.
        theta: (M, S) readings of the calibrator's sensors, without offsets [rad].
        sigma: (S,), or (M, S) where it depends on the pose: standard deviation of a reading [rad].
        manipulator: link -> (M,) reading of the manipulator's own joint sensor, where there is one
            [rad]; the identification itself does not use it.
        manipulator_sigma: standard deviation of such a reading [rad].
        source: where the readings come from, for messages.
        rows: (M,) rows of the source.
        drift: of the held links, None to take them as fixed.
    """

    link: str
    theta: np.ndarray
    sigma: np.ndarray
    manipulator: Mapping[str, np.ndarray]
    manipulator_sigma: float = 0.0
    source: str = "memory"
    rows: np.ndarray | None = None
    drift: Drift | None = None

    def __len__(self) -> int:
        """Return the number of poses M."""
        return len(self.theta)

    def only(self, kept: np.ndarray) -> "Poses":
        """The poses of an index or mask."""
        rows = np.arange(len(self)) if self.rows is None else self.rows
        drift = self.drift and Drift(
            {name: values[kept] for name, values in self.drift.held.items()}, self.drift.ball[kept]
        )
        sigma = self.sigma[kept] if self.sigma.ndim == 2 else self.sigma
        return replace(
            self, theta=self.theta[kept], sigma=sigma, rows=rows[kept], drift=drift,
            manipulator={name: values[kept] for name, values in self.manipulator.items()},
        )  # fmt: skip


_TREND = 2  # degree of the polynomial over the poses: leakage slows down while pressures settle


def with_drift(loop: Loop, poses: Poses) -> Poses:
    """Poses with the drift of held links, as a smooth trend of the manipulator's own sensors.

    Sensors of a manipulator may have any offset: only changes are used. What the drift of links
    inside the moving one does to the ball's place is taken from the nominal chain.

    Args:
        loop: the nominal chain.
        poses: with readings of the manipulator's sensors.

    Returns:
        The poses with their drift; without such sensors as they are.
    """
    place = loop.links.index(poses.link)
    u = np.linspace(-1.0, 1.0, len(poses))
    trends = {
        name: np.polynomial.Polynomial.fit(u, values, _TREND)(u) - float(np.mean(values))
        for name, values in poses.manipulator.items() if name != poses.link and len(poses) > 10
    }  # fmt: skip
    if not trends:
        return poses
    theta = np.tile(loop.home, (len(poses), 1))
    for k, name in enumerate(loop.links[:place]):
        if name in trends:
            middle = float(np.mean(poses.manipulator[name])) + loop.values[k, 0]
            theta[:, k] = middle + trends[name]
    origin, turn = frame_of(loop, place, theta)
    seen = np.einsum("mji,mj->mi", turn, loop.ball - origin)
    middle = seen.mean(axis=0)
    away = middle[:2] / np.hypot(*middle[:2])
    moved = seen - middle
    ball = np.stack([moved[:, :2] @ away, moved[:, 2], moved[:, :2] @ (-away[1], away[0])], axis=1)
    outer = {name: values for name, values in trends.items() if loop.links.index(name) > place}
    return replace(poses, drift=Drift(outer, ball))
