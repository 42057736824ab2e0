"""Poses of a manipulator that a calibrator measured while one link moved."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Poses:
    """Readings while one link moved and the others were held; K's signs.

    Attributes:
        link: the moving link.
        theta: (M, S) readings of the calibrator's sensors, without offsets [rad].
        sigma: (S,) standard deviation of a reading [rad].
        manipulator: link -> (M,) reading of the manipulator's own joint sensor, where there is one
            [rad]; the identification itself does not use it.
        manipulator_sigma: standard deviation of such a reading [rad].
        source: where the readings come from, for messages.
        rows: (M,) rows of the source.
    """

    link: str
    theta: np.ndarray
    sigma: np.ndarray
    manipulator: Mapping[str, np.ndarray]
    manipulator_sigma: float = 0.0
    source: str = "memory"
    rows: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of poses M."""
        return len(self.theta)

    def only(self, kept: np.ndarray) -> "Poses":
        """The poses of an index or mask."""
        rows = np.arange(len(self)) if self.rows is None else self.rows
        return Poses(
            self.link, self.theta[kept], self.sigma,
            {name: values[kept] for name, values in self.manipulator.items()},
            self.manipulator_sigma, self.source, rows[kept],
        )  # fmt: skip
