"""How far an effect that closes a gap is to be believed: it may only imitate another law.

The probabilities of the search compare effects of the library with each other. A law that none of
them has is imitated by some of them to a part: by one, which leaves much, or by several of the same
axis, each of which takes a piece. The right effect in another form leaves little.

The numbers here are set by hand, from trials on a machine of other code whose answers were known
when they were set; series drawn later judge them (`docs/results/independent_trials.md`).
"""

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from hydrotele.estimate.track import Track
from hydrotele.gap.residuals import settled
from hydrotele.gap.result import LearnedLaw, NamedEffect
from hydrotele.machine.signals import parse_channel

_PART, _PART_STEEP = 0.35, 0.07  # see `believed_part`
_LEADS = 0.9  # share of the gap that comes back without an effect that leads
_LEFT, _LEFT_STEEP = 0.12, 0.03  # see `believed`
_PIECE = 0.2, 0.99  # probability between which an effect may be one of several pieces


def believed_part(part: float) -> float:
    """Probability that an effect is the mechanism and not something else of the same balance.

    Args:
        part: share of what the fit runs lacked without it that it takes away.

    Returns:
        The probability.
    """
    return float(1.0 / (1.0 + np.exp(-(part - _PART) / _PART_STEEP)))


def left_over(
    before: Track, after: Track, channels: Sequence[str], floor: float | None
) -> dict[str, float]:
    """Share of the gap on a run that a patch leaves, of each axis' channels and of all.

    Args:
        before: the given model's track of the run.
        after: the patched one's.
        channels: names of the columns.
        floor: RMS of a perfect model's whitened errors, 1 where it is not known.

    Returns:
        Axis -> share, "" -> that of all channels; 0 where an axis has no gap.
    """
    axes = [parse_channel(name).axis or "" for name in channels]
    squares = [np.nanmean(settled(t.whitened, t.run.period) ** 2, axis=0) for t in (before, after)]
    least, shares = (floor or 1.0) ** 2, {}
    for axis in {"", *axes}:
        own = [k for k, name in enumerate(axes) if axis in ("", name)]
        gap, left = (float(np.nanmean(part[own])) - least for part in squares)
        shares[axis] = min(1.0, max(0.0, left / gap)) if gap > 1.0e-3 * least else 0.0
    return shares


def believed(
    named: Sequence[NamedEffect],
    laws: Sequence[LearnedLaw],
    left: Mapping[str, float],
    lost: Collection[str],
) -> tuple[NamedEffect, ...]:
    """The effects with what is left taken into account.

    Args:
        named: the effects, with their probabilities among the library's.
        laws: that were learned beside them; what they close, the effects leave, but for one without
            which nearly all of the gap comes back: laws then tell what else there is.
        left: of `left_over`.
        lost: axes whose channels still show a gap, "" for channels without axis; none where the
            patched machine predicts as well as a perfect one.

    Returns:
        The effects with less probability where something is lacking still: the more is left, the
        less, and shared where several of one axis, none of which does most by itself, may be
        pieces of one law.
    """

    def axis_of(effect: NamedEffect) -> str:
        axis = effect.location.partition(".")[0]
        return axis if axis in left else ""

    pieces = [axis_of(effect) for effect in named if _PIECE[0] < effect.probability < _PIECE[1]]
    found = []
    for effect in named:
        axis = axis_of(effect)
        if not lost or (axis and axis not in lost):
            found.append(effect)
            continue
        beside = [law.share for law in laws if axis in ("", law.axis)]
        leads = effect.share >= _LEADS and effect.share > max(beside, default=0.0)
        rest = left[axis] + (0.0 if leads else sum(beside))
        trust = 1.0 / (1.0 + np.exp((min(rest, 1.0) - _LEFT) / _LEFT_STEEP))
        if axis and effect.probability < _PIECE[1]:
            trust /= max(1, pieces.count(axis))
        found.append(dataclasses.replace(
            effect, probability=float(trust) * effect.probability,
            alternatives=tuple(
                dataclasses.replace(a, probability=float(trust) * a.probability)
                for a in effect.alternatives
            ),
        ))  # fmt: skip
    return tuple(sorted(found, key=lambda effect: -effect.probability))
