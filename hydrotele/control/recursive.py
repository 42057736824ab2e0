"""Recursive least squares with forgetting and resetting."""

import numpy as np

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
