"""Pictures of the steps of the gap search: docs/how_it_works/gap_step_*.png.

    python tools/studies/gap_steps_pictures.py

The test rig has a dead band of 3 % where its model has 1 %, as in the tutorial "Find the gap".
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import hydrotele as ht
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, hypotheses, limit_to_domain
from hydrotele.estimate.levels import smoothed_inputs
from hydrotele.estimate.track import STEP, track_run
from hydrotele.gap.machine_model import MachineModel
from hydrotele.gap.model_search import Model, Proposal, extensions, is_direct, propose, settle, settle_noise

OUT = Path(__file__).resolve().parents[2] / "docs" / "how_it_works"
DEADBAND = 0.03  # of the simulated machine
COMMANDS = {  # valve commands at the times 0, 1, 2 ... s
    "slow": [0.0, 0.2, 0.3, 0.0, -0.2, -0.3, 0.0, 0.4, 0.0, -0.4, 0.0],
    "fast": [0.0, 0.5, -0.5, 0.6, -0.6, 0.7, -0.7, 0.4, -0.4, 0.2, 0.0],
    "test": [0.0, 0.3, -0.3, 0.1, 0.5, -0.5, -0.1, 0.6, -0.6, 0.0, 0.0],
}
CHANNEL = "length.slide"
SHOWN_EFFECTS = 12


def record_logs(folder: Path) -> None:
    """Simulate the three runs."""
    effect = f"[{{name: valve_deadband, location: slide, parameters: {{deadband: {DEADBAND}}}}}]"
    for run, commands in COMMANDS.items():
        times = list(range(len(commands)))
        pilot = (
            f"{{kind: table, quantity: command, interpolate: linear, time: {times}, columns: {{slide: {commands}}}}}"
        )
        keys = {"pilot": pilot, "effects": effect, "duration": "10", "control_rate": "200", "log_rate": "200"}
        ht.save_log(ht.run_scenario(ht.load_scenario("rig_steps", keys)).measured, folder / f"{run}.parquet")


def label_of(proposal: Proposal) -> str:
    """Return effect and location of a proposal."""
    return ", ".join(proposal.key)


def draw_bars(names: Sequence[str], factors: Sequence[float], height: float, label: str):
    """Return a figure with a bar per effect."""
    figure, axis = plt.subplots(figsize=(8, height), layout="constrained")
    axis.barh(names, factors)
    axis.invert_yaxis()
    axis.set(xlabel=label)
    return figure


def save(figure, name: str) -> None:
    """Write a picture."""
    figure.savefig(OUT / f"gap_step_{name}.png", dpi=90)
    plt.close(figure)


def main() -> None:
    """Write all pictures."""
    matplotlib.use("agg")
    with tempfile.TemporaryDirectory() as folder:
        record_logs(Path(folder))
        data = ht.load_dataset(folder, ht.load_machine("rig"), heldout="test")
    column, run = data.channels.index(CHANNEL), data.fit[0]
    time = np.arange(len(run.command)) * run.period

    stated = track_run(data.machine, data, run)
    figure, axes = plt.subplots(2, 1, figsize=(8, 4), sharex=True, layout="constrained")
    axes[0].plot(time, run.command[:, 0])
    axes[0].set(ylabel="command [1]")
    axes[1].plot(time, stated.whitened[:, column], linewidth=0.7)
    axes[1].axhspan(-2, 2, color="0.85", zorder=0)
    axes[1].set(xlabel="time [s]", ylabel="prediction error of the\nstroke / its std. deviation")
    save(figure, "1_errors")

    evidence = Evidence(data, data.fit, 1, STEP, lacking=True)
    try:
        model = MachineModel(evidence)
        given = Model(settle_noise(model, model.judge(Guess())))
        track = next(t for t in given.judged.tracks if t.run.name == run.name)
        inputs = smoothed_inputs(track)
        labels = {
            "force": "force [N]",
            "command": "command [1]",
            "flow_head": "head flow [m³/s]",
            "flow_rod": "rod flow [m³/s]",
        }
        count = len(track.levels.inputs)
        figure, axes = plt.subplots(
            count, 1, figsize=(8, 1.6 * count), sharex=True, layout="constrained", squeeze=False
        )
        for axis, item, values in zip(axes[:, 0], track.levels.inputs, inputs.T, strict=True):
            axis.plot(time, values)
            axis.set(ylabel=labels.get(item.balance, item.balance))
        axes[-1, 0].set(xlabel="time [s]")
        save(figure, "2_residual_inputs")

        candidates = model.prepare(limit_to_domain(hypotheses(data.machine), data.machine)[0], given.judged)
        proposals, _ = propose(model, given, [c for c in candidates if not is_direct(c)])
        single = [p for p in proposals if len(p.parts) == 1]
        names, factors = [label_of(p) for p in single], [p.factor for p in single]
        label = "twice the log Bayes factor, linear step"
        save(draw_bars(names[:SHOWN_EFFECTS], factors[:SHOWN_EFFECTS], 4, label), "3_screening")

        models = sorted((settle(model, m) for m in extensions(model, given, single)), key=lambda m: m.score)
        names = [f"{h.name}, {h.location}" for m in models for h in m.guess.hypotheses[-1:]]
        label = "twice the log Bayes factor after refinement"
        save(draw_bars(names, [given.score - m.score for m in models], 2, label), "4_fits")
    finally:
        evidence.close()

    corrected = ht.apply_effect(data.machine, "valve_deadband", "slide", {"deadband": DEADBAND})
    figure, axis = plt.subplots(figsize=(8, 3.2), layout="constrained")
    bins = np.linspace(-8, 8, 81).tolist()
    for machine, label in ((data.machine, "given machine"), (corrected, "corrected machine")):
        errors = track_run(machine, data, data.heldout).whitened
        axis.hist(np.clip(errors[np.isfinite(errors)], -8, 8), bins, density=True, alpha=0.6, label=label)
    axis.set(
        xlabel="prediction error / its standard deviation, held-out run", ylabel="density", yscale="log", ylim=(1e-4, 1)
    )
    axis.legend()
    save(figure, "5_held_out")

    values = DEADBAND + np.linspace(-4e-5, 4e-5, 9)
    losses = []
    for value in values:
        machine = ht.apply_effect(data.machine, "valve_deadband", "slide", {"deadband": value})
        losses.append(sum(track_run(machine, data, run).loss for run in data.fit))
    a, b, c = np.polyfit(values, losses, 2)
    best, std = -b / (2 * a), 1 / np.sqrt(a)
    figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
    axis.plot(100 * values, np.array(losses) - (c - b**2 / (4 * a)), "o-")
    axis.axvspan(100 * (best - 1.96 * std), 100 * (best + 1.96 * std), color="0.85", zorder=0)
    axis.set(xlabel="dead band [%]", ylabel="-2 log likelihood,\nabove its minimum")
    save(figure, "6_interval")


if __name__ == "__main__":
    main()
