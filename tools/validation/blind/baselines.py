"""Run other identification methods on the same trials and compare their scores.

    python -m tools.validation.blind.baselines --out runs/world --limit 600
        --methods single,cma,sparse,network

- `single`: every effect of the library is tried once, linearised; the best few are fitted by
  `scipy.optimize.least_squares` on the output error (free runs of 5 s); the best one is named.
- `cma`: CMA-ES over the parameters of all effects at once on the same error, as PACE identifies
  actuators; named is the effect that moved furthest in units of its scale.
- `sparse`: what a row changes beyond the model's prediction, regressed on physical terms by
  sequentially thresholded least squares (SINDy: Brunton, Proctor and Kutz 2016); the largest term
  that is the form of an effect is named.
- `network`: the same target, a multilayer perceptron (scikit-learn); it names nothing.

All get the logs and the nominal machine only. Free runs are made by the independent machine in its
nominal form, which is the nominal model; each window starts from smoothed readings. `closed` is the
share of the mean square above the error that a perfect model has with such starts. An answer that
does not lower the error of free runs in the fit runs is dropped. Needs the extra `baselines`.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter, savgol_filter

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.logs.log import Log, load_log
from hydrotele.machine.machine import Machine as Facts
from hydrotele.machine.machine import get_sensor_set, reading_noise_rms
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.score import share
from tools.validation.blind.spreads import SIZES
from tools.validation.blind.trials import Place, write_json
from tools.validation.blind.world import (
    PA,
    PB,
    QD,
    STATES,
    WD,
    Machine,
    Q,
    R,
    S,
    W,
    linkage,
    simulate,
)
from tools.validation.blind.world_judge import closed
from tools.validation.blind.world_machine import channels
from tools.validation.blind.world_runs import SENSORS, STEP, Noise, nominal_world
from tools.validation.blind.world_trials import load_world_series

WINDOW = 5.0  # s
_EVERY = 4  # of the windows is fitted
_FITTED = 6  # best effects of the linearised pass that are fitted in full
_BETTER = 0.98  # of the nominal model's mean square in the fit runs, or the answer is dropped
_THRESHOLD = 0.15  # of a regression's largest normalised coefficient


class Problem(NamedTuple):
    """Logs as arrays.

    Attributes:
        facts: the nominal machine.
        period: of a row [s].
        commands: (rows, n) of each run, the held-out one last.
        readings: (rows, c) of each run.
        states: (rows, n, STATES) smoothed states of each run.
        size: (c,) standard deviation of a reading.
        until: processor time at which the method has to stop [s].
    """

    facts: Facts
    period: float
    commands: list[np.ndarray]
    readings: list[np.ndarray]
    states: list[np.ndarray]
    size: np.ndarray
    until: float


class Answer(NamedTuple):
    """What a method says: `name(place)` or nothing, and how it predicts windows of a run."""

    named: str | None
    predict: Callable[[np.ndarray, np.ndarray, int], np.ndarray]


def make_problem(folder: Path, facts: Facts, limit: float) -> Problem:
    """Read a trial's logs.

    Args:
        folder: of the four logs.
        facts: the nominal machine.
        limit: processor time that the method has [s].

    Returns:
        The problem.
    """
    logs = [load_log(folder / f"{name}.parquet") for name in ("fit_1", "fit_2", "fit_3", "test_1")]
    sensors, names = get_sensor_set(facts, SENSORS[facts.name]), channels(facts)
    size = np.array([reading_noise_rms(facts, sensors, name) for name in names])
    commands = [np.column_stack([log[f"command.{a}"] for a in facts.axes]) for log in logs]
    readings = [np.column_stack([log[name] for name in names]) for log in logs]
    period = float(logs[0].time[1] - logs[0].time[0])
    states = [_smoothed(facts, log, u, period) for log, u in zip(logs, commands, strict=True)]
    return Problem(facts, period, commands, readings, states, size, time.process_time() + limit)


def _smoothed(facts: Facts, log: Log, commands: np.ndarray, period: float) -> np.ndarray:
    """States (rows, n, STATES) from readings alone: local cubics, spools from their commands."""
    states = np.zeros((len(log), len(facts.axes), STATES))
    wide, narrow = (max(5, 2 * round(0.5 * s / period) + 1) for s in (0.24, 0.14))
    for i, axis in enumerate(facts.axes):
        place = log[f"{facts.position_kind(axis)}.{axis}"]
        states[:, i, Q] = states[:, i, QD] = savgol_filter(place, wide, 3)
        states[:, i, W] = savgol_filter(place, wide, 3, deriv=1, delta=period)
        states[:, i, WD] = states[:, i, W]
        states[:, i, PA] = savgol_filter(log[f"pressure_head.{axis}"], narrow, 3)
        states[:, i, PB] = savgol_filter(log[f"pressure_rod.{axis}"], narrow, 3)
        valve = facts.axes[axis].valve
        assert valve
        fine, w, z = 20, valve.bandwidth, valve.damping
        h = period / fine
        top = [0.0, (w * h) ** 2]
        spool = lfilter(top, [1.0, 2 * z * w * h - 2.0, 1.0 - 2 * z * w * h + (w * h) ** 2],
                        np.repeat(commands[:, i], fine))  # fmt: skip
        states[:, i, S] = spool[::fine]
        states[:, i, R] = np.gradient(spool, h)[::fine]
    return states


def windows_of(rows: int, period: float) -> np.ndarray:
    """First rows of the windows that follow each other."""
    length = round(WINDOW / period)
    return np.arange(0, rows - length + 1, length)


def free_run(
    machine: Machine, name: str, starts: np.ndarray, commands: np.ndarray, first: int, rows: int,
    period: float,
) -> np.ndarray:  # fmt: skip
    """Channels (rows, c) of one window from the state before its first row."""
    u = commands[first : first + rows]
    n = u.shape[1]
    zeros, states = np.zeros((rows, n)), np.zeros((rows, n, STATES))
    return simulate(
        machine, starts[first], u.copy(), False, zeros, zeros, zeros, np.ones((7, n)),
        np.zeros((rows, len(machine.sensors.scale))), period, round(period / STEP[name]), 0, states,
    )[1]  # fmt: skip


def world_prediction(problem: Problem, facts: Facts) -> Callable:
    """Prediction by the nominal laws with the numbers of a machine."""
    machine = nominal_world(facts)
    return lambda states, commands, first: free_run(
        machine, facts.name, states, commands, first, round(WINDOW / problem.period),
        problem.period,
    )  # fmt: skip


def errors(problem: Problem, predict: Callable, run: int, every: int = 1) -> np.ndarray:
    """Errors of the windows of a run, flat, in standard deviations; bounded at 1000."""
    length = round(WINDOW / problem.period)
    found = []
    for first in windows_of(len(problem.commands[run]), problem.period)[::every]:
        shown = predict(problem.states[run], problem.commands[run], first)
        found.append((shown - problem.readings[run][first : first + length]) / problem.size)
    return np.clip(np.nan_to_num(np.concatenate(found), nan=1e3), -1e3, 1e3).ravel()


def floor(problem: Problem, rng: np.random.Generator) -> float:
    """RMS error that a perfect model has on the held-out run, whose starts come from readings."""
    facts, run = problem.facts, len(problem.commands) - 1
    machine, u = nominal_world(facts), problem.commands[-1]
    shown = free_run(machine, facts.name, problem.states[run], u, 0, len(u), problem.period)
    readings = shown + Noise({}).draw(facts, len(u), rng)
    names = [f"command.{a}" for a in facts.axes] + channels(facts)
    values = dict(zip(names, [*u.T, *readings.T], strict=True))
    log = Log(problem.period * np.arange(len(u)), values, dict.fromkeys(names, "1") | _units(names))
    perfect = problem._replace(readings=[readings], commands=[u], states=[_smoothed(facts, log, u, problem.period)])
    return float(np.sqrt(np.mean(errors(perfect, world_prediction(problem, facts), 0) ** 2)))


def _units(names: list[str]) -> dict[str, str]:
    from hydrotele.machine.log_channels import default_channel_unit

    return {name: default_channel_unit(name, names) for name in names}


class Number(NamedTuple):
    """A parameter of an effect somewhere."""

    effect: str
    place: str
    key: str
    nominal: float
    low: float
    high: float
    scale: float


def library_numbers(facts: Facts) -> list[list[Number]]:
    """Parameters of all effects that the independent machine can have, by effect and place."""
    found = []
    for name in SIZES:
        effect = EFFECTS[name]
        for place in effect.locations(facts):
            if name == "joint_flexibility" and facts.axes[place].cylinder:
                continue
            found.append([
                Number(name, place, key, p.nominal, p.lower_bound, p.upper_bound, p.prior_std)
                for key, p in effect.parameters(facts, place).items()
            ])  # fmt: skip
    return found


def changed(facts: Facts, group: list[Number], deviations: np.ndarray) -> Facts:
    """Facts with an effect, whose numbers deviate by multiples of their scales."""
    values = {
        p.key: float(np.clip(p.nominal + d * p.scale, p.low, p.high)) for p, d in zip(group, deviations, strict=True)
    }
    return apply_effect(facts, group[0].effect, group[0].place, values)


def _label(group: list[Number]) -> str:
    return f"{group[0].effect}({group[0].place})"


def _output_error(problem: Problem, facts: Facts) -> np.ndarray:
    try:
        predict = world_prediction(problem, facts)
    except (InputError, ValueError):  # a linkage that does not close, an effect it cannot have
        predict = lambda states, commands, first: np.full(  # noqa: E731
            (round(WINDOW / problem.period), len(problem.size)), np.nan
        )
    runs = range(len(problem.commands) - 1)
    return np.concatenate([errors(problem, predict, run, _EVERY) for run in runs])


def best_single(problem: Problem) -> Answer:
    """The effect whose fit leaves the least output error."""
    base = _output_error(problem, problem.facts)
    ranking = []
    for group in library_numbers(problem.facts):
        if time.process_time() > problem.until:
            break
        columns = []
        for k in range(len(group)):
            room = (group[k].high - group[k].nominal) / group[k].scale
            step = 0.3 if room > 0.3 else -0.3
            moved = changed(problem.facts, group, step * np.eye(len(group))[k])
            columns.append((_output_error(problem, moved) - base) / step)
        slope = np.column_stack(columns)
        left = np.linalg.lstsq(slope, -base, rcond=1e-8)
        gain = float(base @ base - np.sum((base + slope @ left[0]) ** 2))
        ranking.append((gain, group, np.clip(left[0], -2.0, 2.0)))
    ranking.sort(key=lambda row: -row[0])
    best = (float(base @ base), None, problem.facts)
    for _, group, guess in ranking[:_FITTED]:
        if time.process_time() > problem.until:
            break
        low = np.array([(p.low - p.nominal) / p.scale for p in group])
        high = np.array([(p.high - p.nominal) / p.scale for p in group])
        fit = least_squares(
            lambda d, group=group: _output_error(problem, changed(problem.facts, group, d)),
            np.clip(guess, low + 1e-6, high - 1e-6), bounds=(low, high), diff_step=0.02,
            loss="soft_l1", max_nfev=8,
        )  # fmt: skip
        size = float(np.sum(fit.fun**2))
        if size < best[0]:
            best = (size, _label(group), changed(problem.facts, group, fit.x))
    return Answer(best[1], world_prediction(problem, best[2]))


def evolution(problem: Problem) -> Answer:
    """CMA-ES over all parameters; what moved furthest is named."""
    import cma

    groups = library_numbers(problem.facts)
    numbers = [p for group in groups for p in group]
    low = [(p.low - p.nominal) / p.scale for p in numbers]
    high = [(p.high - p.nominal) / p.scale for p in numbers]

    def build(deviations: np.ndarray) -> Facts:
        facts, at = problem.facts, 0
        for group in groups:
            part = np.asarray(deviations[at : at + len(group)])
            at += len(group)
            if np.any(np.abs(part) > 0.05):  # an effect that is hardly there would only cost time
                facts = changed(facts, group, part)
        return facts

    def loss(deviations: np.ndarray) -> float:
        try:
            facts = build(deviations)
        except (InputError, ValueError):
            return 1e6
        return float(np.mean(np.log1p(_output_error(problem, facts) ** 2)))

    strategy = cma.CMAEvolutionStrategy(np.zeros(len(numbers)), 0.3, {"bounds": [low, high], "seed": 1, "verbose": -9})
    while not strategy.stop() and time.process_time() < problem.until:
        asked = strategy.ask()
        strategy.tell(asked, [loss(x) for x in asked])
    found = np.asarray(strategy.result.xbest)
    largest = numbers[int(np.argmax(np.abs(found)))]
    named = f"{largest.effect}({largest.place})" if np.abs(found).max() > 0.5 else None
    return Answer(named, world_prediction(problem, build(found)))


# Terms of the regression per axis, and the effect that has their form in a balance.
_TERMS = ("1", "v", "sgn v", "v |v|", "x", "p_A - p_B", "sgn sqrt|p_A - p_B|", "s", "s |s|",
          "p_A", "p_B", "v exp")  # fmt: skip
_MEANINGS = {
    ("force", "v"): "viscous_friction", ("force", "sgn v"): "coulomb_friction",
    ("force", "v |v|"): "viscous_friction", ("force", "v exp"): "stribeck_friction",
    ("force", "1"): "com_offset", ("force", "x"): "com_offset",
    ("force", "p_A - p_B"): "inertia_error", ("flow", "p_A - p_B"): "internal_leakage",
    ("flow", "sgn sqrt|p_A - p_B|"): "internal_leakage", ("flow", "s"): "valve_gain",
    ("flow", "s |s|"): "valve_deadband", ("flow", "v"): "hose_compliance",
}  # fmt: skip


def _features(machine: Machine, states: np.ndarray) -> np.ndarray:
    """Terms (rows, n, m) of smoothed or simulated states (rows, n, STATES)."""
    rows, n, _ = states.shape
    out = np.zeros((rows, n, len(_TERMS)))
    for i in range(n):
        q, w, s, a, b = (states[:, i, k] for k in (Q, W, S, PA, PB))
        places = np.array([linkage(machine.mechanism, i, value) for value in q])
        x, v, d = places[:, 0], places[:, 1] * w, (a - b) / 1e7
        sign = np.tanh(v / 0.01)
        terms = (np.ones(rows), v, sign, v * np.abs(v), x, d, np.sign(d) * np.sqrt(np.abs(d)), s,
                 s * np.abs(s), a / 1e7, b / 1e7, sign * np.exp(-np.abs(v) / 0.03))  # fmt: skip
        out[:, i] = np.column_stack(terms)
    return out


def _targets(problem: Problem, run: int) -> np.ndarray:
    """What a row changes beyond the model: (rows - 1, n, 3) of velocity and both pressures, per s.

    Taken over five rows, so that differences of smoothed states rise above their noise.
    """
    machine, states, span = nominal_world(problem.facts), problem.states[run], 5
    rows = len(states)
    out = np.zeros((rows - span, states.shape[1], 3))
    for first in range(rows - span):
        u = problem.commands[run][first : first + span + 1]
        n = u.shape[1]
        zeros, ends = np.zeros((span + 1, n)), np.zeros((span + 1, n, STATES))
        simulate(machine, states[first], u.copy(), False, zeros, zeros, zeros, np.ones((7, n)),
                 np.zeros((span + 1, len(problem.size))), problem.period,
                 round(problem.period / STEP[problem.facts.name]), 0, ends)  # fmt: skip
        out[first] = states[first + span][:, [W, PA, PB]] - ends[-1][:, [W, PA, PB]]
    return out / (span * problem.period)


def _corrected(problem: Problem, correction: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """Prediction by the nominal model, whose state gets a correction after every row."""
    machine = nominal_world(problem.facts)
    steps = round(problem.period / STEP[problem.facts.name])
    c, rows = len(problem.size), round(WINDOW / problem.period)

    def predict(states: np.ndarray, commands: np.ndarray, first: int) -> np.ndarray:
        y, shown = states[first].copy(), np.zeros((rows, c))
        n = commands.shape[1]
        zeros, ends = np.zeros((2, n)), np.zeros((2, n, STATES))
        for row in range(rows):
            u = commands[[first + row, first + row]]
            found = simulate(machine, y, u.copy(), False, zeros, zeros, zeros, np.ones((7, n)),
                             np.zeros((2, c)), problem.period, steps, 0, ends)  # fmt: skip
            shown[row] = found[1][0]
            y = ends[-1].copy()
            y[:, [W, PA, PB]] += problem.period * correction(y[None])[0]
            if not np.isfinite(y).all():
                shown[row:] = np.nan
                break
        return shown

    return predict


def _training(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    machine = nominal_world(problem.facts)
    runs = range(len(problem.commands) - 1)
    targets = [_targets(problem, run) for run in runs]
    features = [_features(machine, problem.states[run])[: len(targets[run])] for run in runs]
    return np.concatenate(features), np.concatenate(targets)


def _size(problem: Problem, predict: Callable) -> float:
    """Sum of the squared errors of the free runs that are fitted."""
    runs = range(len(problem.commands) - 1)
    return sum(float(np.sum(errors(problem, predict, run, _EVERY) ** 2)) for run in runs)


def _helpful(problem: Problem, correction: Callable, order: list[tuple[int, int]]) -> np.ndarray:
    """Mask (n, 3) of the balances whose correction lowers the error of free runs, one by one.

    A regression that fits every row can still spoil a free run; all balances at once mostly do.
    """
    mask = np.zeros((len(problem.facts.axes), 3))
    best = _size(problem, world_prediction(problem, problem.facts))
    for i, k in order:
        if time.process_time() > problem.until:
            break
        mask[i, k] = 1.0
        size = _size(problem, _corrected(problem, lambda y: mask * correction(y)))
        if size < _BETTER * best:
            best = size
        else:
            mask[i, k] = 0.0
    return mask


def sparse(problem: Problem) -> Answer:
    """Sequentially thresholded least squares of every balance; the best one's term is named."""
    features, targets = _training(problem)
    n, m = features.shape[1:]
    weights, told = np.zeros((n, m, 3)), {}
    names = list(problem.facts.axes)
    for i in range(n):
        size = np.maximum(features[:, i].std(axis=0), 1e-9)
        size[0] = 1.0
        X = features[:, i] / size
        for k in range(3):
            kept, target = np.arange(m), targets[:, i, k]
            for _ in range(10):
                found = np.linalg.lstsq(X[:, kept], target, rcond=1e-8)[0]
                large = np.abs(found) >= _THRESHOLD * np.abs(found).max()
                if large.all():
                    break
                kept = kept[large]
            weights[i, kept, k] = found / size[kept]
            explained = float(np.var(X[:, kept] @ found) / np.var(target))
            balance = "force" if k == 0 else "flow"
            terms = [_TERMS[kept[j]] for j in np.argsort(-np.abs(found))]
            meanings = [_MEANINGS[balance, t] for t in terms if (balance, t) in _MEANINGS]
            told[i, k] = (explained, meanings[0] if meanings else None)
    machine = nominal_world(problem.facts)

    def correction(states: np.ndarray) -> np.ndarray:
        return np.einsum("rim,imk->rik", _features(machine, states), weights)

    order = sorted(told, key=lambda at: -told[at][0])
    mask = _helpful(problem, correction, order)
    first = next((at for at in order if mask[at] and told[at][1]), None)
    named = f"{told[first][1]}({names[first[0]]})" if first else None
    return Answer(named, _corrected(problem, lambda y: mask * correction(y)))


