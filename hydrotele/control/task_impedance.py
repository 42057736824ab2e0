"""Online identification of stiffness, damping and mass of the task during contact.

`RecursiveLeastSquares` estimates parameters with forgetting and covariance resetting.
`TaskImpedance` applies it to the force and position of the tip.
"""

import numpy as np

from hydrotele.control.state_filter import (
    LAST_READING,
    RATE,
    SECOND_DERIVATIVE,
    VALUE,
    filter_step,
    filter_step_matrix,
)
from hydrotele.core.errors import InputError

_ERROR_CONTEXT = "recursive least squares"


class RecursiveLeastSquares:
    """Recursive least squares for `y = phi . theta` with regressor phi and parameters theta.

    A forgetting factor below 1 reduces the weight of old equations, so that parameters may drift.
    Without excitation, forgetting would increase the covariance without limit. Its trace is
    therefore limited to the initial trace. A prediction error larger than `reset_ratio` times its
    usual size resets the covariance to its initial value.

    Attributes:
        value: (p,) present parameters theta.
        covariance: (p, p) their covariance, relative to the variance of the equations' error.
        resets: number of resets of the covariance.
    """

    def __init__(
        self, start: np.ndarray, initial_std: np.ndarray, *, forgetting: float = 1.0,
        reset_ratio: float = np.inf,
    ):  # fmt: skip
        """Set the initial parameters and their covariance.

        Args:
            start: (p,) initial parameters.
            initial_std: (p,) their standard deviations, relative to that of the equations' error.
            forgetting: forgetting factor per equation, above 0, at most 1.
            reset_ratio: multiple of the usual prediction error (RMS of recent equations) above
                which the covariance is reset, above 1.

        Raises:
            InputError: sizes do not match or a value is invalid.
        """
        self.value, initial_std = np.array(start, float), np.array(initial_std, float)
        if self.value.ndim != 1 or initial_std.shape != self.value.shape or not np.all(initial_std > 0.0):
            raise InputError(
                _ERROR_CONTEXT,
                f"{len(self.value)} parameters need as many standard deviations, all above 0",
            )
        if not 0.0 < forgetting <= 1.0:
            raise InputError(_ERROR_CONTEXT, f"forgetting must be above 0 and at most 1: {forgetting}")
        if not reset_ratio > 1.0:
            raise InputError(_ERROR_CONTEXT, f"reset must be above 1, got {reset_ratio}")
        self.covariance = np.diag(initial_std**2)
        self.resets = 0
        self._initial_covariance, self._max_trace = (
            self.covariance.copy(),
            float(np.trace(self.covariance)),
        )
        self._forgetting, self._reset_ratio = forgetting, reset_ratio
        self._mean_square_error, self._count = 0.0, 0

    def update(self, row: np.ndarray, measured: float) -> float:
        """Update the parameters with one equation; skip it if it is not finite.

        Args:
            row: (p,) regressor phi.
            measured: measured value y.

        Returns:
            The prediction error before the update; NaN if the equation was skipped.

        Source: Ljung 1999, System identification, 11.2 (forgetting); Zhu 1994, 3.74 and 6.1.
        """
        row = np.asarray(row, float)
        if not (np.isfinite(row).all() and np.isfinite(measured)):
            return float("nan")
        error = float(measured - row @ self.value)
        if self._detect_sudden_change(error):
            self.covariance = self._initial_covariance.copy()
            self.resets, self._mean_square_error, self._count = self.resets + 1, 0.0, 0
        way = self.covariance @ row
        gain = way / (self._forgetting + row @ way)
        self.value = self.value + gain * error
        wider = (self.covariance - np.outer(gain, way)) / self._forgetting
        if np.trace(wider) <= self._max_trace:
            self.covariance = 0.5 * (wider + wider.T)
        else:
            self.covariance = self.covariance - np.outer(gain, way)
        return error

    def _detect_sudden_change(self, error: float) -> bool:
        """Return whether a prediction error exceeds `reset_ratio` times its usual size; otherwise update this size.

        The usual size is the RMS of the previous errors, with more weight for the last 50. During
        the first 5 p equations of p parameters, the result is always False.
        """
        known = self._count >= 5 * len(self.value)
        if known and error**2 > self._reset_ratio**2 * self._mean_square_error:
            return True
        self._count += 1
        share = max(1.0 / self._count, 0.02)
        if self._count > 2 * len(self.value):  # the first errors depend on the initial parameters
            self._mean_square_error += share * (error**2 - self._mean_square_error)
        return False


