"""A disagreement that no effect of the library explains: which law, where, when, on what it hangs.

Balances (`unknown_laws`) tell the law and the axis, a sparse regression (`unknown_fit`) of their
residual tells on what it depends. Where no balance fails or none can be made, the prediction errors
tell the channel and what their size goes with.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import spearmanr

from hydrotele.dataset.load import Dataset
from hydrotele.errors import InputError
from hydrotele.gap.result import Prediction, Unknown
from hydrotele.gap.unknown_fit import Explained, explain
from hydrotele.gap.unknown_laws import (
    Found,
    Verdict,
    clean_balances,
    excesses,
    judge,
    measured_balances,
)
from hydrotele.gap.unknown_signals import Scene, read_scene, run_log
from hydrotele.gap.unknown_target import channel_target, law_target, roles, signal
from hydrotele.gap.unknown_words import bare_words, channel_law, depends_on, law_words, term_text
from hydrotele.kinematics.triangle import LoopOpen
from hydrotele.machine import Machine
from hydrotele.signals import parse_channel

_SETTLE = 1.0  # s until the start of a run no longer matters
_WINDOW = 1.0  # s, longer than any ringing, shorter than a motion
_BLOCK = 0.2  # s over which the size of errors is looked at
_SHOWS = 0.4  # of the largest excess: windows above it are named
_MOST_WINDOWS = 5
_FIRM = 0.3  # rank correlation, in the fit runs and in the held-out run, that counts


def describe_unknown(machine: Machine, data: Dataset, after: Sequence[Prediction]) -> Unknown:
    """Describe what is left unexplained.

    Args:
        machine: the best machine found.
        data: the logs.
        after: its one-step predictions: held-out run, then the fit runs in the order of `data.fit`.

    Returns:
        The law, channel, dependence and words; less of it the fewer channels there are.
    """
    try:
        return _described(machine, data, after)
    except (InputError, LoopOpen, ValueError, LookupError, ArithmeticError, np.linalg.LinAlgError):
        return _plain(machine, after)  # readings far outside the model: only the errors are left


def _described(machine: Machine, data: Dataset, after: Sequence[Prediction]) -> Unknown:
    channel = worst_channel(after)
    measured = measured_balances(machine, data)
    verdict = judge(machine, data, excesses(measured, clean_balances(machine, data)), measured)
    scenes = [
        read_scene(machine, run_log(data, run), data.sensors) for run in (data.heldout, *data.fit)
    ]
    if verdict is None:
        return _of_channel(machine, channel, scenes, after)
    return _of_law(machine, verdict, channel, scenes, measured, after)


def worst_channel(after: Sequence[Prediction]) -> str:
    """The channel whose errors exceed white noise of size 1 most, in size or in means over 1 s."""
    first = after[0]
    period = float(np.median(np.diff(first.time)))
    length = max(1, round(_WINDOW / period))
    squares, means = [], []
    for run in after:
        whitened = run.whitened[round(_SETTLE / period) :]
        squares.append(whitened**2)
        count = len(whitened) // length
        cut = whitened[: count * length].reshape(count, length, -1)
        there = np.maximum(np.isfinite(cut).sum(axis=1), 1)
        means.append(np.nansum(cut, axis=1) ** 2 / there)
    size, drift = (np.nan_to_num(_mean(np.concatenate(parts))) for parts in (squares, means))
    # window means of a clean machine scatter more than its mean squares
    return first.channels[int(np.argmax(np.maximum(size, np.sqrt(drift))))]


def _of_law(
    machine: Machine, verdict: Verdict, channel: str, scenes: Sequence[Scene],
    measured: Sequence[Found], after: Sequence[Prediction],
) -> Unknown:  # fmt: skip
    if verdict.law == "sensor":
        channel = f"pressure_{verdict.side}.{verdict.place}"
    elif parse_channel(channel).axis != verdict.place and not verdict.everywhere:
        channel = _of_place(after, verdict.place) or channel
    told = Explained((), 0.0, 0.0)
    target = law_target(machine, verdict, scenes, measured)
    if verdict.law != "timing":
        told = explain(target)
    valve = {"feed", "drain", "valve", "sticking", "late"}
    law = "valve" if told.terms and told.terms[0].term.name in valve else verdict.law
    balance = measured[0].get(verdict.balance, {}).get(verdict.place)
    windows = _windows(after[0], channel)
    if balance is not None:
        with np.errstate(all="ignore"):
            loud = (balance.residual / balance.noise) ** 2
        period = float(np.median(np.diff(balance.time)))
        windows = loud_windows(loud, period, float(balance.time[0]))
    return Unknown(
        law=law,
        channel=channel,
        depends_on=depends_on(told, target),
        description=law_words(machine, verdict, told, target),
        term=term_text(machine, verdict, told, target),
        windows=windows,
    )


def _of_channel(
    machine: Machine, channel: str, scenes: Sequence[Scene], after: Sequence[Prediction]
) -> Unknown:
    """What the prediction errors of the worst channel tell."""
    target = channel_target(machine, channel, scenes, after)
    told = explain(target)
    depends = depends_on(told, target) or _size_goes_with(machine, channel, scenes, after)
    words = bare_words(machine, channel, depends, told)
    windows = _windows(after[0], channel)
    return Unknown(channel_law(channel), channel, depends, words, None, windows)


def _plain(machine: Machine, after: Sequence[Prediction]) -> Unknown:
    """What the prediction errors alone tell."""
    channel = worst_channel(after)
    words, windows = bare_words(machine, channel, ()), _windows(after[0], channel)
    return Unknown(channel_law(channel), channel, (), words, None, windows)


def _of_place(after: Sequence[Prediction], place: str) -> str | None:
    """The worst channel of an axis, or the supply's."""
    own = [
        k for k, name in enumerate(after[0].channels)
        if name.endswith(f".{place}") or name == f"pressure_{place}"
    ]  # fmt: skip
    if not own:
        return None
    sizes = [_mean(np.concatenate([run.whitened[:, k] ** 2 for run in after])) for k in own]
    return after[0].channels[own[int(np.nanargmax(np.nan_to_num(sizes)))]]


