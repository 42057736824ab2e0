"""Result types of an identification, and its parameters as table rows for reports and files."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hydrotele.identify.friction import FrictionForce
from hydrotele.identify.identifiability import (
    STATUS_COMBINATION,
    STATUS_FULL,
    STATUS_UNIDENTIFIABLE,
    STATUS_WEAK,
    Identifiability,
)
from hydrotele.identify.linear_least_squares import Estimate
from hydrotele.multibody.regressor import is_friction_deviation


@dataclass(frozen=True)
class HeldOutError:
    """Prediction error of one drive's force on the held-out run.

    Both forces are low-pass filtered to the frequency band of the identification equations.

    Attributes:
        rms: RMS of measured minus predicted force [N] or [N m].
        unit: unit of the force.
        noise_rms: RMS error of a perfect model with these sensors; NaN if unknown.
        relative_error: RMS error over RMS force [1].
        nominal_rms: RMS error with the given parameters.
        is_explained: whether the identified model predicts the force better than zero force does, by more than
            two standard deviations of the difference.
        rest_fraction: fraction of the compared rows in which the drive is at rest [1].
        rest_friction: Coulomb friction [N] or [N m]; at rest, friction is any force within plus and minus this value.
        excess_rms: RMS error beyond that interval; equal to `rms` if the drive is never at rest.
    """

    rms: float
    unit: str
    noise_rms: float
    relative_error: float
    nominal_rms: float
    is_explained: bool
    rest_fraction: float
    rest_friction: float
    excess_rms: float


@dataclass(frozen=True)
class HeldOutForces:
    """Forces of the held-out run, low-pass filtered: n rows, k drives [N] or [N m].

    Attributes:
        run: name of the run.
        drives: names of the k drives.
        time: (n,) time from the start of the run [s].
        measured: (n, k) measured forces, NaN where unknown.
        predicted: (n, k) forces predicted with the identified parameters.
        nominal: (n, k) forces predicted with the given parameters.
    """

    run: str
    drives: tuple[str, ...]
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True)
class Identification:
    """Result of an identification: m parameters, r base parameters.

    Attributes:
        names: names of the m parameters.
        units: (m,) SI units.
        nominal: (m,) given values.
        value: (m,) identified values; undetermined combinations keep their given values.
        data_identifiability: parameters that these data determine despite noise.
        motion_identifiability: parameters that this motion determines without noise.
        estimate: estimate of the base parameters `data_identifiability`, with covariance and residuals.
        bias: (r,) bias caused by position noise, already subtracted.
        heldout: drive -> prediction error of the held-out run.
        friction: friction force of the drives at round speeds, deviations near zero speed included.
        forces: forces of the held-out run.
        band: band of the equations [Hz].
        residual_autocorrelation: drive -> correlation of successive residuals.
        status: `ok`, or a sentence that names the problem and the remedy.
        notes: notes, one sentence each.
        seconds: computing time [s].
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    value: np.ndarray
    data_identifiability: Identifiability
    motion_identifiability: Identifiability
    estimate: Estimate
    bias: np.ndarray
    heldout: dict[str, HeldOutError]
    friction: tuple[FrictionForce, ...]
    forces: HeldOutForces
    band: float
    residual_autocorrelation: dict[str, float]
    status: str
    notes: tuple[str, ...]
    seconds: float

    @property
    def explains_force(self) -> bool:
        """Whether the identified model predicts the held-out force of any drive better than zero force does.

        True also if no held-out force is known.
        """
        return not self.heldout or any(h.is_explained for h in self.heldout.values())

    def squared_distance(self, value: np.ndarray) -> tuple[float, float]:
        """Test whether other parameters lie in the confidence ellipsoid of the estimate.

        Deviations of the friction near zero speed are marginalised.

        Args:
            value: (m,) parameters.

        Returns:
            The squared Mahalanobis distance from the estimate, and the limit below which 95 % of
            true parameters lie.
        """
        told = self.data_identifiability
        kept = np.array([not is_friction_deviation(self.names[b]) for b in told.base])
        estimate = replace(
            self.estimate, value=self.estimate.value[kept], covariance=self.estimate.covariance[np.ix_(kept, kept)],
            rank=min(self.estimate.rank, int(kept.sum())),
        )  # fmt: skip
        limit = float(chi2.ppf(0.95, estimate.rank))
        return estimate.squared_distance((told.combination @ value)[kept]), limit


STATUSES = (STATUS_UNIDENTIFIABLE, STATUS_COMBINATION, STATUS_FULL, STATUS_WEAK)
STATUS_DESCRIPTIONS = {
    STATUS_UNIDENTIFIABLE: "has no effect on the measured forces in this motion",
    STATUS_COMBINATION: "identifiable only in combination with other parameters",
    STATUS_FULL: "identifiable individually",
    STATUS_WEAK: "affects the forces by less than the noise in these data: given value kept",
}


@dataclass(frozen=True)
class ParameterRow:
    """Table row of one parameter.

    Attributes:
        name: name, such as `mass.boom`.
        unit: SI unit.
        nominal: given value; for a combination its value with the given parameters.
        value: identified value, of the combination if the name represents one; None if these data
            do not determine it.
        std: standard deviation, or None.
        ci95: 95 % interval, or None.
        status: whether the parameter is identifiable, one of the keys of `STATUS_DESCRIPTIONS`.
        combination: the combination that the name represents, or those that contain the parameter;
            empty if there is none.
        bias: bias caused by position noise, already subtracted from the value; or None.
    """

    name: str
    unit: str
    nominal: float
    value: float | None
    std: float | None
    ci95: tuple[float, float] | None
    status: str
    combination: str
    bias: float | None = None


def parameter_rows(found: Identification) -> list[ParameterRow]:
    """Return the table rows of all parameters in their order, without deviations of friction near zero speed.

    Args:
        found: the identification.

    Returns:
        The rows; values only for parameters that these data determine.
    """
    told = {int(b): k for k, b in enumerate(found.data_identifiability.base)}
    given = found.data_identifiability.combination @ found.nominal
    rows = []
    for m, name in enumerate(found.names):
        if is_friction_deviation(name):
            continue
        status, unit, nominal = (
            found.data_identifiability.status[m],
            found.units[m],
            float(found.nominal[m]),
        )
        if m in told:
            k = told[m]
            low, high = found.estimate.ci95[k]
            text = found.data_identifiability.format_combination(k) if status == STATUS_COMBINATION else ""
            rows.append(ParameterRow(
                name, unit, float(given[k]), float(found.estimate.value[k]),
                float(found.estimate.std[k]), (float(low), float(high)), status, text,
                float(found.bias[k]),
            ))  # fmt: skip
            continue
        part_of = [found.names[b] for b, row in zip(found.data_identifiability.base,
        found.data_identifiability.combination,
                                                    strict=True) if row[m] != 0.0]  # fmt: skip
        text = f"in {', '.join(part_of)}" if part_of else ""
        rows.append(ParameterRow(name, unit, nominal, None, None, None, status, text))
    return rows


def count_statuses(rows: list[ParameterRow]) -> dict[str, int]:
    """Return status -> number of parameters: unidentifiable, combination, full or weak."""
    return {status: sum(row.status == status for row in rows) for status in STATUSES}
