"""Zhu 1994, chapter 6, without contact: lines, rate against position, the handle's force, steps.

Every measurement takes the seed of its operator and sensors, and changes of its scenario; every
claim quotes the thesis and is judged on measured channels or on the true path of the tip.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from hydrotele.experiments.finding import (
    Changes,
    Claim,
    Experiment,
    Panel,
    Sample,
    Verdict,
    cylindrical,
    drawn,
    largest,
    least,
    mean,
    perform,
    spread,
)
from hydrotele.run.run import Run

_WAYS = {
    "up": (45, "z", 1, ("r",), {"z": "0.8"}),
    "down": (46, "z", -1, ("r",), {"z": "2.2"}),
    "out": (47, "x", 1, ("z",), {"r": "4.8", "z": "1.2"}),
    "in": (48, "x", -1, ("z",), {"r": "6.2", "z": "1.2"}),
}
_STRAY = 0.02  # of the way: less than the width of a line in the published plots
_TURN = 2.0  # degrees of the bucket: the same on their axis of some 60 degrees
_LEAST_WAY = 1.0  # m
_VERTICAL = (
    "the bucket was commanded to go straightly up and down while keeping the bucket angle and"
    " radial displacement constant"
)
_HORIZONTAL = (
    "the bucket was directed to come straightly out from and in towards the cabin while keeping"
    " the bucket angle and height constant"
)


def line(way: str, seed: int, changes: Changes) -> Sample:
    """A straight line of the tip under operator control: up, down, out or in."""
    _, axis, sign, held, start = _WAYS[way]
    push = 0.004 * sign
    keys = {f"start.pose.{k}": v for k, v in start.items()}
    keys |= {"pilot.operator.path": f"{{{axis}: [0, 0, {push}, {push}, 0, 0]}}"} | drawn(seed)
    _, run = perform("joystick_up", keys | dict(changes))
    pose, time = cylindrical(run), run.truth.time
    gone = pose["z" if axis == "z" else "r"]
    values = {
        "way": float(sign * (gone[-1] - gone[0])),
        "stray": float(max(np.abs(pose[c] - pose[c][0]).max() for c in held)),
        "aside": float((pose["r"] * np.abs(pose["theta"] - pose["theta"][0])).max()),
        "turn": float(np.degrees(np.abs(pose["attitude"] - pose["attitude"][0]).max())),
    }
    return Sample(values, (
        Panel("tip [m]", time, {"r": pose["r"], "z": pose["z"]}),
        Panel("bucket [deg]", time, {"attitude": np.degrees(pose["attitude"])}),
        Panel("handle [mm]", run.measured.time, {axis: 1e3 * run.measured[f"handle.{axis}"]}),
    ))  # fmt: skip


def _line_verdict(samples: Sequence[Sample]) -> Verdict:
    way, stray = least(samples, "way"), largest(samples, "stray")
    aside, turn = largest(samples, "aside"), largest(samples, "turn")
    worst = max(stray, aside)
    ok = way > _LEAST_WAY and worst < _STRAY * way and turn < _TURN
    told = (
        f"{way:.2f} m; the other coordinate strays by {1e3 * stray:.0f} mm at most, sideways by"
        f" {1e3 * aside:.0f} mm, the bucket by {turn:.1f} deg"
    )
    limits = (
        f"constant: within {100 * _STRAY:.0f} % of the way and {_TURN:.0f} deg, a limit of ours"
    )
    return Verdict(ok, told, f"{limits}; the thesis gives no figures")


def _line_claim(way: str) -> Claim:
    return Claim(
        f"straight line {way}",
        _VERTICAL if way in ("up", "down") else _HORIZONTAL,
        f"p. 91, Fig. 6.{_WAYS[way][0]}",
        "document",
        _line_verdict,
        {"servo.axis_gains": "{stick: 0.0}", "servo.feedforward": "0.0"},
        "no servo on the stick, no feedforward",
    )


_GOALS = {"r": (5.8, 6.2, 6.2, 6.0), "z": (1.4, 1.4, 1.8, 1.6)}
_HOLDS = ((2.0, 11.0), (11.0, 20.0), (20.0, 30.0))  # s
_NEAR = 0.03  # m: swings that the operator sees, half as much again as he resolves
_SMOOTH = 0.15  # of a step, overshoot of a motion that is called smooth
_SWINGS = 2  # reversals about a goal from which a motion is called an oscillation
_CAUSES = 5  # operators with whom it is asked what an oscillation comes from
_FAST = "{r: {speed: 3.0, scale: 120.0}, theta: {speed: 0.75, scale: 20.0}, z: {speed: 3.0, scale: 120.0}, attitude: {speed: 2.0, scale: 5.0}}"  # noqa: E501


def swings(run: Run) -> tuple[float, int]:
    """Overshoot of the tip's steps and how often it comes back across a goal.

    Args:
        run: of the scenario `steer`.

    Returns:
        (largest overshoot as a share of its step [1], reversals of more than 3 cm either side).
    """
    pose, time = cylindrical(run), run.truth.time
    over, count = 0.0, 0
    for c, goals in _GOALS.items():
        for k, (begin, end) in enumerate(_HOLDS):
            inside = (time > begin) & (time < end)
            step, error = goals[k + 1] - goals[k], pose[c][inside] - goals[k + 1]
            if step:
                over = max(over, float((np.sign(step) * error).max() / abs(step)))
            far = error[np.abs(error) > _NEAR]
            count += int(np.count_nonzero(np.diff(np.sign(far))))
    return over, count


def steering(seed: int, changes: Changes) -> Sample:
    """The same places reached by the same eyes under rate and under position control.

    The operator is asked the same of the tip in both; with a hand that does not tremble, and with
    a machine five times as fast, it is measured what an oscillation comes from.
    """
    cases = {
        "rate": {"pilot.mode": "rate"},
        "position": {"pilot.mode": "position"},
        "calm": {"pilot.mode": "position", "pilot.perception.tremor": "0"},
        "fast": {"pilot.mode": "position", "pilot.coordinates": _FAST, "pilot.acceleration": "5.0"},
        "slow_rate": {"pilot.mode": "rate", "pilot.perception.crossover": "1.5"},
        "slow_position": {"pilot.mode": "position", "pilot.perception.crossover": "1.5"},
    }
    if seed > _CAUSES:
        cases = {name: cases[name] for name in ("rate", "position")}
    values, panels = {}, []
    for name, keys in cases.items():
        keys = {"pilot.mount": "table"} | drawn(seed) | keys | dict(changes)
        _, run = perform("steer", keys)
        over, count = swings(run)
        values |= {f"{name}_over": over, f"{name}_swings": float(count)}
        if name in ("rate", "position"):
            pose = cylindrical(run)
            tip = {c: pose[c] for c in "rz"}
            panels.append(Panel(f"tip under {name} control [m]", run.truth.time, tip))
            handle = {c: 1e3 * run.measured[f"handle.{c}"] for c in "xz"}
            panels.append(Panel(f"handle under {name} control [mm]", run.measured.time, handle))
    return Sample(values, tuple(panels))


def _steering_verdict(samples: Sequence[Sample]) -> Verdict:
    smooth = largest(samples, "rate_over") < _SMOOTH and largest(samples, "rate_swings") < _SWINGS
    swinging = least(samples, "position_swings") >= _SWINGS
    told = [
        f"{name}: overshoot {spread(samples, f'{key}_over', 100.0, 0)} % of a step,"
        f" {spread(samples, f'{key}_swings', 1.0, 0)} reversals"
        for name, key in (("rate", "rate"), ("position", "position"))
    ]
    calm = sum(
        s.values["rate_over"] < _SMOOTH and s.values["rate_swings"] < _SWINGS for s in samples
    )
    restless = sum(s.values["position_swings"] >= _SWINGS for s in samples)
    told.append(
        f"smooth under rate control: {calm} of {len(samples)} operators, swinging under position"
        f" control: {restless}"
    )
    few = [sample for sample in samples if "calm_swings" in sample.values]

    def case(key: str) -> str:
        return (
            f"{spread(few, f'{key}_over', 100.0, 0)} %, {spread(few, f'{key}_swings', 1.0, 0)}"
            " reversals"
        )

    why = (
        f"smooth: overshoot below {100 * _SMOOTH:.0f} % and fewer than {_SWINGS} reversals; same"
        f" eyes and task in both. Position control without tremor: {case('calm')}; with a machine"
        f" five times as fast: {case('fast')}. Operators of a crossover of 1.5 rad/s: rate"
        f" {case('slow_rate')}, position {case('slow_position')}"
    )
    if not smooth:
        why += (
            ". Rate control is not smooth for these operators, who learn gain and lag of the"
            " machine as they go: a mechanism that lets position control alone swing does not"
            " come out"
        )
    return Verdict(smooth and swinging, "; ".join(told), why)


_STRAIGHT = 0.03  # of the largest force: what a linear law may miss by
_TABLE = 0.05  # of a table's figure
_RAMPS = {"x": (1.0, 7.0, 4.0, 0.3, 2.0), "z": (9.0, 15.0, 4.0, 0.4, 2.0)}
# axis -> begin, end [s], then Kp, Kp1 [N/mm] and force drop [N] of Table 6.11
_EDGE = 1.5  # mm: dead band of Table 6.9


def handle_ramp(detent: str, seed: int, changes: Changes) -> Sample:
    """Force of the hand while it moves the handle slowly from its centre to near its stop."""
    keys = {"pilot.detent": detent} | drawn(seed) | dict(changes)
    _, run = perform("handle_ramp", keys)
    m, values, panels = run.measured, {}, []
    for axis, (begin, end, *_) in _RAMPS.items():
        inside = (m.time > begin) & (m.time < end)
        x, force = 1e3 * m[f"handle.{axis}"][inside], m[f"hand_force.{axis}"][inside]
        slope = float(x @ force / (x @ x))
        values[f"{axis}_slope"] = slope
        values[f"{axis}_curved"] = float(
            np.sqrt(np.mean((force - slope * x) ** 2)) / np.abs(force).max()
        )
        values[f"{axis}_rank"] = float(np.corrcoef(x, force)[0, 1])
        near, far = (x > 0.2) & (x < _EDGE - 0.1), x > _EDGE + 0.3
        values[f"{axis}_inside"] = float(np.polyfit(x[near], force[near], 1)[0])
        out = np.polyfit(x[far], force[far], 1)
        values[f"{axis}_outside"] = float(out[0])
        inner = np.polyfit(x[near], force[near], 1)
        values[f"{axis}_drop"] = float(np.polyval(inner, _EDGE) - np.polyval(out, _EDGE))
        order = np.argsort(x)
        panels.append(Panel(f"hand force along {axis} [N]", x[order], {"force": force[order]},
                            over="displacement [mm]"))  # fmt: skip
    return Sample(values, tuple(panels))


def _centring_verdict(samples: Sequence[Sample]) -> Verdict:
    ok, told = True, []
    for axis, (_, _, kp, _, _) in _RAMPS.items():
        curved = largest(samples, f"{axis}_curved")
        slope = mean(samples, f"{axis}_slope")
        ok = ok and curved < _STRAIGHT and abs(slope / kp - 1.0) < _TABLE
        told.append(
            f"{axis}: {slope:.2f} N/mm (Table 6.9: {kp:g}), off a straight line by"
            f" {100 * curved:.1f} % of the largest force"
        )
    return Verdict(ok, "; ".join(told), "judged on the hand's force, not on the command")


def _detent_verdict(samples: Sequence[Sample]) -> Verdict:
    ok, told = True, []
    for axis, (_, _, kp, kp1, drop) in _RAMPS.items():
        inside, outside = mean(samples, f"{axis}_inside"), mean(samples, f"{axis}_outside")
        fell = mean(samples, f"{axis}_drop")
        ok = ok and abs(inside / kp - 1.0) < _TABLE and outside < 0.5 * inside
        ok = ok and abs(outside - kp1) < 0.25 * kp1 and abs(fell / drop - 1.0) < 0.15
        told.append(
            f"{axis}: {inside:.2f} N/mm inside, {outside:.2f} outside, drop {fell:.2f} N"
            f" (Table 6.11: {kp:g}, {kp1:g}, {drop:g})"
        )
    why = "lines fitted to the hand's force; outside within 25 %, drop within 15 %: its noise"
    return Verdict(ok, "; ".join(told), why)


_JOINTS = {"boom": 1.0, "stick": 11.0, "tilt": 21.0}  # s of the steps, back 5 s later
_BACK = 5.0  # s
_REST = 0.5  # s
_HUGE = 0.5  # of the load's pressure difference
_FOLLOWED = 0.05  # of a step
_OVERSHOOT = 0.10  # of a step
_RINGING = 2.0  # percent of a step, at rest


def joint_steps(seed: int, changes: Changes) -> Sample:
    """Steps of 0.1 rad of boom, stick and tilt, there and back, and the pressures meanwhile.

    Once more with half the position gain, to see whether the servo makes what rings.
    """
    values, panels = _joint_steps(seed, changes)
    if seed == 1:
        slower, _ = _joint_steps(seed, {"servo.position_gain": "2.0"} | dict(changes))
        for key in ("over", "ringing"):
            values[f"boom_{key}_slower"] = slower[f"boom_{key}"]
    return Sample(values, panels)


def _joint_steps(seed: int, changes: Changes) -> tuple[dict[str, float], tuple[Panel, ...]]:
    _, run = perform("feller_joint_steps", {"seed": str(seed)} | dict(changes))
    m, values, panels = run.measured, {}, []
    table = run.scenario.pilot.columns  # pyright: ignore[reportAttributeAccessIssue]
    for name, begin in _JOINTS.items():
        before = (m.time > begin - _REST) & (m.time < begin)
        after = (m.time >= begin) & (m.time < begin + _BACK - 0.1)
        late = (m.time >= begin + _BACK - 0.1 - _REST) & (m.time < begin + _BACK - 0.1)
        angle, head = m[f"angle.{name}"], m[f"pressure_head.{name}"]
        start, goal = table[name][0], max(table[name])
        step = goal - start
        values[f"{name}_swing"] = float(np.ptp(head[after]))
        values[f"{name}_level"] = float(head[before].mean())
        values[f"{name}_over"] = float((angle[after].max() - goal) / step)
        values[f"{name}_left"] = float(abs(angle[late].mean() - goal) / step)
        values[f"{name}_ringing"] = float(100.0 * np.ptp(angle[late]) / 2.0 / step)
        shown = (m.time > begin - 1.0) & (m.time < begin + 2 * _BACK)
        panels.append(Panel(f"{name} [rad]", m.time[shown], {"measured": angle[shown]}))
        panels.append(Panel(f"head-side pressure of the {name} [MPa]", m.time[shown],
                            {"measured": head[shown] / 1e6}))  # fmt: skip
    return values, tuple(panels)


def _pressure_verdict(samples: Sequence[Sample]) -> Verdict:
    shares = {n: min(s.values[f"{n}_swing"] / s.values[f"{n}_level"] for s in samples)
              for n in _JOINTS}  # fmt: skip
    told = [f"{n}: {mean(samples, f'{n}_swing') / 1e6:.0f} MPa from peak to peak on"
            f" {mean(samples, f'{n}_level') / 1e6:.0f} MPa" for n in _JOINTS]  # fmt: skip
    why = f"huge: more than {100 * _HUGE:.0f} % of the pressure before the step, a limit of ours"
    return Verdict(min(shares.values()) > _HUGE, "; ".join(told), why)


def _following_verdict(samples: Sequence[Sample]) -> Verdict:
    told, bad = [], []
    for name in _JOINTS:
        over, left = largest(samples, f"{name}_over"), largest(samples, f"{name}_left")
        ringing = largest(samples, f"{name}_ringing")
        told.append(
            f"{name}: overshoot {100 * over:.0f} %, left {100 * left:.1f} %, swing 5 s later"
            f" +-{ringing:.1f} % of the step"
        )
        if over > _OVERSHOOT or left > _FOLLOWED or ringing > _RINGING:
            bad.append(name)
    limits = (
        f"limits: overshoot {100 * _OVERSHOOT:.0f} %, left {100 * _FOLLOWED:.0f} %, swing"
        f" +-{_RINGING:.0f} %"
    )
    why = f"{limits}; beyond them: {', '.join(bad) or 'none'}"
    if "boom" in bad:
        v = samples[0].values
        why += (
            "; with half the position gain (2 /s) the boom overshoots by"
            f" {100 * v['boom_over_slower']:.0f} % and swings by"
            f" +-{v['boom_ringing_slower']:.1f} %: the servo's gain is too high"
            " for the oil under the whole arm's weight"
        )
    return Verdict(not bad, "; ".join(told), why)


_COORDINATES = {"r": 1.0, "theta": 6.0, "z": 11.0, "attitude": 16.0, "head": 21.0}
_CROSS = 0.1  # of a step


def resolved_steps(seed: int, changes: Changes) -> Sample:
    """Steps of the joystick in all five task coordinates, judged on the measured pose."""
    _, run = perform("feller_steps", drawn(seed) | dict(changes))
    m, values, panels = run.measured, {}, []
    for name, begin in _COORDINATES.items():
        inside = (m.time >= begin) & (m.time < begin + 4.9)
        pose, asked = m[f"tip_pose.{name}"][inside], m[f"tip_reference.{name}"][inside]
        step = asked[-1] - asked[0]
        values[f"{name}_step"] = float(abs(step))
        values[f"{name}_over"] = float((np.sign(step) * (pose - asked[-1])).max() / abs(step))
        values[f"{name}_left"] = float(abs(pose[-25:].mean() - asked[-1]) / abs(step))
        values[f"{name}_behind"] = float(np.abs(pose - asked).max() / abs(step))
        cross = 0.0
        for other in _COORDINATES:
            if other != name:
                moved, scale = m[f"tip_pose.{other}"][inside], np.ptp(m[f"tip_reference.{other}"])
                cross = max(cross, float(np.abs(moved - moved[0]).max() / scale))
        values[f"{name}_cross"] = cross
        title = f"{name} [{'m' if name in 'rz' else 'rad'}]"
        panels.append(Panel(title, m.time[inside], {"asked": asked, "measured": pose}))
    return Sample(values, tuple(panels))


def _resolved_verdict(samples: Sequence[Sample]) -> Verdict:
    told, bad = [], []
    for name in _COORDINATES:
        over, left = largest(samples, f"{name}_over"), largest(samples, f"{name}_left")
        cross, step = largest(samples, f"{name}_cross"), least(samples, f"{name}_step")
        unit = "m" if name in "rz" else "rad"
        told.append(f"{name} ({step:.2f} {unit}): overshoot {100 * over:.0f} %, left"
                    f" {100 * left:.1f} %, others {100 * cross:.0f} %")  # fmt: skip
        if over > _OVERSHOOT or left > _FOLLOWED or cross > _CROSS or step < 0.1:
            bad.append(name)
    why = (
        f"measured pose; limits: overshoot {100 * _OVERSHOOT:.0f} %, left {100 * _FOLLOWED:.0f} %,"
        f" others {100 * _CROSS:.0f} % of their own step; beyond them: {', '.join(bad) or 'none'}"
    )
    return Verdict(not bad, "; ".join(told), why)


_SLACK = {"servo.position_gain": "0.3", "servo.feedforward": "0.6"}
_NO_RINGING = {
    "pilot.interpolate": "linear", "pilot.time": "[0, 5, 6, 15, 16, 25, 31]",
    "pilot.columns": "{boom: [0.45, 0.55, 0.55, 0.55, 0.55, 0.55, 0.55],"
    " stick: [-1.35, -1.35, -1.35, -1.25, -1.25, -1.25, -1.25],"
    " tilt: [0.9, 0.9, 0.9, 0.9, 0.9, 1.0, 1.0]}",
}  # fmt: skip

EXPERIMENTS = (
    *(Experiment(f"line {way}", partial(line, way), (_line_claim(way),), most=5)
      for way in _WAYS),
    Experiment("steering", steering, (
        Claim(
            "rate against position control",
            "The mismatch of the fast joystick and the slow excavator could cause oscillation under"
            " position control, on the other hand, an operator can easily achieve a smooth"
            " operation when the machine is under rate control",
            "p. 90",
            "document",
            _steering_verdict,
            {"pilot.mode": "rate"},
            "rate control in both",
        ),
    )),
    Experiment("handle ramp", partial(handle_ramp, "false"), (
        Claim(
            "conventional centring force",
            "the restoring force is a linear function of the position error. The bigger the"
            " position error, the higher the restoring force",
            "p. 101, Fig. 6.52",
            "document",
            _centring_verdict,
            {"pilot.detent": "true"},
            "detents on",
        ),
    ), most=5),
    Experiment("handle ramp with detents", partial(handle_ramp, "true"), (
        Claim(
            "detents",
            "Within the joystick position deadband, it is the same as the single slope approach."
            " Outside this band, it has another slope which is lower than the first one. At the"
            " edge of the band, there is fixed amount of force drop",
            "p. 101, Fig. 6.51, Table 6.11",
            "document",
            _detent_verdict,
            {"pilot.detent": "false"},
            "detents off",
        ),
    ), most=5),
    Experiment("joint steps", joint_steps, (
        Claim(
            "feller-buncher: pressures of joint steps",
            "the joint step responses of the fellerbuncher , from which we can see that huge"
            " hydraulic pressures oscillations during free motion",
            "p. 107, Figs 6.56-6.58",
            "document",
            _pressure_verdict,
            _NO_RINGING,
            "slow ramps instead of steps",
        ),
        Claim(
            "feller-buncher: joints follow their steps",
            "boom, stick and tilt follow a step of 0.1 rad, without overshoot or lasting swing",
            "beyond Figs 6.56-6.58, whose curves have no figures in the text",
            "ours",
            _following_verdict,
            {"servo.position_gain": "12.0", "servo.pressure_feedback": "0.0"},
            "three times the position gain, no damping by pressure",
        ),
    ), most=5),
    Experiment("resolved steps", resolved_steps, (
        Claim(
            "feller-buncher: steps of all five coordinates",
            "the measured pose follows every step of the joystick, the other coordinates stay",
            "beyond Figs 6.56-6.58, which show joints",
            "ours",
            _resolved_verdict,
            _SLACK,
            "joint servos with a tenth of the gain and 60 % of the feedforward",
        ),
    ), most=5),
)  # fmt: skip
