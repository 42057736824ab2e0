"""Teeth with a gap: found where a motor's axis is shaken in a way that no smooth law explains.

Unknown inputs keep their sign for a while; what hits teeth does not, and counts as white noise on
the rate. With that noise a filter follows any motion, so that a gap in the teeth, whose numbers are
not yet right, makes nothing better. Here it is looked for without: the gap, the drive's own inertia
and the damping of the contact that leave the smallest errors when the sensors' noise is all there
is. The likelihood has many small dents in these numbers (every contact is one), so the search needs
no slopes: gaps of several sizes first, then the simplex of Nelder and Mead 1965 (Comput. J. 7(4)).
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize

from hydrotele.dataset.load import RunData
from hydrotele.effects import EFFECTS
from hydrotele.prediction.evidence import Evidence, Judged
from hydrotele.prediction.hypothesis import Hypothesis
from hydrotele.prediction.levels import noise_prior, rippled_at
from hydrotele.prediction.track import Levels, track_run

_TEETH = "backlash"
_GAPS = (0.002, 0.0035, 0.006, 0.01, 0.018, 0.03)  # rad; further apart, one may be jumped over
_SHAKEN = 3.0  # times its floor, of the white noise on a rate; teeth may be hidden in other lacks
_DAMPING = 0.05  # damping ratio to begin with: hard teeth, hardly oiled
_STRETCH = 3.0  # s of the busiest run: some reversals of a motor
_SIMPLEX = (0.15, 0.5, 1.0)  # of the logarithms of gap, inertia and damping ratio
_EVALUATIONS = 50
_CLOSE = 0.01  # of the logarithms: ends the search


def rattling(evidence: Evidence, base: Judged, candidates: Sequence[Hypothesis]) -> Judged | None:
    """Teeth with a gap for an axis that shakes, with levels of their own.

    Args:
        evidence: on the fit runs.
        base: the given machine, judged.
        candidates: the hypotheses.

    Returns:
        The base with teeth in the axis in which they explain most; None where none shakes or none
        has teeth that are likelier than none.
    """
    machine, found = evidence.data.machine, []
    for candidate in candidates:
        axis = candidate.location
        if candidate.name != _TEETH or not rippled_at(
            base.tracks[0].levels, f"rate.{machine.axes[axis].joint}", _SHAKEN
        ):
            continue
        whole = Hypothesis(_TEETH, axis, EFFECTS[_TEETH].parameters(machine, axis))
        deviation = _likeliest(evidence, whole)
        if deviation is not None:
            guess = base.guess.plus(whole, deviation)
            found.append(evidence.judged_from(guess, _sensors_only(evidence)))
    best = min(found, key=lambda judged: judged.loss, default=None)
    return best if best and best.loss < base.loss else None


def _sensors_only(evidence: Evidence) -> Levels:
    return Levels(noise_prior(evidence.data).noise)


def _likeliest(evidence: Evidence, teeth: Hypothesis) -> np.ndarray | None:
    """Deviations of the likeliest teeth; None where every gap is less likely than none."""
    data, levels = evidence.data, _sensors_only(evidence)
    run = _busiest_part(evidence.runs, list(data.axes).index(teeth.location))
    nominal = np.array([p.nominal for p in teeth.parameters.values()])
    scale = np.array([p.scale for p in teeth.parameters.values()])

    def deviation(x: np.ndarray) -> np.ndarray:
        return np.clip((np.exp(x) - nominal) / scale, teeth.low, teeth.high)

    def loss(x: np.ndarray) -> float:
        machine = teeth.machine(data.machine, deviation(x))
        return track_run(machine, data, run, None, evidence.step, levels).loss

    starts = [np.log([gap, nominal[1], _DAMPING]) for gap in _GAPS]
    none, *losses = evidence.map(
        lambda x: loss(x) if x is not None else
        track_run(data.machine, data, run, None, evidence.step, levels).loss, [None, *starts],
    )  # fmt: skip
    begin = starts[int(np.argmin(losses))]
    if not min(losses) < none:
        return None
    simplex = np.vstack([begin, *(begin + np.diag(_SIMPLEX))])
    answer = minimize(
        loss, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": _CLOSE, "fatol": 1.0},
    )  # fmt: skip
    return deviation(answer.x)


def _busiest_part(runs: Sequence[RunData], column: int) -> RunData:
    """The stretch of some seconds of all runs in which a command changes most."""
    best = None
    for run in runs:
        rows = min(round(_STRETCH / run.period), len(run.command) - 1)
        passed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(run.command[:, column])))])
        changes = passed[rows:] - passed[: len(passed) - rows]
        first = int(np.argmax(changes))
        if best is None or changes[first] > best[0]:
            best = float(changes[first]), run, first, rows
    assert best
    _, run, first, rows = best
    return run.part(first, first + rows)
