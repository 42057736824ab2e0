"""Poses of a manipulator, measured by a calibrator while one link moves."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hydrotele.calibrate.calibration_loop import CalibrationLoop, frame_after_links


class Drift(NamedTuple):
    """Motion of the held links while another link is measured.

    Attributes:
        held: (M,) deviation of each held link beyond the moving one from its mean angle [rad],
            by link name.
        ball: (M, 3) displacement of the ball from its mean position, away from, along and around
            the moving joint's axis [m]. It is caused by drift of the links between the chassis and
            the moving link.
    """

    held: Mapping[str, np.ndarray]
    ball: np.ndarray


@dataclass(frozen=True)
class Poses:
    """Readings of M poses while one link moves and the others are held.

    Angles have the signs of Khoshzaban's (K) D-H convention, see `hydrotele.calibrate.calibration_loop`.

    Attributes:
        link: the moving link.
        theta: (M, S) readings of the calibrator's sensors [rad]; the offset parameters are not added.
        sigma: (S,), or (M, S) if it depends on the pose: standard deviation of a reading [rad].
        manipulator: (M,) readings of the manipulator's own joint sensors, if any, by link [rad];
            the identification itself does not use them.
        manipulator_sigma: standard deviation of such a reading [rad].
        source: origin of the readings, for messages.
        rows: (M,) row numbers of the poses in the source.
        drift: drift of the held links; None if they are fixed.
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

    def select(self, index: np.ndarray) -> "Poses":
        """Return the poses selected by an index array or mask."""
        rows = np.arange(len(self)) if self.rows is None else self.rows
        drift = self.drift and Drift(
            {name: values[index] for name, values in self.drift.held.items()},
            self.drift.ball[index],
        )
        sigma = self.sigma[index] if self.sigma.ndim == 2 else self.sigma
        return replace(
            self, theta=self.theta[index], sigma=sigma, rows=rows[index], drift=drift,
            manipulator={name: values[index] for name, values in self.manipulator.items()},
        )  # fmt: skip


_TREND_DEGREE = 2  # polynomial degree over the poses: leakage decreases while pressures settle


def add_held_link_drift(loop: CalibrationLoop, poses: Poses) -> Poses:
    """Estimate how held links drift during a measurement, and add this drift to the poses.

    The drift of a link is a polynomial of degree 2, fitted to the readings of its joint's sensor
    over the poses, minus the mean reading. Drift of links between the chassis and the moving one
    displaces the ball in the moving joint's frame. This displacement is computed with the nominal
    chain.

    Args:
        loop: the nominal chain.
        poses: poses with readings of the manipulator's sensors.

    Returns:
        The poses with their drift; unchanged without such readings, or if there are at most 10
        poses.
    """
    place = loop.links.index(poses.link)
    u = np.linspace(-1.0, 1.0, len(poses))
    trends = {
        name: np.polynomial.Polynomial.fit(u, values, _TREND_DEGREE)(u) - float(np.mean(values))
        for name, values in poses.manipulator.items() if name != poses.link and len(poses) > 10
    }  # fmt: skip
    if not trends:
        return poses
    theta = np.tile(loop.home, (len(poses), 1))
    for k, name in enumerate(loop.links[:place]):
        if name in trends:
            middle = float(np.mean(poses.manipulator[name])) + loop.values[k, 0]
            theta[:, k] = middle + trends[name]
    origin, turn = frame_after_links(loop, place, theta)
    seen = np.einsum("mji,mj->mi", turn, loop.ball - origin)
    middle = seen.mean(axis=0)
    away = middle[:2] / np.hypot(*middle[:2])
    moved = seen - middle
    ball = np.stack([moved[:, :2] @ away, moved[:, 2], moved[:, :2] @ (-away[1], away[0])], axis=1)
    outer = {name: values for name, values in trends.items() if loop.links.index(name) > place}
    return replace(poses, drift=Drift(outer, ball))
