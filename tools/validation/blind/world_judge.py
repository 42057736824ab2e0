"""Judge and score the trials on the independent machine; pure functions.

Fixed before any trial was run:

- An effect counts as named with the probability that the answer gives it, in an answer whose
  verdict is `named` or `partly`; nothing is named in any other.
- A planted part is found if an effect is named that stands in its list of right ones (name and
  place; `tools/validation/blind/forms.py` has the lists of other forms, a library effect has
  itself) with a probability above one half.
- A trial with something planted is right if every planted part is found; it is led right if the
  surest named effect is one of the right ones; it is clean of false names if none above one half
  stands in no list.
- A trial with nothing planted is right if nothing is named. With wrong numbers a named effect is
  false, too, even where its number is indeed off: that is what calibration is for. How many of
  these intervals hold the true number is said apart.
- Added on 22 November 2026, after trials had been seen: "told" counts a planted part, too, whose
  numbers are uncertain ones of the machine and stand in its calibration with intervals that hold
  the truth and not all the model's values; a pump that gives 6 % less where all numbers are off by
  up to 10 % is such a number. It changes none of the other columns.
- Since 23 November 2026 an effect that is planted beside wrong numbers is drawn anew where all its
  numbers are uncertain ones of the machine and differ by less than three of their standard
  deviations: by what the machine states, that is no effect. `redrawn` in the key names them.
- Since 26 November 2026, after trials 0010 of 711 and 0004 of 722: an offset centre of mass and an
  inertia of a link that turns about a vertical axis are one effect under two names, and either is
  right (`same` in the answers).
- Something outside the library is right if no effect of the library has more than one half, in any
  verdict.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np

from tools.validation.blind.judge import is_among
from tools.validation.blind.score import share

Document = Mapping[str, Any]
LIKELY = 0.5
_NAMING = ("named", "partly")
_CLEAR = 0.02  # rise of the one-step error over its floor from which a gap can be closed
_CLEAR_FREE = 0.2  # the same over 5 s, where a perfect model has 1.07: its start is uncertain


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one trial came to.

    Attributes:
        trial: its name.
        kind: its kind.
        planted: `name(place)` of every planted part.
        answer: `name(place) probability` of every effect in the answer.
        verdict: the workflow's word, or `failed`.
        right: see the module.
        found: whether each planted part was found.
        led: whether the surest named effect is right.
        false: how many effects above one half are in no list.
        surest: largest probability of any effect, in any verdict.
        covered: whether each stated interval of a named effect holds its true number.
        told: whether each planted part is found or, being uncertain numbers of the machine,
            calibrated: intervals that hold the true numbers and not the model's.
        calibrated: whether each interval of a calibrated number holds the true one.
        one_step: share of the gap that is closed for one-step predictions, None without a gap.
        open_loop: the same over 5 s; 0 of an outsider without an answer.
        seconds: that the search says it took.
        memory: peak of its process [bytes].
        visible: least visibility of what was planted.
    """

    trial: str
    kind: str
    planted: tuple[str, ...]
    answer: tuple[str, ...]
    verdict: str
    right: bool
    found: tuple[bool, ...]
    led: bool
    false: int
    surest: float
    covered: tuple[bool, ...]
    told: tuple[bool, ...]
    calibrated: tuple[bool, ...]
    one_step: float | None
    open_loop: float | None
    seconds: float | None
    memory: float | None
    visible: float | None


def judge_world(key: Document, result: Document) -> Outcome:
    """Compare a trial's key with the workflow's answer.

    Args:
        key: what was planted.
        result: the trial's result; `answer` is a `gap.json` document or None.

    Returns:
        The outcome.
    """
    answer = result["answer"] or {}
    effects = answer.get("effects", [])
    verdict = answer.get("verdict", "failed")
    naming = effects if verdict in _NAMING else []
    likely = [(e["name"], e["location"]) for e in naming if e["probability"] > LIKELY]
    lists = [[tuple(pair) for pair in part["right"]] for part in key["planted"]]
    everything = {pair for pairs in lists for pair in pairs}
    found = tuple(any(is_among(*pair, pairs) for pair in likely) for pairs in lists)
    surest = max(naming, key=lambda e: e["probability"], default=None)
    led = surest is not None and is_among(surest["name"], surest["location"], everything)
    false = sum(not is_among(*pair, everything) for pair in likely)
    top = max((e["probability"] for e in effects), default=0.0)
    if key["kind"] == "outside":
        right = verdict != "failed" and top <= LIKELY
    elif key["planted"]:
        right = all(found)
    else:
        right = verdict not in ("failed", *_NAMING)
    gap, free = answer.get("gap", {}), answer.get("open_loop", {})
    open_loop = closed(free.get("before"), free.get("after"), 1.0, _CLEAR_FREE)
    if key["kind"] == "outside" and not answer:
        open_loop = 0.0
    return Outcome(
        trial=result["trial"], kind=key["kind"],
        planted=tuple(f"{p['name']}({p['location']})" for p in key["planted"]),
        answer=tuple(f"{e['name']}({e['location']}) {e['probability']:.2f}" for e in effects),
        verdict=verdict, right=right, found=found, led=led, false=false, surest=top,
        covered=tuple(_covered(key, naming)),
        told=tuple(
            own or _told(key, answer, part) for own, part in zip(found, key["planted"], strict=True)
        ),
        calibrated=tuple(_calibrated(key, answer)),
        one_step=closed(gap.get("before"), gap.get("after"), gap.get("noise_floor")),
        open_loop=open_loop,
        seconds=answer.get("seconds"), memory=answer.get("memory_bytes"),
        visible=min((p["visibility"] for p in key["planted"]), default=None),
    )  # fmt: skip


