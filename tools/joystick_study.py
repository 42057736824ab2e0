"""The joystick alone: steps, hovering, identification, detent, stops, a cab that shakes it.

    python tools/joystick_study.py [--trials 20] [--seed 1] [--jobs 2]
        [--out docs/results/joystick.md]

A picture of the step responses is written beside the file.
"""

from pathlib import Path

import numpy as np

from hydrotele.machine.joystick import AXES, load_joystick
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.teleop.compliance import Flotor
from hydrotele.teleop.flotor import FlotorFit, identify_flotor
from hydrotele.teleop.levitation import (
    LevitationRun,
    designed_step,
    excitation_path,
    levitation,
    pose_resolution,
    rotation_vector,
    simulate_levitation,
)
from hydrotele.teleop.master import master, master_step
from tools.handle_laws import Detent
from tools.study import options, publish, side_by_side

JOYSTICK = load_joystick()
SIZES = np.array([2e-3] * 3 + [np.deg2rad(3.0)] * 3)
PERIOD = 1.0 / JOYSTICK.control_rate
COM = (0.002, -0.001, 0.020)  # m: off its axis, so that all three are told
GUESS = Flotor(0.90, np.zeros(3), 2e-3 * np.eye(3))
ROWS = (("mass", "kg", 1.0), ("centre x", "mm", 1e3), ("centre y", "mm", 1e3),
        ("centre z", "mm", 1e3), ("I_xx", "g m^2", 1e3), ("I_yy", "g m^2", 1e3),
        ("I_zz", "g m^2", 1e3), ("I_xy", "g m^2", 1e3), ("I_xz", "g m^2", 1e3),
        ("I_yz", "g m^2", 1e3))  # fmt: skip
QUIET = np.zeros((8, 3))
MICRO = np.array([1e6] * 3 + [np.rad2deg(1.0) * 1e3] * 3)  # um and 0.001 deg


def step(axis: int, joystick=JOYSTICK, **how) -> LevitationRun:
    """0.6 s after a step of one axis."""
    target = np.zeros((121, 6))
    target[:, axis] = SIZES[axis]
    return simulate_levitation(joystick, target, **how)


def step_figures(flight: LevitationRun, axis: int) -> tuple[float, float, float]:
    """Deviation from the designed response, largest cross motion (shares), largest current [A]."""
    alone, share = JOYSTICK.alone, flight.pose / SIZES
    designed = designed_step(flight.time, alone.frequency[axis], alone.ratio[axis])
    deviation = np.abs(share[:, axis] - designed).max()
    cross = np.abs(np.delete(share, axis, axis=1)).max()
    return float(deviation), float(cross), float(np.abs(flight.currents).max())


def coils_and_eyes() -> list[str]:
    """Condition of M; resolution of the diodes."""
    coils, diodes = levitation(JOYSTICK).coils, JOYSTICK.diodes
    weight = coils.currents(np.array([0, 0, 9.81 * JOYSTICK.flotor.mass, 0, 0, 0])).value
    spread = pose_resolution(diodes.distance, diodes.step) * MICRO
    sensing = JOYSTICK.sensing
    stated = np.array([sensing.translation] * 3 + [sensing.rotation] * 3) / np.sqrt(12.0) * MICRO
    lines = [
        "## Coils and sensing", "",
        f"Condition of M, torques counted on the coils' radius: {coils.condition:.4f}. The flotor's"
        f" weight takes {np.abs(weight).max():.2f} of {coils.max_current:g} A.", "",
        f"Three beams on diodes at {1e3 * diodes.distance:g} mm that read in steps of"
        f" {1e6 * diodes.step:g} um, as standard deviation of the pose at the coils' centre,"
        " against that of rounding to the stated resolution:", "",
        "| | x | y | z [um] | rx | ry | rz [0.001 deg] |", "| --- |" + " ---: |" * 6,
        "| diodes | " + " | ".join(f"{v:.2f}" for v in spread) + " |",
        "| stated | " + " | ".join(f"{v:.2f}" for v in stated) + " |", "",
    ]  # fmt: skip
    return lines


