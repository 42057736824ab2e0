"""Stiffness, damping and mass of the task, identified while the machine touches it.

Recursive least squares with forgetting and resetting.
"""

import numpy as np

from hydrotele.control.state_filter import CHANGE, LAST, LOW, RATE, filter_step, filter_table
from hydrotele.core.errors import InputError

_WHERE = "recursive least squares"


class RecursiveLeastSquares:
    """Parameters of `y = phi . theta`, updated with every equation.

    A forgetting factor below 1 lets the past fade, so that parameters may drift. Where nothing
    moves, forgetting would let the covariance grow without end: its trace is bounded. A sudden
    change, an error many times as large as usual, opens the covariance again.
    """

    def __init__(
        self, start: np.ndarray, spread: np.ndarray, *, forgetting: float = 1.0,
        reset: float = np.inf,
    ):  # fmt: skip
        """Begin.

        Args:
            start: (p,) parameters.
            spread: (p,) their standard deviations, in units of the equations' error.
            forgetting: share of the past that is kept from one equation to the next, above 0, at
                most 1.
            reset: times the usual error beyond which the covariance is opened again.

        Raises:
            InputError: sizes do not fit or a number makes no sense.
        """
        self.value, spread = np.array(start, float), np.array(spread, float)
        if self.value.ndim != 1 or spread.shape != self.value.shape or not np.all(spread > 0.0):
            raise InputError(_WHERE, f"{len(self.value)} parameters need as many spreads above 0")
        if not 0.0 < forgetting <= 1.0:
            raise InputError(_WHERE, f"forgetting must be above 0 and at most 1: {forgetting}")
        if not reset > 1.0:
            raise InputError(_WHERE, f"reset must be above 1, got {reset}")
        self.covariance = np.diag(spread**2)
        self.resets = 0
        self._open, self._most = self.covariance.copy(), float(np.trace(self.covariance))
        self._forgetting, self._reset = forgetting, reset
        self._usual, self._count = 0.0, 0

    def update(self, row: np.ndarray, measured: float) -> float:
        """Take in one equation; one that is not finite is left out.

        Args:
            row: (p,) phi.
            measured: y.

        Returns:
            The error before the update; NaN of an equation that was left out.

        Source: Ljung 1999, System identification, 11.2 (forgetting); Zhu 1994, 3.74 and 6.1.
        """
        row = np.asarray(row, float)
        if not (np.isfinite(row).all() and np.isfinite(measured)):
            return float("nan")
        error = float(measured - row @ self.value)
        if self._sudden(error):
            self.covariance = self._open.copy()
            self.resets, self._usual, self._count = self.resets + 1, 0.0, 0
        way = self.covariance @ row
        gain = way / (self._forgetting + row @ way)
        self.value = self.value + gain * error
        wider = (self.covariance - np.outer(gain, way)) / self._forgetting
        if np.trace(wider) <= self._most:
            self.covariance = 0.5 * (wider + wider.T)
        else:
            self.covariance = self.covariance - np.outer(gain, way)
        return error

    def _sudden(self, error: float) -> bool:
        """Whether an error is far beyond the usual ones, which it then does not join."""
        known = self._count >= 5 * len(self.value)
        if known and error**2 > self._reset**2 * self._usual:
            return True
        self._count += 1
        share = max(1.0 / self._count, 0.02)
        if self._count > 2 * len(self.value):  # the first ones tell of the start only
            self._usual += share * (error**2 - self._usual)
        return False


_TOUCHING = 500.0  # N: less is no task, but what is left of the estimate in free motion
# of stiffness [kN/m], damping [kN s/m], mass [t] and offset [kN] before any data
_SPREAD = (3e3, 3e3, 30.0, 30.0)
_FORGET = 0.99  # per sample: some two seconds at 50 Hz
_RESET = 8.0  # times the usual error


class TaskImpedance:
    """Recursive least squares of `F = -(K x + B v + M a + c)` along every task coordinate.

    Force, place, rate and acceleration go through the same filters, so that they are equally late.

    Attributes:
        stiffness: (k,) K [N/m], [N m/rad]; 0 while nothing is touched.
        damping: (k,) B [N s/m], [N m s/rad].
        mass: (k,) M [kg], [kg m^2].
    """

    def __init__(
        self, coordinates: int, period: float, bandwidths: tuple[float, ...], *, late: bool
    ) -> None:
        """Begin with a free task.

        Args:
            coordinates: their number, k.
            period: between two samples [s].
            bandwidths: of the filters, one after the other [Hz].
            late: whether the force comes through these filters already.
        """
        self.stiffness, self.damping = np.zeros(coordinates), np.zeros(coordinates)
        self.mass = np.zeros(coordinates)
        self._fits: list[RecursiveLeastSquares | None] = [None] * coordinates
        self._origin = np.zeros(coordinates)
        self._tables = [filter_table(bandwidth, period) for bandwidth in bandwidths]
        self._place = np.full((len(bandwidths), coordinates, 4), np.nan)
        self._force = None if late else self._place.copy()

    def update(self, force: np.ndarray, pose: np.ndarray) -> None:
        """Take in one sample.

        Args:
            force: (k,) of the environment on the tip [N], [N m].
            pose: (k,) of the tip [m], [rad]; a sample that is not finite is left out.

        Source: Zhu 1994, 3.73-3.76 (mass, damping, stiffness; forgetting and resetting).
        """
        if not (np.isfinite(force).all() and np.isfinite(pose).all()):
            return
        for c in range(len(force)):
            motion = self._filtered(self._place, c, pose[c])
            felt = force[c]
            if self._force is not None:
                felt = self._filtered(self._force, c, force[c])[0]
            self._fit(c, felt, *motion)

    def _filtered(self, states: np.ndarray, c: int, reading: float) -> tuple[float, float, float]:
        """The reading's low-pass with two derivatives; filters stand at the first one."""
        for table, state in zip(self._tables, states[:, c], strict=True):
            if np.isnan(state[LOW]):
                state[:] = 0.0
                state[LOW] = state[LAST] = reading
            filter_step(table, state, float(reading))
            reading, rate, change = state[LOW], state[RATE], state[CHANGE]
        return reading, rate, change

    def _fit(self, c: int, force: float, place: float, rate: float, change: float) -> None:
        """One equation of one coordinate."""
        if not abs(force) > _TOUCHING:
            self._fits[c] = None
            self.stiffness[c] = self.damping[c] = self.mass[c] = 0.0
            return
        fit = self._fits[c]
        if fit is None:
            self._origin[c] = place
            fit = self._fits[c] = RecursiveLeastSquares(
                np.zeros(4), np.array(_SPREAD), forgetting=_FORGET, reset=_RESET
            )
        fit.update(np.array([place - self._origin[c], rate, change, 1.0]), -force / 1e3)
        self.stiffness[c] = max(0.0, 1e3 * fit.value[0])
        self.damping[c] = max(0.0, 1e3 * fit.value[1])
        self.mass[c] = max(0.0, 1e3 * fit.value[2])
