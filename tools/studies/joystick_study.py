"""Study the joystick alone: steps, identification, detent, travel, damping, heat, cab motion.

    python tools/studies/joystick_study.py [--trials 20] [--seed 1] [--jobs 2]
        [--out docs/validation/joystick.md]

A picture of the step responses is written beside the file.
"""

from pathlib import Path

import numpy as np

from hydrotele.machine.joystick import AXES, load_joystick
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.joystick import SimulatedFlotor, coil_force_factors
from hydrotele.teleop.coils import make_three_station_coils, relative_heating, time_to_overheat
from hydrotele.teleop.compliance import Flotor, quaternion_to_matrix
from hydrotele.teleop.flotor_identification import FlotorFit, identify_flotor_parameters
from hydrotele.teleop.levitation import (
    LevitationRun,
    make_excitation_path,
    make_levitation_control,
    quaternion_to_rotation_vector,
    second_order_step_response,
    simulate_levitation,
)
from hydrotele.teleop.master import build_master, step_master
from hydrotele.teleop.optical_sensing import pose_resolution
from hydrotele.teleop.sampled_stability import (
    make_spinning_body,
    make_tilting_body,
    max_sampled_handle_eigenvalue,
    max_stable_handle_damping,
    min_stable_handle_inertia,
)
from tools.studies.handle_laws import Detent
from tools.studies.study import options, publish, side_by_side

JOYSTICK = load_joystick()
SIZES = np.array([2e-3] * 3 + [np.deg2rad(2.0)] * 3)
PERIOD = 1.0 / JOYSTICK.control_rate
COM = (0.002, -0.001, 0.020)  # m: off its axis, so that all three are identifiable
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
    """Deviation from the designed response, cross motion (fractions), largest current [A]."""
    alone, share = JOYSTICK.closed_loop, flight.pose / SIZES
    designed = second_order_step_response(flight.time, alone.frequency[axis], alone.ratio[axis])
    deviation = np.abs(share[:, axis] - designed).max()
    cross = np.abs(np.delete(share, axis, axis=1)).max()
    return float(deviation), float(cross), float(np.abs(flight.currents).max())


def coils_and_sensing() -> list[str]:
    """Condition of M; resolution of the diodes."""
    coils, diodes = make_levitation_control(JOYSTICK).coils, JOYSTICK.diodes
    weight = coils.compute_currents(np.array([0, 0, 9.81 * JOYSTICK.flotor.mass, 0, 0, 0])).value
    spread = pose_resolution(diodes.distance, diodes.step) * MICRO
    sensing = JOYSTICK.sensing
    stated = np.array([sensing.translation] * 3 + [sensing.rotation] * 3) / np.sqrt(12.0) * MICRO
    lines = [
        "## Coils and sensing", "",
        "M is the matrix that maps the six coil currents to force and torque on the flotor, with torques divided "
        f"by the radius of the coils. Its condition number is {coils.condition:.4f}; 1 is the best possible, and "
        f"Zhu calls M well-conditioned. Carrying the weight of the flotor takes {np.abs(weight).max():.2f} A of "
        f"the largest current of {coils.max_current:g} A.",
        "",
        "Three light beams of the flotor meet position-sensitive diodes at a distance of "
        f"{1e3 * diodes.distance:g} mm, which are read in steps of {1e6 * diodes.step:g} um. The table gives the "
        "standard deviation of the measured pose at the centre of the coils (lower is better). Row \"diodes\": "
        "computed from the diodes. Row \"stated\": rounding to the resolution that Zhu states, 1 um and 0.001 "
        "deg. The diodes are at least as accurate as stated.",
        "",
        "| | x [um] | y [um] | z [um] | rx [0.001 deg] | ry [0.001 deg] | rz [0.001 deg] |", "| --- |" + " ---: |" * 6,
        "| diodes | " + " | ".join(f"{v:.2f}" for v in spread) + " |",
        "| stated | " + " | ".join(f"{v:.2f}" for v in stated) + " |", "",
    ]  # fmt: skip
    return lines