def network(problem: Problem) -> Answer:
    """A multilayer perceptron for the same correction."""
    from sklearn.neural_network import MLPRegressor
    from sklearn.preprocessing import StandardScaler

    features, targets = _training(problem)
    flat, wanted = features[:, :, 1:].reshape(len(features), -1), targets.reshape(len(targets), -1)
    inputs, outputs = StandardScaler().fit(flat), StandardScaler().fit(wanted)
    model = MLPRegressor(hidden_layer_sizes=(48, 48), early_stopping=True, max_iter=400, random_state=1, alpha=1e-3)
    model.fit(inputs.transform(flat), outputs.transform(wanted))
    machine, n = nominal_world(problem.facts), targets.shape[1]

    def correction(states: np.ndarray) -> np.ndarray:
        seen = _features(machine, states)[:, :, 1:].reshape(len(states), -1)
        found = outputs.inverse_transform(model.predict(inputs.transform(np.nan_to_num(seen))))
        return found.reshape(len(states), -1, 3)

    left = wanted - outputs.inverse_transform(model.predict(inputs.transform(flat)))
    explained = (1.0 - left.var(axis=0) / wanted.var(axis=0)).reshape(n, 3)
    order = sorted(np.ndindex(n, 3), key=lambda at: -explained[at])
    mask = _helpful(problem, correction, order)
    return Answer(None, _corrected(problem, lambda y: mask * correction(y)))


