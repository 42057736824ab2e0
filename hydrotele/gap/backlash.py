"""Backlash: proposed by a direct search, because its likelihood has a local optimum at every contact.

A filter with white noise on the rate of an axis follows any motion, so a backlash whose parameters are not yet right
improves nothing. It is therefore looked for with the noise of the sensors alone: backlash, inertia of the drive side
and damping of the contact that leave the smallest errors in the seconds in which the command changes most. Backlashes
of several sizes start simplexes of Nelder and Mead (1965, Comput. J. 7(4)), which also move the position of the drive
side at the start of these seconds. `gap.model_search` then compares the result like any other effect.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.levels import noise_prior
from hydrotele.estimate.track import Levels, Track, track_run
from hydrotele.logs.dataset import RunData
from hydrotele.machine.machine import Machine

BACKLASH = "backlash"
_SIZES = (0.002, 0.0035, 0.006, 0.01, 0.018, 0.03)  # rad; with wider steps, one may be missed
_DAMPING_RATIO = 0.05  # to begin with: metal on metal
_SECONDS = 3.0  # of a run: some reversals of a drive
_RUNS = 4  # at most, that are fitted together
_SIMPLEX = (0.15, 0.5, 1.0, 0.4, 0.3)  # logarithms of the parameters, and the start position
_SHRINKING = (1.0, 0.3)  # times that simplex, one after the other
_STARTS = 2  # sizes from which to search
_EVALUATIONS = 60  # of a simplex
_CLOSE = 0.01  # a simplex of this size ends


def is_unexplained(judged: Judged, axis: str) -> bool:
    """Return whether a model has residual inputs on an axis."""
    levels = judged.tracks[0].levels
    return any(i.axis == axis and size > 0.0 for i, size in zip(levels.inputs, levels.sizes, strict=True))


def add_backlash(evidence: Evidence, guess: Guess, axis: str) -> Judged | None:
    """Return a model with backlash of an axis, started with the noise of the sensors alone.

    Args:
        evidence: on the fitted runs.
        guess: what else acts.
        axis: where.

    Returns:
        The extended model; None if no backlash predicts the busiest seconds better than none.
    """
    machine = evidence.data.machine
    whole = Hypothesis(BACKLASH, axis, EFFECTS[BACKLASH].parameters(machine, axis))
    levels = Levels(noise_prior(evidence.data).noise, jitter=evidence.tracks[0].levels.jitter)
    deviation = _search(evidence, guess.machine(machine), whole, levels)
    if deviation is None or deviation[0] < whole.least[0]:
        return None
    found = evidence.judged_from(guess.plus(whole, deviation), levels)
    return found if np.isfinite(found.loss) else None


def _search(evidence: Evidence, rigid: Machine, backlash: Hypothesis, levels: Levels) -> np.ndarray | None:
    """Return the likeliest deviations; None where no backlash is likelier than none."""
    data = evidence.data
    column = list(data.axes).index(backlash.location)
    parts = sorted((_busiest_seconds(run, column) for run in evidence.runs), key=lambda part: -part[0])
    stretches = [run for _, run in parts[:_RUNS]]
    table = backlash.parameters.values()
    nominal, scale = np.array([p.nominal for p in table]), np.array([p.prior_std for p in table])
    size = backlash.size

    def deviation(x: np.ndarray) -> np.ndarray:
        return np.clip((np.exp(x[:size]) - nominal) / scale, backlash.low, backlash.high)

    def track(x: np.ndarray | None, run: RunData, rest: np.ndarray | None = None) -> Track:
        machine = rigid if x is None else backlash.machine(rigid, deviation(x))
        return track_run(machine, data, run, None, evidence.step, levels, rest=rest)

    starts = [np.log([own, nominal[1], _DAMPING_RATIO, nominal[3]]) for own in _SIZES]
    none, *tracks = evidence.map(lambda x: track(x, stretches[0]), [None, *starts])
    order = sorted(range(len(starts)), key=lambda k: tracks[k].loss)
    if not tracks[order[0]].loss < none.loss:
        return None

    def first(x: np.ndarray) -> float:
        return track(x, stretches[0], np.clip(x[size:], -1.0, 1.0)).loss

    def climb(k: int) -> OptimizeResult:
        return _minimise(first, np.append(starts[k], tracks[k].rest), _SHRINKING[0])

    best = min(evidence.map(climb, order[:_STARTS]), key=lambda answer: answer.fun)
    best = _minimise(first, best.x, _SHRINKING[-1]).x[:size]  # a simplex shrinks into a local optimum
    rests = evidence.map(lambda run: track(best, run).rest, stretches)

    def loss(x: np.ndarray) -> float:
        pairs = list(zip(stretches, rests, strict=True))
        return sum(evidence.map(lambda pair: track(x, *pair).loss, pairs))

    return deviation(_minimise(loss, best, _SHRINKING[-1]).x)


def _minimise(loss: Callable[[np.ndarray], float], begin: np.ndarray, size: float) -> OptimizeResult:
    simplex = np.vstack([begin, *(begin + size * np.diag(_SIMPLEX[: len(begin)]))])
    return minimize(
        loss, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": _CLOSE, "fatol": 1.0},
    )  # fmt: skip


def _busiest_seconds(run: RunData, column: int) -> tuple[float, RunData]:
    """Return by how much a command changes in the seconds in which it changes most, and these seconds."""
    rows = min(round(_SECONDS / run.period), len(run.command) - 1)
    passed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(run.command[:, column])))])
    changes = passed[rows:] - passed[: len(passed) - rows]
    first = int(np.argmax(changes))
    return float(changes[first]), run.select_rows(first, first + rows)