def steps() -> list[str]:
    """Step responses and hovering, with both readings."""
    lines = [
        "## Steps and hovering", "",
        f"Each axis follows a step of {1e3 * SIZES[0]:g} mm or {np.rad2deg(SIZES[3]):g} deg without a hand, "
        "controlled at 200 Hz. Columns, all lower is better: largest deviation from the designed response, as a "
        "percentage of the step; cross motion, the largest motion of the other axes, as a percentage; largest "
        "coil current. The first three columns use readings of the pose rounded to the stated resolution, the "
        "last three readings of the diodes.",
        "",
        "| axis | deviation [%] | cross motion [%] | current [A] | diodes: deviation [%] |"
        " cross motion [%] | current [A] |", "| --- |" + " ---: |" * 6,
    ]  # fmt: skip
    for axis, name in enumerate(AXES):
        cells = []
        for diodes in (False, True):
            d, c, i = step_figures(step(axis, diodes=diodes), axis)
            cells += [f"{100 * d:.2f}", f"{100 * c:.2f}", f"{i:.2f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += [
        "",
        "The deviation of about 5 % comes from the sampling period of 5 ms. A current is held for 5 ms. The "
        "velocity is a difference of two readings and therefore 2.5 ms old."
        " In the next table the handle is held at its "
        "centre for 10 s (lower is better).",
        "",
        "| hovering for 10 s | largest error of the handle [um] | RMS [um] |"
        " largest rotation [0.001 deg] |", "| --- | ---: | ---: | ---: |",
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
    control = make_levitation_control(joystick, GUESS)
    flight = simulate_levitation(
        joystick,
        make_excitation_path(joystick, 12.0, seed),
        control=control,
        seed=seed,
        diodes=diodes,
    )
    fit = identify_flotor_parameters(flight.place, flight.quaternion, flight.currents, control.period, control.coils)
    return fit, flight


def one_trial(seed: int, number: int) -> tuple[FlotorFit, FlotorFit]:
    """The same with other tones' phases and noise, by both readings."""
    draw = int(np.random.default_rng([seed, number]).integers(2**31))
    return identified(draw)[0], identified(draw, diodes=True)[0]


def identification(results: list[tuple[FlotorFit, FlotorFit]]) -> list[str]:
    """Table of the ten parameters, and of the control that uses them."""
    f, (first, flight) = crooked().flotor, identified(0)
    truth = np.array([f.mass, *f.com, *f.inertia, 0.0, 0.0, 0.0])
    worst = [np.max([np.abs(r[k].value - truth) for r in results], axis=0) for k in (0, 1)]
    lines = [
        "## Identification", "",
        "The joystick can identify mass, centre of mass and moments of inertia of its flotor from its own "
        "readings and currents. For this it moves for 12 s with six tones per axis between 0.4 and 6 Hz."
        " During this motion "
        f"the control assumes wrong values: {GUESS.mass:g} kg, the centre of mass at the coils, and 2 g m^2 about "
        "every axis. All parameters are found within their intervals. Largest current "
        f"{np.abs(flight.currents).max():.2f} A, largest travel"
        f" {1e3 * np.abs(flight.pose[:, :3]).max():.1f} mm and "
        f"{np.rad2deg(np.linalg.norm(flight.pose[:, 3:], axis=1).max()):.1f} deg"
        f"; condition number of the scaled equations {first.condition:.1f}. Columns: true and identified value of "
        f"the first trial, half-width of its 95 % interval, and the worst error of {len(results)} trials with the "
        "rounded pose and with the diodes (lower is better).",
        "",
        "| | true | identified | 95 % interval | worst error | worst error, diodes |",
        "| --- |" + " ---: |" * 5,
    ]  # fmt: skip
    for i, (name, unit, scale) in enumerate(ROWS):
        cells = [f"{scale * truth[i]:.6f}", f"{scale * first.value[i]:.6f}"]
        cells += [f"{scale * v[i]:.1e}" for v in (first.interval_half_width, *worst)]
        lines.append(f"| {name} [{unit}] | {' | '.join(cells)} |")
    inside = [np.mean([np.abs(r[k].value - truth) <= r[k].interval_half_width for r in results]) for k in (0, 1)]
    lines += [
        "",
        f"{100 * inside[0]:.0f} % of the intervals contain the true value, {100 * inside[1]:.0f} "
        "% with the diodes. The intervals are wider than the errors from noise, because they include the error "
        "of differences over 5 ms at 6 Hz. The next table shows why identification matters: hovering and steps "
        "with a control that assumes the wrong, the identified and the true flotor (lower is better).",
        "",
        "| control assumes | height at rest, error [um] | worst deviation of a step [%] |"
        " worst cross motion [%] |", "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, body in (("the assumed flotor", GUESS), ("the identified flotor", first.to_flotor()),
                       ("the true flotor", None)):  # fmt: skip
        control = make_levitation_control(crooked(), body)
        rest = simulate_levitation(crooked(), np.zeros((600, 6)), control=control).pose[200:, 2].mean()
        figures = np.array([
            step_figures(step(axis, crooked(), control=control), axis)
            for axis in range(6)
        ])  # fmt: skip
        d, c = 100.0 * figures[:, :2].max(axis=0)
        lines.append(f"| {name} | {1e6 * rest:.2f} | {d:.2f} | {c:.2f} |")
    return [*lines, ""]


def seated(**keys):
    """Parameters and state of the haptic device, without a machine."""
    pilot = TeleopPilot.model_validate({"kind": "teleop", "operator": {"kind": "follow"}, "reflection": "none", **keys})
    return build_master(JOYSTICK, pilot, ("r", "theta", "z"))


def detent() -> list[str]:
    """Force that a clamp needs to lead the handle through the notch of x."""
    gains = JOYSTICK.gains["feller"]["x"]
    assert gains.detent
    law = Detent(gains.deadband, gains.detent.drop, gains.nominal_stiffness, gains.detent.slope)
    numbers, s = seated(gains="feller", detent=True)
    flotor = SimulatedFlotor(JOYSTICK, hand=False)
    flotor.model.jnt_stiffness[:3], flotor.model.dof_damping[:3] = 2e4, 100.0
    lines = [
        "## Detent", "",
        "A detent is a drop of the centring force at the edge of the dead band, which the operator can feel. "
        "This test checks that the simulated joystick produces the designed force, for the x axis of the "
        "feller-buncher (Table 6.11 and Fig. 6.51). A simulated clamp of 20 N/mm moves the handle outwards in "
        "steps and waits. Column \"force\": force of the clamp. Column \"law\": designed force, with a stiffness "
        f"of {1e-3 * gains.nominal_stiffness:g} N/mm inside the dead band, a force drop at its edge, and "
        f"{1e-3 * gains.detent.slope:g} N/mm outside.",
        "",
        "| displacement [mm] | force [N] | law [N] |", "| ---: | ---: | ---: |",
    ]  # fmt: skip
    worst = 0.0
    for place in np.arange(0.3, 4.51, 0.3) * 1e-3:
        flotor.model.qpos_spring[0] = place
        forces = []
        for k in range(200):
            step_master(numbers, flotor.data.qpos, QUIET, 1.0, PERIOD, k == 0, s)
            flotor.step(s.currents, np.zeros(6))
            forces.append(2e4 * (place - flotor.data.qpos[0]))
        now, felt = float(flotor.data.qpos[0]), float(np.mean(forces[-40:]))
        worst = max(worst, abs(felt + law.force(now)))
        lines.append(f"| {1e3 * now:.3f} | {felt:.3f} | {-law.force(now):.3f} |")
    return [*lines, "", f"The largest difference is {1e3 * worst:.1f} mN.", ""]


def coils_moved(qpos: np.ndarray) -> np.ndarray:
    """Displacement (3,) of the coils' centre in its gap [m]."""
    turn, handle = np.empty((3, 3)), np.array(JOYSTICK.flotor.handle)
    quaternion_to_matrix(qpos[3:7], turn)
    return qpos[:3] + handle - turn @ handle


def travel() -> list[str]:
    """Position of the stops, travel of the handle, and penetration of a stop under 20 N."""
    reach, limits = JOYSTICK.handle_travel, JOYSTICK.workspace
    deg = np.rad2deg(reach[3:])
    bound = limits.translation / JOYSTICK.gains["feller"]["ry"].deadband
    lines = [
        "## Travel and stops", "",
        "Zhu 1994, 5.1.2: \"The joystick workspace is limited by the size of the magnetic gap "
        "[...] approximately + 5 mm translational motion and + 7 deg rotational motion from the "
        "nominal center\". "
        "The stops of the simulated joystick are therefore at the coils. The centre of the coils moves by"
        " "
        f"{1e3 * limits.translation:g} mm along each axis, and the flotor rotates by "
        f"{np.rad2deg(limits.rotation):g} deg. The centre of the handle is "
        f"{1e3 * JOYSTICK.flotor.handle[2]:g} mm above the coils (A). A rotation about the handle "
        f"moves the coils sideways. The handle alone therefore rotates by {deg[0]:.2f} deg about "
        f"x and y and by {deg[2]:.2f} deg about z. The feller-buncher's printed dead band of "
        f"0.035 rad (Table 6.9) could not be left with a handle higher than {1e3 * bound:.0f} mm.",
        "",
        "The table shows how far the stops give way under 20 N at the height of the coils, or 2 N m about an "
        "axis (lower is better). No hand holds the handle, and its weight is carried. In the last row the 20 N "
        "act at the handle and tilt the flotor about its stop.",
        "",
        "| axis | beyond the stop |", "| --- | ---: |",
    ]  # fmt: skip
    lift = make_levitation_control(JOYSTICK).coils.compute_currents(
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
            deep = quaternion_to_rotation_vector(qpos[3:7])[axis - 3] - limits.rotation
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
    """Stability of the printed rotational damping, and the inertia that it requires."""
    f = JOYSTICK.flotor
    arm = f.com[2] - f.handle[2]
    printed = {"excavator": (600.0, 6.0, 6.0, 3.0), "feller": (4000.0, 45.0, 25.0, 4.0)}
    lines = [
        "## Rotational damping", "",
        "The printed rotational damping cannot be used, as this section shows. Tables 6.7 and 6.9 print 0.03 and "
        "0.04 in units of 100 N m/rad/s, that is 3 and 4 N m s/rad. The control rate is 200 Hz (5.3). The last "
        "three columns give the largest eigenvalue of the sampled control loop. Below 1 the handle comes to "
        "rest; above 1 its motion grows in every period. \"free\" and \"held\": the coupled motion of x and ry "
        "with the spring of x at the handle (damping 60 N s/m), without and with a hand. \"rz\": rotation about "
        "z, which is uncoupled, without a hand.",
        "",
        "| gains | damping [N m s/rad] | rate [Hz] | free | held | rz |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, (stiff, turn, about, rub) in printed.items():
        for damped, what in ((rub, "printed"), (rub / 2, "half of the printed value"),
                             (rub / 100, "printed value without the factor 100"), (0.25, "chosen")):  # fmt: skip
            for rate in (200.0, 1000.0):
                springs, dampers = np.array([stiff, turn]), np.array([60.0, damped])
                decays = [
                    max_sampled_handle_eigenvalue(
                        make_tilting_body(f.mass, arm, f.inertia[0], held),
                        springs,
                        dampers,
                        1 / rate,
                    )
                    for held in ((0.0,) * 5, HELD)
                ]
                spin = make_spinning_body(f.inertia[2])
                decays.append(max_sampled_handle_eigenvalue(spin, np.array([about]), dampers[1:], 1 / rate))
                cells = " | ".join(f"{d:.3f}" for d in decays)
                lines.append(f"| {name} | {damped:g} ({what}) | {rate:g} | {cells} |")
    needed = [min_stable_handle_inertia(rub, about, PERIOD) for _, _, about, rub in printed.values()]
    radii = [1e3 * np.sqrt(i / f.mass) for i in needed]
    fast = [min_stable_handle_inertia(rub, about, 1e-3) for _, _, about, rub in printed.values()]
    return [
        *lines, "",
        "The second column has three interpretations of the printed value, and the value that hydrotele uses:",
        "",
        "- printed: as printed, in units of 100 N m/rad/s.",
        "- half of the printed value: if the damper acts on the rate of the Euler vector of 5.1.3, which is half of "
        "the rate of the angle.",
        "- printed value without the factor 100: if the unit of damping is 1 N m/rad/s.",
        "- chosen: the value of this project (A), stable at 200 Hz in rz and with a hand.",
        "",
        f"To be stable at 200 Hz, the printed damping of rz requires moments of inertia of {1e3 * needed[0]:.1f} "
        f"and {1e3 * needed[1]:.1f} g m^2 (excavator, feller-buncher). These are radii of gyration of"
        " "
        f"{radii[0]:.0f} and {radii[1]:.0f} mm for {f.mass:g} kg, with the coils at "
        f"{1e3 * JOYSTICK.coils.radius:g} mm. "
        f"The simulated flotor has {1e3 * f.inertia[0]:g} g m^2 about x and y, and {1e3 * f.inertia[2]:g} g m^2 "
        "about z."
        f" At 1 kHz, {1e3 * fast[0]:.1f} and {1e3 * fast[1]:.1f} g "
        "m^2 would be enough. The largest damping at which rz of this flotor is stable at 200 Hz "
        "with a stiffness of 6 N m/rad is"
        f" {max_stable_handle_damping(f.inertia[2], 6.0, PERIOD):.2f} N m s/rad.",
        "",
    ]  # fmt: skip


def heat() -> list[str]:
    """Currents and temperatures of a handle that is held out, with and without a detent."""
    c = JOYSTICK.coils
    coils = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current)
    handle, weight = JOYSTICK.flotor.handle[2], 9.81 * JOYSTICK.flotor.mass
    lines = [
        "## Heat", "",
        "Zhu 1994, 6.3: \"a stiff joystick could easily cause heating problem\". "
        f"Detents are intended to avoid it, and they do here. The coils carry {c.continuous_current:g} A "
        f"continuously and have a thermal time constant of {c.thermal_time:g} s (both A). A hand holds one axis "
        "at nine tenths of its reach, with the gains of the feller-buncher: first against the linear centring "
        "spring, then with the detent. Heat: final temperature rise divided by the allowed one; above 1 the "
        "coils become too hot (lower is better). Time: until cold coils reach the allowed temperature.",
        "",
        "| axis | linear spring: force [N], [N m] | current [A] | heat | time [s] |"
        " detent: force [N], [N m] | current [A] | heat | time [s] |", "| --- |" + " ---: |" * 8,
    ]  # fmt: skip
    for axis in (0, 2, 4):
        gains = JOYSTICK.gains["feller"][AXES[axis]]
        assert gains.detent
        x = 0.9 * JOYSTICK.handle_travel[axis]
        law = Detent(gains.deadband, gains.detent.drop, gains.nominal_stiffness, gains.detent.slope)
        cells = []
        for force in (gains.nominal_stiffness * x, -law.force(x)):
            wrench = np.array([0.0, 0.0, weight, 0.0, 0.0, 0.0])
            wrench[axis] += force
            wrench[4] += force * handle if axis == 0 else 0.0
            asked = np.linalg.solve(coils.wrench_map, wrench)
            left = time_to_overheat(asked, c.continuous_current, c.thermal_time)
            current = f"{np.abs(asked).max():.2f}"
            current += " (cut to 4)" if np.abs(asked).max() > c.max_current else ""
            cells += [f"{force:.2f}", current, f"{relative_heating(asked, c.continuous_current):.2f}",
                      "unlimited" if np.isinf(left) else f"{left:.0f}"]  # fmt: skip
        lines.append(f"| {AXES[axis]} | {' | '.join(cells)} |")
    return [*lines, ""]


def force_over_the_gap() -> list[str]:
    """Force error of a field that decreases towards the ends of the gap."""
    c, limits = JOYSTICK.coils, JOYSTICK.workspace
    coils = make_three_station_coils(c.radius, c.force_per_ampere, c.max_current)
    weight, handle = 9.81 * JOYSTICK.flotor.mass, JOYSTICK.flotor.handle[2]
    lines = [
        "## Force over the gap", "",
        "Zhu 1994, 5.1.2: \"Due to the small motion range\" M is \"approximately\" constant; the "
        "loss of a coil is not stated. "
        "The table shows the consequences of an unknown loss. It assumes that a coil"
        " loses force quadratically "
        "towards the end of the gap and that the control does not know this. First column: fraction lost at 5 "
        "mm. Errors: smaller is better.",
        "",
        "| lost at 5 mm [%] | error of 4.8 N at the handle at x = 4.5 mm [N] | drop of the"
        " hovering flotor there [um] | error of 4.8 N at x = 2 mm [N] |",
        "| ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    stiff = JOYSTICK.gains["feller"]["z"].nominal_stiffness
    for loss in (0.0, 0.05, 0.1, 0.2):
        errors = []
        for x in (4.5e-3, 2e-3):
            wrench = np.array([4.8, 0.0, weight, 0.0, 4.8 * handle, 0.0])
            shares = coil_force_factors(coils.position, np.array([x, 0.0, 0.0]), np.eye(3), limits.translation, loss)
            errors.append(coils.wrench_map @ (shares * coils.compute_currents(wrench).value) - wrench)
        lines.append(
            f"| {100 * loss:g} | {errors[0][0]:.2f} | {-1e6 * errors[0][2] / stiff:.0f} | {errors[1][0]:.2f} |"
        )
    return [*lines, "", "The shipped joystick has no loss (`coils.edge_loss: 0`).", ""]


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
        pose[k, 3:] = quaternion_to_rotation_vector(flotor.data.qpos[3:7])
        step_master(numbers, flotor.data.qpos, QUIET, 1.0, PERIOD, k == 0, s)
        flotor.step_in_cab(s.currents, muscles, np.array(JOYSTICK.mount), float(spin[k]), float(change[k]))
    return pose


def shaking() -> list[str]:
    """Handle motion while the machine swings, attached to the cab and on a table."""
    spin, change = swing()
    still = np.zeros_like(spin)
    target = np.zeros((len(spin), 6))
    poses = {
        "in the cab, no hand": simulate_levitation(JOYSTICK, target, cab_motion=(spin, change)).pose,
        "in the cab, a hand rests on it": held(spin, change),
        "on a table, no hand": simulate_levitation(JOYSTICK, target).pose,
        "on a table, a hand rests on it": held(still, still),
    }
    lines = [
        "## Motion of the cab", "",
        "The cab swings with the machine and shakes the joystick in it. The table shows how far the handle moves "
        "without being commanded (lower is better). The motion is the swing of the scenario `excitation` on the "
        f"CAT 215, up to {np.abs(spin).max():.2f} rad/s and {np.abs(change).max():.2f} rad/s^2. The joystick is "
        f"at {JOYSTICK.mount} m in the cab. With a hand, the centring springs are the gains `excavator` (Table "
        "6.7). Tremor of the hand is omitted.",
        "",
        "| | largest displacement [mm] | RMS [mm] | largest rotation [deg] |",
        "| --- | ---: | ---: | ---: |",
    ]  # fmt: skip
    for name, pose in poses.items():
        far = np.linalg.norm(pose[:, :3], axis=1)
        turn = np.rad2deg(np.linalg.norm(pose[:, 3:], axis=1).max())
        lines.append(f"| {name} | {1e3 * far.max():.4f} | {1e3 * np.sqrt(np.mean(far**2)):.4f} | {turn:.4f} |")
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
        alone = JOYSTICK.closed_loop
        panel.plot(
            fine, second_order_step_response(fine, alone.frequency[axis], alone.ratio[axis]), color="black",
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
        row[0].set_ylabel("fraction of the step")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def report(results) -> str:
    """The whole result in Markdown."""
    intro = [
        "This page tests the simulated joystick alone, without a machine: how accurately it follows commands, "
        "identifies its own moving part, renders forces, and where its limits are. The joystick is the "
        "magnetically levitated one of Zhu 1994. Its moving part, the flotor, carries the handle and floats "
        "between six coils. The simulation behaves as designed: steps deviate from the designed response by less "
        "than 5 %, and the force at a detent by 2 mN. One printed value could not be used: the rotational "
        "damping of Zhu 1994 is unstable on this flotor at 200 Hz (see below). Section, table and figure numbers "
        "are those of Zhu 1994. (A) marks an assumption of this project. Axes: x, y, z are translations of the "
        "handle, rx, ry, rz rotations about them.",
        "",
    ]
    limits = [
        "## Limits", "",
        "- Identification includes no error of the coil map and none of the position of the "
        "diodes; a real joystick has both.",
        "- "
        "No flotor of this size makes the printed rotational damping stable at 200 Hz. Either the factor 100 holds "
        "for the printed stiffness but not for the damping, or the coil loop of the real joystick ran faster than "
        "the 200 Hz of 5.3. At 1 kHz, x and ry are stable with the printed damping and a hand, but not without a "
        "hand.",
        "- "
        "Without a hand, x and ry are unstable at 200 Hz with all of these dampings, because a push at the "
        "handle tilts a free flotor. A handle without a hand is therefore held by the law of 5.1.3. It controls "
        "the six axes of the flotor as uncoupled second-order systems.",
        "- Zhu 1994 does not state how the coil force decreases over the gap.",
        "",
    ]  # fmt: skip
    picture = ["![Steps of the six axes; other axes in grey](joystick.png)", ""]
    return "\n".join([
        *intro, *coils_and_sensing(), *steps(), *picture, *identification(results), *detent(),
        *travel(), *damping(), *heat(), *force_over_the_gap(), *shaking(), *limits,
    ])  # fmt: skip


if __name__ == "__main__":
    asked = options(__doc__, trials=20, seed=1, jobs=2)
    found = side_by_side(one_trial, asked)
    publish(report(found), "The joystick without the machine", asked)
    if asked.out:
        draw(asked.out.with_suffix(".png"))
