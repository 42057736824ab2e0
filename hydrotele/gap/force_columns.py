"""Effects of mechanisms as groups of columns of the regression (`gap.force_evidence`).

Columns and places are those of `gap.mechanism_columns`; an effect is a `Hypothesis` whose parameters have priors.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects.effect import Parameter
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.gap.mechanism_columns import LEAST, STRIBECK, TYPICAL, Columns, Key, strengths
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.regressor import BODY_PARAMETERS

SENTENCES = {
    "coulomb_friction": "different Coulomb friction of a joint",
    "viscous_friction": "different viscous friction of a joint",
    "stribeck_friction": "additional friction of a drive near zero velocity",
    "friction_asymmetry": "viscous friction that depends on the direction of a drive",
    "speed_dependent_force": "resistance proportional to the square of the speed",
    "joint_spring": "a spring in the joint of a drive",
    "drive_inertia": "different inertia of a drive",
    "payload": "an additional mass on a body (negative: the mass of the model is too large)",
    "com_offset": "an offset of a body's centre of mass",
    "inertia_error": "different moments of inertia of a body about its centre of mass",
    "base_tilt": "a tilt of the base",
    "force_pulse": "a constant force on a drive for a limited time in one run",
    "force_offset": "a constant in a drive's force: an offset of its sensor, or a constant load",
    "force_scale": "a scale error of a force sensor",
    "force_delay": "a delay of a force sensor",
    "angle_offset": "an offset of an angle sensor",
    "length_offset": "an offset of a position sensor",
    "angle_delay": "a delay of an angle sensor",
    "length_delay": "a delay of a position sensor",
    "clock_offset": "a delay of all forces relative to the positions (negative: of the positions)",
}
_MOST = 20.0  # times the typical size, where a search ends
_FORM = 0.2  # of a drive's dry friction, which its form near rest may change
_NONE = 1e-9  # share that has no effect
_ASIDE = 0.3  # of its radius of gyration that a body's centre of mass is aside, typically
_NOTABLE = 0.2  # of a body's moments of inertia that is worth naming, little as forces may change
_SECOND = 0.1  # s, beyond which no sensor is late
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
    build = _Builder(chain, columns, nominal, applied)
    out = [*build.joints(), *build.bodies(), *build.sensors()]
    return [one for one in out if isinstance(one, ForceEffect)]


class _Builder:
    def __init__(self, chain: Chain, columns: Columns, nominal, applied) -> None:
        self.chain, self.columns, self.nominal, self.applied = chain, columns, nominal, applied
        self.strength = dict(zip(columns.names, strengths(columns), strict=True))

    def number(
        self, column: str, unit: str, nominal: float = 0.0, low: float = -np.inf,
        factor: float = 1.0,
    ) -> Parameter | None:  # fmt: skip
        """A parameter of which a unit adds `factor` along a column; None without effect."""
        share = self.strength.get(column, 0.0) * abs(factor)
        if share < _NONE:
            return None
        scale = TYPICAL / share
        return Parameter(
            unit, nominal, max(low, nominal - _MOST * scale), nominal + _MOST * scale, scale,
            LEAST / share,
        )  # fmt: skip

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

    def units(self, joint: str) -> tuple[str, str, str, str]:
        """Of force, position, rate and inertia of a joint or a closure."""
        straight = joint in self.chain.joints and self.chain.tree.is_slide[self.chain.index(joint)]
        return ("N", "m", "m/s", "kg") if straight else ("N m", "rad", "rad/s", "kg m^2")

    def joints(self):
        """Friction, springs and inertia."""
        for place in (*self.chain.joints, *self.chain.closures):
            force, length, _, inertia = self.units(place)
            for name, kind, unit, low in (
                ("coulomb_friction", "coulomb", force, 0.0),
                ("viscous_friction", "viscous", f"{force} s/{length}", 0.0),
                ("friction_asymmetry", "viscous_asymmetry", f"{force} s/{length}", -np.inf),
                ("speed_dependent_force", "quadratic", f"{force} s^2/{length}^2", 0.0),
                ("drive_inertia", "drive_inertia", inertia, 0.0),
            ):
                if kind == "drive_inertia" and place not in self.chain.drives:
                    continue
                column = f"{kind}.{place}"
                given = self.nominal.get(column, 0.0)
                yield self.linear(name, place, kind, column, unit, given, min(low, given))
            if place not in self.chain.drives:
                continue
            for variant in range(len(STRIBECK)):
                one = self.linear(
                    "stribeck_friction", place, "stribeck", f"stribeck{variant}.{place}", force,
                    0.0, 0.0, variant,
                )  # fmt: skip
                yield one and self.sliding(one)
            yield self.spring(place)

    def sliding(self, one: ForceEffect) -> ForceEffect:
        """Stribeck's effect, not worth naming below a part of dry friction.

        The form of that near rest (sticking, presliding) is never known as well as far from it.
        """
        (facts,) = one.parameters.values()
        least = max(facts.min_relevant_change, _FORM * self.nominal.get(f"coulomb.{one.location}", 0.0))
        return replace(one, parameters={"stribeck": replace(facts, min_relevant_change=least)})

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

    def bodies(self):
        """Payload, centre of mass and inertia."""
        for k, body in enumerate(self.chain.bodies):
            names = tuple(f"{kind}.{body}" for kind in BODY_PARAMETERS)
            if any(name not in self.strength for name in names):
                continue
            given = self.chain.inertia[k]
            mass = float(given[0])
            about = _matrix(given[4:])
            centre = given[1:4] / mass if mass > 0.0 else np.zeros(3)
            size = float(np.sqrt(max(np.trace(about), 0.0) / (2.0 * mass))) if mass > 0.0 else 0.0
            size = max(size, 0.02)  # m
            yield self.payload(body, names, mass, centre, size)
            if mass <= 0.0:
                continue
            yield self.move_mass(body, names[1:], mass, centre, size)
            own = about - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
            yield self.turn_inertia(body, names[4:], own)

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

    def sensors(self):
        """Defects of sensors, and the base."""
        for drive in self.chain.drives:
            force = self.units(drive)[0]
            yield self.linear("force_offset", drive, "offset", f"offset.{drive}", force)
            yield self.scale(drive)
            yield self.delay("force_delay", drive, f"delay.force.{drive}", 0.0)
        yield self.delay("clock_offset", "force", "delay.force", -_SECOND)
        for joint in self.columns.sizes:
            unit, kind = self.units(joint)[1], "length" if self.units(joint)[1] == "m" else "angle"
            column = f"offset.position.{joint}"
            yield self.linear(f"{kind}_offset", joint, "offset", column, unit)
            yield self.delay(f"{kind}_delay", joint, f"delay.position.{joint}", 0.0)
        yield self.tilt()

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


def _point(place: np.ndarray) -> np.ndarray:
    """Inertia (6,) of a unit mass at a place, about the origin."""
    x, y, z = place
    return np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])


def _matrix(upper: np.ndarray) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = upper
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
