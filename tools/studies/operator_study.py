"""Study the operator model: crossover, discrimination, identification, sensitivity.

python tools/studies/operator_study.py --part all --operators 20 --records 10 --trials 60
--seeds 2 --jobs 1
"""

import dataclasses
import math
import sys
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from hydrotele.experiments.scenario_runs import compute_cylindrical_pose
from hydrotele.machine.joystick import load_joystick
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.scenario.teleoperation import OperatorSettings
from hydrotele.teleop.hand_impedance import attach_operator_hand
from hydrotele.teleop.manual_control import (
    FORMS,
    TrackingRecord,
    find_crossover,
    make_sum_of_sines,
    measure_describing_functions,
    simulate_tracking,
)
from hydrotele.teleop.operator_identification import identify_operator
from hydrotele.teleop.operator_parameters import load_operator_file, make_operator
from hydrotele.teleop.psychophysics import measure_discrimination
from tools.studies.study import options, publish

FILE, HAND = load_operator_file(), load_joystick().hand
LEARNING, PERIOD = 30.0, 120.0  # s before a record, and of its target
BANDWIDTH = 2.5  # rad/s of the target
# Of compensatory tracking at 2.5 rad/s: McRuer and Jex's adjustment rules give 5.2, 4.8 and
# 3.6 rad/s with 51, 46 and 28 degrees, side sticks of Delft 2.5 to 4 rad/s with 30 to 60 degrees.
CROSSOVER = {"K": (2.5, 6.0), "K/s": (2.5, 5.5), "K/s^2": (1.8, 4.0)}  # rad/s
MARGIN = {"K": (25.0, 70.0), "K/s": (20.0, 60.0), "K/s^2": (15.0, 50.0)}  # degrees
SLOPE = (-25.0, -15.0)  # dB per decade: -20; the neuromuscular peak flattens it by 2 to 4
HELD, STEADY = (2.0e4, 3.5e4), 6.0  # N of press_stiffness; s before the end of each
RESTING = ((7.0, 11.0), (16.0, 20.0), (25.0, 30.0))  # s of steer
DISPLAYED = {"pilot.operator.display": "both"}


def crossover(number: int | None, form: int, records: int, seed: int = 0, **known: float):
    """Crossover of the mean describing function of several simulated records."""
    him = make_operator(FILE, number, **known)
    time = np.arange(0.0, LEARNING + PERIOD, 0.01)
    done = []
    for k in range(records):
        target, frequencies = make_sum_of_sines(time, BANDWIDTH, PERIOD, seed + k)
        done.append(simulate_tracking(him, form, 2.0, target, seed=1000 * (number or 0) + seed + k))
    return find_crossover(frequencies, measure_describing_functions(done, frequencies, LEARNING)[0])


def recovered(number: int, form: int) -> list[tuple[str, bool, float]]:
    """(parameter, whether its interval contains the true value, width) of a laboratory's record."""
    him, rng = make_operator(FILE, number), np.random.default_rng([number, form, 7])
    length = LEARNING + 1.5 * PERIOD
    target, _ = make_sum_of_sines(np.arange(0.0, length, 0.01), duration=PERIOD, seed=50 + number)
    record = simulate_tracking(him, form, 2.0, target, seed=5000 + 10 * number + form)
    rate = rng.uniform(30.0, 100.0)  # Hz, with jitter, of which the fit knows nothing
    time = np.arange(LEARNING, length - 0.1, 1.0 / rate)
    time = time + rng.uniform(-0.2, 0.2, len(time)) / rate
    noisy = []
    for values in record[1:]:
        seen = np.interp(time, record.time, values)
        noisy.append(seen + 0.005 * seen.std() * rng.standard_normal(len(time)))
    fit = identify_operator(TrackingRecord(time, *noisy))
    lead = him.lead_delay if form == 2 else 0.0
    truth = {"delay": him.visual_delay + lead, "remnant": him.remnant,
             "neuromuscular_frequency": him.neuromuscular_frequency,
             "neuromuscular_damping": him.neuromuscular_damping}  # fmt: skip
    found = []
    for name, value in truth.items():
        one = fit.estimates[name]
        width = 0.5 * math.log(one.high / max(one.low, 1e-12))
        found.append((name, bool(one.low <= value <= one.high), width))
    near = crossover(number, form, 5, 50)
    for name, value in (("crossover", near.frequency), ("phase_margin", near.margin)):
        if one := fit.estimates.get(name):
            found.append((f"{name} (ratio to the measured one)", True, one.value / value - 1.0))
    return found


