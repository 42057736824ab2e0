"""Zhu 1994, 6.3 and 6.3.2: tree felling with the feller-buncher, and tip-over protection."""

from collections.abc import Sequence

import numpy as np

from hydrotele.experiments.comparison import Changes, Claim, Evaluation, Experiment, Panel, Sample
from hydrotele.experiments.scenario_runs import (
    compute_cylindrical_pose,
    make_random_operator_settings,
    read_true_channel,
    run_shipped_scenario,
)
from hydrotele.experiments.statistical_checks import (
    check_fraction,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.run.run import Run
from hydrotele.scenario.teleoperation import TeleopPilot, TipOver
from hydrotele.teleop.tip_over_protection import tipping_ratio

JUST_NOTICEABLE_DIFFERENCE = 0.23
"""Just noticeable relative difference of a compliance without other cues (Tan 1995)."""
_MIN_CONTACT_FORCE = 500.0  # force of the head on the stem that counts as contact [N]
_MIN_FORCE_RATIO = 3.0  # detectable force over the force estimated without contact
_MAX_RISE_TIME = 1.0  # s; a ninth of the time axis of Fig. 6.55
_NO_EVENT_TIME = np.inf  # time of an event that does not occur [s]
_MAX_LYING_ATTITUDE = -50.0  # attitude of the head at which the stem lies rather than stands [deg]
_MIN_SWING_ANGLE = 30.0  # swing angle to the side [deg]
_EVENT_WORDS = {"cut": "is cut", "held": "holds", "let_go": "lets"}


def simulate_tree_felling(seed: int, changes: Changes) -> Sample:
    """Simulate felling a tree: contact of the head with the stem, sawing, grabbing and laying down.

    The scenario's first saw button starts the saw.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        Event times [s], infinite if the event does not occur: `touched` (first contact of head and stem
        above 0.5 kN; the stump does not count), `saw` (start), `cut`, `held`, `let_go`. True and
        estimated contact forces [N]; `rise`, the time from contact until the estimated force exceeds
        three times that without contact [s]; joystick stiffness along x without and in contact [N/m] and
        its largest relative change; attitude (`laid`) and swing angle (`aside`) of the head when it lets
        go of the stem [deg].
    """
    scenario, run = run_shipped_scenario("fell_tree", make_random_operator_settings(seed) | dict(changes))
    pose, time, m = compute_cylindrical_pose(run), run.truth.time, run.measured
    contact = {thing: _compute_contact_force(run, thing) for thing in ("tree_0", "tree_0_stump")}
    values = {
        key: next((float(n.rsplit(" ", 2)[-2]) for n in run.summary["notes"] if word in n), _NO_EVENT_TIME)
        for key, word in _EVENT_WORDS.items()
    }
    assert isinstance(scenario.pilot, TeleopPilot)
    saw = min((b.start for b in scenario.pilot.buttons if b.axis == "saw" and b.command), default=0.0)
    on_stem = contact["tree_0"] > _MIN_CONTACT_FORCE
    touched = float(time[np.argmax(on_stem)]) if on_stem.any() else _NO_EVENT_TIME
    free = (m.time > 0.5) & (m.time < min(touched, saw) - 0.2)
    pressing = (m.time >= touched) & (m.time < saw)
    force, stiffness = np.abs(m["tip_force.r"]), m["handle_stiffness.x"]
    free_force = _compute_robust_maximum(force[free])
    rise = m.time[pressing & (force > _MIN_FORCE_RATIO * free_force)]
    in_air = float(np.median(stiffness[free])) if free.any() else np.nan
    change = np.abs(stiffness[pressing] / in_air - 1.0)
    before_release = time < min(values["let_go"], time[-1])
    values |= {
        "touched": touched, "saw": saw, "free_force": free_force,
        "contact_force": _compute_robust_maximum(force[pressing]),
        "rise": float(rise[0]) - touched if rise.size else _NO_EVENT_TIME,
        "stem": float(contact["tree_0"][(time >= touched) & (time < saw)].max(initial=0.0)),
        "stump": float(contact["tree_0_stump"].max()),
        "stiffness_free": in_air,
        "stiffness_contact": float(stiffness[pressing][change.argmax()]) if change.size else np.nan,
        "stiffness_change": float(change.max(initial=0.0)),
        "centring": _compute_robust_maximum(np.abs(m["handle_force.x"][pressing])),
        "laid": float(np.degrees(pose["attitude"][before_release][-1])),
        "aside": float(np.degrees(pose["theta"][before_release][-1])),
        "tripped": float(run.summary["teleoperation"]["tripped"]),
    }  # fmt: skip
    return Sample(values, (
        Panel("tip [m]", time, {"r": pose["r"], "z": pose["z"]}),
        Panel("swing and attitude [rad]", time,
              {"theta": pose["theta"], "attitude": pose["attitude"]}),
        Panel("contact force, true [kN]", time,
              {"stem": contact["tree_0"] / 1e3, "stump": contact["tree_0_stump"] / 1e3}),
        Panel("estimated force along r [kN]", m.time, {"r": m["tip_force.r"] / 1e3}),
        Panel("stiffness of the joystick along x [N/mm]", m.time, {"x": stiffness / 1e3}),
        Panel("centring force along x [N]", m.time, {"x": m["handle_force.x"]}),
    ))  # fmt: skip


def _compute_contact_force(run: Run, object_name: str) -> np.ndarray:
    """Return the magnitude (n,) of the true contact force between the machine and an object over a run [N]."""
    parts = [read_true_channel(run, f"truth.object_contact.{object_name}_{c}") for c in "xyz"]
    return np.linalg.norm(parts, axis=0)


def _compute_robust_maximum(values: np.ndarray) -> float:
    """Return the 98th percentile, a maximum that is robust against single noisy samples."""
    return float(np.percentile(values, 98)) if values.size else np.nan


def _evaluate_contact(samples: Sequence[Sample]) -> Evaluation:
    checks = (
        check_fraction("operators whose head presses on the stem with 0.5 kN or more before the saw"
                       " starts", collect_values(samples, "touched") < collect_values(samples, "saw")),
        check_fraction(f"operators whose estimated force reaches {_MIN_FORCE_RATIO:g} times that without"
                       f" contact within {_MAX_RISE_TIME:g} s after contact",
                       collect_values(samples, "rise") <= _MAX_RISE_TIME),
    )  # fmt: skip
    note = (
        f"contact at {format_values(samples, 'touched')} s, up to"
        f" {format_values(samples, 'stem', 1e-3)} kN on the stem, the estimated force rises within"
        f" {format_values(samples, 'rise', 1.0, 2)} s; estimated"
        f" {format_values(samples, 'contact_force', 1e-3)} kN in contact,"
        f" {format_values(samples, 'free_force', 1e-3)} kN without contact (98th percentiles)"
    )
    explanation = (
        "the resting disc touches the stem, then the operator retracts it and starts the saw,"
        " because a disc that presses on the stem does not start; without contact, times are inf and forces nan,"
        " and one such operator makes the mean inf or nan"
    )
    return Evaluation(checks, explanation, note)


def _evaluate_felt_stiffness(samples: Sequence[Sample]) -> Evaluation:
    check = check_fraction(
        f"operators whose stiffness changes by more than {100 * JUST_NOTICEABLE_DIFFERENCE:.0f} % before the"
        " saw starts", collect_values(samples, "stiffness_change") > JUST_NOTICEABLE_DIFFERENCE,
    )  # fmt: skip
    note = (
        f"stiffness along x from {format_values(samples, 'stiffness_free', 1e-3)} N/mm without"
        f" contact to {format_values(samples, 'stiffness_contact', 1e-3)} N/mm in contact; centring"
        " force"
        f" up to {format_values(samples, 'centring')} N"
    )
    explanation = (
        f"felt: a change of more than {100 * JUST_NOTICEABLE_DIFFERENCE:.0f} %, the just noticeable difference"
        " of a compliance (Tan 1995); without contact, stiffness and force are nan"
    )
    return Evaluation((check,), explanation, note)


def _evaluate_felling_sequence(samples: Sequence[Sample]) -> Evaluation:
    touched, saw, cut, held, let_go, laid, aside, tripped = (
        collect_values(samples, key) for key in ("touched", "saw", "cut", "held", "let_go", "laid", "aside", "tripped")
    )
    in_order = (touched < saw) & (saw < cut) & (cut < _NO_EVENT_TIME) & (saw < held) & (held < let_go)
    lies = (let_go < _NO_EVENT_TIME) & (laid < _MAX_LYING_ATTITUDE) & (aside > _MIN_SWING_ANGLE)
    checks = (
        check_fraction("operators who touch, saw, grab and let go in this order",
                       in_order & (tripped == 0.0)),
        check_fraction("operators who let go of a stem that lies to the side", lies),
    )  # fmt: skip
    times = ", ".join(
        f"{words} at {format_values(samples, key)} s"
        for words, key in (("contact", "touched"), ("saw started", "saw"), ("cut", "cut"),
                           ("held", "held"), ("let go", "let_go"))
    )  # fmt: skip
    note = (
        f"{times}; laid down at {format_values(samples, 'laid', 1.0, 0)} deg,"
        f" {format_values(samples, 'aside', 1.0, 0)} deg to the side; largest force on the stump"
        f" {format_values(samples, 'stump', 1e-3)} kN"
    )
    explanation = (
        f"lies: the attitude of the head is below {_MAX_LYING_ATTITUDE:.0f} deg; to the"
        f" side: more than {_MIN_SWING_ANGLE:.0f} deg of swing"
    )
    return Evaluation(checks, explanation, note)


_FELLER_TIP_OVER = TipOver(mass=25.0e3, tipping_edge=1.6)
"""The mass of 25 t is from the feller-buncher's data sheet; half the track gauge is assumed."""
_DEADBAND_WIDTH = 1.5e-3  # m, Table 6.9
_SOFT_SOIL = "[{kind: plate, position: [6.8, 0.0, 0.3], size: [1.0, 1.0], stiffness: 3.0e+5, damping: 3.0e+4}]"  # noqa: E501


def _compute_tipping_fraction(run: Run, facts: TipOver) -> np.ndarray:
    """Return the moment of the true vertical contact force as a fraction of the moment that tips the machine.

    The result has one value per row of the run's true log, (n,). `facts` holds mass, centre of mass and
    tipping edge of the machine.
    """
    pose, force = compute_cylindrical_pose(run), read_true_channel(run, "truth.contact_force.z")
    pairs = zip(pose["r"], force, strict=True)
    return np.array([tipping_ratio(facts, r, f) for r, f in pairs])


def simulate_pushing_down(seed: int, changes: Changes) -> Sample:
    """Simulate an operator who pushes the feller-buncher's head down with constant hand force.

    Four conditions are simulated: with stiffness feedback (`with`), without force reflection (`without`),
    with stiffness feedback on softer ground (`soil`), and with a stiff hand that keeps its position
    instead of its force (`stiff_hand`). The hand force is that which displaces the handle by 3.5 mm.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        Per condition: largest fraction of the tipping moment (`CONDITION_share`); largest handle
        displacement in the last 5 s (`_handle`), and mean displacement in the half second before contact
        (`_before`) [m].
    """
    cases = {
        "with": {"pilot.reflection": "stiffness"},
        "without": {"pilot.reflection": "none"},
        "soil": {"surroundings": _SOFT_SOIL},
        "stiff_hand": {"pilot.perception.handle_position_gain": "6.0"},
    }
    values, panels = {}, []
    for name, keys in cases.items():
        keys = make_random_operator_settings(seed) | keys | dict(changes)
        _, run = run_shipped_scenario("press_over", keys)
        share, m = _compute_tipping_fraction(run, _FELLER_TIP_OVER), run.measured
        touching = run.truth.time[np.argmax(share > 0.02)] if (share > 0.02).any() else 0.0
        late = m.time > run.scenario.duration - 5.0
        before = (m.time > touching - 0.5) & (m.time < touching)
        values[f"{name}_share"] = float(share.max())
        values[f"{name}_handle"] = float(np.abs(m["handle.z"][late]).max())
        values[f"{name}_before"] = float(np.abs(m["handle.z"][before]).mean())
        if name in ("with", "without"):
            words = f"{name} reflection"
            panels.append(Panel(f"fraction of the tipping moment, {words} [1]", run.truth.time,
                                {"fraction": share}))  # fmt: skip
            panels.append(Panel(f"handle, {words} [mm]", m.time, {"z": 1e3 * m["handle.z"]}))
    return Sample(values, tuple(panels))


def _evaluate_push_back(samples: Sequence[Sample]) -> Evaluation:
    pushed_back = (collect_values(samples, "with_handle") < _DEADBAND_WIDTH) & (
        collect_values(samples, "without_handle") > _DEADBAND_WIDTH
    )
    check = check_fraction("operators whose handle is pushed into the dead band with reflection and stays outside "
                "without", pushed_back)  # fmt: skip
    note = (
        f"a hand with constant force is pushed from {format_values(samples, 'with_before', 1e3)}"
        f" to {format_values(samples, 'with_handle', 1e3)} mm; without reflection it stays at"
        f" {format_values(samples, 'without_handle', 1e3)} mm; a stiff hand is not"
        f" pushed back ({format_values(samples, 'stiff_hand_handle', 1e3)} mm)"
    )
    return Evaluation((check,), "dead band of 1.5 mm, Table 6.9", note)


def _evaluate_tip_over(samples: Sequence[Sample]) -> Evaluation:
    reason = "the machine tips at 1; mass and gauge are not in the thesis"
    checks = tuple(
        check_mean(f"largest moment over the tipping moment, {words}",
                   collect_values(samples, f"{key}_share"), accepted, reason)
        for key, words, accepted in (
            ("with", "with reflection on rock of 2 MN/m", (0.0, 1.0)),
            ("soil", "with reflection on soil of 0.3 MN/m", (0.0, 1.0)),
            ("without", "without reflection on rock", (1.0, np.inf)),
        )
    )  # fmt: skip
    explanation = (
        "the handle returns to its dead band, but the force estimate has a delay of 0.3 s and the"
        " stiffness saturates at the 30 kN of Table 6.10: on hard rock the head continues to move"
    )
    return Evaluation(checks, explanation)


def simulate_tip_over_protection(seed: int, changes: Changes) -> Sample:
    """Simulate an operator who presses with 60 kN, with and without an added spring in the joystick.

    The spring pushes the handle back if the contact force causes more than half of the tipping moment.
    Without the spring, 60 kN tip the excavator.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        With the spring (`spring`) and without it (`bare`): largest fraction of the tipping moment
        (`CONDITION_share`), and largest handle displacement after 10 s (`CONDITION_handle`) [m].
    """
    values, panels = {}, []
    too_large = {"pilot.operator.target.force": "[6.0e+4]"}
    for name, keys in (("spring", {}), ("bare", {"pilot.tip_over": "null"})):
        scenario, run = run_shipped_scenario(
            "tip_over", make_random_operator_settings(seed) | too_large | keys | dict(changes)
        )
        assert isinstance(scenario.pilot, TeleopPilot)
        facts = scenario.pilot.tip_over or TipOver(mass=20.0e3, tipping_edge=1.6)
        share, handle = _compute_tipping_fraction(run, facts), run.measured["handle.z"]
        values[f"{name}_share"] = float(share.max())
        late = run.measured.time > 10.0
        values[f"{name}_handle"] = float(np.abs(handle[late]).max())
        words = "with the spring" if name == "spring" else "without the spring"
        panels.append(Panel(f"fraction of the tipping moment, {words} [1]", run.truth.time,
                            {"fraction": share}))  # fmt: skip
        panels.append(Panel(f"handle, {words} [mm]", run.measured.time, {"z": 1e3 * handle}))
    return Sample(values, tuple(panels))


def _evaluate_protection(samples: Sequence[Sample]) -> Evaluation:
    kept, bare = collect_values(samples, "spring_share"), collect_values(samples, "bare_share")
    check = check_fraction(
        "operators who tip the machine without the spring but not with it",
        (kept < 1.0) & (bare > 1.0), reason="a statement on most operators",
    )  # fmt: skip
    note = (
        f"largest moment over the tipping moment: {format_values(samples, 'spring_share', 1.0, 2)}"
        f" with the spring, {format_values(samples, 'bare_share', 1.0, 2)} without; handle within"
        f" {format_values(samples, 'spring_handle', 1e3)} mm after 10 s"
    )
    explanation = "8 kN/m and 100 N s/m beyond half of the tipping moment; not in the thesis"
    return Evaluation((check,), explanation, note)


TIP_OVER = (
    Experiment("constant hand force", simulate_pushing_down, (
        Claim(
            "tip-over: the stick pushed back",
            '"the most effective way is via force reflection which automatically pushes the'
            ' joystick back into its position deadband"',
            "p. 99",
            "document",
            _evaluate_push_back,
            {"pilot.reflection": "none"},
            "no force reflection in both runs",
        ),
        Claim(
            "tip-over avoided by stiffness feedback alone",
            '"machine tip-over can be avoided by pushing the joystick back to the center under'
            ' computer control"',
            "p. 6",
            "document",
            _evaluate_tip_over,
            {"pilot.reflection": "none"},
            "no force reflection in both runs",
        ),
    ), 6),
    Experiment("added spring", simulate_tip_over_protection, (
        Claim(
            "tip-over: an added spring",
            "an additional spring of 8 kN/m beyond half of the tipping moment prevents an operator"
            " whose target force is too large from tipping the machine",
            "additional to p. 99",
            "additional",
            _evaluate_protection,
            {"pilot.tip_over": "null"},
            "without the spring in both",
        ),
    ), 10),
)  # fmt: skip

FELLING = (
    Experiment("tree", simulate_tree_felling, (
        Claim(
            "a tree felled: contact",
            '"The endpoint force increased rapidly after contact with the tree was made"',
            "p. 105, Fig. 6.55",
            "document",
            _evaluate_contact,
            {"pilot.buttons": "[{start: 0.0, axis: saw, command: 1.0}]"},
            "the saw runs from the start and cuts the stem before contact",
        ),
        Claim(
            "a tree felled: felt stiffness",
            '"Through the change of stiffness of the joystick, the operator could feel this contact'
            ' kinesthetically"',
            "p. 105, Fig. 6.55",
            "document",
            _evaluate_felt_stiffness,
            {"pilot.reflection": "none"},
            "no force reflection",
        ),
        Claim(
            "a tree felled: the process",
            '"the rotating saw started cutting the tree, and the grab arm on the felling-head'
            ' closed and grabbed it. The cut tree was then laid to the side in bunches"',
            "p. 105",
            "document",
            _evaluate_felling_sequence,
            {"pilot.buttons": "[{start: 16.0, axis: saw, command: 1.0}]"},
            "the grab arm never closes",
        ),
    ), 8),
)  # fmt: skip