_MIN_CONTACT_FORCE_N = 500.0  # N, smallest contact force: above the error of the estimate in free motion
# initial standard deviations of stiffness [kN/m], damping [kN s/m], mass [t] and offset [kN]
_INITIAL_STD = (3e3, 3e3, 30.0, 30.0)
_FORGETTING_FACTOR = 0.99  # forgetting factor per sample: about two seconds at 50 Hz
_RESET_ERROR_RATIO = 8.0  # multiple of the usual error that resets the covariance


class TaskImpedance:
    """Online estimator of stiffness K, damping B and mass M of the environment along every task coordinate.

    The model is `F = -(K x + B v + M a + c)` with force F, displacement x since contact, velocity v,
    acceleration a and offset c.

    Force, position, rate and acceleration pass the same filters, so that they have equal delay.

    Attributes:
        stiffness: (k,) K [N/m], [N m/rad]; 0 without contact.
        damping: (k,) B [N s/m], [N m s/rad]; 0 without contact.
        mass: (k,) M [kg], [kg m^2]; 0 without contact.
    """

    def __init__(
        self,
        coordinates: int,
        period: float,
        bandwidths: tuple[float, ...],
        *,
        force_is_filtered: bool,
    ) -> None:
        """Prepare the filters, and set all estimates to 0, as without contact.

        Args:
            coordinates: number k of task coordinates.
            period: time between two samples [s].
            bandwidths: bandwidths of the filters in series [Hz].
            force_is_filtered: whether the force has already passed these filters.
        """
        self.stiffness, self.damping = np.zeros(coordinates), np.zeros(coordinates)
        self.mass = np.zeros(coordinates)
        self._fits: list[RecursiveLeastSquares | None] = [None] * coordinates
        self._origin = np.zeros(coordinates)
        self._tables = [filter_step_matrix(bandwidth, period) for bandwidth in bandwidths]
        self._position_states = np.full((len(bandwidths), coordinates, 4), np.nan)
        self._force_states = None if force_is_filtered else self._position_states.copy()

    def update(self, force: np.ndarray, pose: np.ndarray) -> None:
        """Update stiffness, damping and mass with one sample of force and pose; skip a sample that is not finite.

        Args:
            force: (k,) force of the environment on the tip [N], [N m].
            pose: (k,) pose of the tip [m], [rad].

        Source: Zhu 1994, 3.73-3.76 (mass, damping, stiffness; forgetting and resetting).
        """
        if not (np.isfinite(force).all() and np.isfinite(pose).all()):
            return
        for c in range(len(force)):
            motion = self._filter_reading(self._position_states, c, pose[c])
            felt = force[c]
            if self._force_states is not None:
                felt = self._filter_reading(self._force_states, c, force[c])[0]
            self._update_coordinate_fit(c, felt, *motion)

    def _filter_reading(self, states: np.ndarray, c: int, reading: float) -> tuple[float, float, float]:
        """Pass a reading of coordinate c through all filters in series.

        The filters start at rest at the first reading. `states` (filters, k, 4) is updated.

        Returns:
            (filtered value, its first and its second time derivative).
        """
        for table, state in zip(self._tables, states[:, c], strict=True):
            if np.isnan(state[VALUE]):
                state[:] = 0.0
                state[VALUE] = state[LAST_READING] = reading
            filter_step(table, state, float(reading))
            reading, rate, change = state[VALUE], state[RATE], state[SECOND_DERIVATIVE]
        return reading, rate, change

    def _update_coordinate_fit(self, c: int, force: float, position: float, rate: float, acceleration: float) -> None:
        """Update stiffness, damping and mass along coordinate c with one sample; set them to 0 without contact.

        A force of at most 500 N or N m means no contact. The sample gives one equation of the model
        in the class docstring. At the start of a contact the estimation starts anew, with
        displacement 0. Negative estimates are replaced by 0.
        """
        if not abs(force) > _MIN_CONTACT_FORCE_N:
            self._fits[c] = None
            self.stiffness[c] = self.damping[c] = self.mass[c] = 0.0
            return
        fit = self._fits[c]
        if fit is None:
            self._origin[c] = position
            fit = self._fits[c] = RecursiveLeastSquares(
                np.zeros(4),
                np.array(_INITIAL_STD),
                forgetting=_FORGETTING_FACTOR,
                reset_ratio=_RESET_ERROR_RATIO,
            )
        fit.update(np.array([position - self._origin[c], rate, acceleration, 1.0]), -force / 1e3)
        self.stiffness[c] = max(0.0, 1e3 * fit.value[0])
        self.damping[c] = max(0.0, 1e3 * fit.value[1])
        self.mass[c] = max(0.0, 1e3 * fit.value[2])