def closed(before: float | None, after: float | None, floor: float | None, clear: float = _CLEAR) -> float | None:
    """Share of a gap that is closed, in mean squares above the floor; None where there is no gap.

    A model that got worse has a negative share; one that diverged, -1.

    >>> closed(3.0, 1.0, 1.0), closed(1.0, 1.0, 1.0), closed(2.0, 2.0, 1.0)
    (1.0, None, 0.0)
    """
    if before is None or floor is None or before - floor < clear:
        return None
    if after is None:
        return -1.0
    return max(-1.0, (before**2 - after**2) / (before**2 - floor**2))


def _calibrated(key: Document, answer: Document):
    """Of every calibrated number that the key tells: does its interval hold the true one?"""
    for number, found in answer.get("calibration", {}).items():
        name, _, rest = number.partition(".")
        place, _, parameter = rest.rpartition(".")
        truth = key["truth"].get(f"{name}({place})", {})
        if parameter in truth:
            yield found["ci95"][0] <= truth[parameter] <= found["ci95"][1]


def _told(key: Document, answer: Document, part: Document) -> bool:
    """Whether calibration tells a planted part: all numbers, and one that is not the model's."""
    truth = key["truth"].get(f"{part['name']}({part['location']})", {})
    moved, table = False, answer.get("calibration", {})
    for parameter in part["parameters"]:
        found = table.get(f"{part['name']}.{part['location']}.{parameter}")
        if found is None or parameter not in truth:
            return False
        low, high = found["ci95"]
        if not low <= truth[parameter] <= high:
            return False
        moved |= not low <= found["nominal"] <= high
    return moved


def _covered(key: Document, named: Sequence[Document]):
    """Of every effect whose true numbers the key tells: does its interval hold them?"""
    planted = {f"{p['name']}({p['location']})": p["parameters"] for p in key["planted"]
               if [p["name"], p["location"]] in p["right"]}  # fmt: skip
    for effect in named:
        label = f"{effect['name']}({effect['location']})"
        truth = key["truth"].get(label, {})
        if label not in planted and key["kind"] != "off":
            continue  # not planted: its truth is the model's, and naming it is an error of its own
        for name, parameter in effect["parameters"].items():
            low, high = parameter["ci95"]
            if name in truth and None not in (low, high):
                yield low <= truth[name] <= high


