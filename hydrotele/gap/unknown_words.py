"""An unknown disagreement in a formula and in a mechanic's words."""

import math

import numpy as np

from hydrotele.gap.customary import amount
from hydrotele.gap.unknown_fit import Explained, Fitted
from hydrotele.gap.unknown_laws import Verdict
from hydrotele.gap.unknown_target import Target
from hydrotele.machine import Machine
from hydrotele.signals import parse_channel

_MEGA = 1e6
_CHANNELS = {
    "angle": "angle", "position": "position", "length": "cylinder length",
    "pressure_head": "head side pressure", "pressure_rod": "rod side pressure",
    "pressure_supply": "supply pressure", "rate": "speed", "command": "command",
    "acceleration": "acceleration", "return": "return flow of all axes", "valve_head": "valve flow",
    "valve_rod": "valve flow", "time": "time",
}  # fmt: skip

_LAWS = {
    "force": "the forces", "flow_head": "the head side flow", "flow_rod": "the rod side flow",
    "closure": "length against angle", "supply": "the pressure",
}  # fmt: skip


def channel_law(channel: str) -> str:
    """The law that errors of a channel suggest where no balance tells it: `flow` or `motion`."""
    kind = parse_channel(channel).kind
    if kind == "pressure_supply":
        return "supply"
    return "flow" if kind.startswith("pressure") else "motion"


def depends_on(told: Explained, target: Target) -> tuple[str, ...]:
    """Names of the signals that the terms depend on, the most telling first."""
    names = []
    for fitted in told.terms:
        term = fitted.term
        silent = set(term.silent) - {"d"}
        names += [_shown(target.roles[r]) for r in term.roles if r not in silent]
    return tuple(dict.fromkeys(names))


def term_text(machine: Machine, verdict: Verdict, told: Explained, target: Target) -> str | None:
    """The terms as a formula, such as `force.stick: 8.7 kN * sign(rate.stick)`; None without."""
    if not told.terms:
        return None
    subject = {
        "sensor": f"error of pressure_{verdict.side}.{verdict.place}",
        "supply": "pump flow",
        "geometry": f"length.{verdict.place} - length from its angle",
    }.get(verdict.law, f"{verdict.balance}.{verdict.place}")
    parts = []
    for fitted in told.terms:
        size, phase = _size(fitted.coefficients)
        names = _names(machine, verdict, target) | {"phase": f"{phase:.2f}"}
        formula = fitted.term.formula.format(*_numbers(machine, verdict.place, fitted), **names)
        unit = fitted.term.unit or target.unit
        per = _per(machine, verdict.place, fitted.term.per)
        said = amount(size, unit) + (f" per {per}" if per else "")
        parts.append(f"{said} * {formula}" if formula else said)
    return f"{subject}: {' + '.join(parts)}"


def law_words(machine: Machine, verdict: Verdict, told: Explained, target: Target) -> str:
    """One paragraph for a mechanic."""
    texts = [_broken(verdict)]
    for fitted in told.terms:
        texts.append(_sentence(machine, verdict, fitted, target))
    if told.terms:
        share = 100.0 * max(0.0, told.heldout_share)
        texts.append(
            f"This explains {share:.0f} % of what is left of that balance in the run that was not"
            " fitted."
        )
    elif verdict.law != "timing":
        texts.append("No simple dependence on position, speed, pressure, command or time holds up.")
    if verdict.others and not verdict.everywhere:
        places = [f"{_LAWS[law]} of the {place}" for law, place in verdict.others]
        texts.append(f"Also off: {', '.join(places)}.")
    if verdict.everywhere:
        texts.append(
            "The flows of all axes are off, so look for one cause for all: the oil, the tank line,"
            " the pump."
        )
    return " ".join(texts)


def bare_words(
    machine: Machine, channel: str, depends: tuple[str, ...], told: Explained | None = None
) -> str:
    """What can be said from a channel's prediction errors alone."""
    text = (
        f"The {_plain(channel)} does not follow the model's predictions, but no balance of forces"
        " or flows tells why: it is over too fast to be seen in one, or channels are missing."
    )
    if depends:
        text += f" The errors go with {' and '.join(_plain(name) for name in depends)}."
    place = parse_channel(channel).axis
    for fitted in told.terms if told else ():
        words = fitted.term.words.format(
            *_numbers(machine, place, fitted), said="", more="", side="", place=place, gains="",
            **_units(machine, place),
        )  # fmt: skip
        if fitted.term.units and not words[0].isupper():
            text += f" They look like something that acts {words}."
    return text


