"""Score a series: fractions per class, coverage, closure, time, and the required values."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tools.validation.blind.judge import SURE, Document, Verdict, judge

_FEW_CLEAN = 5  # below this many clean trials their scatter says little
_USUAL_SCATTER = 0.005  # of the RMS over 2000 rows of 12 channels: 1 / sqrt(2 * 24000)
_CLEAR = 10.0  # a gap counts for closure from this many times the floor's scatter on
_BINS = np.array([0.0, 10.0, 30.0, 100.0, 300.0, 1000.0, np.inf])  # of the visibility


def score(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """All scores of a series.

    Args:
        verdicts: those of the finished trials.

    Returns:
        `classes`, `coverage`, `closure`, `seconds`, `by_visibility`, and `targets`: name ->
        value, what is asked, whether it is reached (None where no trial tells).
    """
    by = {k: [v for v in verdicts if v.kind == k] for k in ("single", "double", "clean", "outside")}
    covered = [low <= truth <= high for v in verdicts for _, _, low, high, truth in v.covered]
    seconds = [v.seconds for v in verdicts if v.seconds is not None]
    scores = {
        "trials": len(verdicts),
        "failed": [v.trial for v in verdicts if v.verdict == "failed"],
        "classes": {kind: _class(chosen) for kind, chosen in by.items() if chosen},
        "coverage": share(covered),
        "closure": closure(verdicts),
        "seconds": {"mean": _rounded(np.mean(seconds)), "max": max(seconds)} if seconds else None,
        "by_visibility": _by_visibility(by["single"]),
    }
    scores["targets"] = _targets(scores, by)
    return scores


def swapped(keys: dict[str, Document], results: dict[str, Document]) -> list[Verdict]:
    """Negative control: every answer judged by another trial's key with another truth.

    Trials are sorted by what was planted and the keys passed on by the size of the largest group of
    equal truths, so that no trial gets a key like its own if no truth fills half of the series.
    """
    truths = {}
    for trial in results:
        names = sorted(f"{e['name']}({e['location']})" for e in keys[trial]["effects"])
        kind = keys[trial]["class"]
        truths[trial] = f"{kind} {names if kind in ('single', 'double') else ''}"
    order = sorted(results, key=lambda trial: truths[trial])
    listed = list(truths.values())
    shift = max((listed.count(text) for text in listed), default=0)
    return [judge(keys[order[(k + shift) % len(order)]], results[trial]) for k, trial in enumerate(order)]


def share(flags: Sequence[bool]) -> dict[str, Any] | None:
    """Share of true ones with its 95 % interval (Wilson 1927); None without any."""
    n = len(flags)
    if n == 0:
        return None
    p, z = sum(flags) / n, 1.959964
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return {
        "share": round(p, 4), "of": n,
        "ci95": [round(max(0.0, middle - half), 4), round(min(1.0, middle + half), 4)],
    }  # fmt: skip


def floor_scatter(verdicts: Sequence[Verdict]) -> float:
    """Standard deviation of a clean machine's gap around the stated floor."""
    clean = [v.before - v.floor for v in verdicts
             if v.kind == "clean" and v.before is not None and v.floor is not None]  # fmt: skip
    return float(np.std(clean, ddof=1)) if len(clean) >= _FEW_CLEAN else _USUAL_SCATTER


def closures(verdicts: Sequence[Verdict]) -> list[tuple[Verdict, float]]:
    """(before - after) / (before - floor) of each planted gap that stands clear of the floor."""
    least = _CLEAR * floor_scatter(verdicts)
    return [
        (v, (v.before - v.after) / (v.before - v.floor))
        for v in verdicts
        if v.kind in ("single", "double") and v.before is not None and v.after is not None
        and v.floor is not None and v.before - v.floor >= least
    ]  # fmt: skip


def closure(verdicts: Sequence[Verdict]) -> dict[str, Any] | None:
    """Median closure of the gaps that stand clear of the floor."""
    values = [value for _, value in closures(verdicts)]
    if not values:
        return None
    return {
        "median": _rounded(np.median(values)), "tenth": _rounded(np.quantile(values, 0.1)),
        "of": len(values), "floor_scatter": _rounded(floor_scatter(verdicts)),
    }  # fmt: skip


def _class(chosen: Sequence[Verdict]) -> dict[str, Any]:
    scores: dict[str, Any] = {"right": share([v.right for v in chosen])}
    kind = chosen[0].kind
    if kind in ("single", "double"):
        clear = [v for v in chosen if not v.weak or _forced(v)]
        scores["right_without_weak"] = share([v.right for v in clear])
        scores["weak"] = _words([v for v in chosen if v.weak])
        scores["found"] = share([k < v.found for v in chosen for k in range(len(v.truth))])
    if kind == "clean":
        scores["falsely_named"] = share([v.answer != (v.verdict,) for v in chosen])
    if kind == "outside":
        scores["called_unknown"] = share([v.verdict == "unknown" for v in chosen])
        scores["surely_named"] = share([any(p > SURE for p, _ in v.beliefs) for v in chosen])
    scores["verdicts"] = _words(chosen)
    return scores


def _forced(v: Verdict) -> bool:
    """Whether an answer names what was not planted: weak effects excuse silence, not that."""
    return not v.right and any(not planted for _, planted in v.beliefs)


def _words(chosen: Sequence[Verdict]) -> dict[str, int]:
    words = [f"{v.verdict}, {'right' if v.right else 'wrong'}" for v in chosen]
    return {word: words.count(word) for word in sorted(set(words))}


def _by_visibility(singles: Sequence[Verdict]) -> dict[str, Any]:
    table = {}
    for low, high in zip(_BINS[:-1], _BINS[1:], strict=True):
        chosen = [v.right for v in singles if v.visible is not None and low <= v.visible < high]
        if chosen:
            table[f"{low:g} .. {high:g}"] = share(chosen)
    return table


def _targets(scores: dict[str, Any], by: dict[str, list[Verdict]]) -> dict[str, Any]:
    def of(kind: str, what: str) -> float | None:
        part = scores["classes"].get(kind, {}).get(what)
        return part and part["share"]

    asked = [
        (
            "single right, silence on weak ones set aside",
            of("single", "right_without_weak"),
            True,
            0.95,
        ),
        ("single right, silence on weak ones counted as wrong", of("single", "right"), True, 0.95),
        (
            "double right, silence on weak ones set aside",
            of("double", "right_without_weak"),
            True,
            0.85,
        ),
        ("double right, silence on weak ones counted as wrong", of("double", "right"), True, 0.85),
        ("clean falsely named", of("clean", "falsely_named"), False, 0.02),
        ("outside called unknown", of("outside", "called_unknown"), True, 0.85),
        ("outside surely named", of("outside", "surely_named"), False, 0.0),
        ("interval coverage", (scores["coverage"] or {}).get("share"), True, 0.90),
        ("interval coverage, not too wide", (scores["coverage"] or {}).get("share"), False, 0.98),
        ("gap closed, median", (scores["closure"] or {}).get("median"), True, 0.95),
    ]
    return {
        name: {
            "value": value, "asked": f"{'>=' if high else '<='} {limit:g}",
            "reached": None if value is None else value >= limit if high else value <= limit,
        }
        for name, value, high, limit in asked
    }  # fmt: skip


def _rounded(value) -> float:
    return float(f"{float(value):.4g}")