def score_world(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Rates with Wilson's intervals, closures, times and memory, by kind.

    Args:
        outcomes: of the finished trials; `noise`, `off`, `coloured` and `drift` are split by whether something was
            planted.

    Returns:
        Row name -> figures (see `TABLE`), and `targets`: what is asked, its value, whether reached.
    """
    groups: dict[str, list[Outcome]] = {}
    for o in outcomes:
        planted = "" if o.kind not in ("noise", "off", "coloured", "drift") else ", planted" if o.planted else ", bare"
        groups.setdefault(o.kind + planted, []).append(o)
    rows = {name: _row(chosen) for name, chosen in sorted(groups.items())}
    return {"rows": rows, "targets": _targets(rows, groups)}


def _row(chosen: Sequence[Outcome]) -> dict[str, Any]:
    planted = [o for o in chosen if o.found]
    return {
        "trials": len(chosen),
        "right": share([o.right for o in chosen]),
        "found": share([flag for o in planted for flag in o.found]),
        "told": share([flag for o in planted for flag in o.told]),
        "led": share([o.led for o in planted]),
        "named": share([o.verdict in _NAMING for o in chosen]),
        "false names": share([o.false > 0 for o in chosen]),
        "surely wrong": share([o.surest > LIKELY and not o.led for o in chosen]),
        "coverage": share([flag for o in chosen for flag in o.covered]),
        "calibrated": share([flag for o in chosen for flag in o.calibrated]),
        "one step": _median([o.one_step for o in chosen]),
        "open loop": _median([o.open_loop for o in chosen]),
        "seconds": _median_and_most([o.seconds for o in chosen]),
        "memory": _median_and_most([o.memory for o in chosen]),
        "verdicts": dict(sorted(Counter(o.verdict for o in chosen).items())),
    }  # fmt: skip


def _median(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return round(float(np.median(known)), 4) if known else None


def _median_and_most(values: Sequence[float | None]) -> tuple[float, float] | None:
    known = [v for v in values if v is not None]
    return (round(float(np.median(known)), 3), round(max(known), 3)) if known else None


def _targets(rows: dict[str, Any], groups: dict[str, list[Outcome]]) -> dict[str, Any]:
    """What is asked of the search, pooled over kinds where that is asked."""
    kinds = ("noise", "off", "coloured", "drift")
    bare = [o for name in kinds for o in groups.get(f"{name}, bare", [])]
    planted = [o for name in kinds for o in groups.get(f"{name}, planted", [])]
    covered = [flag for o in (*bare, *planted) for flag in o.covered]
    outside = groups.get("outside", [])
    asked: list[tuple[str, float | None, str, float]] = [
        ("near: mechanism and place named", _part(rows, "near", "right"), ">=", 0.90),
        ("wrong noise or numbers, nothing planted: named", _rate([not o.right for o in bare]),
         "<=", 0.02),
        ("wrong noise or numbers: planted effect found",
         _rate([flag for o in planted for flag in o.found]), ">=", 0.90),
        ("wrong noise or numbers: intervals cover", _rate(covered), ">=", 0.90),
        ("wrong noise or numbers: intervals cover, not too wide", _rate(covered), "<=", 0.98),
        ("clean: named", _part(rows, "clean", "named"), "<=", 0.02),
        ("outside: no library effect above one half", _part(rows, "outside", "right"), ">=", 0.95),
        ("outside: median gap closed, open loop", _median([o.open_loop for o in outside]),
         ">=", 0.60),
        ("wrong numbers: planted effect found or calibrated",
         _rate([flag for o in groups.get("off, planted", []) for flag in o.told]), ">=", 0.90),
        ("wrong numbers: intervals of calibrated numbers cover",
         _rate([flag for o in chain(*groups.values()) for flag in o.calibrated]), ">=", 0.90),
        ("library: found", _part(rows, "library", "found"), ">=", 0.95),
    ]  # fmt: skip
    return {
        name: {
            "value": value, "asked": f"{sign} {limit:g}",
            "reached": None if value is None else (value <= limit, value >= limit)[sign == ">="],
        }
        for name, value, sign, limit in asked
    }  # fmt: skip


def _rate(flags: Sequence[bool]) -> float | None:
    return round(sum(flags) / len(flags), 4) if flags else None


def _part(rows: dict[str, Any], row: str, what: str) -> float | None:
    part = rows.get(row, {}).get(what)
    return part and part["share"]


def world_markdown(head: Sequence[str], scores: dict[str, Any], outcomes: Sequence[Outcome]) -> str:
    """The page of a series.

    Args:
        head: sentences on the series: command, commits, machine.
        scores: of `score_world`.
        outcomes: of the trials.

    Returns:
        Markdown text.
    """
    lines = [
        "# Blind validation on an independent simulator",
        "",
        *head,
        "",
        "| criterion | value | required | reached |",
        "| --- | ---: | --- | --- |",
    ]
    for name, target in scores["targets"].items():
        value = "-" if target["value"] is None else f"{target['value']:.3f}"
        word = {None: "no data", True: "yes", False: "no"}[target["reached"]]
        lines.append(f"| {name} | {value} | {target['asked']} | {word} |")
    columns = ("right", "found", "told", "led", "named", "false names", "surely wrong",
               "coverage", "calibrated")  # fmt: skip
    lines += [
        "",
        "Rates in % with 95 % intervals (Wilson 1927). One step and open loop: median reduction"
        " of the mean square error above that of a perfect model.",
        "",
        f"| kind | trials | {' | '.join(columns)} | one step | open loop 5 s | s median, max."
        " | MB median, max. | verdicts |",
        "| --- | ---: " + "| --- " * len(columns) + "| ---: | ---: | --- | --- | --- |",
    ]
    for name, row in scores["rows"].items():
        cells = [_cell(row[c]) for c in columns]
        numbers = ["-" if row[c] is None else f"{row[c]:.2f}" for c in ("one step", "open loop")]
        seconds = row["seconds"] and "{:.0f}, {:.0f}".format(*row["seconds"])
        memory = row["memory"] and "{:.0f}, {:.0f}".format(*(m / 1e6 for m in row["memory"]))
        words = ", ".join(f"{count} {word}" for word, count in row["verdicts"].items())
        lines.append(f"| {name} | {row['trials']} | {' | '.join(cells)} | {' | '.join(numbers)} |"
                     f" {seconds or '-'} | {memory or '-'} | {words} |")  # fmt: skip
    lines += ["", "## Incorrect answers", "",
              "| trial | kind | hidden | visibility | verdict | named |",
              "| --- | --- | --- | ---: | --- | --- |"]  # fmt: skip
    lines += [
        f"| {o.trial} | {o.kind} | {', '.join(o.planted) or 'nothing'} |"
        f" {'' if o.visible is None else f'{o.visible:.3g}'} | {o.verdict} |"
        f" {', '.join(o.answer) or '-'} |"
        for o in outcomes if not o.right
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _cell(part: dict[str, Any] | None) -> str:
    if part is None:
        return "-"
    low, high = part["ci95"]
    return f"{100 * part['share']:.0f} ({100 * low:.0f}..{100 * high:.0f})"
