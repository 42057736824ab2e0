"""Compare the designed excitation with one as Khoshzaban used: determinant and intervals.

    python tools/studies/excitation_study.py [--harmonics 10] [--starts 4] [--seed 0] [--trials 5]
        [--out docs/validation/excitation.md]

Both motions repeat after 20 s and are run for 60 s by the simulator, with the CAT 215's sensors.
The criterion is that of the design, (det of the information)^(1/p) over p base parameters that an
ordinary motion tells; the intervals are those that the identification states, from equally long
logs, for parameters that it tells from either.
"""

import tempfile
from pathlib import Path

import numpy as np
import yaml

from hydrotele.identify.excitation import (
    Excitation,
    MachineLimits,
    compute_information,
    design_motion,
    select_determinable_parameters,
)
from hydrotele.identify.identification import identify_dynamics
from hydrotele.identify.record import build_records, compute_force_noise
from hydrotele.identify.regressor_setup import machine_setup
from hydrotele.identify.result import parameter_rows
from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario, load_scenario
from hydrotele.simulate.closed_loops import load_closed_chain
from tools.studies.study import options, publish

SENSORS, OLD, HELD_OUT = "khoshzaban1992", "excitation", "excitation_fast"


def motion_of(scenario: Scenario) -> Excitation:
    """The Fourier motion of a scenario."""
    pilot, longest = scenario.pilot, 12

    def padded(values) -> list[float]:
        return [*values, *[0.0] * (longest - len(values))]

    axes = pilot.axes
    return Excitation(
        tuple(axes), pilot.period, np.array([a.mean for a in axes.values()]),
        np.array([padded(a.sin) for a in axes.values()]),
        np.array([padded(a.cos) for a in axes.values()]), 0.0, 0.0, 0,
    )  # fmt: skip


def spreads(scenario: Scenario, trials: int) -> dict[str, float]:
    """Parameter -> mean standard deviation that the identification states."""
    machine, found = load_machine("cat215"), []
    for trial in range(trials):
        logs = []
        for one in (scenario, load_scenario(HELD_OUT)):
            seeded = one.model_copy(update={"seed": 1000 + trial})
            logs.append(RunFiles(one.name, (run_scenario(seeded).measured,)))
        data = make_dataset(sorted(logs), machine, SENSORS, HELD_OUT)
        fit, heldout, _ = build_records(data)
        setup = machine_setup(machine, load_closed_chain(machine))
        rows = parameter_rows(identify_dynamics(fit, heldout, setup))
        found.append({row.name: row.std for row in rows if row.std is not None})
    names = set.intersection(*(set(f) for f in found))
    return {n: float(np.mean([f[n] for f in found])) for n in sorted(names)}


def main() -> None:
    """Design, compare, print."""
    asked = options(__doc__, harmonics=10, starts=4, seed=0, trials=5)
    machine = load_machine("cat215")
    setup = machine_setup(machine, load_closed_chain(machine))
    noise = compute_force_noise(machine, SENSORS)
    base = select_determinable_parameters(machine, setup, noise)
    old = motion_of(load_scenario(OLD))
    new = design_motion(
        MachineLimits(machine, setup), setup, noise, base, period=old.period,
        harmonics=asked.harmonics, starts=asked.starts, seed=asked.seed,
        progress=lambda said, share: print(said, flush=True),
    )  # fmt: skip
    time = np.arange(0.0, old.period, 0.05)
    logs = [np.linalg.slogdet(compute_information(setup, one.evaluate(time), noise, base))[1] for one in (old, new)]
    better = float(np.exp((logs[1] - logs[0]) / len(base)))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "designed.yaml"
        file.write_text(yaml.safe_dump(new.to_scenario("designed", machine, 2.75, sensors=SENSORS)))
        designed = load_scenario(file)
        tracked = run_scenario(designed).summary
    long = load_scenario(OLD, {"duration": "60.0"})
    stds = [spreads(one, asked.trials) for one in (long, designed)]
    both = sorted(set(stds[0]) & set(stds[1]))
    ratios = {name: stds[0][name] / stds[1][name] for name in both}
    text = "\n".join([
        "Which motion should a machine perform so that its masses and friction can be identified best? This "
        f"study compares a designed motion with the scenario `{OLD}`, whose axes move as sums of sines as in "
        f"Khoshzaban 1992. The designed motion determines {len(stds[1])} instead of {len(stds[0])} "
        "parameters. For the parameters that both determine, its standard deviation is "
        f"{np.median(list(ratios.values())):.2f} times smaller (median).",
        "",
        f"Both motions are simulated for 60 s with the sensors of the CAT 215 in {asked.trials} trials. The "
        f"design varies the amplitudes and phases of {asked.harmonics} harmonics and keeps the limits of "
        f"joint range, stroke, flow and pressure; it starts from {asked.starts} random motions. It maximises the "
        "determinant of the information matrix, that is, it minimises the volume of the joint confidence "
        f"region (D-optimal design). The determinant is that of {len(base)} [base parameters](../terms.md): those "
        "that a random motion determines despite the sensor noise. More are determined by logs without noise "
        "([identifiability](identifiability.md)).",
        "",
        "| quantity | value |", "| --- | ---: |",
        f"| predicted information, designed motion over `{OLD}`: root of order {len(base)} of the ratio of "
        f"the determinants | {better:.1f} |",
        "| largest use of a limit (joint range, stroke, flow, pressure) by the designed motion |"
        f" {100 * new.max_utilisation:.0f} % |",
        f"| parameters determined by both motions | {len(both)} |",
        f"| parameters determined by `{OLD}` / by the designed motion |"
        f" {len(stds[0])} / {len(stds[1])} |",
        f"| standard deviation of a parameter, `{OLD}` over designed motion, median | "
        f"{np.median(list(ratios.values())):.2f} |", "",
        "The first two rows describe the design: information above 1 favours the designed motion, and the "
        "use of a limit must not exceed 100 %. Information is an inverse variance, so its square root compares "
        "with a ratio of standard deviations. The other rows come from the simulated logs. In the last row, a value "
        "above 1 favours the designed motion.",
        "",
        "A parameter is a mass property or a friction coefficient of a link or drive, in SI units. "
        "`boom_rod` and `stick_rod` are the cylinders of boom and stick. `inertia_xy` is an element of the "
        "inertia matrix, and `moment_x` is mass times the x coordinate of the centre of mass. `coulomb` is "
        "dry friction, `stribeck` additional dry friction near zero speed, and `viscous` friction per speed. "
        "`offset` is a constant force of a drive. Std: standard deviation of the estimate, smaller is "
        "better. Ratio: first std over second; above 1 the designed motion is better.",
        "",
        "| parameter | std, `excitation` | std, designed | ratio |",
        "| --- | ---: | ---: | ---: |",
        *(f"| {n} | {stds[0][n]:.3g} | {stds[1][n]:.3g} | {r:.2f} |" for n, r in ratios.items()),
        "",
    ])  # fmt: skip
    print(tracked.get("tracking"))
    publish(text, "Designed excitation", asked)


if __name__ == "__main__":
    main()
