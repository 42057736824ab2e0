"""Test whether the coefficient of an accepted effect varies: a known law times a learned profile.

A leak may act only in the worn middle of a stroke, friction may grow as oil warms. The law is then right and its
coefficient is a function of one variable. Its columns follow from the same filter: the change of the states per row
that the effect makes, weighted by hat functions of the variable, passes through the linearised filter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.estimate.evidence import Evidence, Judged, flat
from hydrotele.estimate.filter import _rows_later
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis
from hydrotele.estimate.reduced_model import model_space, reduced_model, state_names
from hydrotele.estimate.track import COARSE, error_responses, steps_per_row
from hydrotele.gap.discover import Seen, see
from hydrotele.gap.model_search import MIN_LOG_BAYES_FACTOR
from hydrotele.gap.regression import NormalEquations, compare_groups

VARIABLES = ("position", "velocity", "command", "pressure_head", "pressure_rod", "time")
_KNOTS = 7  # of a profile: finer than a third of the range, and each knot still has many rows
_QUANTILES = (0.02, 0.98)  # of the variable's values, between which the knots lie
_OWN_SCALE = 10.0  # prior standard deviations within which the model's own parameters may move along
_STEP = 0.02  # prior standard deviations, for the slope of the states' change


@dataclass(frozen=True)
class Profile:
    """A coefficient that varies with one variable.

    Attributes:
        name: of the effect.
        location: of the effect.
        variable: on which its coefficient depends.
        factor: twice the log Bayes factor of the profile against a constant coefficient.
        points: (k,) values of the variable [SI].
        ratios: (k,) coefficient there, relative to the constant one.
    """

    name: str
    location: str
    variable: str
    factor: float
    points: np.ndarray
    ratios: np.ndarray


def hat_weights(values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the weights (n, k) of hat functions at increasing points; each row adds up to 1.

    >>> hat_weights(np.array([0.25, 2.0]), np.array([0.0, 1.0]))
    array([[0.75, 0.25],
           [0.  , 1.  ]])
    """
    return np.stack([np.interp(values, points, row) for row in np.eye(len(points))], axis=1)


def find_profiles(evidence: Evidence, model: Judged) -> list[Profile]:
    """Test every accepted effect with one parameter against a coefficient that varies with one variable.

    Args:
        evidence: whose base is the model.
        model: the accepted effects.

    Returns:
        Per effect the profile with the largest Bayes factor, if it reaches that of an effect.
    """
    if not model.guess.parts:
        return []
    seen = [see(evidence.data, model, track) for track in model.tracks]
    own = _OWN_SCALE * evidence.base_slopes(evidence.slope_step)
    found = []
    for index, (hypothesis, deviation) in enumerate(model.guess.parts):
        axis = hypothesis.location.partition(".")[0]
        if hypothesis.name == CALIBRATION or hypothesis.size != 1 or axis not in seen[0].values:
            continue
        changes = _state_changes(evidence, model.guess, index)
        if changes is None or not np.any(deviation):
            continue
        profiles = [
            _profile(evidence, hypothesis, float(deviation[0]), changes, seen, axis, variable, own)
            for variable in VARIABLES if variable in seen[0].values[axis]
        ]  # fmt: skip
        best = max(profiles, key=lambda p: p.factor, default=None)
        if best is not None and best.factor > MIN_LOG_BAYES_FACTOR:
            found.append(best)
    return found


def _state_changes(evidence: Evidence, guess: Guess, index: int) -> list[np.ndarray] | None:
    """Per run (n, nz) change of the next states per prior standard deviation; None if the effect adds states."""
    nominal = evidence.data.machine
    first = sum(h.size for h in guess.hypotheses[:index])
    moved = guess.deviation
    step = -_STEP if moved[first] + _STEP > guess.hypotheses[index].high[0] else _STEP
    moved[first] += step
    both = guess, guess.at(moved)
    if len({tuple(state_names(one.machine(nominal))) for one in both}) > 1:
        return None
    found = []
    for track in evidence.tracks:
        later = []
        for one in (side.machine(nominal, track.run.name) for side in both):
            model, ends = reduced_model(one, ()), np.empty(track.states.shape)
            steps = steps_per_row(one, track.run.period, COARSE)
            _rows_later(model, model_space(model), track.states, track.run.command, track.run.period, steps, ends)
            later.append(ends)
        found.append((later[1] - later[0]) / step)
    return found if any(np.any(change) for change in found) else None


def _profile(
    evidence: Evidence, hypothesis: Hypothesis, size: float, changes: Sequence[np.ndarray], seen: Sequence[Seen],
    axis: str, variable: str, own: np.ndarray,
) -> Profile:  # fmt: skip
    """Regress the errors on the effect's column times hat functions of a variable.

    A coefficient of 1 is a variation as large as the effect itself.
    """
    values = [s.values[axis][variable] for s in seen]
    low, high = np.quantile(np.concatenate([v[s.known] for v, s in zip(values, seen, strict=True)]), _QUANTILES)
    points = np.linspace(low, high, _KNOTS)
    columns, errors = [], []
    for track, change, value, s in zip(evidence.tracks, changes, values, seen, strict=True):
        weights = np.where(s.known[:, None], hat_weights(value, points), 0.0)
        response = error_responses(track, np.nan_to_num(change), size * weights)
        columns.append(response.reshape(-1, _KNOTS))
        errors.append(-flat(track.whitened))
    terms = NormalEquations.of(np.concatenate(errors), [np.concatenate(columns)], own)
    marginal = terms.marginalise(np.ones(own.shape[1]))
    factors, means = compare_groups(terms.edges, marginal.right, marginal.blocks)
    return Profile(
        hypothesis.name, hypothesis.location, variable, float(factors[0]), points, 1.0 + means[0],
    )  # fmt: skip


def profile_words(profile: Profile) -> str:
    """Describe a profile in one sentence."""
    least, most = profile.ratios.min(), profile.ratios.max()
    at = profile.points[int(np.argmax(profile.ratios))]
    return (
        f"The coefficient of {profile.name} at {profile.location} varies with the {profile.variable.replace('_', ' ')}"
        f" ({least:.2f} to {most:.2f} times the fitted value, largest at {at:.3g} in SI units; twice the log Bayes"
        f" factor against a constant coefficient {profile.factor:.0f}). The corrected model uses the constant value."
    )
