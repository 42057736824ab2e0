"""Zhu 1994, chapter 6, without contact: straight lines, steering, handle force, and steps.

Every measurement has the seed of operator and sensor noise and the changes of scenario keys as
arguments. Claims are evaluated with measured channels or with the true path of the tip.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from hydrotele.experiments.comparison import (
    Changes,
    Check,
    Claim,
    Evaluation,
    Experiment,
    Panel,
    Sample,
)
from hydrotele.experiments.scenario_runs import (
    compute_cylindrical_pose,
    make_random_operator_settings,
    run_shipped_scenario,
)
from hydrotele.experiments.statistical_checks import (
    check_fraction,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.run.run import Run

_LINES = {
    "up": (45, "z", 1, ("r",), {"z": "0.8"}),
    "down": (46, "z", -1, ("r",), {"z": "2.2"}),
    "out": (47, "x", 1, ("z",), {"r": "4.8", "z": "1.2"}),
    "in": (48, "x", -1, ("z",), {"r": "6.2", "z": "1.2"}),
}
"""Direction -> (figure 6.n, axis of the handle, its sign, constant coordinates, start [m])."""
_MAX_DEVIATION_RATIO = 0.02  # deviation from the line over the travel
_MAX_ROTATION = 2.0  # rotation of the bucket [deg]
_MIN_TRAVEL = 1.0  # m
_VERTICAL_QUOTE = (
    "the bucket was commanded to go straightly up and down while keeping the bucket angle and"
    " radial displacement constant"
)
_HORIZONTAL_QUOTE = (
    "the bucket was directed to come straightly out from and in towards the cabin while keeping"
    " the bucket angle and height constant"
)


def measure_line(direction: str, seed: int, changes: Changes) -> Sample:
    """Simulate an operator who moves the excavator's tip along a straight line by deflecting one handle axis.

    Args:
        direction: `up`, `down`, `out` or `in`.
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        `travel` along the line; largest deviation from the line in the arm's plane (`stray`) and
        `sideways` [m]; larger one of both over the travel (`stray_share`); largest `rotation` of the
        bucket from its start [deg].
    """
    _, axis, sign, held, start = _LINES[direction]
    push = 0.004 * sign
    keys = {f"start.pose.{k}": v for k, v in start.items()}
    keys |= {"pilot.operator.path": f"{{{axis}: [0, 0, {push}, {push}, 0, 0]}}"}
    _, run = run_shipped_scenario("joystick_up", keys | make_random_operator_settings(seed) | dict(changes))
    pose, time = compute_cylindrical_pose(run), run.truth.time
    moved = pose["z" if axis == "z" else "r"]
    travel = float(sign * (moved[-1] - moved[0]))
    stray = float(max(np.abs(pose[c] - pose[c][0]).max() for c in held))
    sideways = float((pose["r"] * np.abs(pose["theta"] - pose["theta"][0])).max())
    attitude = np.degrees(pose["attitude"] - pose["attitude"][0])
    values = {
        "travel": travel, "stray": stray, "sideways": sideways,
        "stray_share": max(stray, sideways) / max(abs(travel), 1e-3),
        "rotation": float(np.abs(attitude).max()),
    }  # fmt: skip
    return Sample(values, (
        Panel("tip [m]", time, {"r": pose["r"], "z": pose["z"]}),
        Panel("bucket angle from its start [deg]", time, {"attitude": attitude}),
        Panel("handle [mm]", run.measured.time, {axis: 1e3 * run.measured[f"handle.{axis}"]}),
    ))  # fmt: skip


def _evaluate_line(samples: Sequence[Sample]) -> Evaluation:
    checks = (
        check_mean("travel", collect_values(samples, "travel"), (_MIN_TRAVEL, np.inf),
                   "long compared with the accepted deviation", unit="m"),
        check_mean("largest deviation from the line over the travel",
                   collect_values(samples, "stray_share"), (0.0, _MAX_DEVIATION_RATIO),
                   "constant: the width of a drawn line in a plot of this travel"),
        check_mean("largest rotation of the bucket", collect_values(samples, "rotation"),
                   (0.0, _MAX_ROTATION),
                   "constant: the width of a drawn line on the plot's axis of 60 deg", unit="deg"),
    )  # fmt: skip
    note = (
        f"largest deviation {format_values(samples, 'stray', 1e3, 0)} mm, sideways by"
        f" {format_values(samples, 'sideways', 1e3, 0)} mm"
    )
    return Evaluation(checks, "the thesis gives no values", note)


def _make_line_claim(direction: str) -> Claim:
    return Claim(
        f"straight line {direction}",
        f'"{_VERTICAL_QUOTE if direction in ("up", "down") else _HORIZONTAL_QUOTE}"',
        f"p. 91, Fig. 6.{_LINES[direction][0]}",
        "document",
        _evaluate_line,
        {"servo.axis_gains": "{stick: 0.0}", "servo.feedforward": "0.0"},
        "no servo on the stick, no feedforward",
    )


_GOAL_POSITIONS = {"r": (5.8, 6.2, 6.2, 6.0), "z": (1.4, 1.4, 1.8, 1.6)}
_GOAL_INTERVALS = ((2.0, 11.0), (11.0, 20.0), (20.0, 30.0))  # time intervals of the goals [s]
_MIN_COUNTED_ERROR = 0.03  # smallest counted error [m]; 1.5 times the operator's visual resolution
_MAX_OVERSHOOT = 0.15  # overshoot over step of a smooth motion
_MIN_REVERSALS = 2  # reversals about a goal that count as an oscillation
_CAUSE_OPERATORS = 5  # number of operators with whom the causes of an oscillation are varied
_FAST_COORDINATES = "{r: {speed: 3.0, scale: 120.0}, theta: {speed: 0.75, scale: 20.0}, z: {speed: 3.0, scale: 120.0}, attitude: {speed: 2.0, scale: 5.0}}"  # noqa: E501


def measure_overshoot_and_reversals(run: Run) -> tuple[float, int]:
    """Return the largest overshoot of the tip and the number of reversals about the goals of a steering run.

    The operator steers the tip in r and z to a sequence of goals. A reversal is a change of the error
    from one side of a goal to the other.

    Args:
        run: run of the scenario `steer`.

    Returns:
        (largest overshoot beyond a goal over the step to this goal [1], number of changes between errors
        above +3 cm and below -3 cm, summed over goals and coordinates).
    """
    pose, time = compute_cylindrical_pose(run), run.truth.time
    overshoot, count = 0.0, 0
    for c, goals in _GOAL_POSITIONS.items():
        for k, (start, end) in enumerate(_GOAL_INTERVALS):
            inside = (time > start) & (time < end)
            step, error = goals[k + 1] - goals[k], pose[c][inside] - goals[k + 1]
            if step:
                overshoot = max(overshoot, float((np.sign(step) * error).max() / abs(step)))
            far = error[np.abs(error) > _MIN_COUNTED_ERROR]
            count += int(np.count_nonzero(np.diff(np.sign(far))))
    return overshoot, count


def compare_rate_and_position_control(seed: int, changes: Changes) -> Sample:
    """Simulate an operator who steers the tip to goals by sight, under rate and under position control.

    For the first five operators (seeds) the possible causes of an oscillation are varied as well: no
    tremor (`calm`) and a machine five times as fast (`fast`), both under position control; and an
    operator with a low crossover frequency under either control (`slow_rate`, `slow_position`).

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        Per condition: largest overshoot over the step, and number of reversals about the goals, as by
        `measure_overshoot_and_reversals`.
    """
    cases = {
        "rate": {"pilot.mode": "rate"},
        "position": {"pilot.mode": "position"},
        "calm": {"pilot.mode": "position", "pilot.perception.tremor": "0"},
        "fast": {
            "pilot.mode": "position",
            "pilot.coordinates": _FAST_COORDINATES,
            "pilot.acceleration": "5.0",
        },
        "slow_rate": {"pilot.mode": "rate", "pilot.perception.max_crossover_frequency": "1.5"},
        "slow_position": {"pilot.mode": "position", "pilot.perception.max_crossover_frequency": "1.5"},
    }
    if seed > _CAUSE_OPERATORS:
        cases = {name: cases[name] for name in ("rate", "position")}
    values, panels = {}, []
    for name, keys in cases.items():
        keys = {"pilot.mount": "table"} | make_random_operator_settings(seed) | keys | dict(changes)
        _, run = run_shipped_scenario("steer", keys)
        overshoot, count = measure_overshoot_and_reversals(run)
        values |= {f"{name}_overshoot": overshoot, f"{name}_reversals": float(count)}
        if name in ("rate", "position"):
            pose = compute_cylindrical_pose(run)
            tip = {c: pose[c] for c in "rz"}
            panels.append(Panel(f"tip under {name} control [m]", run.truth.time, tip))
            handle = {c: 1e3 * run.measured[f"handle.{c}"] for c in "xz"}
            panels.append(Panel(f"handle under {name} control [mm]", run.measured.time, handle))
    return Sample(values, tuple(panels))


def _evaluate_rate_and_position_control(samples: Sequence[Sample]) -> Evaluation:
    smooth = (collect_values(samples, "rate_overshoot") < _MAX_OVERSHOOT) & (
        collect_values(samples, "rate_reversals") < _MIN_REVERSALS
    )
    oscillates = collect_values(samples, "position_reversals") >= _MIN_REVERSALS
    check = check_fraction(
        "operators whose motion is smooth under rate control and oscillates under position control",
        smooth & oscillates,
    )
    note = "; ".join(
        f"{key} control: overshoot {format_values(samples, f'{key}_overshoot', 100.0, 0)} % of a"
        f" step, {format_values(samples, f'{key}_reversals', 1.0, 0)} reversals"
        for key in ("rate", "position")
    )
    note += (
        f"; smooth under rate control: {smooth.sum()} of {len(samples)} operators, oscillating"
        f" under position control: {oscillates.sum()}"
    )
    varied = [sample for sample in samples if "calm_reversals" in sample.values]

    def describe_case(key: str) -> str:
        return (
            f"overshoot {format_values(varied, f'{key}_overshoot', 100.0, 0)} %,"
            f" {format_values(varied, f'{key}_reversals', 1.0, 0)} reversals"
        )

    explanation = (
        f"smooth: overshoot below {100 * _MAX_OVERSHOOT:.0f} % and fewer than {_MIN_REVERSALS}"
        f" reversals; oscillates: {_MIN_REVERSALS} reversals or more. A reversal is a change from more than"
        f" {100 * _MIN_COUNTED_ERROR:.0f} cm on one side of the goal to more than that on the other."
        " Rate control is not smooth for most operators, because they estimate the"
        " machine's gain and lag while they steer. Position control without tremor:"
        f" {describe_case('calm')}; with a machine five times as fast: {describe_case('fast')}."
        f" Operators with a crossover of 1.5 rad/s: rate {describe_case('slow_rate')}, position"
        f" {describe_case('slow_position')}"
    )
    return Evaluation((check,), explanation, note)


_MAX_NONLINEARITY = 0.03  # RMS deviation over the largest force
_RAMPS = {"x": (1.0, 7.0, 4.0, 0.3, 2.0), "z": (9.0, 15.0, 4.0, 0.4, 2.0)}
"""Axis -> (start, end [s], and Kp, Kp1 [N/mm] and force drop [N] of Zhu 1994, Table 6.11)."""
_DEADBAND_EDGE = 1.5  # mm, Table 6.9


def measure_handle_force_curve(detent: str, seed: int, changes: Changes) -> Sample:
    """Measure the hand force over displacement while the handle moves slowly from its centre to its stop.

    Args:
        detent: `true` or `false`, whether the joystick has detents.
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        Per axis x and z: stiffness of a line through the centre (`slope`) [N/mm]; RMS deviation from
        this line over the largest force (`nonlinearity`); stiffness `inside` and `outside` the dead band
        [N/mm]; force `drop` at the edge of the dead band [N].
    """
    keys = {"pilot.detent": detent} | make_random_operator_settings(seed) | dict(changes)
    _, run = run_shipped_scenario("handle_ramp", keys)
    m, values, panels = run.measured, {}, []
    for axis, (start, end, *_) in _RAMPS.items():
        inside = (m.time > start) & (m.time < end)
        x, force = 1e3 * m[f"handle.{axis}"][inside], m[f"hand_force.{axis}"][inside]
        slope = float(x @ force / (x @ x))
        values[f"{axis}_slope"] = slope
        values[f"{axis}_nonlinearity"] = float(np.sqrt(np.mean((force - slope * x) ** 2)) / np.abs(force).max())
        near, far = (x > 0.2) & (x < _DEADBAND_EDGE - 0.1), x > _DEADBAND_EDGE + 0.3
        inner, outer = np.polyfit(x[near], force[near], 1), np.polyfit(x[far], force[far], 1)
        values[f"{axis}_inside"], values[f"{axis}_outside"] = float(inner[0]), float(outer[0])
        values[f"{axis}_drop"] = float(np.polyval(inner, _DEADBAND_EDGE) - np.polyval(outer, _DEADBAND_EDGE))
        order = np.argsort(x)
        panels.append(Panel(f"hand force along {axis} [N]", x[order], {"force": force[order]},
                            "displacement [mm]"))  # fmt: skip
    return Sample(values, tuple(panels))


def _evaluate_centring(samples: Sequence[Sample]) -> Evaluation:
    checks: list[Check] = []
    for axis, (_, _, kp, _, _) in _RAMPS.items():
        checks.append(check_mean(
            f"stiffness along {axis}", collect_values(samples, f"{axis}_slope"), (kp - 0.05, kp + 0.05),
            "the printed digits of Table 6.9", unit="N/mm", published=kp,
        ))  # fmt: skip
        checks.append(check_mean(
            f"RMS deviation from a straight line along {axis} over the largest force",
            collect_values(samples, f"{axis}_nonlinearity"), (0.0, _MAX_NONLINEARITY),
            "linear, except for noise and friction of the measured hand force",
        ))  # fmt: skip
    return Evaluation(tuple(checks), "evaluated with the hand's force, not with the command")


def _evaluate_detent(samples: Sequence[Sample]) -> Evaluation:
    checks: list[Check] = []
    for axis, (_, _, kp, kp1, drop) in _RAMPS.items():
        checks.append(check_mean(
            f"Kp along {axis}", collect_values(samples, f"{axis}_inside"), (kp - 0.05, kp + 0.05),
            "the printed digits of Table 6.11", unit="N/mm", published=kp,
        ))  # fmt: skip
        checks.append(check_mean(
            f"Kp1 along {axis}", collect_values(samples, f"{axis}_outside"), (kp1 - 0.05, kp1 + 0.05),
            "the printed digits of Table 6.11", unit="N/mm", published=kp1,
        ))  # fmt: skip
        checks.append(check_mean(
            f"force drop along {axis}", collect_values(samples, f"{axis}_drop"), (0.9 * drop, 1.1 * drop),
            "10 %: both lines are extrapolated to the edge from the moving hand's force", unit="N",
            published=drop,
        ))  # fmt: skip
    return Evaluation(tuple(checks), "lines fitted to the hand's force inside and outside")


_JOINT_STEPS = {"boom": (1.0, 56), "stick": (11.0, 57), "tilt": (21.0, 58)}
"""Joint -> time of its step [s], figure 6.n; it steps back 5 s later."""
_STEP_DURATION = 5.0  # time from a step to the step back [s]
_AVERAGING_TIME = 0.5  # length of an averaging interval [s]
_MIN_PRESSURE_SWING = 0.5  # peak-to-peak pressure over the pressure before the step
_MAX_JOINT_ERROR = 0.05  # remaining error over the step
_MAX_JOINT_OVERSHOOT = 0.10  # overshoot over the step
_MAX_RINGING = 0.02  # amplitude of the remaining oscillation over the step


def measure_joint_steps(seed: int, changes: Changes) -> Sample:
    """Simulate steps of the feller-buncher's boom, stick and tilt by 0.1 rad and back; evaluate the response.

    The first repetition (seed 1) is also simulated with half the position gain, which shows whether the
    servo causes the oscillation.

    Args:
        seed: seed of the sensor noise.
        changes: scenario keys.

    Returns:
        Per joint: head-side pressure from peak to peak (`swing`) and before the step (`level`) [Pa] and
        their ratio (`pressure`); overshoot, remaining error and amplitude of the remaining oscillation
        (`ringing`) of the angle, each over the step. With half the gain: overshoot and ringing of the boom.
    """
    values, panels = _simulate_joint_steps(seed, changes)
    if seed == 1:
        slower, _ = _simulate_joint_steps(seed, {"servo.position_gain": "2.0"} | dict(changes))
        for key in ("overshoot", "ringing"):
            values[f"boom_{key}_slower"] = slower[f"boom_{key}"]
    return Sample(values, panels)


def _simulate_joint_steps(seed: int, changes: Changes) -> tuple[dict[str, float], tuple[Panel, ...]]:
    _, run = run_shipped_scenario("feller_joint_steps", {"seed": str(seed)} | dict(changes))
    m, values, panels = run.measured, {}, []
    table = run.scenario.pilot.columns  # pyright: ignore[reportAttributeAccessIssue]
    for name, (start, _) in _JOINT_STEPS.items():
        before = (m.time > start - _AVERAGING_TIME) & (m.time < start)
        after = (m.time >= start) & (m.time < start + _STEP_DURATION - 0.1)
        late = (m.time >= start + _STEP_DURATION - 0.1 - _AVERAGING_TIME) & (m.time < start + _STEP_DURATION - 0.1)
        angle, head = m[f"angle.{name}"], m[f"pressure_head.{name}"]
        goal = max(table[name])
        step = goal - table[name][0]
        values[f"{name}_swing"] = float(np.ptp(head[after]))
        values[f"{name}_level"] = float(head[before].mean())
        values[f"{name}_pressure"] = values[f"{name}_swing"] / values[f"{name}_level"]
        values[f"{name}_overshoot"] = float((angle[after].max() - goal) / step)
        values[f"{name}_error"] = float(abs(angle[late].mean() - goal) / step)
        values[f"{name}_ringing"] = float(np.ptp(angle[late]) / 2.0 / step)
        shown = (m.time > start - 1.0) & (m.time < start + 2 * _STEP_DURATION)
        panels.append(Panel(f"{name} angle [rad]", m.time[shown], {"measured": angle[shown]}))
        panels.append(Panel(f"head-side pressure of the {name} [MPa]", m.time[shown],
                            {"measured": head[shown] / 1e6}))  # fmt: skip
    return values, tuple(panels)


def _evaluate_pressure_oscillation(joint: str, samples: Sequence[Sample]) -> Evaluation:
    check = check_mean(
        "pressure from peak to peak over the pressure before the step",
        collect_values(samples, f"{joint}_pressure"), (_MIN_PRESSURE_SWING, np.inf),
        "\"huge\": at least half of the pressure that carries the arm; no values of the curves are "
                "legible",
    )  # fmt: skip
    note = (
        f"{format_values(samples, f'{joint}_swing', 1e-6, 0)} MPa from peak to peak on"
        f" {format_values(samples, f'{joint}_level', 1e-6, 0)} MPa"
    )
    return Evaluation((check,), note=note)


def _make_pressure_claim(joint: str) -> Claim:
    return Claim(
        f"feller-buncher: pressure of a {joint} step",
        '"the joint step responses of the fellerbuncher , from which we can see that huge hydraulic'
        ' pressures oscillations during free motion"',
        f"p. 107, Fig. 6.{_JOINT_STEPS[joint][1]}",
        "document",
        partial(_evaluate_pressure_oscillation, joint),
        _SLOW_RAMPS,
        "slow ramps instead of steps",
        (f"{joint} angle [rad]", f"head-side pressure of the {joint} [MPa]"),
    )


def _evaluate_joint_steps(samples: Sequence[Sample]) -> Evaluation:
    checks = [
        check_mean(f"{words} of the {name} over its step", collect_values(samples, f"{name}_{key}"),
                   (-np.inf, limit), "a limit of this project")
        for name in _JOINT_STEPS
        for key, words, limit in (("overshoot", "overshoot", _MAX_JOINT_OVERSHOOT),
                                  ("error", "remaining error", _MAX_JOINT_ERROR),
                                  ("ringing", "oscillation after 5 s", _MAX_RINGING))
    ]  # fmt: skip
    v = samples[0].values
    explanation = (
        "with half the position gain (2 /s) the boom overshoots by"
        f" {100 * v['boom_overshoot_slower']:.0f} % and oscillates by"
        f" +-{100 * v['boom_ringing_slower']:.1f} %: the servo's gain is too high for the oil under"
        " the whole arm's weight"
    )
    return Evaluation(tuple(checks), explanation)


_COORDINATE_STEPS = {"r": 1.0, "theta": 6.0, "z": 11.0, "attitude": 16.0, "head": 21.0}
"""Coordinate -> time of its step [s]."""
_MAX_CROSS_MOTION = 0.1  # motion of another coordinate over the step of that coordinate


def measure_coordinate_steps(seed: int, changes: Changes) -> Sample:
    """Simulate joystick steps of the feller-buncher in each of the five task coordinates; evaluate the pose.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        Per coordinate: size of the reference's step [m] or [rad]; overshoot and remaining error of the
        measured pose over the step; largest motion of another coordinate during the step, over the range
        of that coordinate's reference (`cross`).
    """
    _, run = run_shipped_scenario("feller_steps", make_random_operator_settings(seed) | dict(changes))
    m, values, panels = run.measured, {}, []
    for name, start in _COORDINATE_STEPS.items():
        inside = (m.time >= start) & (m.time < start + 4.9)
        pose, reference = m[f"tip_pose.{name}"][inside], m[f"tip_reference.{name}"][inside]
        step = reference[-1] - reference[0]
        values[f"{name}_step"] = float(abs(step))
        values[f"{name}_overshoot"] = float((np.sign(step) * (pose - reference[-1])).max() / abs(step))
        values[f"{name}_error"] = float(abs(pose[-25:].mean() - reference[-1]) / abs(step))
        cross = 0.0
        for other in _COORDINATE_STEPS:
            if other != name:
                moved, scale = m[f"tip_pose.{other}"][inside], np.ptp(m[f"tip_reference.{other}"])
                cross = max(cross, float(np.abs(moved - moved[0]).max() / scale))
        values[f"{name}_cross"] = cross
        unit = "m" if name in "rz" else "rad"
        panels.append(Panel(f"{name} [{unit}]", m.time[inside],
                            {"reference": reference, "measured": pose},
                            errors={"measured - reference": pose - reference},
                            error_label=f"error of {name} [{unit}]"))  # fmt: skip
    return Sample(values, tuple(panels))


def _evaluate_coordinate_steps(samples: Sequence[Sample]) -> Evaluation:
    checks = [
        check_mean(f"{words} of {name}", collect_values(samples, f"{name}_{key}"), (-np.inf, limit),
                   "a limit of this project")
        for name in _COORDINATE_STEPS
        for key, words, limit in (
            ("overshoot", "overshoot", _MAX_JOINT_OVERSHOOT),
            ("error", "remaining error", _MAX_JOINT_ERROR),
            ("cross", "motion of other coordinates during the step", _MAX_CROSS_MOTION),
        )
    ]  # fmt: skip
    steps = ", ".join(f"{name} {format_values(samples, f'{name}_step', 1.0, 2)}"
                      for name in _COORDINATE_STEPS)  # fmt: skip
    return Evaluation(tuple(checks), note=f"steps of {steps} m or rad; errors relative to the step")


_SLOW_SERVO = {"servo.position_gain": "0.3", "servo.feedforward": "0.6"}
_SLOW_RAMPS = {
    "pilot.interpolate": "linear", "pilot.time": "[0, 5, 6, 15, 16, 25, 31]",
    "pilot.columns": "{boom: [0.45, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55],"
    " stick: [-1.35, -1.35, -1.35, -1.25, -1.25, -1.25, -1.25],"
    " tilt: [0.9, 0.9, 0.9, 0.9, 0.9, 1.0, 1.0]}",
}  # fmt: skip

STEERING = Experiment("steering", compare_rate_and_position_control, (
    Claim(
        "rate against position control",
        '"The mismatch of the fast joystick and the slow excavator could cause oscillation under'
        " position control, on the other hand, an operator can easily achieve a smooth operation"
        ' when the machine is under rate control"',
        "p. 90",
        "document",
        _evaluate_rate_and_position_control,
        {"pilot.mode": "rate"},
        "rate control in both",
    ),
))  # fmt: skip

LINES = tuple(Experiment(f"line {one}", partial(measure_line, one), (_make_line_claim(one),), 10) for one in _LINES)

HANDLE_RAMPS = (
    Experiment("handle ramp with detents", partial(measure_handle_force_curve, "true"), (
        Claim(
            "detents",
            '"Within the joystick position deadband, it is the same as the single slope approach.'
            " Outside this band, it has another slope which is lower than the first one. At the"
            ' edge of the band, there is fixed amount of force drop"',
            "p. 101, Fig. 6.51",
            "document",
            _evaluate_detent,
            {"pilot.detent": "false"},
            "detents off",
        ),
    )),
    Experiment("handle ramp", partial(measure_handle_force_curve, "false"), (
        Claim(
            "conventional centring force",
            '"the restoring force is a linear function of the position error. The bigger the'
            ' position error, the higher the restoring force"',
            "p. 101, Fig. 6.52",
            "document",
            _evaluate_centring,
            {"pilot.detent": "true"},
            "detents on",
        ),
    )),
)  # fmt: skip

STEPS = (
    Experiment("joint steps", measure_joint_steps, (
        *(_make_pressure_claim(joint) for joint in _JOINT_STEPS),
        Claim(
            "feller-buncher: joints follow their steps",
            "boom, stick and tilt follow a step of 0.1 rad without overshoot or sustained"
            " oscillation",
            "additional to Fig. 6.56, whose curves have no legible values",
            "additional",
            _evaluate_joint_steps,
            {"servo.position_gain": "12.0", "servo.pressure_feedback": "0.0"},
            "three times the position gain, no damping by pressure",
        ),
    ), 6),
    Experiment("resolved steps", measure_coordinate_steps, (
        Claim(
            "feller-buncher: steps of all five coordinates",
            "the measured pose follows every step of the joystick, the other coordinates stay"
            " constant",
            "additional to Fig. 6.56, which shows joints",
            "additional",
            _evaluate_coordinate_steps,
            _SLOW_SERVO,
            "joint servos with a tenth of the gain and 60 % of the feedforward",
        ),
    ), 10),
)  # fmt: skip