def _broken(verdict: Verdict) -> str:
    times = f"{verdict.excess:.1f} times as large as the sensors' noise explains"
    place = verdict.place
    return {
        "force": f"The forces at the {place} drive do not balance: what is left is {times}.",
        "flow": f"The oil of the {place} drive does not add up: what is left is {times}.",
        "supply": "The supply pressure is not what valves and pump should make of it: the"
        f" difference is {times}.",
        "geometry": f"Length and angle of the {place} do not belong together: the difference is"
        f" {times}.",
        "timing": f"The {place} does not move when its valve lets oil through: the lag is {times}.",
        "sensor": f"The {_side(verdict)} pressure sensor of the {place} contradicts both the forces"
        f" and the flows there, which are {times}.",
    }[verdict.law]  # fmt: skip


def _sentence(machine: Machine, verdict: Verdict, fitted: Fitted, target: Target) -> str:
    size, _ = _size(fitted.coefficients)
    term = fitted.term
    more = "more" if size > 0 else "less"
    said = amount(abs(size), term.unit or target.unit)
    side = "rod" if verdict.balance == "flow_rod" else "head"
    words = term.words.format(
        *_numbers(machine, verdict.place, fitted), said=said, more=more, side=side,
        place=verdict.place, gains="gains" if size > 0 else "loses",
        **_units(machine, verdict.place),
    )  # fmt: skip
    if words[0].isupper():
        return f"{words}."
    if len(fitted.coefficients) == 2:
        said, more = f"up to {said}", "more or less"
    head = {
        "force": f"The {verdict.place} drive needs {said} {more} {_push(target)} than the model"
        " says,",
        "flow": f"Into the {side} side of the {verdict.place} goes {said} {more} oil than the model"
        " says,",
        "supply": f"The pump delivers {said} {more} than the model says,",
        "geometry": f"The length reads {said} {more} than the angle says,",
        "sensor": f"The sensor reads {said} too {'high' if size > 0 else 'low'},",
    }.get(verdict.law, f"{said} {more},")  # fmt: skip
    return f"{head} {words}."


def _push(target: Target) -> str:
    return "torque" if target.unit == "N m" else "force"


def _side(verdict: Verdict) -> str:
    return f"{verdict.side} side"


def _size(coefficients: np.ndarray) -> tuple[float, float]:
    """Coefficient, or amplitude and phase [rad] of a sine and a cosine."""
    if len(coefficients) == 1:
        return float(coefficients[0]), 0.0
    return float(np.hypot(*coefficients)), math.atan2(coefficients[1], coefficients[0])


def _numbers(machine: Machine, place: str, fitted: Fitted) -> list[str]:
    """The parameters of a term with their units."""
    texts = []
    for value, unit in zip(fitted.parameters, fitted.term.units, strict=True):
        if unit == "x":
            texts.append(amount(value, _length_unit(machine, place)))
        elif unit == "MPa":
            texts.append(amount(value * _MEGA, "Pa"))
        elif unit == "Hz":
            texts.append(f"{value:.3g} Hz")
        elif unit == "1/rad":
            texts.append(f"{value:.3g}")
        else:
            texts.append(amount(value, unit))
    return texts


def _names(machine: Machine, verdict: Verdict, target: Target) -> dict[str, str]:
    return {**target.roles, **_units(machine, verdict.place)}


def _units(machine: Machine, place: str) -> dict[str, str]:
    unit = _length_unit(machine, place)
    return {"x_unit": unit, "v_unit": f"{unit}/s"}


def _per(machine: Machine, place: str, per: str) -> str:
    unit = _length_unit(machine, place)
    return {
        "x": unit, "v": f"{unit}/s", "v^2": f"({unit}/s)^2", "v/s": f"{unit}/s^2", "v s": unit,
    }.get(per, per)  # fmt: skip


def _length_unit(machine: Machine, place: str) -> str:
    axis = machine.axes.get(place)
    if axis is None or axis.cylinder or machine.position_kind(place) == "position":
        return "m"
    return "rad"


def _shown(name: str) -> str:
    """A signal by a channel-like name that people know."""
    kind, _, axis = name.partition(".")
    shown = {
        "change_head": "pressure_head", "change_rod": "pressure_rod", "valve_head": "command",
        "valve_rod": "command", "opened_head": "command", "opened_rod": "command",
        "drained_head": "pressure_head", "drained_rod": "pressure_rod",
    }.get(kind, kind)  # fmt: skip
    return f"{shown}.{axis}" if axis else shown


def _plain(name: str) -> str:
    kind, _, axis = name.partition(".")
    words = _CHANNELS.get(kind, kind.replace("_", " "))
    return f"{axis} {words}".strip() if axis else words
