"""Measure how often 95 % intervals of identified parameters contain the true values.

    python tools/studies/identify_coverage.py [--trials 300] [--seed 1] [--jobs 2] [--sensors NAME]
        [--out docs/validation/identify_coverage.md]

Every trial records `excitation` and `excitation_fast` of the CAT 215 anew, with its sensors' noise
and converters, and a third run to judge on. The identification starts from a machine whose masses,
centres of mass, inertia and friction are off by up to 15 %, drawn anew. Judged are all base
parameters that it gives a number for: the combination as the identification wrote it down, with the
recorded machine's numbers. The ellipsoid is that of all of them together.
"""

import dataclasses
from typing import Any

import numpy as np
from scipy.stats import chi2

from hydrotele.identify.identification import identify_dynamics
from hydrotele.identify.record import build_records
from hydrotele.identify.regressor_setup import RegressorSetup, machine_setup
from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.closed_loops import load_closed_chain
from tools.studies.study import options, publish, side_by_side

FIT, HELD_OUT = ("excitation", "excitation_fast"), "excitation_stick"
OFF = 0.15


def wrong_setup(setup: RegressorSetup, rng: np.random.Generator) -> RegressorSetup:
    """The setup with other given numbers: bodies stretched and weighted anew, friction scaled."""
    inertia = setup.chain.inertia * rng.uniform(1 - OFF, 1 + OFF, (len(setup.chain.inertia), 1))
    inertia[:, 1:4] *= rng.uniform(1 - OFF, 1 + OFF, (len(inertia), 1))
    rubbing = tuple(
        dataclasses.replace(one, nominal={k: v * rng.uniform(1 - OFF, 1 + OFF) for k, v in one.nominal.items()})
        for one in setup.friction_terms
    )
    chain = dataclasses.replace(setup.chain, inertia=inertia)
    return dataclasses.replace(setup, chain=chain, friction_terms=rubbing)


def one_trial(seed: int, number: int, sensors: str) -> dict[str, Any]:
    """Names, errors in standard deviations, and the ellipsoid of a trial."""
    machine, rng = load_machine("cat215"), np.random.default_rng([seed, number])
    logs = []
    for name in (*FIT, HELD_OUT):
        own = {"seed": str(int(rng.integers(2**31))), "sensors": sensors}
        logs.append(RunFiles(name, (run_scenario(load_scenario(name, own)).measured,)))
    dataset = make_dataset(sorted(logs), machine, sensors, HELD_OUT)
    fit, heldout, _ = build_records(dataset)
    setup = machine_setup(machine, load_closed_chain(machine))
    found = identify_dynamics(fit, heldout, wrong_setup(setup, rng))
    known = np.concatenate([setup.chain.inertia[setup.chain.bodies.index(b)] for b in setup.bodies]
                           + [list(one.nominal.values()) for one in setup.friction_terms]
                           + [np.zeros(len(setup.chain.drives))])  # fmt: skip
    truth = found.data_identifiability.combination @ known
    names = [found.names[b] for b in found.data_identifiability.base]
    away = (found.estimate.value - truth) / found.estimate.std
    return {
        "away": dict(zip(names, away.tolist(), strict=True)),
        "ellipsoid": found.estimate.squared_distance(truth) / float(chi2.ppf(0.95, len(names))),
        "heldout": {d: [h.rms, h.noise_rms] for d, h in found.heldout.items()},
        "status": found.status,
    }


def report(results: list[dict[str, Any]]) -> str:
    """A table in Markdown."""
    away = np.array([z for r in results for z in r["away"].values()])
    inside = np.abs(away) <= 1.959964
    spread = [float(np.mean(np.abs(list(r["away"].values())) <= 1.959964)) for r in results]
    sure = 1.96 * np.std(spread) / np.sqrt(len(results))
    whole = np.mean([r["ellipsoid"] <= 1.0 for r in results])
    lines = [
        "`hydrotele identify` states every parameter with a 95 % interval. This study tests whether these "
        "intervals can be trusted, that is, whether 95 % of them contain the true value. "
        f"{100 * inside.mean():.1f} % do; 93 to 97 % are required.",
        "",
        f"Each of {len(results)} experiments simulates new logs of the CAT 215 with sensor noise. The "
        f"identification starts from parameters with errors of up to {100 * OFF:.0f} %. In all, {len(away)} "
        "intervals are checked. The 95 % ellipsoid is the joint confidence region of all base parameters of "
        "an experiment (combinations that the data determine, see [terms](../terms.md)). +-: half the width of "
        "the 95 % interval of the percentage. It is larger for the ellipsoid, because each experiment has only "
        "one.",
        "",
        "| | contain the true value | required |",
        "| --- | ---: | ---: |",
        f"| 95 % intervals | {100 * inside.mean():.1f} % (+- {100 * sure:.1f}) | 93 to 97 % |",
        f"| 95 % ellipsoid of all base parameters | {100 * whole:.1f} %"
        f" (+- {100 * 1.96 * np.sqrt(whole * (1 - whole) / len(results)):.1f}) | 93 to 97 % |",
        "",
        "Each row is one parameter. `moment` is mass times a coordinate of the centre of mass, `inertia` an "
        "element of the inertia matrix ([all names](identifiability.md)). Estimated in: number of experiments "
        "whose data determine it. Intervals that contain the true value: 95 % is ideal; much less means that "
        "the intervals are too narrow, much more that they are too wide. Mean error: average of estimate minus "
        "true value, in standard deviations of the estimate; 0 is ideal.",
        "",
        "| parameter | estimated in | intervals that contain the true value | mean error [std] |",
        "| --- | ---: | ---: | ---: |",
    ]
    names = dict.fromkeys(n for r in results for n in r["away"])
    for name in names:
        own = np.array([r["away"][name] for r in results if name in r["away"]])
        lines.append(f"| {name} | {len(own)} | {100 * np.mean(np.abs(own) <= 1.959964):.1f} % | {own.mean():+.2f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    asked = options(__doc__, trials=300, seed=1, sensors="khoshzaban1992", jobs=2)
    found = side_by_side(one_trial, asked, asked.sensors)
    publish(report(found), "Coverage of identified parameters", asked)
