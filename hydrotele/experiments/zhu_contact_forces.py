"""Zhu 1994, chapter 6, in contact: stiffness feedback, direct force feedback, and force tracking.

Contact forces are evaluated as in the thesis, that is, as estimates of the static model (6.6) from
pressures. True forces are given in the notes.
"""

import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import yaml

from hydrotele.core.files import models_folder
from hydrotele.experiments.comparison import Changes, Claim, Evaluation, Experiment, Panel, Sample
from hydrotele.experiments.scenario_runs import (
    make_random_operator_settings,
    read_true_channel,
    run_shipped_scenario,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_fraction,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.experiments.zhu_felling import JUST_NOTICEABLE_DIFFERENCE
from hydrotele.run.run import Run
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import RegulateForce, TeleopPilot, TrackForce

_FORCE_ESTIMATE_CHANGES = {"pilot.force": "static", "pilot.bandwidth_hz": "5.0"}
"""The thesis computes the force from pressures by (6.6) and mentions no filter.

5 Hz is the highest filter bandwidth available here.
"""
_AVERAGING_TIME = 6.0  # last seconds of a target, in which the force is averaged [s]
_MAX_RIPPLE = 0.15  # standard deviation over mean of a stable force
_MIN_UNSTABLE_RIPPLE = 0.5  # standard deviation over mean of an unstable force
_MAX_DEVIATION = 0.15  # relative to the hand force
_DEADBAND = 1.5e-3  # m, Table 6.7
_TARGET_FORCE = 25.0e3  # target force of direct feedback [N]; read from the axis of Fig. 6.50
_PUBLISHED_HAND_FORCE = 4.5  # hand force [N], p. 96
_PUBLISHED_FORCE_RATIO = _PUBLISHED_HAND_FORCE / _TARGET_FORCE


def find_force_task(scenario: Scenario) -> RegulateForce | TrackForce:
    """Return the operator behaviour of a teleoperation scenario, which contains the target force over time.

    The behaviour must be one that regulates or tracks a force.
    """
    assert isinstance(scenario.pilot, TeleopPilot)
    behaviour = scenario.pilot.operator
    assert isinstance(behaviour, RegulateForce | TrackForce)
    return behaviour


def _draw_panels(scenario: Scenario, run: Run, title: str = "") -> tuple[Panel, ...]:
    time, facts, m = run.truth.time, find_force_task(scenario).target, run.measured
    target = np.interp(time, facts.time, facts.force) / 1e3
    force = read_true_channel(run, "truth.contact_force.z") / 1e3
    estimated = np.interp(time, m.time, m["tip_force.z"]) / 1e3
    return (
        Panel(f"{title}contact force [kN]", time,
              {"target": target, "true": force, "estimated": estimated}),
        Panel(f"{title}handle [mm]", m.time, {"z": 1e3 * m["handle.z"]}),
        Panel(f"{title}hand force [N]", m.time, {"z": m["hand_force.z"]}),
    )  # fmt: skip


def _compute_proportionality_error(x: np.ndarray, force: np.ndarray, slope: np.ndarray | float) -> float:
    """Return the RMS deviation of `force` from `slope` times the displacement `x`, over the RMS force [1]."""
    return float(np.sqrt(np.mean((force - slope * x) ** 2) / np.mean(force**2)))


def measure_stiffness_feedback(seed: int, changes: Changes) -> Sample:
    """Simulate an operator who presses with 20 kN and then 35 kN and feels only the joystick's stiffness.

    The joystick's stiffness changes with the contact force (stiffness feedback).

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        `held_20`, `held_35`: estimated contact force [N], averaged over the last 6 s of each target.
        `error`, `true_error`: largest relative deviation of the estimated and of the true force from the
        targets. `line`, `fixed_line`: largest RMS deviation of the hand force from the current stiffness,
        or from a fitted constant stiffness, times the handle's displacement, over the RMS hand force.
    """
    keys = make_random_operator_settings(seed) | _FORCE_ESTIMATE_CHANGES | dict(changes)
    scenario, run = run_shipped_scenario("press_stiffness", keys)
    m, values = run.measured, {}
    facts = find_force_task(scenario).target
    edges = [*facts.time[2::2], scenario.duration]
    error, true_error, line, fixed_line = 0.0, 0.0, 0.0, 0.0
    force = read_true_channel(run, "truth.contact_force.z")
    start = float(m.time[np.argmax(m["tip_force.z"] > 0.25 * facts.force[0])])
    for goal, edge in zip(facts.force[::2], edges, strict=False):
        late = (m.time > edge - _AVERAGING_TIME) & (m.time <= edge - 0.05)
        held = float(m["tip_force.z"][late].mean())
        true = float(force[(run.truth.time > edge - _AVERAGING_TIME) & (run.truth.time <= edge)].mean())
        values[f"held_{goal / 1e3:.0f}"] = held
        error = max(error, abs(held / goal - 1.0))
        true_error = max(true_error, abs(true / goal - 1.0))
        pressing = (m.time > start + 1.0) & (m.time <= edge)
        x, hand = m["handle.z"][pressing], m["hand_force.z"][pressing]
        line = max(line, _compute_proportionality_error(x, hand, m["handle_stiffness.z"][pressing]))
        fixed_line = max(fixed_line, _compute_proportionality_error(x, hand, float((x @ hand) / (x @ x))))
        start = edge
    values |= {"error": error, "true_error": true_error, "line": line, "fixed_line": fixed_line}
    return Sample(values, _draw_panels(scenario, run))


def measure_direct_feedback(ratio: float, seed: int, changes: Changes) -> Sample:
    """Simulate an operator who presses with 25 kN while the scaled contact force is reflected to the hand.

    Args:
        ratio: reflected hand force over contact force [N/N].
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        In the last 40 % of the run: mean estimated contact force (`held`) and hand force (`hand`) [N],
        `ripple` of the true contact force (standard deviation over mean), and mean and largest magnitude
        of the handle's `displacement` [m]. Also the `ratio` of the run.
    """
    keys = {
        "pilot.ratio": str(ratio), "pilot.operator.target.force": f"[{_TARGET_FORCE}]"
    } | make_random_operator_settings(seed) | _FORCE_ESTIMATE_CHANGES | dict(changes)  # fmt: skip
    scenario, run = run_shipped_scenario("press_direct", keys)
    assert isinstance(scenario.pilot, TeleopPilot)
    m, start = run.measured, 0.6 * scenario.duration
    late = m.time > start
    handle = m["handle.z"][late]
    true = read_true_channel(run, "truth.contact_force.z")[run.truth.time > start]
    values = {
        "ratio": scenario.pilot.ratio,
        "held": float(m["tip_force.z"][late].mean()),
        "ripple": float(true.std() / max(true.mean(), 1.0)),
        "displacement": float(np.abs(handle).mean()),
        "max_displacement": float(np.abs(handle).max()),
        "hand": float(m["hand_force.z"][late].mean()),
    }
    return Sample(values, _draw_panels(scenario, run))


def _describe_held_forces(samples: Sequence[Sample]) -> str:
    return (
        f"{format_values(samples, 'held_20', 1e-3)} kN for a target of 20 kN,"
        f" {format_values(samples, 'held_35', 1e-3)} kN for 35 kN; error"
        f" {format_values(samples, 'error', 100.0, 0)} %, of the true force"
        f" {format_values(samples, 'true_error', 100.0, 0)} %"
    )


def _evaluate_operators_within_jnd(samples: Sequence[Sample]) -> Evaluation:
    check = check_fraction(
        f"operators whose force is within {100 * JUST_NOTICEABLE_DIFFERENCE:.0f} % of both targets",
        collect_values(samples, "error") < JUST_NOTICEABLE_DIFFERENCE,
    )
    explanation = (
        f"reasonably good is taken as {100 * JUST_NOTICEABLE_DIFFERENCE:.0f} %, the just noticeable difference of a"
        " compliance (Tan 1995). Perception errors of that fraction in the stiffness and K_nom"
        " cause force errors of 33 % at 20 kN and 29 % at 35 kN (4.1, Tables 6.7 and 6.8); the"
        " operator of the thesis practised with the force on a screen, the simulated one only knows"
        " K_nom and K_r"
    )
    return Evaluation((check,), explanation, _describe_held_forces(samples))


def _evaluate_target_forces(samples: Sequence[Sample]) -> Evaluation:
    check = check_fraction(
        "operators within 10 % of both targets", collect_values(samples, "error") < 0.1,
        reason="a statement on most operators",
    )  # fmt: skip
    return Evaluation((check,), "see the row on the force applied by feel", _describe_held_forces(samples))


def _evaluate_hand_force_proportionality(samples: Sequence[Sample]) -> Evaluation:
    check = check_mean(
        "RMS deviation of the hand's force from the current stiffness times the displacement",
        collect_values(samples, "line"), (0.0, _MAX_DEVIATION),
        "proportional, except for damping and inertia of the moving handle",
    )  # fmt: skip
    note = f"RMS deviation from a line of fixed slope: {format_values(samples, 'fixed_line', 100.0, 0)} %"
    return Evaluation((check,), "the slope follows the contact force (4.1)", note)


def _evaluate_direct_feedback(samples: Sequence[Sample]) -> Evaluation:
    checks = (
        check_mean("force of the hand", collect_values(samples, "hand"), (-1.1 * _PUBLISHED_HAND_FORCE,
                   -0.9 * _PUBLISHED_HAND_FORCE), "10 %: the ratio is known only from the axis of Fig. 6.50",
                   unit="N", published=-_PUBLISHED_HAND_FORCE),
        check_mean("displacement of the handle from its centre",
                   1e3 * collect_values(samples, "displacement"), (0.0, 1e3 * _DEADBAND),
                   "almost none: inside the dead band of Table 6.7", unit="mm"),
        check_fraction(f"operators who hold the force with less than {100 * _MAX_RIPPLE:.0f} %"
                       " ripple", collect_values(samples, "ripple") < _MAX_RIPPLE),
    )  # fmt: skip
    note = (
        f"contact force {format_values(samples, 'held', 1e-3)} kN with {samples[0].values['ratio']:.1e} N/N,"
        f" ripple {format_values(samples, 'ripple', 100.0, 0)} %"
    )
    explanation = (
        f"with this ratio, 50 kN (Table 6.8) give {50e3 * _PUBLISHED_FORCE_RATIO:.0f} N at the hand, close to the"
        " stability limit; the force filter has the highest bandwidth (5 Hz), because the thesis"
        " mentions no filter"
    )
    return Evaluation(checks, explanation, note)


_SOFT_GROUND = "[{kind: plate, position: [6.0, -0.11, 0.3], size: [0.8, 0.9], stiffness: 3.0e+5, damping: 3.0e+4}]"  # noqa: E501
_HARD_GROUND = "[{kind: plate, position: [6.0, -0.11, 0.3], size: [0.8, 0.9], stiffness: 3.0e+6, damping: 9.0e+4}]"  # noqa: E501
FEEDBACK_CONDITIONS: tuple[tuple[str, Changes, dict[str, float]], ...] = (
    ("reference (force delay 0.10 s, 1 MN/m, 0.3 m/s at the stop, 200 Hz)", {}, {}),
    ("true force without delay, available only in simulation", {"pilot.force": "'true'"}, {}),
    ("force delay 0.32 s (1.5 Hz)", {"pilot.bandwidth_hz": "1.5"}, {}),
    ("force delay 0.68 s (0.7 Hz)", {"pilot.bandwidth_hz": "0.7"}, {}),
    ("ground of 0.3 MN/m", {"surroundings": _SOFT_GROUND}, {}),
    ("ground of 3 MN/m", {"surroundings": _HARD_GROUND}, {}),
    ("0.1 m/s at the stop", {"pilot.coordinates.z.speed": "0.1"}, {}),
    ("hand twice as stiff and damped", {}, {"stiffness": 2.0, "damping": 2.0}),
    ("joystick sampled at 100 Hz", {"control_rate": "100"}, {}),
)  # fmt: skip
"""Conditions that may limit direct feedback: (description, changes, factors of the hand)."""
_SEARCH_RANGE = (4.0e-5, 8.0e-4)  # range of searched ratios [N/N]
_HALVINGS = 4
_SEARCH_ERROR = 1.2  # uncertainty factor of the limit after the halvings


def search_max_feedback_ratio(number: int, changes: Changes) -> Sample:
    """Search for the largest stable ratio of hand force to contact force in direct feedback, to 20 %.

    Direct feedback reflects the contact force, scaled by this ratio, to the hand. Ratios from 4e-5 to
    8e-4 are searched by bisection.

    Args:
        number: number of the condition in `FEEDBACK_CONDITIONS`, from 1 on.
        changes: scenario keys.

    Returns:
        `limit`: largest stable ratio [N/N]; 0 if the smallest ratio is unstable, infinite if the
        largest is stable.
    """
    _, keys, hand = FEEDBACK_CONDITIONS[number - 1]
    with tempfile.TemporaryDirectory() as folder:
        keys = {"duration": "25.0", **keys, **changes}
        if hand:
            keys["pilot.joystick"] = _write_scaled_joystick(Path(folder), hand)
        low, high = _SEARCH_RANGE
        if not _is_direct_feedback_stable(low, keys):
            return Sample({"limit": 0.0})
        if _is_direct_feedback_stable(high, keys):
            return Sample({"limit": np.inf})
        for _ in range(_HALVINGS):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if _is_direct_feedback_stable(middle, keys) else (low, middle)
    return Sample({"limit": low})


def _is_direct_feedback_stable(ratio: float, keys: Changes) -> bool:
    """Return whether direct force feedback with this ratio keeps the handle near its centre.

    The handle must stay within twice its dead band of 1.5 mm in the last 40 % of a run. `ratio` is
    hand force over contact force [N/N], and `keys` are changed scenario keys.
    """
    values = measure_direct_feedback(ratio, 1, keys).values
    return values["max_displacement"] < 2.0 * _DEADBAND


def _write_scaled_joystick(folder: Path, factors: dict[str, float]) -> str:
    """Write a copy of the shipped joystick file with scaled hand impedance to `folder`, and return its path.

    `factors` maps `stiffness` or `damping` of the hand to a factor, which also applies to rotations.
    """
    source = models_folder() / "joystick" / "joystick.yaml"
    facts = yaml.safe_load(source.read_text(encoding="utf-8"))
    for name, factor in factors.items():
        facts["hand"][name] *= factor
        facts["hand"][f"rotation_{name}"] *= factor
    facts["mjcf"] = str(source.parent / facts["mjcf"])
    target = folder / "joystick.yaml"
    target.write_text(yaml.safe_dump(facts), encoding="utf-8")
    return str(target)


def _evaluate_feedback_limits(samples: Sequence[Sample]) -> Evaluation:
    limits = collect_values(samples, "limit")
    exists = (limits > 0.0) & np.isfinite(limits)
    words = [one[0] for one in FEEDBACK_CONDITIONS]
    published = 50e3 * _PUBLISHED_FORCE_RATIO
    checks = (
        check_deterministic_value(
            "conditions, of 9, under which direct feedback has a stability limit", int(exists.sum()),
            (len(FEEDBACK_CONDITIONS), len(FEEDBACK_CONDITIONS)),
            "\"severely restricted\": a limit under all conditions"),
        check_deterministic_value(
            "stability limit of the reflected force for a contact force of 50 kN, in the reference "
                "condition",
                    5e4 * limits[0], (published / _SEARCH_ERROR, np.inf),
                    "the published 4.5 N were held, the search is accurate to a factor of"
                    f" {_SEARCH_ERROR:g}", unit="N", published=published),
    )  # fmt: skip
    note = "limits for 50 kN (Table 6.8): " + "; ".join(
        f"{one}: {_describe_limit(limit)}" for one, limit in zip(words, limits, strict=False)
    )
    explanation = ""
    if exists.all():
        factor = np.maximum(limits / limits[0], limits[0] / limits)
        order = np.argsort(-factor)[:3]
        explanation = "the limit depends most on " + ", ".join(f"{words[k]} ({factor[k]:.1f} times)" for k in order)
        explanation += (
            ". The force is estimated with two filters: that of the force has the frequency in parentheses, that of"
            " the motion twice this frequency; the force delay is that of both"
        )
    return Evaluation(checks, explanation, note)


def _describe_limit(limit: float) -> str:
    if limit == 0.0:
        return f"below {5e4 * _SEARCH_RANGE[0]:.0f} N"
    return f"above {5e4 * _SEARCH_RANGE[1]:.0f} N" if np.isinf(limit) else f"{5e4 * limit:.1f} N"


def _evaluate_instability(samples: Sequence[Sample]) -> Evaluation:
    check = check_fraction(
        f"operators whose contact force has a ripple of more than {100 * _MIN_UNSTABLE_RIPPLE:.0f} % of its mean",
        collect_values(samples, "ripple") > _MIN_UNSTABLE_RIPPLE,
    )
    ratio = samples[0].values["ratio"]
    note = (
        f"{ratio:.1e} N/N, {5e4 * ratio:.0f} N for 50 kN: ripple"
        f" {format_values(samples, 'ripple', 100.0, 0)} %, handle up to"
        f" {format_values(samples, 'max_displacement', 1e3)} mm"
    )
    return Evaluation((check,), note=note)


_CONTACT_TIME = 12.0  # time at which the head has reached the rock [s]
_MIN_IMPROVEMENT = 2.0  # error ratio


def measure_tracking(seed: int, changes: Changes) -> Sample:
    """Simulate an operator who tracks a force trajectory on a rock and sees the contact force on a screen.

    The four conditions are with and without force reflection, each with and without the detents of
    Zhu 1994, Table 6.11.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        `REFLECTION_DETENT`: RMS difference of the estimated contact force from the target after the
        contact [N], with `stiffness` or `none` as reflection, and `detent` or `plain` joystick.
    """
    values, panels = {}, []
    for detent in ("true", "false"):
        for reflection in ("stiffness", "none"):
            keys = {
                "pilot.reflection": reflection, "pilot.detent": detent
            } | make_random_operator_settings(seed) | dict(changes)  # fmt: skip
            scenario, run = run_shipped_scenario("track_rock", keys)
            m, facts = run.measured, find_force_task(scenario).target
            late = m.time > _CONTACT_TIME
            error = m["tip_force.z"] - np.interp(m.time, facts.time, facts.force)
            name = f"{reflection}_{'detent' if detent == 'true' else 'plain'}"
            values[name] = float(np.sqrt(np.mean(error[late] ** 2)))
            title = f"{reflection}{', detents' if detent == 'true' else ''}: "
            panels += _draw_panels(scenario, run, title)[:2]
    return Sample(values, tuple(panels))


def _evaluate_tracking(samples: Sequence[Sample]) -> Evaluation:
    checks = []
    for key, words in (("detent", "with detents"), ("plain", "without detents")):
        pairs = np.stack([collect_values(samples, f"{kind}_{key}") for kind in ("none", "stiffness")], 1)
        checks.append(check_bootstrapped_statistic(
            "mean RMS error of the tracked force without reflection over that with reflection, "
                f"{words}", pairs,
            lambda rows: float(np.mean(rows[:, 0]) / np.mean(rows[:, 1])),
            (_MIN_IMPROVEMENT, np.inf),
            "\"greatly improves\": half of the error; the thesis does not say whether the detents were "
                "on",
        ))  # fmt: skip
    note = "; ".join(
        f"RMS error {words}: {format_values(samples, f'stiffness_{key}', 1e-3)} kN with reflection,"
        f" {format_values(samples, f'none_{key}', 1e-3)} kN without"
        for key, words in (("detent", "with detents"), ("plain", "without detents"))
    )
    explanation = (
        "an operator who sees the contact force on the screen corrects it even without force"
        f" reflection: the error ratio is {checks[1].value:.1f} without detents"
    )
    return Evaluation(tuple(checks), explanation, note)


STIFFNESS_FEEDBACK = (
    Experiment("force by feel", measure_stiffness_feedback, (
        Claim(
            "stiffness feedback: a force applied by feel",
            '"Both methods achieved reasonably good results in terms of controlling the endpoint'
            ' force"',
            "p. 96, Fig. 6.49",
            "document",
            _evaluate_operators_within_jnd,
            {"pilot.reflection": "none"},
            "no force reflection",
        ),
        Claim(
            "stiffness feedback: force over displacement",
            "\"the operator's hand applied force is proportional to the wrist displacement along"
            ' corresponding z axis"',
            "p. 96, Fig. 6.49",
            "document",
            _evaluate_hand_force_proportionality,
            {"pilot.reflection": "direct_force", "pilot.ratio": "1.0e-4"},
            "direct feedback",
        ),
        Claim(
            "stiffness feedback: 20 and 35 kN",
            "20 kN and then 35 kN are held within 10 % of the target",
            "additional to p. 96",
            "additional",
            _evaluate_target_forces,
            {"pilot.reflection": "none"},
            "no force reflection",
        ),
    )),
    Experiment("direct feedback", partial(measure_direct_feedback, _PUBLISHED_FORCE_RATIO), (
        Claim(
            "direct feedback: held with 4.5 N",
            '"while the operator applied - 4 . 5 Newton force to the wrist to counterbalance the'
            ' feedback force there is almost no wrist displacement in z axis"',
            "p. 96, Fig. 6.50",
            "document",
            _evaluate_direct_feedback,
            {"pilot.ratio": "4.0e-4"},
            "twice the reflected force",
        ),
    )),
    Experiment("limit of direct feedback", search_max_feedback_ratio, (
        Claim(
            "direct feedback: severely restricted",
            '"direct force feedback method is only possible when the amount of force feedback is'
            ' severely restricted. Otherwise, stability problems can arise"',
            "p. 96",
            "document",
            _evaluate_feedback_limits,
            {"pilot.reflection": "stiffness"},
            "stiffness feedback, for which the ratio has no influence: the handle stays within twice its"
            " dead band at all ratios or, pushed by the operator, at none",
        ),
    ), fixed_repetitions=len(FEEDBACK_CONDITIONS)),
)  # fmt: skip

FORCE_TRACKING = (
    Experiment("force tracking", measure_tracking, (
        Claim(
            "force tracking with and without reflection",
            '"it is very hard to track a desired force trajectory without the use of force'
            " reflection. The results clearly demonstrate that the addition of force reflection to"
            " the teleoperator system greatly improves the ability of the operator to control the"
            ' endpoint force"',
            "p. 102, Fig. 6.53, Fig. 6.54",
            "document",
            _evaluate_tracking,
            {"pilot.reflection": "none"},
            "no force reflection in both runs",
        ),
    ), 10),
)  # fmt: skip

UNSTABLE_FEEDBACK = (
    Experiment("direct feedback, large", partial(measure_direct_feedback, 4.0e-4), (
        Claim(
            "direct feedback: unstable when large",
            '"direct force feedback under rate control can easily introduce instability"',
            "p. 111",
            "document",
            _evaluate_instability,
            {"pilot.ratio": "4.0e-5"},
            "a tenth of the reflected force",
        ),
    ), 10),
)  # fmt: skip
