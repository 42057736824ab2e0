"""Teeth with a gap: found where a motor's axis is shaken in a way that no smooth law explains.

Unknown inputs keep their sign for a while; what hits teeth does not, and counts as white noise on
the rate. With that noise a filter follows any motion, so that a gap in the teeth, whose numbers are
not yet right, makes nothing better. Here it is looked for without: the gap, the drive's own inertia
and the damping of the contact that leave the smallest errors when the sensors' noise is all there
is. The likelihood has many small dents in these numbers (every contact is one), so the search needs
no slopes: gaps of several sizes first, then the simplex of Nelder and Mead 1965 (Comput. J. 7(4)),
which also moves where the drive rests in the gap as the stretch begins.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.estimate.levels import noise_prior, rippled_at
from hydrotele.estimate.track import Levels, Track, track_run
from hydrotele.logs.load import RunData

_TEETH = "backlash"
_GAPS = (0.002, 0.0035, 0.006, 0.01, 0.018, 0.03)  # rad; further apart, one may be jumped over
_SHAKEN = 3.0  # times its floor, of the white noise on a rate; teeth may be hidden in other lacks
_DAMPING = 0.05  # damping ratio to begin with: hard teeth, hardly oiled
_STRETCH = 3.0  # s where a run is busiest: some reversals of a motor
_STRETCHES = 4  # at most, each of another run, that are taken together at last
_SIMPLEX = (0.15, 0.5, 1.0, 0.3)  # of the logarithms of gap, inertia and damping ratio; of the rest
_SIMPLEXES = (1.0, 0.3)  # times that, one after the other
_STARTS = 2  # gaps from which to search
_EVALUATIONS = 60  # of a simplex
_CLOSE = 0.01  # ends the search


def rattling(
    evidence: Evidence, base: Judged, ahead: Judged, candidates: Sequence[Hypothesis]
) -> Judged | None:
    """Teeth with a gap for an axis that shakes, with levels of their own.

    Args:
        evidence: on the fit runs.
        base: the given machine, judged.
        ahead: the best other explanation so far, or the base: an axis that does not shake with it
            has no teeth to look for, which takes minutes.
        candidates: the hypotheses.

    Returns:
        The base with teeth in the axis in which they explain most, which need not be likelier than
        the base: with wrong numbers, only both together are. None where none shakes or none has
        teeth that are likelier than none as long as nothing unknown acts.
    """
    found = []
    for candidate in candidates:
        axis = candidate.location
        if candidate.name != _TEETH or not all(shaken(evidence, j, axis) for j in (base, ahead)):
            continue
        whole = Hypothesis(_TEETH, axis, EFFECTS[_TEETH].parameters(evidence.data.machine, axis))
        deviation = _likeliest(evidence, whole)
        if deviation is not None:
            guess = base.guess.plus(whole, deviation)
            found.append(evidence.judged_from(guess, _sensors_only(evidence)))
    return min(found, key=lambda judged: judged.loss, default=None)


def shaken(evidence: Evidence, judged: Judged, axis: str) -> bool:
    """Whether an axis moves as if hit: with white noise on its rate that a guess does not have."""
    joint = evidence.data.machine.axes[axis].joint
    return rippled_at(judged.tracks[0].levels, f"rate.{joint}", _SHAKEN)


def _sensors_only(evidence: Evidence) -> Levels:
    return Levels(noise_prior(evidence.data).noise)


def _likeliest(evidence: Evidence, teeth: Hypothesis) -> np.ndarray | None:
    """Deviations of the likeliest teeth; None where every gap is less likely than none."""
    data, levels = evidence.data, _sensors_only(evidence)
    column = list(data.axes).index(teeth.location)
    parts = sorted((_busiest_part(run, column) for run in evidence.runs), key=lambda p: -p[0])
    stretches = [run for _, run in parts[:_STRETCHES]]
    nominal = np.array([p.nominal for p in teeth.parameters.values()])
    scale = np.array([p.scale for p in teeth.parameters.values()])

    def deviation(x: np.ndarray) -> np.ndarray:
        return np.clip((np.exp(x[:3]) - nominal) / scale, teeth.low, teeth.high)

    def track(x: np.ndarray | None, run: RunData, rest: np.ndarray | None = None) -> Track:
        machine = data.machine if x is None else teeth.machine(data.machine, deviation(x))
        return track_run(machine, data, run, None, evidence.step, levels, rest=rest)

    starts = [np.log([gap, nominal[1], _DAMPING]) for gap in _GAPS]
    none, *tracks = evidence.map(lambda x: track(x, stretches[0]), [None, *starts])
    order = sorted(range(len(starts)), key=lambda k: tracks[k].loss)
    if not tracks[order[0]].loss < none.loss:
        return None

    def climbed(k: int) -> OptimizeResult:
        """On one stretch, together with where the drive rests as it begins."""
        answer = OptimizeResult(x=np.append(starts[k], tracks[k].rest))
        for size in _SIMPLEXES:  # the simplex shrinks into a dent: once more from there
            answer = _simplex(
                lambda x: track(x, stretches[0], np.clip(x[3:], -1.0, 1.0)).loss, answer.x, size
            )
        return answer

    best = min(evidence.map(climbed, order[:_STARTS]), key=lambda answer: answer.fun).x[:3]
    rests = evidence.map(lambda run: track(best, run).rest, stretches)

    def loss(x: np.ndarray) -> float:
        pairs = list(zip(stretches, rests, strict=True))
        return sum(evidence.map(lambda pair: track(x, *pair).loss, pairs))

    return deviation(_simplex(loss, best, _SIMPLEXES[-1]).x)


def _simplex(loss: Callable[[np.ndarray], float], begin: np.ndarray, size: float) -> OptimizeResult:
    simplex = np.vstack([begin, *(begin + size * np.diag(_SIMPLEX[: len(begin)]))])
    return minimize(
        loss, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": _CLOSE, "fatol": 1.0},
    )  # fmt: skip


def _busiest_part(run: RunData, column: int) -> tuple[float, RunData]:
    """By how much a command changes in the stretch in which it changes most; and the stretch."""
    rows = min(round(_STRETCH / run.period), len(run.command) - 1)
    passed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(run.command[:, column])))])
    changes = passed[rows:] - passed[: len(passed) - rows]
    first = int(np.argmax(changes))
    return float(changes[first]), run.part(first, first + rows)
