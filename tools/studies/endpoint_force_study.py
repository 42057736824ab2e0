"""Estimate the force at the tip from cylinder pressures, with the static and the dynamic model.

    python tools/studies/endpoint_force_study.py [--trials 5] [--seed 1] [--jobs 2]
        [--out docs/validation/endpoint_force.md]

A picture of the recursion's convergence is written beside the file.
"""

import math
import time
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.control.endpoint_force import (
    FORCE_BANDWIDTH_HZ,
    MOTION_BANDWIDTH_HZ,
    EndpointForce,
    endpoint_force_of_log,
)
from hydrotele.control.gravity_model import GravityModel, fit_gravity_to_masses, identify_gravity
from hydrotele.control.state_filter import VALUE, filter_delay, filter_signal, filter_step_matrix
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import Run, prepare_run, run_scenario
from hydrotele.scenario.scenario import Scenario, load_scenario
from hydrotele.simulate.record import start_leapfrog
from tools.studies.study import options, publish, side_by_side

REAL, IDEAL, KINDS = "khoshzaban1992", "ideal", ("static", "dynamic")
FREE = ("zhu_up", "zhu_down", "zhu_out", "zhu_in", "excitation", "excitation_fast")
BRISK = {"tool": "bucket", "duration": "24", "start.joints": "{boom: 0.5, stick: -1.55}"}
SETTLED = 1.0  # s: the filters' start is left out
WIDER = 1.3  # times the friction of the model
BANDS = ((0.5, 2.5), (0.7, 2.5), (1.0, 2.5), (1.5, 3.0), (2.0, 4.0), (3.0, 6.0), (5.0, 10.0))
OPEN = 12.0  # Hz: a slow filter that lets nearly all pass
PRESS = {
    "name": "press",
    "tool": "bucket",
    "duration": 16.0,
    "control_rate": 50,  # commands held over each row, so that the run can be repeated exactly
    "start": {"pose": {"r": 6.4, "z": 0.4, "attitude": math.radians(-80)}},
    "pilot": {"kind": "waypoints", "settle": 1.0, "points": [
        {"duration": r[0], "pause": r[1],
         "pose": {"r": r[2], "z": r[3], "attitude": math.radians(r[4])}}
        for r in ((2.0, 0.0, 6.4, 0.02, -80), (1.0, 4.0, 6.4, 0.005, -80),
                  (4.0, 0.0, 5.2, 0.005, -105), (2.0, 1.5, 5.2, 0.6, -110))
    ]},
}  # fmt: skip
WINDOWS = {"free, lowering": (1.0, 2.5), "pressed, at rest": (5.5, 8.0),
           "dragged": (8.5, 12.0), "free again": (13.5, 15.5)}  # fmt: skip

LIMITS = (
    "## Limits",
    "",
    "- The 95 % intervals of the static model are too narrow. They assume independent errors, but the "
    "remaining errors come from inertia and the shape of friction.",
    "- About two thirds of the remaining false force come from the noise of the pressures. The "
    "rest is friction of motions too slow to be distinguished from rest.",
    "- A faster estimate has a larger false force. On `zhu_up` the dynamic estimate is worse "
    "than the static one at 3 and 6 Hz and above.",
    "- A disturbance observer and a friction model of creep gave no improvement.",
    "",
)


def machine() -> Machine:
    return load_machine("cat215", "bucket")


def asked_run(name: str, sensors: str, seed: int, planted: str = "") -> Run:
    """A run of a shipped scenario with the bucket, clear of the ground."""
    keys = {"sensors": sensors, "seed": str(seed), "ground": "false"}
    if name.startswith("excitation"):
        keys |= BRISK
    if planted:
        keys["effects"] = planted
    return run_scenario(load_scenario(name, keys))


def at_the_tip(run: Run, found: dict[str, np.ndarray], true: np.ndarray | None = None):
    """Estimate less truth in the tip's directions (n, 3) [N]: r, theta over the radius, z."""
    r = np.hypot(run.truth["truth.tip.x"], run.truth["truth.tip.y"])
    felt = np.column_stack([found["r"], found["theta"] / r, found["z"]])
    return felt if true is None else felt - true


