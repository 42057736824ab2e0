"""Study the joystick alone: steps, identification, detent, travel, damping, heat, cab motion.

    python tools/studies/joystick_study.py [--trials 20] [--seed 1] [--jobs 2]
        [--out docs/results/joystick.md]

A picture of the step responses is written beside the file.
"""

from pathlib import Path

import numpy as np

from hydrotele.machine.joystick import AXES, load_joystick
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.joystick import SimulatedFlotor, field_shares
from hydrotele.teleop.coils import heating, seconds_until_hot, three_stations
from hydrotele.teleop.compliance import Flotor, turn_matrix
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
from hydrotele.teleop.sampled import (
    largest_damping,
    least_inertia,
    slowest_decay,
    spinning_body,
    tilting_body,
)
from tools.studies.handle_laws import Detent
from tools.studies.study import options, publish, side_by_side

JOYSTICK = load_joystick()
SIZES = np.array([2e-3] * 3 + [np.deg2rad(2.0)] * 3)
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


def coils_moved(qpos: np.ndarray) -> np.ndarray:
    """Displacement (3,) of the coils' centre in its gap [m]."""
    turn, handle = np.empty((3, 3)), np.array(JOYSTICK.flotor.handle)
    turn_matrix(qpos[3:7], turn)
    return qpos[:3] + handle - turn @ handle


def travel() -> list[str]:
    """Where the stops are, how far the handle goes, and how deep 20 N go into a stop."""
    reach, limits = JOYSTICK.reach, JOYSTICK.workspace
    deg = np.rad2deg(reach[3:])
    bound = limits.translation / JOYSTICK.gains["feller"]["ry"].deadband
    lines = [
        "## Travel and stops", "",
        'Zhu 1994, 5.1.2: "The joystick workspace is limited by the size of the magnetic gap [...]'
        " approximately + 5 mm translational motion and + 7 deg rotational motion from the nominal"
        ' center." The stops are therefore at the coils: their centre moves by'
        f" {1e3 * limits.translation:g} mm along each axis, the flotor turns by"
        f" {np.rad2deg(limits.rotation):g} deg. Turned about the handle, whose centre is"
        f" {1e3 * JOYSTICK.flotor.handle[2]:g} mm above (A), the coils move aside: the handle"
        f" alone turns by {deg[0]:.2f} deg about x and y and by {deg[2]:.2f} deg about z. The"
        " feller-buncher's printed dead band of 0.035 rad (Table 6.9) could not be left with a"
        f" handle higher than {1e3 * bound:.0f} mm.", "",
        "At rest under 20 N at the height of the coils (2 N m about an axis); no hand, weight"
        " carried. Last row: 20 N at the handle, which tilt the flotor about its stop.", "",
        "| axis | beyond the stop |", "| --- | ---: |",
    ]  # fmt: skip
    lift = levitation(JOYSTICK).coils.currents(
        np.array([0.0, 0.0, 9.81 * JOYSTICK.flotor.mass, 0.0, 0.0, 0.0])
    ).value  # fmt: skip

    def pushed(push: np.ndarray) -> np.ndarray:
        flotor = SimulatedFlotor(JOYSTICK, hand=False)
        flotor.model.dof_damping[:] = [20.0] * 3 + [0.2] * 3
        for _ in range(600):
            flotor.step(lift, push)
        return flotor.data.qpos.copy()

    for axis, name in enumerate(AXES):
        push = np.zeros(6)
        push[axis] = 20.0 if axis < 3 else 2.0
        if axis < 2:
            push[4 - axis] = 20.0 * JOYSTICK.flotor.handle[2] * (2 * axis - 1.0)
        qpos = pushed(push)
        if axis < 3:
            shown = f"{1e3 * (coils_moved(qpos)[axis] - limits.translation):.3f} mm"
        else:
            deep = rotation_vector(qpos[3:7])[axis - 3] - limits.rotation
            shown = f"{np.rad2deg(deep):.3f} deg"
        lines.append(f"| {name} | {shown} |")
    qpos = pushed(np.array([20.0, 0, 0, 0, 0, 0]))
    lines.append(
        f"| x, at the handle | {1e3 * (coils_moved(qpos)[0] - limits.translation):.3f} mm,"
        f" handle at {1e3 * qpos[0]:.1f} mm |"
    )
    return [*lines, ""]


