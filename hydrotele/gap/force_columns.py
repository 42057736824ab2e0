"""Effects of mechanisms as groups of columns of the regression (`gap.force_evidence`).

Columns and places are those of `gap.mechanism_columns`; an effect is a `Hypothesis` whose parameters have priors.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects.effect import Parameter
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.gap.mechanism_columns import (
    _ASIDE,
    _MOST,
    _NONE,
    _NOTABLE,
    _SECOND,
    LEAST,
    TYPICAL,
    Columns,
    Key,
    _Builder,
    _point,
)
from hydrotele.multibody.chain import Chain

_LATE_STEP = 0.02  # s, typical delay of a sensor, and its largest change from round to round


@dataclass(frozen=True)
class ForceEffect(Hypothesis):
    """An effect at a joint, a drive, a body, `force` or `base`, as a combination of columns.

    Attributes:
        columns: those that it acts through.
        coefficients: (p,) parameter values -> (c,) what they add to the given model along the columns.
        variant: number of the form, where there are several.
        interval: start and duration of a pulse [s].
    """

    columns: tuple[str, ...] = ()
    coefficients: Callable[[np.ndarray], np.ndarray] = lambda values: values
    variant: int = 0
    interval: tuple[float, float] | None = None


def force_effects(
    chain: Chain, columns: Columns, nominal: Mapping[str, float],
    applied: Mapping[Key, np.ndarray],
) -> list[ForceEffect]:  # fmt: skip
    """All effects that can show in some runs.

    Args:
        chain: the given mechanism.
        columns: of the runs.
        nominal: parameter of the regressor -> its given value.
        applied: sensor effect -> its numbers, where they are taken off the readings.

    Returns:
        The effects. Those that move no drive's force are left out.
    """
    build = _ForceBuilder(chain, columns, nominal, applied)
    out = [*build.joints(), *build.bodies(), *build.sensors()]
    return [one for one in out if isinstance(one, ForceEffect)]


class _ForceBuilder(_Builder):
    def linear(
        self, name: str, place: str, parameter: str, column: str, unit: str, nominal: float = 0.0,
        low: float = -np.inf, variant: int = 0,
    ) -> ForceEffect | None:  # fmt: skip
        facts = self.number(column, unit, nominal, low)
        if facts is None:
            return None
        return ForceEffect(
            name, place, {parameter: facts}, None, (column,), lambda p: p - nominal, variant,
        )  # fmt: skip

    def spring(self, drive: str) -> ForceEffect | None:
        force, length, _, _ = self.units(drive)
        j = self.chain.index(drive)
        stiff, rest = float(self.chain.stiffness[j]), float(self.chain.spring_rest[j])
        middle, travel, _ = self.columns.sizes.get(drive, (rest, 1.0, 1.0))
        facts = self.number(f"spring.{drive}", f"{force}/{length}", stiff, 0.0)
        if facts is None:
            return None
        centre = rest if stiff else middle
        slack = Parameter(length, centre, centre - 3 * travel, centre + 3 * travel, travel, 0.0)

        def coefficients(p: np.ndarray) -> np.ndarray:
            return np.array([p[0] - stiff, p[0] * (middle - p[1]) - stiff * (middle - rest)])

        start = stiff + facts.prior_std
        facts = replace(facts, start_values=(start, start, start))
        slack = replace(slack, start_values=(centre, centre - travel, centre + travel))
        return ForceEffect(
            "joint_spring", drive, {"stiffness": facts, "rest": slack}, None,
            (f"spring.{drive}", f"offset.{drive}"), coefficients,
        )  # fmt: skip

    def payload(self, body, names, mass, centre, size) -> ForceEffect | None:
        move = max(self.strength[n] for n in names[1:4])
        share = max(self.strength[names[0]], move * size)
        if share < _NONE:
            return None
        scale = TYPICAL / share
        aside = np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])  # where a load is looked for, in radii of gyration
        loads = tuple(sign * scale for sign in (1.0, -1.0) for _ in aside)
        load = Parameter("kg", 0.0, -0.9 * mass, _MOST * scale, scale, LEAST / share, loads)
        place = {
            axis: Parameter("m", c, c - 3.0 * size, c + 3.0 * size, size, 0.0, tuple(c + size * way) * 2)
            for axis, c, way in zip("xyz", centre.tolist(), aside.T, strict=True)
        }

        def coefficients(p: np.ndarray) -> np.ndarray:
            return np.concatenate([[p[0]], p[0] * p[1:], p[0] * _point(p[1:])])

        return ForceEffect("payload", body, {"mass": load, **place}, None, names, coefficients)

    def move_mass(self, body, names, mass, centre, size) -> ForceEffect | None:
        share = mass * max(self.strength[n] for n in names[:3])
        if share < _NONE:
            return None
        scale = min(TYPICAL / share, _ASIDE * size)
        way = Parameter("m", 0.0, -2.0 * size, 2.0 * size, scale, LEAST / share)

        def coefficients(p: np.ndarray) -> np.ndarray:
            change = mass * (_point(centre + p) - _point(centre))
            return np.concatenate([mass * p, change])

        return ForceEffect("com_offset", body, dict.fromkeys("xyz", way), None, names, coefficients)

    def turn_inertia(self, body, names, own) -> ForceEffect | None:
        upper = own[np.triu_indices(3)]
        share = max(self.strength[n] * abs(x) for n, x in zip(names, upper, strict=True))
        if share < _NONE:
            return None
        scale = min(TYPICAL / share, 1.0)
        least = min(LEAST / share, _NOTABLE)
        ratio = Parameter("1", 1.0, 0.05, 1.0 + _MOST * scale, scale, least)
        return ForceEffect("inertia_error", body, {"ratio": ratio}, None, names, lambda p: (p[0] - 1.0) * upper)

    def delay(self, name: str, place: str, column: str, low: float) -> ForceEffect | None:
        facts = self.number(column, "s")
        if facts is None:
            return None
        known = float(self.applied.get((name, place), [0.0])[0])
        reach = min(facts.prior_std, _LATE_STEP)  # its column is a small difference: it holds near the known delay
        facts = Parameter(
            "s", 0.0, max(low, known - reach), min(_SECOND, known + reach), reach, facts.min_relevant_change
        )
        return ForceEffect(name, place, {"delay": facts}, None, (column,))

    def scale(self, drive: str) -> ForceEffect | None:
        column = f"scale.force.{drive}"
        if self.number(column, "1") is None:
            return None
        known = float(self.applied.get(("force_scale", drive), [1.0])[0])
        facts = Parameter("1", 1.0, 0.2, 5.0, 0.2, LEAST)
        return ForceEffect(
            "force_scale",
            drive,
            {"scale": facts},
            None,
            (column,),
            lambda p: (p - 1.0) / known,
        )

    def tilt(self) -> ForceEffect | None:
        share = max(self.strength["tilt.x"], self.strength["tilt.y"])
        if share < _NONE:
            return None
        way = Parameter("rad", 0.0, -0.3, 0.3, 0.03, LEAST / share)
        return ForceEffect("base_tilt", "base", {"x": way, "y": way}, None, ("tilt.x", "tilt.y"))