def rms(error: np.ndarray) -> float:
    return math.sqrt(float(np.mean(np.sum(error**2, axis=1))))


def false_force(
    run: Run, gravity: GravityModel, sensors: str, bands=(FORCE_BANDWIDTH_HZ, MOTION_BANDWIDTH_HZ)
) -> list[float]:
    """RMS of the false force of the static and the dynamic estimate in free motion [N]."""
    settled, out = run.measured.time >= SETTLED, []
    for kind in KINDS:
        found = endpoint_force_of_log(
            machine(), run.measured, kind, gravity, bandwidth=bands[0], motion_bandwidth=bands[1],
            sensors=get_sensor_set(machine(), sensors),
        )  # fmt: skip
        out.append(rms(at_the_tip(run, found)[settled]))
    return out


def other_ways(run: Run) -> list[float]:
    """RMS [N] of one filter, and of a momentum observer, as late as the two filters are.

    The momentum observer's first-order lag acts on the balance with the rate of the fast filter.
    """
    late, settled = (
        filter_delay(FORCE_BANDWIDTH_HZ) + filter_delay(MOTION_BANDWIDTH_HZ),
        run.measured.time >= SETTLED,
    )
    sensors, out = get_sensor_set(machine(), REAL), []
    one = filter_delay(1.0) / (late - filter_delay(OPEN))
    lag = 1.0 - math.exp(-(run.measured.rate**-1) / (late - filter_delay(MOTION_BANDWIDTH_HZ)))
    for fast in (one, MOTION_BANDWIDTH_HZ):
        found = endpoint_force_of_log(
            machine(),
            run.measured,
            "dynamic",
            bandwidth=OPEN,
            motion_bandwidth=fast,
            sensors=sensors,
        )
        felt = at_the_tip(run, found)
        for row in range(1, len(felt) if fast == MOTION_BANDWIDTH_HZ else 0):
            felt[row] = felt[row - 1] + lag * (felt[row] - felt[row - 1])
        out.append(rms(felt[settled]))
    return out


def true_contact(scenario: Scenario, run: Run) -> np.ndarray:
    """Means (n, 3) of the ground's force over every row, in the tip's directions [N].

    The run is repeated step by step: a bucket chatters over ground quicker than a log shows.
    """
    prepared = prepare_run(scenario)
    model, data = prepared.plant.model, prepared.data
    start_leapfrog(model, data)
    steps = round(1.0 / (scenario.control_rate * scenario.timestep))
    names, wrench = prepared.plant.axes, np.zeros(6)
    commands = np.column_stack([run.truth[f"command.{a}"] for a in names])
    out = np.zeros((len(commands), 3))
    for row, command in enumerate(commands[:-1]):
        data.ctrl[:] = command
        for _ in range(steps):
            mujoco.mj_step(model, data)
            for k, contact in enumerate(data.contact):
                mujoco.mj_contactForce(model, data, k, wrench)
                force = contact.frame.reshape(3, 3).T @ wrench[:3] / steps
                out[row + 1] += force if model.geom_bodyid[contact.geom[0]] == 0 else -force
    x, y = run.truth["truth.tip.x"], run.truth["truth.tip.y"]
    end = data.qpos[prepared.plant.qpos[1]] - model.opt.timestep * data.qvel[prepared.plant.dof[1]]
    assert abs(end - run.truth["angle.boom"][-1]) < 1e-9, "the run was not repeated"
    r = np.hypot(x, y)
    along, aside = x * out[:, 0] + y * out[:, 1], x * out[:, 1] - y * out[:, 0]
    return np.column_stack([along / r, aside / r, out[:, 2]])


def through_filters(signal: np.ndarray, period: float) -> np.ndarray:
    """Apply the filters of the estimate to a signal (n, 3)."""
    for band in (MOTION_BANDWIDTH_HZ, FORCE_BANDWIDTH_HZ):
        table = filter_step_matrix(band, period)
        signal = np.column_stack([filter_signal(table, c.copy())[:, VALUE] for c in signal.T])
    return signal


