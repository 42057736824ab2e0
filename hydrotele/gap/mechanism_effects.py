"""Effects that a mechanism can have and its model can lack: names, places, numbers, columns."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects.effect import Parameter
from hydrotele.gap.mechanism_columns import STRIBECK, Columns
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.regressor import BODY_PARAMETERS

SENTENCES = {
    "coulomb_friction": "another Coulomb friction of a joint",
    "viscous_friction": "another viscous friction of a joint",
    "stribeck_friction": "extra friction of a drive near rest",
    "friction_asymmetry": "viscous friction that is larger in one direction of a drive",
    "speed_dependent_force": "resistance that grows with the square of the speed",
    "joint_spring": "a spring in a drive's joint",
    "drive_inertia": "another inertia of a drive",
    "payload": "a mass on a body that the model does not have there (negative: one too much)",
    "com_offset": "a body's centre of mass lies elsewhere",
    "inertia_error": "a body's moments of inertia about its centre of mass are others",
    "base_tilt": "the base does not stand level",
    "force_offset": "a constant in a drive's force: an offset of its sensor, or a constant load",
    "force_scale": "a force sensor with another scale",
    "force_delay": "a force sensor that reads late",
    "angle_offset": "a position sensor that is mounted askew",
    "length_offset": "a position sensor with an offset",
    "angle_delay": "a position sensor that reads late",
    "length_delay": "a position sensor that reads late",
    "clock_offset": "all forces read late against the positions (negative: the positions do)",
}
TYPICAL, LEAST = 0.3, 0.01  # share of a drive's force RMS that an effect moves, typically; at least
_MOST = 20.0  # times the typical size, where a search ends
_FORM = 0.2  # of a drive's dry friction, which its form near rest may change
_NONE = 1e-9  # share that has no effect
_ASIDE = 0.3  # of its radius of gyration that a body's centre of mass is aside, typically
_NOTABLE = 0.2  # of a body's moments of inertia that is worth naming, little as forces may change
_SECOND = 0.1  # s, beyond which no sensor is late

Key = tuple[str, str]


@dataclass(frozen=True)
class MechanismEffect:
    """An effect at a place.

    Attributes:
        name: see `SENTENCES`.
        location: a joint, a drive, a body, `force` or `base`.
        parameters: name -> number, with its prior (`scale` about `start`) and its bounds.
        columns: those that it acts through.
        coefficients: (p,) parameters -> (c,) what they add to the given model along the columns.
        start: (p,) mean of the prior.
        variant: number of the form, where there are several.
    """

    name: str
    location: str
    parameters: Mapping[str, Parameter]
    columns: tuple[str, ...]
    coefficients: Callable[[np.ndarray], np.ndarray]
    start: np.ndarray
    variant: int = 0

    @property
    def key(self) -> Key:
        """Name and place."""
        return self.name, self.location

    @property
    def scale(self) -> np.ndarray:
        """(p,) standard deviations of the prior."""
        return np.array([one.scale for one in self.parameters.values()])

    @property
    def low(self) -> np.ndarray:
        """(p,) smallest values."""
        return np.array([one.low for one in self.parameters.values()])

    @property
    def high(self) -> np.ndarray:
        """(p,) largest values."""
        return np.array([one.high for one in self.parameters.values()])


def strengths(columns: Columns) -> np.ndarray:
    """(m,) share of a drive's force RMS that a unit of each column moves, of the drive most so."""
    force = np.sqrt(np.mean(columns.measured**2, axis=0))
    moved = np.sqrt(np.mean(columns.matrix**2, axis=0))
    return (moved / np.maximum(force, 1e-12)[:, None]).max(axis=0)


def mechanism_effects(
    chain: Chain, columns: Columns, nominal: Mapping[str, float],
    applied: Mapping[Key, np.ndarray],
) -> list[MechanismEffect]:  # fmt: skip
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
    return [one for one in out if one is not None]


