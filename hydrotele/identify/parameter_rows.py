"""An identification, parameter by parameter, as reports and files have it."""

from dataclasses import dataclass

from hydrotele.identify.identifiability import COMBINATION, FULL, UNIDENTIFIABLE, WEAK
from hydrotele.identify.result import Identification

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