HAND = JOYSTICK.hand
HELD = (HAND.mass, HAND.damping, HAND.stiffness, HAND.rotation_damping, HAND.rotation_stiffness)


def damping() -> list[str]:
    """Whether the printed rotational damping can be held, and with which inertia it could."""
    f = JOYSTICK.flotor
    arm = f.com[2] - f.handle[2]
    printed = {"excavator": (600.0, 6.0, 6.0, 3.0), "feller": (4000.0, 45.0, 25.0, 4.0)}
    lines = [
        "## Rotational damping", "",
        "Tables 6.7 and 6.9 print 0.03 and 0.04 in 100 N m/rad/s, so 3 and 4 N m s/rad, under a"
        " control of 200 Hz (5.3). Largest eigenvalue of the sampled loop: below 1 the handle comes"
        " to rest. x and ry together with the springs of x (60 N s/m) at the handle, free and in"
        " the hand; rz alone, without a hand.", "",
        "| gains | damping [N m s/rad] | rate [Hz] | free | in the hand | rz |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, (stiff, turn, about, rub) in printed.items():
        for damped, what in ((rub, "printed"), (rub / 2, "half"), (rub / 100, "unit 1"),
                             (0.25, "ours, A")):  # fmt: skip
            for rate in (200.0, 1000.0):
                springs, dampers = np.array([stiff, turn]), np.array([60.0, damped])
                decays = [
                    slowest_decay(
                        tilting_body(f.mass, arm, f.inertia[0], held), springs, dampers, 1 / rate
                    )
                    for held in ((0.0,) * 5, HELD)
                ]
                spin = spinning_body(f.inertia[2])
                decays.append(slowest_decay(spin, np.array([about]), dampers[1:], 1 / rate))
                cells = " | ".join(f"{d:.3f}" for d in decays)
                lines.append(f"| {name} | {damped:g} ({what}) | {rate:g} | {cells} |")
    needed = [least_inertia(rub, about, PERIOD) for _, _, about, rub in printed.values()]
    radii = [1e3 * np.sqrt(i / f.mass) for i in needed]
    fast = [least_inertia(rub, about, 1e-3) for _, _, about, rub in printed.values()]
    return [
        *lines, "",
        "Half: if the damper acts on the rate of the Euler vector of 5.1.3, which is half of the"
        " angle's. Unit 1: if the damping's unit were 1 and not 100 N m/rad/s.", "",
        f"At 200 Hz the printed damping of rz needs {1e3 * needed[0]:.1f} and"
        f" {1e3 * needed[1]:.1f} g m^2 (excavator, feller-buncher): radii of gyration of"
        f" {radii[0]:.0f} and {radii[1]:.0f} mm"
        f" of {f.mass:g} kg, where the coils are at {1e3 * JOYSTICK.coils.radius:g} mm. Ours has"
        f" {1e3 * f.inertia[0]:g} and {1e3 * f.inertia[2]:g} g m^2. So no assumed inertia of this"
        " size holds it, about z in particular, where the handle's height does not help; at 1 kHz"
        f" {1e3 * fast[0]:.1f} and {1e3 * fast[1]:.1f} g m^2 would. Either the printed unit of"
        " damping is not that of stiffness, or the loop of the coils ran faster than the 200 Hz of"
        " 5.3. The largest damping that rz of this flotor holds at 200 Hz with 6 N m/rad is"
        f" {largest_damping(f.inertia[2], 6.0, PERIOD):.2f} N m s/rad. Without a hand x and ry grow"
        " with every one of these springs at 200 Hz, since a push at the handle tilts a free"
        " flotor; a handle that stands alone is therefore held by the law of 5.1.3 instead.", "",
    ]  # fmt: skip


def heat() -> list[str]:
    """Currents and temperatures of a handle that is held out, with and without a detent."""
    c = JOYSTICK.coils
    coils = three_stations(c.radius, c.force_per_ampere, c.max_current)
    handle, weight = JOYSTICK.flotor.handle[2], 9.81 * JOYSTICK.flotor.mass
    lines = [
        "## Heat", "",
        'Zhu 1994, 6.3: "a stiff joystick could easily cause heating problem", which detents are to'
        f" solve. Coils that bear {c.continuous_current:g} A for ever and warm up with"
        f" {c.thermal_time:g} s (both A); a hand holds one axis of the feller-buncher's gains at"
        " nine tenths of its reach. Heat: temperature rise in the end, over what is allowed; time"
        " until cold coils are there.", "",
        "| axis | one slope: force [N], [N m] | current [A] | heat | time [s] | detent: force |"
        " current [A] | heat | time [s] |", "| --- |" + " ---: |" * 8,
    ]  # fmt: skip
    for axis in (0, 2, 4):
        gains = JOYSTICK.gains["feller"][AXES[axis]]
        assert gains.detent
        x = 0.9 * JOYSTICK.reach[axis]
        law = Detent(gains.deadband, gains.detent.drop, gains.nominal, gains.detent.outside)
        cells = []
        for force in (gains.nominal * x, -law.force(x)):
            wrench = np.array([0.0, 0.0, weight, 0.0, 0.0, 0.0])
            wrench[axis] += force
            wrench[4] += force * handle if axis == 0 else 0.0
            asked = np.linalg.solve(coils.wrench_map, wrench)
            left = seconds_until_hot(asked, c.continuous_current, c.thermal_time)
            current = f"{np.abs(asked).max():.2f}"
            current += " (cut to 4)" if np.abs(asked).max() > c.max_current else ""
            cells += [f"{force:.2f}", current, f"{heating(asked, c.continuous_current):.2f}",
                      "for ever" if np.isinf(left) else f"{left:.0f}"]  # fmt: skip
        lines.append(f"| {AXES[axis]} | {' | '.join(cells)} |")
    return [*lines, ""]


def force_over_the_gap() -> list[str]:
    """What a field that falls off towards the ends of the gap does to the force that is felt."""
    c, limits = JOYSTICK.coils, JOYSTICK.workspace
    coils = three_stations(c.radius, c.force_per_ampere, c.max_current)
    weight, handle = 9.81 * JOYSTICK.flotor.mass, JOYSTICK.flotor.handle[2]
    lines = [
        "## Force over the gap", "",
        'Zhu 1994, 5.1.2: "Due to the small motion range" M is "approximately" constant; how much a'
        " coil loses is not told. If it lost a share of its force quadratically towards the end of"
        " its gap, with a control that knows of none:", "",
        "| lost at 5 mm [%] | error of 4.8 N at the handle at 4.5 mm of x [N] | sinking of the"
        " hovering flotor there [um] | error with 2 mm [N] |", "| ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    stiff = JOYSTICK.gains["feller"]["z"].nominal
    for loss in (0.0, 0.05, 0.1, 0.2):
        errors = []
        for x in (4.5e-3, 2e-3):
            wrench = np.array([4.8, 0.0, weight, 0.0, 4.8 * handle, 0.0])
            shares = field_shares(
                coils.position, np.array([x, 0.0, 0.0]), np.eye(3), limits.translation, loss
            )
            errors.append(coils.wrench_map @ (shares * coils.currents(wrench).value) - wrench)
        lines.append(
            f"| {100 * loss:g} | {errors[0][0]:.2f} | {-1e6 * errors[0][2] / stiff:.0f} |"
            f" {errors[1][0]:.2f} |"
        )
    return [*lines, "", "The shipped joystick loses nothing (`coils.edge_loss: 0`).", ""]


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
        *coils_and_eyes(), *steps(), *picture, *identification(results), *detent(), *travel(),
        *damping(), *heat(), *force_over_the_gap(), *shaking(),
    ])  # fmt: skip


if __name__ == "__main__":
    asked = options(__doc__, trials=20, seed=1, jobs=2)
    found = side_by_side(one_trial, asked)
    publish(report(found), "The joystick alone", asked)
    if asked.out:
        draw(asked.out.with_suffix(".png"))
