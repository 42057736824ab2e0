"""Compare the linear stability limit of direct force feedback with the simulated machine.

python tools/studies/station_stability.py --trials 24 --seed 0 --jobs 2
"""

from typing import NamedTuple

import numpy as np

from hydrotele.cli.analyse_command import analyse_scenario
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from tools.studies.study import options, publish, side_by_side

OVERLAP = ", ".join(
    f"{{name: valve_deadband, location: {axis}, parameters: {{deadband: 0.0}}}}"
    for axis in ("swing", "boom", "stick", "bucket")
)
# the linear loop has no dead bands: neither have joystick and valves here
BARE = {
    "duration": "24", "sensors": "ideal", "pilot.stiffness": "{z: {deadband: 0.0}}",
    "effects": f"[{OVERLAP}]",
}  # fmt: skip
TARGET = 2.2e4  # N
SWING = 0.25  # of the target: half the 5 to 95 % spread of the contact force in the last third
STIFFNESS = (3e5, 2.5e6)  # N/m, of the plate
SPEED = (0.1, 0.63)  # m/s at the handle's stop
BANDWIDTH = (0.75, 3.0)  # Hz, of the force's estimate
DELAY, JITTER = 0.12, 0.03  # s each way, largest; mean of the jitter, largest
ASIDE = 1.2  # e-folds about the predicted limit of the ratio


class Row(NamedTuple):
    """One run."""

    factor: float
    swing: float


def trial(seed: int, number: int) -> Row:
    """A plate, a speed, an estimate and a network; a ratio on either side of the limit."""
    rng = np.random.default_rng([seed, number])
    stiffness, speed = (float(np.exp(rng.uniform(*np.log(r)))) for r in (STIFFNESS, SPEED))
    there, back = rng.uniform(0.0, DELAY, 2)
    jitter, hertz = rng.uniform(0.0, JITTER), rng.uniform(*BANDWIDTH)
    factor = float(np.exp(rng.uniform(-ASIDE, ASIDE)))
    plate = (
        "{kind: plate, position: [6.0, -0.11, 0.3], size: [0.8, 0.9],"
        f" stiffness: {stiffness}, damping: {0.03 * stiffness}}}"
    )
    keys = BARE | {
        "surroundings": f"[{plate}]", "pilot.coordinates.z": f"{{speed: {speed}}}",
        "pilot.bandwidth": f"{2.0 * np.pi * hertz}", "seed": f"{number}",
    }  # fmt: skip
    mean = f"{{delay_forward: {there + jitter}, delay_back: {back + jitter}}}"
    told = load_scenario("press_direct", keys | {"pilot.channel": mean})
    ratio = factor * analyse_scenario(told).loop.max_ratio
    line = f"{{delay_forward: {there}, delay_back: {back}, jitter: {jitter}}}"
    run = run_scenario(load_scenario("press_direct", keys | {"pilot.channel": line, "pilot.ratio": f"{ratio}"}))
    force = run.truth["truth.contact_force.z"]
    low, high = np.percentile(force[2 * len(force) // 3 :], [5.0, 95.0])
    return Row(factor, float(0.5 * (high - low) / TARGET))


def main() -> None:
    asked = options(__doc__, trials=24, seed=0, jobs=2)
    found = side_by_side(trial, asked)
    bands = ((0.0, 0.5), (0.5, 0.8), (0.8, 1.0), (1.0, 1.25), (1.25, 2.0), (2.0, 4.0))
    lines = ["| ratio over the predicted limit | runs | predicted stable | stable in simulation |",
             "| --- | ---: | --- | ---: |"]  # fmt: skip
    for low, high in bands:
        rows = [r for r in found if low <= r.factor < high]
        seen = sum(r.swing < SWING for r in rows)
        told = "yes" if high <= 1.0 else "no"
        lines.append(f"| {low:g} to {high:g} | {len(rows)} | {told} | {seen} |")
    right = sum((r.factor < 1.0) == (r.swing < SWING) for r in found)
    far = [r for r in found if not 0.8 <= r.factor < 1.25]
    right_far = sum((r.factor < 1.0) == (r.swing < SWING) for r in far)
    risky = sum(r.factor < 1.0 and r.swing >= SWING for r in found)
    text = "\n".join([
        "Can a linear analysis predict whether a teleoperated machine is stable over a network? `hydrotele "
        "analyse teleop` predicts the largest stable force ratio (gain from machine force to hand force), "
        "and the complete simulation checks it. In the simulation, the CAT 215 presses on a plate under rate "
        "control with direct force, with joystick, operator model, network packets, valves, oil, arm and "
        f"contact. The prediction is correct in {right} of {len(found)} runs. {len(found) - right - risky} other "
        "runs are predicted unstable but stable in simulation. Runs predicted stable that are unstable in "
        f"simulation, the dangerous error: {risky} of {sum(r.factor < 1.0 for r in found)}.",
        "",
        "Stiffness of the plate, speed of the handle and bandwidth of the force estimate are random in each "
        f"run. So are the delays (up to {1e3 * DELAY:g} ms each way) and the jitter, the variation of the "
        f"delay (mean of up to {1e3 * JITTER:g} ms). The prediction uses the mean delays. The ratio is random "
        f"between {np.exp(-ASIDE):.2f} and {np.exp(ASIDE):.1f} times the predicted limit. A run is stable in "
        f"simulation if the contact force swings by less than {100 * SWING:g} % of the target.",
        "",
        "Each row is a range of the ratio divided by the predicted limit. Below 1 all runs should be "
        "stable, above 1 none.",
        "", *lines, "",
        f"Correct (higher is better): {right} of {len(found)}; {right_far} of the {len(far)} with a ratio"
        " below 0.8 or above 1.25 times the limit.",
        "", "## Limits", "",
        "- The prediction is cautious: the simulated limit is 1.09 to 1.36 times as high "
        "([force reflection](force_reflection.md)).",
        "- The linear case omits friction, leakage, loss of contact and the corrections of the "
        "operator.",
        "",
    ])  # fmt: skip
    publish(text, "Stability of the simulated machine with direct force and jitter", asked)


if __name__ == "__main__":
    main()
