"""Judge one answer: pure functions of a key and a `gap.json` document."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

from hydrotele.gap.answer import base_effect

DETECTABLE = 10.0
"""Least visibility (root of the summed squares over all samples and channels of the fit runs) at
which an effect counts as detectable: 5 is the limit of a test that knows what to look for."""
SURE = 0.5  # probability above which something outside the library must never be named

Document = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What one trial came to.

    Attributes:
        trial: its name.
        kind: its class.
        truth: `name(location)` of what was planted, sorted; empty for a clean machine.
        answer: the same of what was named; else the verdict, or `failed`.
        verdict: the workflow's own word, or `failed`.
        right: whether the answer counts as right for its class.
        found: how many of the planted effects were named, or stand in an ambiguous set.
        visible: least visibility of what was planted, None for a clean machine.
        weak: whether it is below what can be detected.
        beliefs: (probability, whether it was planted) of every named effect.
        covered: (parameter, value, low, high, truth) of every effect named rightly.
        before: the gap of the given model on the held-out run.
        after: that of the patched model.
        floor: the noise floor that the workflow states.
        seconds: what the search took.
        error: why there is no answer.
    """

    trial: str
    kind: str
    truth: tuple[str, ...]
    answer: tuple[str, ...]
    verdict: str
    right: bool
    found: int
    visible: float | None
    weak: bool
    beliefs: tuple[tuple[float, bool], ...]
    covered: tuple[tuple[str, float, float, float, float], ...]
    before: float | None
    after: float | None
    floor: float | None
    seconds: float | None
    error: str | None = None


def is_among(name: str, location: str, pairs: Collection[tuple[str, str]]) -> bool:
    """Return whether a named effect, or the one whose varying coefficient it is, is among (name, location) pairs.

    >>> is_among("coulomb_friction_by_position", "stick", [("coulomb_friction", "stick")])
    True
    """
    return (name, location) in pairs or (base_effect(name), location) in pairs


def judge(key: Document, result: Document) -> Verdict:
    """Compare the key of a trial with the workflow's answer.

    Args:
        key: what was planted.
        result: the trial's result; `answer` is a `gap.json` document or None.

    Returns:
        The verdict. Right is: for one or two effects, that exactly as many are named as were
        planted and each planted one is among them, or in the ambiguous set of one of them; for a
        clean machine, that the answer is `no_gap`; for an effect outside the library, that the
        answer is `unknown` or `learned` and nothing is named with more than 50 %, or that a force pulse is named as
        such.
    """
    planted = {_label(e): e for e in key["effects"]}
    sizes = [e["visibility"]["total_fit_runs"] for e in key["effects"]]
    visible = min(sizes, default=None)
    answer = result["answer"] or {}
    named = [_with_base(e, planted) for e in answer.get("effects", [])]
    verdict = answer.get("verdict", "failed")
    found = _found(planted, named, verdict == "ambiguous")
    match key["class"]:
        case "clean":
            right = verdict == "no_gap" and not named
        case "outside":
            right = verdict in ("unknown", "learned") and all(e["probability"] <= SURE for e in named)
            right |= _is_pulse(key["effects"], named)
        case _:
            right = verdict in ("named", "ambiguous") and len(named) == len(planted) == len(found)
    gap = answer.get("gap", {})
    return Verdict(
        trial=result["trial"], kind=key["class"], truth=tuple(sorted(planted)),
        answer=tuple(sorted(map(_label, named))) or (verdict,), verdict=verdict, right=right,
        found=len(found), visible=visible, weak=visible is not None and visible < DETECTABLE,
        beliefs=tuple((e["probability"], _label(e) in planted) for e in named),
        covered=tuple(x for e in named if _label(e) in planted
                      for x in _intervals(planted[_label(e)], e)),
        before=gap.get("before"), after=gap.get("after"), floor=gap.get("noise_floor"),
        seconds=answer.get("seconds"), error=result["error"],
    )  # fmt: skip


def _is_pulse(planted: list[Document], named: list[Document]) -> bool:
    """Return whether a planted force pulse is named, in each run apart."""
    places = {e["location"].rpartition(".")[0] for e in named if e["name"] == "force_pulse"}
    is_alone = all(e["name"] == "force_pulse" for e in named)
    return is_alone and places == {e["location"] for e in planted if e["name"] == "pulse"} and bool(places)


def _with_base(effect: Document, planted: Mapping[str, Any]) -> Document:
    """Return a named effect whose coefficient varies under the name of the effect, if that is planted there."""
    base = {**effect, "name": base_effect(effect["name"])}
    return base if _label(base) in planted else effect


def _label(effect: Document) -> str:
    return f"{effect['name']}({effect['location']})"


def _found(planted: Mapping[str, Any], named: list[Document], ambiguous: bool) -> set[str]:
    """Planted effects that are named; in an ambiguous answer each name stands for its set."""
    found = {_label(e) for e in named} & planted.keys()
    if ambiguous:
        for effect in named:
            if _label(effect) not in planted:
                others = {_label(a) for a in effect["alternatives"]}
                found |= set(sorted(others & (planted.keys() - found))[:1])
    return found


def _intervals(planted: Document, named: Document):
    for name, parameter in named["parameters"].items():
        low, high = parameter["ci95"]
        if name in planted["parameters"] and None not in (parameter["value"], low, high):
            truth = planted["parameters"][name]["value"]
            yield f"{_label(named)}.{name}", parameter["value"], low, high, truth