def steps() -> list[str]:
    """Step responses and hovering, with both readings."""
    lines = [
        "## Steps and hovering", "",
        "No hand; 200 Hz; readings with errors up to one step, through the rounded pose and through"
        " the diodes. Deviation from the designed response and motion of the other axes, as shares"
        f" of the step ({1e3 * SIZES[0]:g} mm, {np.rad2deg(SIZES[3]):g} deg); largest current.", "",
        "| axis | deviation [%] | cross motion [%] | current [A] | by diodes: deviation [%] |"
        " cross motion [%] | current [A] |", "| --- |" + " ---: |" * 6,
    ]  # fmt: skip
    for axis, name in enumerate(AXES):
        cells = []
        for diodes in (False, True):
            d, c, i = step_figures(step(axis, diodes=diodes), axis)
            cells += [f"{100 * d:.2f}", f"{100 * c:.2f}", f"{i:.2f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += [
        "", "The deviation is that of 5 ms: a current is held for 5 ms, and a difference of two"
        " readings is the velocity of 2.5 ms ago.", "",
        "| hovering for 10 s | largest error of the handle [um] | RMS [um] | turning, largest"
        " [0.001 deg] |", "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, diodes in (("rounded pose", False), ("diodes", True)):
        pose = simulate_levitation(JOYSTICK, np.zeros((2200, 6)), diodes=diodes).pose[200:] * MICRO
        rms = np.sqrt(np.mean(np.sum(pose[:, :3] ** 2, axis=1)))
        lines.append(
            f"| {name} | {np.linalg.norm(pose[:, :3], axis=1).max():.2f} | {rms:.2f} |"
            f" {np.abs(pose[:, 3:]).max():.1f} |"
        )
    return [*lines, ""]


def crooked():
    """The joystick with its flotor's centre of mass off the axis."""
    return JOYSTICK.model_copy(update={"flotor": JOYSTICK.flotor.model_copy(update={"com": COM})})


def identified(seed: int, diodes: bool = False) -> tuple[FlotorFit, LevitationRun]:
    """12 s of wobbling under a control that takes the flotor for another one."""
    joystick = crooked()
    control = levitation(joystick, GUESS)
    flight = simulate_levitation(
        joystick, excitation_path(joystick, 12.0, seed), control=control, seed=seed, diodes=diodes
    )
    fit = identify_flotor(
        flight.place, flight.quaternion, flight.currents, control.period, control.coils
    )
    return fit, flight


def one_trial(seed: int, number: int) -> tuple[FlotorFit, FlotorFit]:
    """The same with other tones' phases and noise, by both readings."""
    draw = int(np.random.default_rng([seed, number]).integers(2**31))
    return identified(draw)[0], identified(draw, diodes=True)[0]


def identification(results: list[tuple[FlotorFit, FlotorFit]]) -> list[str]:
    """Table of the ten numbers, and what the control makes of them."""
    f, (first, flight) = crooked().flotor, identified(0)
    truth = np.array([f.mass, *f.com, *f.inertia, 0.0, 0.0, 0.0])
    worst = [np.max([np.abs(r[k].value - truth) for r in results], axis=0) for k in (0, 1)]
    lines = [
        "## Identification", "",
        "12 s of six tones per axis between 0.4 and 6 Hz, from readings and currents alone, under a"
        f" control that takes the flotor for one of {GUESS.mass:g} kg with its centre at the coils"
        f" and 2 g m^2 about every axis. Largest current {np.abs(flight.currents).max():.2f} A,"
        f" largest way {1e3 * np.abs(flight.pose[:, :3]).max():.1f} mm and"
        f" {np.rad2deg(np.linalg.norm(flight.pose[:, 3:], axis=1).max()):.1f} deg; condition of the"
        f" scaled equations {first.condition:.1f}. Worst errors of {len(results)} trials.", "",
        "| | true | found | 95 % interval | worst error | worst error, diodes |",
        "| --- |" + " ---: |" * 5,
    ]  # fmt: skip
    for i, (name, unit, scale) in enumerate(ROWS):
        cells = [f"{scale * truth[i]:.6f}", f"{scale * first.value[i]:.6f}"]
        cells += [f"{scale * v[i]:.1e}" for v in (first.interval, *worst)]
        lines.append(f"| {name} [{unit}] | {' | '.join(cells)} |")
    inside = [
        np.mean([np.abs(r[k].value - truth) <= r[k].interval for r in results]) for k in (0, 1)
    ]
    lines += [
        "", f"{100 * inside[0]:.0f} % of the intervals hold the truth, {100 * inside[1]:.0f} % with"
        " the diodes: they are wider than the noise makes the errors, because they also count what"
        " differences over 5 ms leave at 6 Hz. They count no error of the coils' map and none"
        " of the place of the diodes, which a real joystick has.", "",
        "| control knows | height at rest, error [um] | worst deviation of a step [%] | worst cross"
        " motion [%] |", "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, body in (("the guess", GUESS), ("what was found", first.body()),
                       ("the truth", None)):  # fmt: skip
        control = levitation(crooked(), body)
        rest = (
            simulate_levitation(crooked(), np.zeros((600, 6)), control=control).pose[200:, 2].mean()
        )
        figures = np.array([
            step_figures(step(axis, crooked(), control=control), axis)
            for axis in range(6)
        ])  # fmt: skip
        d, c = 100.0 * figures[:, :2].max(axis=0)
        lines.append(f"| {name} | {1e6 * rest:.2f} | {d:.2f} | {c:.2f} |")
    return [*lines, ""]


def seated(**keys):
    """The master's numbers and state, without a machine."""
    pilot = TeleopPilot.model_validate(
        {"kind": "teleop", "operator": {"kind": "follow"}, "reflection": "none", **keys}
    )
    return master(JOYSTICK, pilot, ("r", "theta", "z"))


def detent() -> list[str]:
    """Force that a clamp needs to lead the handle through the notch of x."""
    gains = JOYSTICK.gains["feller"]["x"]
    assert gains.detent
    law = Detent(gains.deadband, gains.detent.drop, gains.nominal, gains.detent.outside)
    numbers, s = seated(gains="feller", detent=True)
    flotor = SimulatedFlotor(JOYSTICK, hand=False)
    flotor.model.jnt_stiffness[:3], flotor.model.dof_damping[:3] = 2e4, 100.0
    lines = [
        "## Detent", "",
        "Feller-buncher's x (Zhu 1994, Table 6.11 and Fig. 6.51): a clamp of 20 N/mm leads the"
        " handle outwards and waits; force of the clamp against the law there.", "",
        "| displacement [mm] | force [N] | law [N] |", "| ---: | ---: | ---: |",
    ]  # fmt: skip
    worst = 0.0
    for place in np.arange(0.3, 4.51, 0.3) * 1e-3:
        flotor.model.qpos_spring[0] = place
        forces = []
        for k in range(200):
            master_step(numbers, flotor.data.qpos, QUIET, 1.0, PERIOD, k == 0, s)
            flotor.step(s.currents, np.zeros(6))
            forces.append(2e4 * (place - flotor.data.qpos[0]))
        now, felt = float(flotor.data.qpos[0]), float(np.mean(forces[-40:]))
        worst = max(worst, abs(felt + law.force(now)))
        lines.append(f"| {1e3 * now:.3f} | {felt:.3f} | {-law.force(now):.3f} |")
    return [*lines, "", f"Largest difference {1e3 * worst:.1f} mN.", ""]


def stops() -> list[str]:
    """How far 20 N push the handle into its stops."""
    lines = [
        "## Stops", "",
        "At rest under 20 N (2 N m about an axis), beyond 5 mm (7 deg); no hand, weight carried.",
        "", "| axis | beyond the stop |", "| --- | ---: |",
    ]  # fmt: skip
    lift = levitation(JOYSTICK).coils.currents(
        np.array([0.0, 0.0, 9.81 * JOYSTICK.flotor.mass, 0.0, 0.0, 0.0])
    ).value  # fmt: skip
    for axis, name in enumerate(AXES):
        flotor, push = SimulatedFlotor(JOYSTICK, hand=False), np.zeros(6)
        push[axis] = 20.0 if axis < 3 else 2.0
        flotor.model.dof_damping[:] = [20.0] * 3 + [0.2] * 3
        for _ in range(600):
            flotor.step(lift, push)
        pose = np.concatenate([flotor.data.qpos[:3], rotation_vector(flotor.data.qpos[3:7])])
        reach = JOYSTICK.workspace
        deep = pose[axis] - (reach.translation if axis < 3 else reach.rotation)
        shown = f"{1e3 * deep:.3f} mm" if axis < 3 else f"{np.rad2deg(deep):.3f} deg"
        lines.append(f"| {name} | {shown} |")
    return [*lines, ""]


def swing() -> tuple[np.ndarray, np.ndarray]:
    """Turning of the cab [rad/s] and its rate, by control period, of the excitation's motion."""
    run = run_scenario(load_scenario("excitation", {"ground": "false", "duration": "12"}))
    log = run.truth
    time = np.arange(0.0, log.time[-1], PERIOD)
    names = ("truth.velocity.swing", "truth.acceleration.swing")
    spin, change = (np.interp(time, log.time, log[name]) for name in names)
    return spin, change


def held(spin: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Handle (n, 6) with a hand that only rests on it, in the cab."""
    numbers, s = seated()
    flotor, muscles, pose = SimulatedFlotor(JOYSTICK), np.zeros(6), np.empty((len(spin), 6))
    muscles[2] = 9.81 * JOYSTICK.hand.mass
    for k in range(len(spin)):
        pose[k, :3] = flotor.data.qpos[:3]
        pose[k, 3:] = rotation_vector(flotor.data.qpos[3:7])
        master_step(numbers, flotor.data.qpos, QUIET, 1.0, PERIOD, k == 0, s)
        flotor.shaken_step(
            s.currents, muscles, np.array(JOYSTICK.mount), float(spin[k]), float(change[k])
        )
    return pose


def shaking() -> list[str]:
    """Handle motion while the machine swings, attached to the cab and on a table."""
    spin, change = swing()
    still = np.zeros_like(spin)
    target = np.zeros((len(spin), 6))
    poses = {
        "in the cab, no hand": simulate_levitation(JOYSTICK, target, cab=(spin, change)).pose,
        "in the cab, a hand rests on it": held(spin, change),
        "on a table, no hand": simulate_levitation(JOYSTICK, target).pose,
        "on a table, a hand rests on it": held(still, still),
    }
    lines = [
        "## Shaken by the cab", "",
        f"Swing of `excitation` on the CAT 215, up to {np.abs(spin).max():.2f} rad/s and"
        f" {np.abs(change).max():.2f} rad/s^2, joystick at {JOYSTICK.mount} m in the cab; springs"
        " of the table `excavator` where there is a hand. A tremor is left out.", "",
        "| | largest displacement [mm] | RMS [mm] | largest turn [deg] |",
        "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, pose in poses.items():
        far = np.linalg.norm(pose[:, :3], axis=1)
        turn = np.rad2deg(np.linalg.norm(pose[:, 3:], axis=1).max())
        lines.append(
            f"| {name} | {1e3 * far.max():.4f} | {1e3 * np.sqrt(np.mean(far**2)):.4f} |"
            f" {turn:.4f} |"
        )
    return [*lines, ""]


def draw(path: Path) -> None:
    """Picture of the step responses."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(2, 3, figsize=(9.0, 4.6), sharex=True, sharey=True)
    for axis, panel in enumerate(panels.ravel()):
        flight = step(axis)
        share = flight.pose / SIZES
        fine = np.linspace(0.0, flight.time[-1], 400)
        alone = JOYSTICK.alone
        panel.plot(
            fine, designed_step(fine, alone.frequency[axis], alone.ratio[axis]), color="black",
            linewidth=0.9, linestyle="--", label="designed",
        )  # fmt: skip
        panel.plot(flight.time, share[:, axis], linewidth=1.4, label="simulated")
        panel.plot(flight.time, np.delete(share, axis, axis=1), color="0.6", linewidth=0.8)
        panel.set_title(AXES[axis], fontsize=9)
        panel.grid(alpha=0.3)
    panels[0, 0].legend(fontsize=8, loc="lower right")
    for panel in panels[1]:
        panel.set_xlabel("time [s]")
    for row in panels:
        row[0].set_ylabel("share of the step")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def report(results) -> str:
    """The whole result in Markdown."""
    picture = ["![Steps of the six axes; other axes in grey](joystick.png)", ""]
    return "\n".join([
        *coils_and_eyes(), *steps(), *picture, *identification(results), *detent(), *stops(),
        *shaking(),
    ])  # fmt: skip


if __name__ == "__main__":
    asked = options(__doc__, trials=20, seed=1, jobs=2)
    found = side_by_side(one_trial, asked)
    publish(report(found), "The joystick alone", asked)
    if asked.out:
        draw(asked.out.with_suffix(".png"))