def one_trial(seed: int, number: int) -> dict:
    """All results that depend on the seed."""
    draw = int(np.random.default_rng([seed, number]).integers(2**31))
    slow = run_scenario(load_scenario("slow_moves", {"seed": str(draw)})).measured
    gravity, plain = (identify_gravity(machine(), slow, friction) for friction in (True, False))
    out = {"gravity": gravity, "plain": plain, "free": {}, "bands": {}, "ways": {}, "contact": {}}
    for name in FREE:
        for sensors in (IDEAL, REAL):
            run = asked_run(name, sensors, draw)
            out["free"][name, sensors] = false_force(run, gravity, sensors)
            if name in ("zhu_up", "excitation") and sensors == REAL:
                out["bands"][name] = [false_force(run, gravity, sensors, b) for b in BANDS]
            if sensors == REAL:
                out["ways"][name] = other_ways(run)
        coulomb = WIDER * machine().axes["boom"].drive.friction.coulomb
        planted = f"[{{name: coulomb_friction, location: boom, parameters: {{coulomb: {coulomb}}}}}]"
        run = asked_run(name, REAL, draw, planted)
        out["free"][name, "friction"] = false_force(run, gravity, REAL)
    for sensors in (IDEAL, REAL):
        out["contact"][sensors] = contact_errors(gravity, sensors, draw)
    return out


def contact_errors(gravity: GravityModel, sensors: str, seed: int) -> dict[str, list[float]]:
    """Window -> size of the true force, then error of static and dynamic, at once and filtered."""
    scenario = Scenario.model_validate(PRESS | {"sensors": sensors, "seed": seed})
    run = run_scenario(scenario)
    true, out = true_contact(scenario, run), {}
    late = through_filters(true, 1.0 / scenario.log_rate)
    errors = []
    for kind in KINDS:
        found = endpoint_force_of_log(
            machine(), run.measured, kind, gravity, sensors=get_sensor_set(machine(), sensors)
        )
        errors += [at_the_tip(run, found, true), at_the_tip(run, found, late)]
    for name, (begin, end) in WINDOWS.items():
        rows = (run.truth.time >= begin) & (run.truth.time < end)
        out[name] = [rms(true[rows]), *(rms(error[rows]) for error in errors)]
    return out


def cost() -> list[float]:
    """Time of one update of static and dynamic estimate [us], best of ten."""
    axes, out = tuple(machine().axes), []
    joint, head, rod = np.array([0.0, 0.45, -1.6, -1.2]), np.full(4, 4e6), np.full(4, 2e6)
    for kind in KINDS:
        felt, best = EndpointForce(machine(), axes, kind), math.inf
        felt.update(joint, head, rod)
        for _ in range(10):
            begin = time.perf_counter()
            for _ in range(5000):
                felt.update(joint, head, rod)
            best = min(best, (time.perf_counter() - begin) / 5000)
        out.append(1e6 * best)
    return out


def links_only() -> GravityModel:
    """Static model of the machine with cylinders that weigh nothing."""
    bare, axes = machine(), {}
    for name, axis in bare.axes.items():
        cylinder = axis.cylinder
        if cylinder:
            parts = {p: getattr(cylinder, p).model_copy(update={"mass": 0.0})
                     for p in ("tube", "rod")}  # fmt: skip
            axis = axis.model_copy(update={"cylinder": cylinder.model_copy(update=parts)})
        axes[name] = axis
    return fit_gravity_to_masses(bare.model_copy(update={"axes": axes}))