def _windows(run: Prediction, channel: str) -> tuple[tuple[float, float], ...]:
    loud = run.whitened[:, run.channels.index(channel)] ** 2
    return loud_windows(loud, float(np.median(np.diff(run.time))), float(run.time[0]))


def loud_windows(loud: np.ndarray, period: float, start: float) -> tuple[tuple[float, float], ...]:
    """Where a signal is loud.

    Args:
        loud: (n,) squares over their expectation [1], NaN where unknown.
        period: time between rows [s].
        start: time of the first row [s].

    Returns:
        Up to five (start, end) [s] of at least a second, in order of time.
    """
    length = max(1, round(_WINDOW / period))
    count = len(loud) // length
    if count == 0:
        return ()
    blocks = loud[: count * length].reshape(count, length)
    level = np.nan_to_num(_mean(blocks.T))
    level[: max(1, round(_SETTLE / _WINDOW))] = 0.0
    high = level > max(2.0, 1.0 + _SHOWS * (np.quantile(level, 0.95) - 1.0))
    edges = np.flatnonzero(np.diff(np.r_[0, high.astype(int), 0]))
    spans = [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    spans = sorted(spans, key=lambda s: -level[s[0] : s[1]].sum())[:_MOST_WINDOWS]
    times = [(start + a * _WINDOW, start + b * _WINDOW) for a, b in sorted(spans)]
    return tuple((round(a, 2), round(b, 2)) for a, b in times)


def _size_goes_with(
    machine: Machine, channel: str, scenes: Sequence[Scene], after: Sequence[Prediction]
) -> tuple[str, ...]:
    """The signal whose size goes with that of a channel's errors, if one does in all runs."""
    parsed = parse_channel(channel)
    side = "rod" if parsed.kind == "pressure_rod" else "head"
    best, found = _FIRM, ()
    names = roles(machine, parsed.axis, side)
    for role in ("t", "x", "v", "a", "u", "p", "o", "d", "s"):
        name = names.get(role, "")
        if not all(name in scene.values for scene in scenes):
            continue
        firm = [
            _likeness([(scenes[k], after[k]) for k in chosen], name, channel)
            for chosen in ([0], list(range(1, len(scenes))))
        ]
        if min(firm) > best:
            best, found = min(firm), (name.replace("change_", "pressure_"),)
    return found


def _likeness(runs: list[tuple[Scene, Prediction]], name: str, channel: str) -> float:
    """Rank correlation between the sizes of a signal and of a channel's errors, block by block."""
    sizes, errors = [], []
    for scene, run in runs:
        length = max(1, round(_BLOCK / scene.period))
        edge = round(_SETTLE / scene.period)
        whitened = run.whitened[edge:, run.channels.index(channel)]
        value = np.abs(signal(scene, name)[edge:])
        count = min(len(whitened), len(value)) // length
        errors.append(_mean(whitened[: count * length].reshape(count, length).T ** 2))
        sizes.append(_mean(value[: count * length].reshape(count, length).T))
    x, y = np.concatenate(sizes), np.concatenate(errors)
    good = np.isfinite(x) & np.isfinite(y)
    if good.sum() < 10 or np.ptp(x[good]) == 0.0:
        return 0.0
    return float(np.nan_to_num(np.asarray(spearmanr(x[good], y[good]))[0]))


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean along the first axis of what is finite; NaN where nothing is."""
    there = np.isfinite(values)
    total = np.where(there, values, 0.0).sum(axis=0)
    return np.where(there.any(axis=0), total / np.maximum(there.sum(axis=0), 1), np.nan)