def undone(columns: Columns, applied: Mapping[Key, np.ndarray], name_of: Mapping[Key, str]):
    """Columns whose readings have the sensors' defects again, to the first order.

    What is taken off the readings thus stays a question: columns are those about the numbers found
    so far, and the gap is that of the readings as they are.

    Args:
        columns: of readings from which defects are taken off.
        applied: effect -> its numbers.
        name_of: effect -> its column.

    Returns:
        The columns.
    """
    value = {}
    for key, numbers in applied.items():
        known = float(numbers[0])
        back = known if key[0] != "force_scale" else 1.0 - 1.0 / known
        value[name_of[key]] = -back
    return columns.moved(value)


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
    ) -> MechanismEffect | None:  # fmt: skip
        facts = self.number(column, unit, nominal, low)
        if facts is None:
            return None
        return MechanismEffect(
            name, place, {parameter: facts}, (column,), lambda p: p - nominal, np.array([nominal]),
            variant,
        )  # fmt: skip

    def units(self, joint: str) -> tuple[str, str, str, str]:
        """Of force, position, rate and inertia of a joint or a closure."""
        straight = joint in self.chain.joints and self.chain.tree.slides[self.chain.index(joint)]
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

    def sliding(self, one: MechanismEffect) -> MechanismEffect:
        """Stribeck's effect, not worth naming below a part of dry friction.

        The form of that near rest (sticking, presliding) is never known as well as far from it.
        """
        (facts,) = one.parameters.values()
        least = max(facts.least, _FORM * self.nominal.get(f"coulomb.{one.location}", 0.0))
        return replace(one, parameters={"stribeck": replace(facts, least=least)})

    def spring(self, drive: str) -> MechanismEffect | None:
        force, length, _, _ = self.units(drive)
        j = self.chain.index(drive)
        stiff, rest = float(self.chain.stiffness[j]), float(self.chain.rest[j])
        middle, travel, _ = self.columns.sizes.get(drive, (rest, 1.0, 1.0))
        facts = self.number(f"spring.{drive}", f"{force}/{length}", stiff, 0.0)
        if facts is None:
            return None
        centre = rest if stiff else middle
        slack = Parameter(length, centre, centre - 3 * travel, centre + 3 * travel, travel, 0.0)

        def coefficients(p: np.ndarray) -> np.ndarray:
            return np.array([p[0] - stiff, p[0] * (middle - p[1]) - stiff * (middle - rest)])

        return MechanismEffect(
            "joint_spring", drive, {"stiffness": facts, "rest": slack},
            (f"spring.{drive}", f"offset.{drive}"), coefficients, np.array([stiff, centre]),
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
            yield self.moved(body, names[1:], mass, centre, size)
            own = about - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
            yield self.turned(body, names[4:], own)

    def payload(self, body, names, mass, centre, size) -> MechanismEffect | None:
        move = max(self.strength[n] for n in names[1:4])
        share = max(self.strength[names[0]], move * size)
        if share < _NONE:
            return None
        scale = TYPICAL / share
        load = Parameter("kg", 0.0, -0.9 * mass, _MOST * scale, scale, LEAST / share)
        place = {
            axis: Parameter("m", c, c - 3.0 * size, c + 3.0 * size, size, 0.0)
            for axis, c in zip("xyz", centre.tolist(), strict=True)
        }

        def coefficients(p: np.ndarray) -> np.ndarray:
            return np.concatenate([[p[0]], p[0] * p[1:], p[0] * _point(p[1:])])

        return MechanismEffect(
            "payload", body, {"mass": load, **place}, names, coefficients,
            np.concatenate([[0.0], centre]),
        )  # fmt: skip

    def moved(self, body, names, mass, centre, size) -> MechanismEffect | None:
        share = mass * max(self.strength[n] for n in names[:3])
        if share < _NONE:
            return None
        scale = min(TYPICAL / share, _ASIDE * size)
        way = Parameter("m", 0.0, -2.0 * size, 2.0 * size, scale, LEAST / share)

        def coefficients(p: np.ndarray) -> np.ndarray:
            change = mass * (_point(centre + p) - _point(centre))
            return np.concatenate([mass * p, change])

        return MechanismEffect(
            "com_offset", body, dict.fromkeys("xyz", way), names, coefficients, np.zeros(3)
        )

    def turned(self, body, names, own) -> MechanismEffect | None:
        upper = own[np.triu_indices(3)]
        share = max(self.strength[n] * abs(x) for n, x in zip(names, upper, strict=True))
        if share < _NONE:
            return None
        scale = min(TYPICAL / share, 1.0)
        least = min(LEAST / share, _NOTABLE)
        ratio = Parameter("1", 1.0, 0.05, 1.0 + _MOST * scale, scale, least)
        return MechanismEffect(
            "inertia_error", body, {"ratio": ratio}, names, lambda p: (p[0] - 1.0) * upper,
            np.ones(1),
        )  # fmt: skip

    def sensors(self):
        """Defects of sensors, and the base."""
        for drive in self.chain.drives:
            force = self.units(drive)[0]
            yield self.linear("force_offset", drive, "offset", f"offset.{drive}", force)
            yield self.scale(drive)
            yield self.late("force_delay", drive, f"delay.force.{drive}", 0.0)
        yield self.late("clock_offset", "force", "delay.force", -_SECOND)
        for joint in self.columns.sizes:
            unit, kind = self.units(joint)[1], "length" if self.units(joint)[1] == "m" else "angle"
            column = f"offset.position.{joint}"
            yield self.linear(f"{kind}_offset", joint, "offset", column, unit)
            yield self.late(f"{kind}_delay", joint, f"delay.position.{joint}", 0.0)
        yield self.tilt()

    def late(self, name: str, place: str, column: str, low: float) -> MechanismEffect | None:
        facts = self.number(column, "s")
        if facts is None:
            return None
        facts = Parameter("s", 0.0, low, _SECOND, min(facts.scale, 0.02), facts.least)
        return MechanismEffect(name, place, {"delay": facts}, (column,), lambda p: p, np.zeros(1))

    def scale(self, drive: str) -> MechanismEffect | None:
        column = f"scale.force.{drive}"
        if self.number(column, "1") is None:
            return None
        known = float(self.applied.get(("force_scale", drive), [1.0])[0])
        facts = Parameter("1", 1.0, 0.2, 5.0, 0.2, LEAST)
        return MechanismEffect(
            "force_scale",
            drive,
            {"scale": facts},
            (column,),
            lambda p: (p - 1.0) / known,
            np.ones(1),
        )

    def tilt(self) -> MechanismEffect | None:
        share = max(self.strength["tilt.x"], self.strength["tilt.y"])
        if share < _NONE:
            return None
        way = Parameter("rad", 0.0, -0.3, 0.3, 0.03, LEAST / share)
        return MechanismEffect(
            "base_tilt", "base", {"x": way, "y": way}, ("tilt.x", "tilt.y"), lambda p: p,
            np.zeros(2),
        )  # fmt: skip


def _point(place: np.ndarray) -> np.ndarray:
    """Inertia (6,) of a unit mass at a place, about the origin."""
    x, y, z = place
    return np.array([y * y + z * z, -x * y, -x * z, x * x + z * z, -y * z, x * x + y * y])


def _matrix(upper: np.ndarray) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = upper
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