def held(changes: dict[str, str]) -> float:
    """Largest relative error of the two forces held by feel."""
    run = run_scenario(load_scenario("press_stiffness", changes))
    time, force = run.truth.time, run.truth["truth.contact_force.z"]
    half = 0.5 * float(time[-1])
    ends = ((half, HELD[0]), (2.0 * half, HELD[1]))
    late = [force[(time > end - STEADY) & (time <= end - 0.05)].mean() / goal - 1.0
            for end, goal in ends]  # fmt: skip
    return float(np.abs(late).max())


def tracked(changes: dict[str, str]) -> float:
    """RMS error of a tracked contact force after 10 s [N]."""
    run = run_scenario(load_scenario("track_force", changes))
    time, facts = run.truth.time, run.scenario.pilot.operator.target
    error = run.truth["truth.contact_force.z"] - np.interp(time, facts.time, facts.force)
    return float(np.sqrt(np.mean(error[time > 10.0] ** 2)))


def restless(changes: dict[str, str]) -> float:
    """RMS speed of the tip where it should rest [m/s]."""
    run = run_scenario(load_scenario("steer", changes))
    pose, time = compute_cylindrical_pose(run), run.truth.time
    rest = np.zeros(len(time), bool)
    for begin, end in RESTING:
        rest |= (time > begin) & (time < end)
    speed = [np.gradient(pose[c], time)[rest] for c in ("r", "z")]
    return float(np.sqrt(np.mean(np.square(speed))))


def person(number: int | None, seed: int, **known: float) -> dict[str, str]:
    """Overrides of a scenario for an operator."""
    made = {"seed": str(seed)}
    if number is not None:
        made["pilot.perception.sample"] = str(number)
    return made | {f"pilot.perception.{name}": str(value) for name, value in known.items()}


CONFIGURATIONS = {
    "force held by feel: error [%]": (held, {}, 100.0),
    "tracking, display and stiffness feedback: RMS error [kN]": (tracked, DISPLAYED, 1e-3),
    "tracking, display alone: RMS error [kN]": (
        tracked, DISPLAYED | {"pilot.reflection": "none"}, 1e-3),
    "tracking, stiffness feedback alone: RMS error [kN]": (tracked, {}, 1e-3),
    "tracking, neither: RMS error [kN]": (tracked, {"pilot.reflection": "none"}, 1e-3),
    "rate control: speed at rest [mm/s]": (restless, {}, 1e3),
    "position control: speed at rest [mm/s]": (restless, {"pilot.mode": "position"}, 1e3),
    "position control, joystick on a table: speed at rest [mm/s]": (
        restless, {"pilot.mode": "position", "pilot.mount": "table"}, 1e3),
}  # fmt: skip


def scenario_results(number: int) -> list[float]:
    """All configurations with one drawn operator."""
    found = [
        factor * function(more | person(number, 100 + number)) for function, more, factor in CONFIGURATIONS.values()
    ]
    say(f"operator {number}: {', '.join(f'{x:.3g}' for x in found)}")
    return found