def parameters(results: list[dict]) -> list[str]:
    """Table of the static model's parameters."""
    exact, bare = fit_gravity_to_masses(machine()), links_only()
    first = results[0]
    spread = {key: np.array([r[key].value for r in results]) for key in ("gravity", "plain")}
    lines = [
        "| parameter [N m] | links alone | all masses | identified | 95 % interval | worst error"
        " of a trial | friction ignored: worst error |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for i, name in enumerate(exact.names):
        worst = {k: np.abs(v[:, i] - exact.value[i]).max() for k, v in spread.items()}
        lines.append(
            f"| {name} | {bare.value[i]:.0f} | {exact.value[i]:.0f} |"
            f" {first['gravity'].value[i]:.0f} | +-{first['gravity'].ci95_half_width[i]:.0f} |"
            f" {worst['gravity']:.0f} | {worst['plain']:.0f} |"
        )
    largest = np.abs(exact.value).max()
    error = max(np.abs(v - exact.value).max() for v in spread["gravity"])
    shown = ", ".join(f"{v:.0f}" for v in exact.residual)
    return [
        "## Static model", "",
        "The static estimator computes the joint torques of gravity as `tau = Y(q) P`: Y depends on the "
        "joint angles q, and P has the six gravity parameters of the table. C2 and S2 are the factors of the "
        "cosine and sine of joint angle 2 (boom). C23 and S23 belong to the sum of angles 2 and 3 (stick). "
        "C234 and S234 also include angle 4 (bucket). This table tests whether slow motions "
        "(`scenarios/slow_moves.yaml`, the machine's sensors) identify P. Columns:",
        "",
        "- links alone, all masses: true values, computed from the masses of the links, without and with "
        "those of cylinder tubes and rods;",
        "- identified, 95 % interval: estimate by recursive least squares, with a Coulomb friction of every "
        "drive as a further parameter;",
        "- worst error of a trial: largest difference from \"all masses\";",
        "- friction ignored: the same error if friction is left in the torques, as in Zhu's work.",
        "", *lines, "",
        f"The largest error is {100 * error / largest:.2f} % of the largest parameter. {shown} N m (boom, "
        "stick, bucket) of the torques of cylinders and bucket linkage cannot be represented by these "
        "parameters.",
        "",
    ]  # fmt: skip


def free_motion(results: list[dict]) -> list[str]:
    """Table of false forces."""
    said = {IDEAL: "ideal", REAL: "real", "friction": f"real, boom's friction x {WIDER}"}
    lines = [
        "## False force in free motion", "",
        "How large is the estimated force at the tip in free motion, where the true force is 0? The force "
        f"has the components r, theta (torque over the radius) and z; cells are its RMS over {len(results)} "
        f"seeds, from {SETTLED:g} s on. Ratio: dynamic over static; below 1 the dynamic estimator is better. "
        "`zhu_*` are slow straight lines between rests, `excitation*` fast motions of all axes. Sensors: "
        f"ideal (without error), real, and real with {WIDER} times the boom's friction, as an example of a "
        "machine that differs from its model.",
        "",
        "| motion | sensors | static [N] | dynamic [N] | ratio, mean | ratio, worst |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    for (name, sensors), _ in results[0]["free"].items():
        both = np.array([r["free"][name, sensors] for r in results])
        ratio = both[:, 1] / both[:, 0]
        lines.append(
            f"| {name} | {said[sensors]} | {both[:, 0].mean():.0f} | {both[:, 1].mean():.0f} |"
            f" {ratio.mean():.3f} | {ratio.max():.3f} |"
        )
    return [*lines, ""]


def bands(results: list[dict]) -> list[str]:
    """Table of false forces over the bandwidth of the filters."""
    lines = [
        "## Bandwidth", "",
        "How does the bandwidth change the false force in free motion? A faster estimate has less delay but "
        "a larger false force. Each row is one choice of the slow and the fast filter, with the machine's "
        "sensors.",
        "",
        "| slow, fast [Hz] | delay [s] | zhu_up: static, dynamic [N] |"
        " excitation: static, dynamic [N] |",
        "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for i, pair in enumerate(BANDS):
        delay = sum(filter_delay(band) for band in pair)
        cells = []
        for name in ("zhu_up", "excitation"):
            both = np.mean([r["bands"][name][i] for r in results], axis=0)
            cells.append(f"{both[0]:.0f}, {both[1]:.0f}")
        lines.append(f"| {pair[0]:g}, {pair[1]:g} | {delay:.2f} | {' | '.join(cells)} |")
    return [*lines, ""]


def ways(results: list[dict]) -> list[str]:
    """Table of other estimates."""
    lines = [
        "## Alternative estimators", "",
        "Could a simpler or another estimator do the same? Cells: false force in free motion of the dynamic "
        "estimate with the machine's sensors [N], all with the same delay; smaller is better. One filter: "
        "all signals pass one slow filter; friction computed from a filtered rate then differs from filtered "
        "friction. Momentum observer: the generalised-momentum observer of robotics. Two filters: the "
        "estimator of this page.",
        "",
        "| motion | one filter | momentum observer | two filters |",
        "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name in FREE:
        other = np.mean([r["ways"][name] for r in results], axis=0)
        own = np.mean([r["free"][name, REAL][1] for r in results])
        lines.append(f"| {name} | {other[0]:.0f} | {other[1]:.0f} | {own:.0f} |")
    return [*lines, ""]


def contact(results: list[dict]) -> list[str]:
    """Table of errors in contact."""
    lines = [
        "## Contact with the ground", "",
        "How large is the error while the bucket touches the ground? The bucket is lowered, pressed on the "
        "ground, held, then dragged towards the machine and lifted. Each row is one part of this motion. "
        "True force: RMS of the simulator's contact force. It differs between ideal and real sensors, because "
        "the controller of the motion uses the sensors. The next two columns are the RMS error of the "
        "estimate against it. Most of it is the delay of the filters. The last two columns compare with the "
        "true force passed through the same filters: this is the error of the estimator itself.",
        "",
        "| part | sensors | true force [N] | static [N] | dynamic [N] |"
        " static, filtered [N] | dynamic, filtered [N] |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name in WINDOWS:
        for sensors, said in ((IDEAL, "ideal"), (REAL, "real")):
            v = np.mean([r["contact"][sensors][name] for r in results], axis=0)
            lines.append(f"| {name} | {said} | {v[0]:.0f} | {v[1]:.0f} | {v[3]:.0f} | {v[2]:.0f} | {v[4]:.0f} |")
    return [*lines, ""]


def draw(found: GravityModel, path: Path) -> None:
    """Picture of the recursion."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(2, 3, figsize=(9.0, 4.5), sharex=True)
    exact = fit_gravity_to_masses(machine())
    for i, panel in enumerate(panels.ravel()[: len(found.names)]):
        panel.plot(found.history[:, i] / 1e3, linewidth=1.0)
        panel.axhline(exact.value[i] / 1e3, color="black", linewidth=0.8, linestyle="--")
        panel.set_title(f"{found.names[i]} [kN m]", fontsize=9)
        settled = found.history[40:, i] / 1e3
        low, high = (
            min(settled.min(), exact.value[i] / 1e3),
            max(settled.max(), exact.value[i] / 1e3),
        )
        panel.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
    for panel in panels[1]:
        panel.set_xlabel("equations")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def report(results: list[dict]) -> str:
    """The whole result in Markdown."""
    took = cost()
    lines = [
        "Can the contact force at the tip be computed from cylinder pressures, without a force sensor? Two "
        "estimators are compared with the true force of the simulated CAT 215. The static estimator "
        "subtracts gravity only; the dynamic one also subtracts inertia and friction. In free motion, where "
        "the true force is 0, the dynamic one is wrong by about 0.2 kN and the static one by 1 to 6 kN. Use "
        "the dynamic one for moving machines.",
        "",
        "All errors are RMS values; smaller is better. A fast filter gives positions, rates, accelerations "
        "and pressures with equal delay, and the force computed from them passes a slow filter. Their "
        f"bandwidths are {MOTION_BANDWIDTH_HZ:g} Hz (fast) and {FORCE_BANDWIDTH_HZ:g} Hz (slow) unless stated "
        "otherwise, with a delay of "
        f"{filter_delay(FORCE_BANDWIDTH_HZ) + filter_delay(MOTION_BANDWIDTH_HZ):.2f} s in all. One update "
        f"takes {took[0]:.0f} us (static) and {took[1]:.0f} us (dynamic) of computing time.",
        "",
        *parameters(results),
        "![Convergence](endpoint_force.png)", "",
        "Convergence of the six parameters with the number of equations (readings of slow motion) used. "
        "Blue: estimate; dashed: true value 'all masses'. A good estimate reaches the dashed line and stays "
        "there; the remaining distance is the error in the table.",
        "",
        *free_motion(results), *ways(results), *bands(results), *contact(results),
        *LIMITS,
    ]  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    asked = options(__doc__, trials=5, seed=1, jobs=2)
    found = side_by_side(one_trial, asked)
    publish(report(found), "Force at the tip from cylinder pressures", asked)
    if asked.out:
        draw(found[0]["gravity"], asked.out.with_suffix(".png"))
