"""The hierarchical answer of the gap search: place, family and law with probabilities that add up.

Each accepted effect, its rivals and "none of them" are exclusive explanations of one part of the gap. Their
probabilities are summed over the family of the effect and over its place. The answer is the deepest level that is
sure enough.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydrotele.effects import EFFECTS
from hydrotele.gap.result import SURE, VARIES, NamedEffect

LEVELS = ("place", "family", "law")
"""The levels of an answer, from the first to the deepest."""

FAMILIES: Mapping[str, tuple[str, ...]] = {
    "friction": (
        "coulomb_friction", "viscous_friction", "stribeck_friction", "friction_asymmetry", "presliding",
        "load_dependent_friction", "position_dependent_friction", "speed_dependent_force", "warming",
        "oil_viscosity",
    ),
    "leakage": ("internal_leakage", "tank_leakage", "orifice_leakage"),
    "compliance": ("hose_compliance", "bulk_modulus", "entrained_air", "joint_flexibility", "backlash", "joint_spring"),
    "inertia": ("com_offset", "inertia_error", "payload", "base_tilt", "drive_inertia"),
    "sensor": (
        "force_offset", "force_scale", "force_delay", "angle_offset", "length_offset", "angle_delay", "length_delay",
        "clock_offset",
    ),
    "external force": ("external_force", "force_pulse", "periodic_force", "end_stop_stiffness"),
}  # fmt: skip
"""Family -> names of effects, where the part of the model that an effect changes is not its family."""


def base_effect(name: str) -> str:
    """Return the library effect of an effect whose coefficient varies (`EFFECT_by_VARIABLE`), or the name itself."""
    base = name.partition(VARIES)[0]
    return base if base in EFFECTS else name


def family_of(name: str) -> str:
    """Return the family of an effect: one of `FAMILIES`, else the part of the model that it changes.

    A coefficient that varies is of the same family; a learned law is none of a library effect.

    >>> family_of("coulomb_friction_by_position"), family_of("angle_offset"), family_of("valve_deadband")
    ('friction', 'sensor', 'valve')
    """
    name = base_effect(name)
    for family, names in FAMILIES.items():
        if name in names:
            return family
    return EFFECTS[name].model_part if name in EFFECTS else "unknown"


@dataclass(frozen=True)
class Explanation:
    """A law at a place, with its probability.

    Attributes:
        name: of the effect.
        location: where it acts.
        probability: that it is this law there.
    """

    name: str
    location: str
    probability: float

    @property
    def place(self) -> str:
        """The axis or part of the machine, without the side of a cylinder."""
        return self.location.partition(".")[0]


@dataclass(frozen=True)
class Answer:
    """What explains one part of the gap, at three levels.

    Attributes:
        explanations: exclusive laws, the most probable first; with `none` they add up to 1.
        none: probability that none of them is right.
    """

    explanations: tuple[Explanation, ...]
    none: float

    def places(self) -> dict[str, float]:
        """Return place -> probability, the most probable first."""
        return _sum((e.place, e.probability) for e in self.explanations)

    def families(self, place: str) -> dict[str, float]:
        """Return family -> probability at a place, the most probable first."""
        return _sum((family_of(e.name), e.probability) for e in self.explanations if e.place == place)

    @property
    def level(self) -> tuple[str, ...]:
        """The deepest of (place, family, law) that reaches `SURE`; empty if not even the place does."""
        best = self.explanations[0]
        family = family_of(best.name)
        chances = (
            self.places()[best.place],
            self.families(best.place)[family],
            best.probability,
        )
        names = (best.place, family, best.name)
        return tuple(n for k, n in enumerate(names) if all(c >= SURE for c in chances[: k + 1]))


def _sum(pairs: Any) -> dict[str, float]:
    table: dict[str, float] = {}
    for key, value in pairs:
        table[key] = table.get(key, 0.0) + value
    return dict(sorted(table.items(), key=lambda item: -item[1]))


def answer_of(effect: NamedEffect) -> Answer:
    """Return the hierarchical answer of a named effect and its alternatives."""
    found = [Explanation(effect.name, effect.location, effect.probability)]
    found += [Explanation(a.name, a.location, a.probability) for a in effect.alternatives]
    found.sort(key=lambda e: -e.probability)
    return Answer(tuple(found), max(0.0, 1.0 - sum(e.probability for e in found)))


def answer_document(effects: Sequence[NamedEffect]) -> list[dict[str, Any]]:
    """Return the answers as plain data: per effect the sure level, places, families and laws."""
    documents = []
    for effect in effects:
        answer = answer_of(effect)
        place = answer.explanations[0].place
        documents.append({
            "sure": list(answer.level),
            "places": answer.places(),
            "families": answer.families(place),
            "laws": {f"{e.name} {e.location}": e.probability for e in answer.explanations},
            "none": answer.none,
        })  # fmt: skip
    return documents


def answer_words(effect: NamedEffect) -> str:
    """Say which level is sure where the law is not; empty where it is.

    >>> answer_words(NamedEffect("coulomb_friction", "boom", 0.97, {}))
    ''
    """
    answer = answer_of(effect)
    level = answer.level
    if len(level) == len(LEVELS):
        return ""
    known = ", ".join(f"{kind} {name}" for kind, name in zip(LEVELS, level, strict=False))
    laws = ", ".join(f"{e.name} {e.location} {100.0 * e.probability:.0f} %" for e in answer.explanations)
    if not known:
        return f"No location of {effect.name} reaches {100.0 * SURE:.0f} %. Laws: {laws}."
    return f"Determined with at least {100.0 * SURE:.0f} %: {known}. Laws: {laws}."