METHODS: dict[str, Callable[[Problem], Answer]] = {
    "single": best_single, "cma": evolution, "sparse": sparse, "network": network,
}  # fmt: skip


def run_method(name: str, folder: Path, facts: Facts, limit: float) -> dict[str, Any]:
    """Let a method answer and judge its free runs on the held-out run.

    Returns:
        `named`, RMS errors `before`, `after` and `floor` over 5 s, `closed`, `seconds`.
    """
    begin = time.perf_counter()
    problem = make_problem(folder, facts, limit)
    answer = METHODS[name](problem)
    last = len(problem.commands) - 1

    def rms(predict: Callable) -> float:
        return float(np.sqrt(np.mean(errors(problem, predict, last) ** 2)))

    nominal = world_prediction(problem, facts)
    if _size(problem, answer.predict) > _BETTER * _size(problem, nominal):
        answer = Answer(None, nominal)
    before, after = rms(nominal), rms(answer.predict)
    perfect = floor(problem, np.random.default_rng(0))
    return {
        "named": answer.named, "before": before, "after": after, "floor": perfect,
        "closed": closed(before, after, perfect), "seconds": time.perf_counter() - begin,
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown: by method and kind how often the right effect is named, and what is closed."""
    lines = [
        "| method | kind | trials | named correctly | named although nothing is hidden |"
        " median error reduction over 5 s | median s |",
        "| --- | --- | ---: | --- | --- | ---: | ---: |",
    ]
    for method in METHODS:
        for kind in sorted({row["kind"] for row in rows}):
            chosen = [r for r in rows if r["method"] == method and r["kind"] == kind]
            if not chosen:
                continue
            planted = share([r["right"] for r in chosen if r["planted"]])
            bare = share([r["named"] is not None for r in chosen if not r["planted"]])
            gaps = [r["closed"] for r in chosen if r["closed"] is not None]
            cells = [f"{100 * p['share']:.0f} % of {p['of']}" if p else "-" for p in (planted, bare)]
            shut = f"{np.median(gaps):.2f}" if gaps else "-"
            seconds = np.median([r["seconds"] for r in chosen])
            lines.append(f"| {method} | {kind} | {len(chosen)} | {cells[0]} | {cells[1]} | {shut} |"
                         f" {seconds:.0f} |")  # fmt: skip
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run the methods on a series and write `baselines.md`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of a series")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--only", nargs="+", metavar="ID", help="these trials")
    parser.add_argument("--limit", type=float, default=600.0, help="processor time per method and trial [s]")
    args = parser.parse_args()
    series = load_world_series(args.out)
    facts, rows = load_machine(series.machine), []
    for trial in args.only or series.names():
        place = Place(args.out, trial)
        if not place.key.is_file():
            continue
        key, path = json.loads(place.key.read_text()), place.folder / "baselines.json"
        found = json.loads(path.read_text()) if path.is_file() else {}
        for method in args.methods.split(","):
            if method not in METHODS:
                raise InputError(f"--methods {method}", f"the methods are {', '.join(METHODS)}")
            if method not in found:
                found[method] = run_method(method, place.data, facts, args.limit)
                write_json(path, found)
        pairs = [f"{n}({at})" for part in key["planted"] for n, at in part["right"]]
        rows += [
            {"method": m, "kind": key["kind"], "planted": bool(key["planted"]),
             "right": answer["named"] in pairs, **answer}
            for m, answer in found.items()
        ]  # fmt: skip
        print(f"{trial} done", flush=True)
    (args.out / "baselines.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