def sensitivity(
    name: str, value: float | str, seeds: int, records: int, trials: int
) -> list[float]:  # fmt: skip
    """Results with one parameter changed, the others nominal: bench; machine by `seeds` runs."""
    known, hand = {name: value} if name else {}, HAND
    bench: dict[str, float] = {}
    if isinstance(value, str):  # grip or posture
        hand = attach_operator_hand(load_joystick(), OperatorSettings(**{name: value})).hand
    elif name:
        bench = {name: value}
    one = crossover(None, 1, records, **bench)
    him = make_operator(FILE, None, **bench)
    felt = measure_discrimination(him, hand, trials=trials).jnd
    scenario = {} if name in _BENCH_ONLY else known
    rows = []
    for seed in range(1, seeds + 1):
        changes = person(None, seed, **scenario)
        rows.append((
            100.0 * held(changes | _SHORT),
            1e3 * restless(changes),
            1e3 * restless(changes | {"pilot.mode": "position"}),
        ))  # fmt: skip
    machine = np.mean(rows, axis=0).tolist() if rows else [math.nan] * 3
    return [one.frequency, math.degrees(one.margin), 100.0 * felt, *machine]


_BENCH_ONLY = ("lead_delay", "cocontraction_stiffness_factor")  # not keys of a scenario, or without effect alone
_SHORT = {"duration": "40", "pilot.operator.target.time": "[0.0, 20.0, 20.01, 40.0]"}


def say(words: str) -> None:
    """A line for whoever waits."""
    print(words, file=sys.stderr, flush=True)


def table(head: tuple[str, ...], rows) -> str:
    """A Markdown table."""
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    return "\n".join(lines + [f"| {' | '.join(row)} |" for row in rows])


def span(values) -> str:
    """Median and range."""
    low, middle, high = np.percentile(values, [0, 50, 100])
    return f"{middle:.3g} ({low:.3g} to {high:.3g})"


def crossover_part(asked, pool) -> str:
    rows = []
    for form, name in enumerate(FORMS):
        found = list(pool.map(crossover, range(asked.operators), [form] * asked.operators,
                              [asked.records] * asked.operators))  # fmt: skip
        w, m = [c.frequency for c in found], [math.degrees(c.margin) for c in found]
        s = [c.slope for c in found]
        limits = CROSSOVER[name], MARGIN[name], SLOPE
        inside = sum(
            all(low <= x <= high for x, (low, high) in zip(one, limits, strict=True))
            for one in zip(w, m, s, strict=True)
        )
        said = [f"{low:g} to {high:g}" for low, high in limits]
        rows.append((name, span(w), said[0], span(m), said[1], span(s), said[2],
                     f"{inside}/{len(found)}"))  # fmt: skip
    say("crossover done")
    return table(
        ("element", "crossover [rad/s]", "published", "phase margin [deg]", "published",
         "slope [dB/decade]", "expected", "all three inside"), rows)  # fmt: skip


def discrimination_part(asked, pool) -> str:
    n, rows = asked.operators, []
    people = [make_operator(FILE, k) for k in range(n)]
    blunt = [dataclasses.replace(p, integration_weber=0.0) for p in people]
    vague = [dataclasses.replace(p, integration_weber=0.4) for p in people]
    for words, group, sense, reference, (low, high) in (
        ("stiffness, 1 kN/m", people, "stiffness", 1e3, (17.0, 27.0)),
        ("stiffness, 3 kN/m", people, "stiffness", 3e3, (17.0, 27.0)),
        ("force, 5 N", people, "force", 5.0, (5.0, 9.0)),
        ("stiffness, without error of integration (control)", blunt, "stiffness", 1e3,
         (17.0, 27.0)),
        ("stiffness, with twice the error of integration (control)", vague, "stiffness", 1e3,
         (17.0, 27.0)),
    ):  # fmt: skip
        jnd = list(pool.map(measure_discrimination, group, [HAND] * n, [sense] * n, [reference] * n,
                            [asked.trials] * n, range(n)))  # fmt: skip
        share = [100.0 * one.jnd for one in jnd]
        mean = float(np.mean(share))
        rows.append((words, f"{mean:.1f}", span(share), f"{low:g} to {high:g}",
                     "yes" if low <= mean <= high else "no"))  # fmt: skip
    say("discrimination done")
    head = ("quantity", "mean JND [%]", "operators", "published, with tolerance", "inside")
    return table(head, rows)


