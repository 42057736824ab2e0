"""Result types of an identification, and its parameters as table rows for reports and files."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hydrotele.identify.estimation import Estimate
from hydrotele.identify.identifiability import (
    COMBINATION,
    FULL,
    UNIDENTIFIABLE,
    WEAK,
    Identifiability,
)


@dataclass(frozen=True)
class HeldOut:
    """Prediction error of one drive's force on the held-out run, in the band of the equations.

    Attributes:
        rms: RMS of measured minus predicted force [N] or [N m].
        unit: unit of the force.
        noise_rms: RMS error of a perfect model with these sensors; NaN if unknown.
        relative: RMS error over RMS force [1].
        nominal_rms: RMS error with the given parameters.
    """

    rms: float
    unit: str
    noise_rms: float
    relative: float
    nominal_rms: float


@dataclass(frozen=True)
class Forces:
    """Forces of the held-out run in the band of the equations: n rows, k drives [N] or [N m].

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
        told: parameters that these data determine despite noise.
        structure: parameters that this motion determines without noise.
        estimate: estimate of the base parameters `told`, with covariance and residuals.
        bias: (r,) bias caused by position noise, already subtracted.
        heldout: drive -> prediction error of the held-out run.
        forces: forces of the held-out run.
        band: band of the equations [Hz].
        whiteness: drive -> correlation of successive residuals.
        status: `ok`, or a sentence that names the problem and the remedy.
        notes: notes, one sentence each.
        seconds: computing time [s].
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: np.ndarray
    value: np.ndarray
    told: Identifiability
    structure: Identifiability
    estimate: Estimate
    bias: np.ndarray
    heldout: dict[str, HeldOut]
    forces: Forces
    band: float
    whiteness: dict[str, float]
    status: str
    notes: tuple[str, ...]
    seconds: float

    def distance(self, value: np.ndarray) -> tuple[float, float]:
        """Test whether other parameters lie in the confidence ellipsoid of the estimate.

        Args:
            value: (m,) parameters.

        Returns:
            The squared Mahalanobis distance from the estimate, and the limit below which 95 % of
            true parameters lie.
        """
        limit = float(chi2.ppf(0.95, self.estimate.rank))
        return self.estimate.ellipsoid(self.told.combination @ value), limit


STATUSES = (UNIDENTIFIABLE, COMBINATION, FULL, WEAK)
MEANING = {
    UNIDENTIFIABLE: "has no effect on the measured forces in this motion",
    COMBINATION: "identifiable only in combination with other parameters",
    FULL: "identifiable individually",
    WEAK: "affects the forces by less than the noise in these data: given value kept",
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
        status: see `MEANING`.
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
    """Return the table rows of all parameters in their order.

    Args:
        found: the identification.

    Returns:
        The rows; values only for parameters that these data determine.
    """
    told = {int(b): k for k, b in enumerate(found.told.base)}
    given = found.told.combination @ found.nominal
    rows = []
    for m, name in enumerate(found.names):
        status, unit, nominal = found.told.status[m], found.units[m], float(found.nominal[m])
        if m in told:
            k = told[m]
            low, high = found.estimate.ci95[k]
            text = found.told.text(k) if status == COMBINATION else ""
            rows.append(ParameterRow(
                name, unit, float(given[k]), float(found.estimate.value[k]),
                float(found.estimate.std[k]), (float(low), float(high)), status, text,
                float(found.bias[k]),
            ))  # fmt: skip
            continue
        part_of = [found.names[b] for b, row in zip(found.told.base, found.told.combination,
                                                    strict=True) if row[m] != 0.0]  # fmt: skip
        text = f"in {', '.join(part_of)}" if part_of else ""
        rows.append(ParameterRow(name, unit, nominal, None, None, None, status, text))
    return rows


def counts(rows: list[ParameterRow]) -> dict[str, int]:
    """Count the parameters of each status."""
    return {status: sum(row.status == status for row in rows) for status in STATUSES}
