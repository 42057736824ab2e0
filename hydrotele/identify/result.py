"""What an identification found.

An identification, parameter by parameter, as reports and files have it.
"""

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
    """Force of one drive on the run that was not fitted, in the band of the equations.

    Attributes:
        rms: of measured less predicted force [N] or [N m].
        unit: its unit.
        noise_rms: what a perfect model would show with these sensors; NaN if not known.
        relative: the error's norm over the force's [1].
        nominal_rms: the same as rms, with the given parameters.
    """

    rms: float
    unit: str
    noise_rms: float
    relative: float
    nominal_rms: float


@dataclass(frozen=True)
class Forces:
    """Forces of the held-out run in the band of the equations; n rows, k drives [N] or [N m].

    Attributes:
        run: its name.
        drives: the k drives.
        time: (n,) [s] from its start.
        measured: (n, k), NaN where unknown.
        predicted: (n, k) with the identified parameters.
        nominal: (n, k) with the given parameters.
    """

    run: str
    drives: tuple[str, ...]
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True)
class Identification:
    """Result; m parameters, r of them in the base.

    Attributes:
        names: the m parameters.
        units: (m,) SI units.
        nominal: (m,) as given.
        value: (m,) identified; what the data do not tell stays as given.
        told: what these data tell in spite of their noise.
        structure: what this motion would tell without noise, and the base parameters.
        estimate: of the base parameters, with covariance and residuals.
        bias: (r,) that the positions' noise would have left in them, taken off.
        heldout: drive -> prediction of the held-out run.
        forces: of the held-out run.
        band: of the equations [Hz].
        whiteness: drive -> correlation of a residual with the one before it.
        status: `ok`, or what is wrong and what to do about it.
        notes: one sentence each.
        seconds: that it took.
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
        """How far other parameters are from the estimate: the test by its confidence ellipsoid.

        Args:
            value: (m,) parameters.

        Returns:
            Squared distance in standard deviations, and what 95 % of right ones stay below.
        """
        limit = float(chi2.ppf(0.95, self.estimate.rank))
        return self.estimate.ellipsoid(self.told.combination @ value), limit


STATUSES = (UNIDENTIFIABLE, COMBINATION, FULL, WEAK)
MEANING = {
    UNIDENTIFIABLE: "has no effect on the measured forces in this motion",
    COMBINATION: "only a combination with others shows in the forces",
    FULL: "is told by itself",
    WEAK: "would show in the forces, but less than noise does in these data: kept as given",
}


@dataclass(frozen=True)
class ParameterRow:
    """One parameter.

    Attributes:
        name: such as `mass.boom`.
        unit: SI.
        nominal: as given; of a combination its value with the given parameters.
        value: identified; of a combination that stands behind this name, the combination's; None
            where these data do not tell it.
        std: its standard deviation, or None.
        ci95: its 95 % interval, or None.
        status: see `MEANING`.
        combination: the combination that stands behind this name, or those that the parameter is
            part of; empty where there is none.
        bias: that noise of the positions would have left in the value, taken off; or None.
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
    """Rows of all parameters, in their order.

    Args:
        found: the identification.

    Returns:
        The rows; numbers only where these data tell them.
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
    """Status -> number of parameters."""
    return {status: sum(row.status == status for row in rows) for status in STATUSES}
