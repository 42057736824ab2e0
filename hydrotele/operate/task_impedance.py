"""Stiffness and damping of the task, identified while the machine touches it."""

import numpy as np

from hydrotele.teleop.recursive import RecursiveLeastSquares

_TOUCHING = 500.0  # N: less is no task, but what is left of the estimate in free motion
_SPREAD = (3e3, 3e3, 30.0)  # of stiffness [kN/m], damping [kN s/m] and offset [kN] before any data
_FORGET = 0.99  # per sample: some two seconds at 50 Hz
_RESET = 8.0  # times the usual error


class TaskImpedance:
    """Recursive least squares of `F = -(K x + B v + c)` along every task coordinate.

    Attributes:
        stiffness: (k,) K [N/m], [N m/rad]; 0 while nothing is touched.
        damping: (k,) B [N s/m], [N m s/rad].
    """

    def __init__(self, coordinates: int) -> None:
        """Begin with a free task."""
        self.stiffness, self.damping = np.zeros(coordinates), np.zeros(coordinates)
        self._fits: list[RecursiveLeastSquares | None] = [None] * coordinates
        self._origin = np.zeros(coordinates)

    def update(self, force: np.ndarray, measured: np.ndarray) -> None:
        """Take in one sample.

        Args:
            force: (k,) of the environment on the tip [N], [N m].
            measured: (2, 5) pose of the tip and its rate [m], [rad].

        Source: Zhu 1994, 3.73-3.76 (forgetting and resetting).
        """
        for c in range(len(force)):
            if not abs(force[c]) > _TOUCHING:
                self._fits[c] = None
                self.stiffness[c] = self.damping[c] = 0.0
                continue
            fit = self._fits[c]
            if fit is None:
                self._origin[c] = measured[0, c]
                fit = self._fits[c] = RecursiveLeastSquares(
                    np.zeros(3), np.array(_SPREAD), forgetting=_FORGET, reset=_RESET
                )
            row = np.array([measured[0, c] - self._origin[c], measured[1, c], 1.0])
            fit.update(row, -force[c] / 1e3)
            self.stiffness[c] = max(0.0, 1e3 * fit.value[0])
            self.damping[c] = max(0.0, 1e3 * fit.value[1])