def identification_part(asked, pool) -> str:
    rows = []
    for form, name in enumerate(FORMS):
        hits: dict[str, list] = {}
        for found in pool.map(recovered, range(asked.operators), [form] * asked.operators):
            for parameter, inside, width in found:
                hits.setdefault(parameter, []).append((inside, width))
        for parameter, values in hits.items():
            inside = sum(a for a, _ in values)
            middle = 100.0 * float(np.median([b for _, b in values]))
            ratio = "ratio" in parameter
            rows.append((name, parameter, "-" if ratio else f"{inside}/{len(values)}",
                         f"{middle:+.0f} %" if ratio else f"+-{middle:.0f} %"))  # fmt: skip
    say("identification done")
    return table(("element", "parameter", "true value inside 95 %", "median half-width"), rows)


def scenario_part(asked, pool) -> str:
    found = np.array(list(pool.map(scenario_results, range(asked.operators))))
    rows = [(name, span(found[:, k])) for k, name in enumerate(CONFIGURATIONS)]

    def survives(words: str, better: int, worse: int) -> tuple[str, str]:
        wins = int((found[:, better] < found[:, worse]).sum())
        ratio = np.median(found[:, worse] / found[:, better])
        verdict = "holds" if wins >= 0.95 * len(found) else "does not hold"
        return words, f"{wins}/{len(found)} operators, median ratio {ratio:.2g}: {verdict}"

    rows += [
        survives("reflection helps tracking without a display (error without reflection over with it)", 3, 4),
        survives("reflection helps tracking with a display (error without reflection over with it)", 1, 2),
        survives("a display helps tracking without reflection (error without display over with it)", 2, 4),
        survives("lower speed at rest under rate control than under position control"
                 " (speed under position control over rate control)", 5, 6),
        survives("the same with the joystick on a table (speed under position control over rate control)", 5, 7),
    ]  # fmt: skip
    say("scenarios done")
    return table(("result", f"median (range) over {asked.operators} operators"), rows)


def sensitivity_part(asked, pool) -> str:
    cases: list[tuple[str, float | str]] = [("", 0.0)]
    for name, p in FILE.parameters.items():
        cases += [(name, value) for value in (p.low, p.high) if value != p.value]
    cases += [("grip", name) for name in FILE.grips] + [("posture", name) for name in FILE.postures]
    n = len(cases)
    found = list(pool.map(sensitivity, [c[0] for c in cases], [c[1] for c in cases],
                          [asked.seeds] * n, [asked.records] * n, [asked.trials] * n))  # fmt: skip
    rows = [("nominal", "", *(f"{x:.3g}" for x in found[0]))]
    for (name, value), one in zip(cases[1:], found[1:], strict=True):
        basis = FILE.parameters[name].basis if name in FILE.parameters else "assumption"
        at = value if isinstance(value, str) else f"{value:g}"
        cells = tuple(f"{x:.3g}" for x in one)
        if cells != rows[0][2:]:  # omit rows that repeat the nominal values
            rows.append((f"{name} ({basis})", at, *cells))
    say("sensitivity done")
    return table(
        ("parameter", "value", "crossover with K/s [rad/s]", "phase margin [deg]",
         "stiffness JND [%]", "force held by feel: error [%]",
         "rate control: speed at rest [mm/s]",
         "position control: speed at rest [mm/s]"), rows)  # fmt: skip


PARTS = {
    "Crossover in simulated tracking": crossover_part,
    "Discrimination": discrimination_part,
    "Identification of random operators": identification_part,
    "Results over random operators": scenario_part,
    "Sensitivity": sensitivity_part,
}

if __name__ == "__main__":
    asked = options(__doc__, operators=20, records=10, trials=60, seeds=2, jobs=1, part="all")
    with ProcessPoolExecutor(asked.jobs) as pool:
        text = "\n\n".join(
            f"## {title}\n\n{part(asked, pool)}" for title, part in PARTS.items()
            if asked.part in ("all", part.__name__.removesuffix("_part"))
        )  # fmt: skip
    publish(text + "\n", "Operator model", asked)
