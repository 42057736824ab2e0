"""The machine experiments of Zhu 1994, chapter 6, with a simulated operator.

Zhu's experiments with whole tasks: a tree is felled, a machine does not tip over.

Zhu's experiments on contact force: held by feel, reflected directly, tracked on a screen.

Zhu's experiments on motion: straight lines, rate against position control, step responses.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hydrotele.control.endpoint_force import endpoint_force_of_log
from hydrotele.experiments.finding import (
    Finding,
    Panel,
    Progress,
    cylindrical,
    perform,
    performed,
    truth,
)
from hydrotele.run.run import Run
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import Regulate, TeleopPilot, Track
from hydrotele.teleop.master import tipping_share


def tree() -> Finding:
    """Approach, contact, saw, grab and lay down."""
    _, run = perform("fell_tree")
    said = {key: next((float(n.rsplit(" ", 2)[-2]) for n in run.summary["notes"] if key in n), None)
            for key in ("is cut", "holds", "lets")}  # fmt: skip
    times = [said[key] for key in ("is cut", "holds", "lets")]
    pose, time = cylindrical(run), run.truth.time
    laid = float(np.degrees(pose["attitude"][time < 69.0][-1]))
    done = all(t is not None for t in times) and times == sorted(times)  # pyright: ignore
    words = [f"{w} at {t:.1f} s" if t is not None else f"not {w}"
             for w, t in zip(("cut", "held", "let go"), times, strict=True)]  # fmt: skip
    return Finding(
        "a tree felled",
        "Fig. 6.55",
        "approach, contact, the saw cuts, the grab arm closes and holds, the tree is laid down",
        f"{', '.join(words)}; laid down with the head at {laid:.0f} deg; largest force at the tip"
        f" {run.summary['teleoperation']['largest_tip_force_N'] / 1e3:.1f} kN",
        bool(done and laid < -50.0 and not run.summary["teleoperation"]["tripped"]),
        (
            Panel("tip [m]", time, {"r": pose["r"], "z": pose["z"]}),
            Panel("swing and attitude [rad]", time,
                  {"theta": pose["theta"], "attitude": pose["attitude"]}),
            Panel("saw [rad/s] and grab [deg]", time,
                  {"saw": truth(run, "truth.velocity.saw"),
                   "grab": np.degrees(truth(run, "angle.grab"))}),
            Panel("force felt at the tip [kN]", time,
                  {"z": run.measured["tip_force.z"] / 1e3, "r": run.measured["tip_force.r"] / 1e3}),
        ),
    )  # fmt: skip


def tip_over() -> Finding:
    """An operator who presses too hard, with and without protection."""
    shares, panels = {}, []
    facts = None
    for name, changes in (("protected", {}), ("bare", {"pilot.tip_over": "null"})):
        scenario, run = perform("tip_over", changes)
        assert isinstance(scenario.pilot, TeleopPilot)
        facts = facts or scenario.pilot.tip_over
        assert facts is not None
        pose, time = cylindrical(run), run.truth.time
        force = truth(run, "truth.contact_force.z")
        share = np.array(
            [tipping_share(facts, r, f) for r, f in zip(pose["r"], force, strict=True)]
        )
        handle = run.measured["handle.z"]
        late = time > 10.0
        shares[name] = float(share.max()), float(np.abs(handle[late]).max())
        panels.append(Panel(f"share of the tipping moment, {name} [1]", time, {"share": share}))
        panels.append(Panel(f"handle, {name} [mm]", time, {"z": 1e3 * handle}))
    kept, bare = shares["protected"], shares["bare"]
    return Finding(
        "tip-over protection",
        "chapter 6",
        "the reflected force pushes the stick back into the dead band before the machine tips",
        f"largest share of the tipping moment {kept[0]:.2f} with protection, {bare[0]:.2f}"
        f" without; once in danger the handle stays within {1e3 * kept[1]:.1f} mm of a dead band"
        " of 1.5 mm",
        kept[0] < 1.0 < bare[0] and kept[1] < 1.5e-3,
        tuple(panels),
    )


_WITHIN = 0.1  # of the target
_HELD = 6.0  # s before the end of a target in which it should be held
_STEADY = 0.15  # share of its mean that a held force may ripple by
_BOUNCING = 0.5  # share by which an unstable one does
_LIMITED = "4.0e-5"  # N/N: 2 N at the hand for 50 kN
_BETTER = 3.0  # times smaller with reflection


def target_of(scenario: Scenario) -> Regulate | Track:
    """The operator's task, with its target."""
    assert isinstance(scenario.pilot, TeleopPilot)
    behaviour = scenario.pilot.operator
    assert isinstance(behaviour, Regulate | Track)
    return behaviour


def hold_by_feel(seed: int | None = None) -> Finding:
    """20 kN, then 35 kN, held by what the joystick's stiffness tells."""
    scenario, run = perform("press_stiffness", {"seed": str(seed)} if seed is not None else {})
    time, force = run.truth.time, truth(run, "truth.contact_force.z")
    facts = target_of(scenario).target
    edges = [*facts.time[2::2], scenario.duration]
    said, ok = [], True
    for goal, edge in zip(facts.force[::2], edges, strict=False):
        late = (time > edge - _HELD) & (time <= edge - 0.05)
        mean = float(force[late].mean())
        ok = ok and abs(mean / goal - 1.0) < _WITHIN
        said.append(f"{mean / 1e3:.1f} kN for {goal / 1e3:.0f}")
    handle, hand = run.measured["handle.z"], run.measured["hand_force.z"]
    away = np.abs(handle) > 5e-4
    share = hand[away] / (handle[away] * run.measured["handle_stiffness.z"][away])
    proportional = float(np.median(share))
    return Finding(
        "stiffness feedback: a force held by feel",
        "Fig. 6.49",
        "the hand's force is proportional to the handle's displacement, and forces of 20 to 35 kN"
        " are reached as wanted",
        f"{', '.join(said)} (mean of the last {_HELD:g} s); hand force over stiffness times"
        f" displacement: {proportional:.2f} in the median",
        ok and abs(proportional - 1.0) < _WITHIN,
        _panels(scenario, run),
    )


def direct_force() -> tuple[Finding, Finding]:
    """The reflected force on the hand itself: held if it is small, unstable at the usual size."""
    found = []
    for ratio in (_LIMITED, None):
        scenario, run = perform("press_direct", {"pilot.ratio": ratio} if ratio else {})
        assert isinstance(scenario.pilot, TeleopPilot)
        time, force = run.truth.time, truth(run, "truth.contact_force.z")
        late = time > 0.6 * scenario.duration
        ripple = float(force[late].std() / max(force[late].mean(), 1.0))
        handle = run.measured["handle.z"][late]
        hand = float(run.measured["hand_force.z"][late].mean())
        at_most = scenario.pilot.ratio * 5e4
        found.append((run, scenario, ripple, handle, hand, at_most, float(force[late].mean())))
    run, scenario, ripple, handle, hand, at_most, mean = found[0]
    small = Finding(
        "direct force feedback: severely limited",
        "Fig. 6.50",
        "a hand force of -4.5 N holds against the reflected force with almost no displacement; it"
        " is stable only while the reflected force is severely limited",
        f"at {at_most:.0f} N for 50 kN: {hand:.1f} N hold against {mean / 1e3:.1f} kN,"
        f" {1e3 * abs(handle.mean()):.1f} mm from the centre, ripple {100 * ripple:.0f} %",
        ripple < _STEADY and np.abs(handle).max() < 1.5e-3 and mean > 5e3,
        _panels(scenario, run),
    )
    run, scenario, ripple, handle, hand, at_most, mean = found[1]
    large = Finding(
        "direct force feedback: not limited",
        "section 6.2",
        "direct force feedback under rate control is unstable",
        f"at {at_most:.0f} N for 50 kN the machine bounces: ripple {100 * ripple:.0f} % of the"
        f" mean, handle from {1e3 * handle.min():.1f} to {1e3 * handle.max():.1f} mm",
        ripple > _BOUNCING,
        _panels(scenario, run),
    )
    return small, large


def tracking_error(reflection: str, seed: int) -> tuple[float, tuple[Panel, ...]]:
    """RMS error [N] of a tracked force once it is touched, and the curves."""
    scenario, run = perform("track_force", {"pilot.reflection": reflection, "seed": str(seed)})
    time, force = run.truth.time, truth(run, "truth.contact_force.z")
    facts = target_of(scenario).target
    error = force - np.interp(time, facts.time, facts.force)
    late = time > 10.0  # until then the bucket is on its way
    return float(np.sqrt(np.mean(error[late] ** 2))), _panels(scenario, run)


def tracking(
    with_it: Sequence[tuple[float, tuple[Panel, ...]]],
    without: Sequence[tuple[float, tuple[Panel, ...]]],
) -> Finding:
    """A displayed force tracked with and without reflection, by many operators.

    Args:
        with_it: of `tracking_error("stiffness", seed)`, one per seed.
        without: the same for `none`.
    """
    felt, blind = np.array([e for e, _ in with_it]), np.array([e for e, _ in without])
    times = blind.mean() / felt.mean()
    panels = [p._replace(title=f"with reflection: {p.title}") for p in with_it[0][1]]
    panels += [p._replace(title=f"without: {p.title}") for p in without[0][1]]
    return Finding(
        "force tracking with and without reflection",
        "Figs 6.53, 6.54",
        "without force reflection the operator cannot track a desired force; with it he can",
        f"RMS error over {len(felt)} operators: {felt.mean() / 1e3:.1f} kN"
        f" ({felt.min() / 1e3:.1f} to {felt.max() / 1e3:.1f}) with reflection,"
        f" {blind.mean() / 1e3:.1f} kN ({blind.min() / 1e3:.1f} to {blind.max() / 1e3:.1f})"
        f" without: {times:.1f} times",
        times > _BETTER,
        tuple(panels),
    )


def _panels(scenario: Scenario, run: Run) -> tuple[Panel, ...]:
    time, facts = run.truth.time, target_of(scenario).target
    target = np.interp(time, facts.time, facts.force) / 1e3
    force = truth(run, "truth.contact_force.z") / 1e3
    felt = run.measured["tip_force.z"] / 1e3
    return (
        Panel("contact force [kN]", time, {"target": target, "true": force, "estimated": felt}),
        Panel("handle [mm]", time, {"z": 1e3 * run.measured["handle.z"]}),
        Panel("hand force [N]", time, {"z": run.measured["hand_force.z"]}),
    )


_STRAY = 0.03  # m, of lines of 1.4 m: what the published plots leave open
_TURN = 5.0  # degrees, of the bucket, the same
_CALM = 3.0  # times as restless as under rate control counts as oscillating
_SETTLED = 0.01  # m: smooth
_CROSS = 0.1  # of a step, that another coordinate may move along
_FALSE = 0.2  # of the static model's false force


def line(way: str) -> Finding:
    """A straight line of the tip under operator control: up, down, out or in."""
    axis, sign, held, start = {
        "up": ("z", 1, ("r",), {"z": "0.8"}), "down": ("z", -1, ("r",), {"z": "2.2"}),
        "out": ("x", 1, ("z",), {"r": "4.8", "z": "1.2"}),
        "in": ("x", -1, ("z",), {"r": "6.2", "z": "1.2"}),
    }[way]  # fmt: skip
    push = 0.004 * sign
    changes = {f"start.pose.{k}": v for k, v in start.items()}
    changes["pilot.operator.path"] = f"{{{axis}: [0, 0, {push}, {push}, 0, 0]}}"
    _, run = perform("joystick_up", changes)
    pose, time = cylindrical(run), run.truth.time
    moved = "z" if axis == "z" else "r"
    gone = pose[moved][-1] - pose[moved][0]
    stray = max(np.abs(pose[c] - pose[c][0]).max() for c in held)
    aside = float((pose["r"] * np.abs(pose["theta"] - pose["theta"][0])).max())
    turned = float(np.degrees(np.abs(pose["attitude"] - pose["attitude"][0]).max()))
    figure = {"up": 45, "down": 46, "out": 47, "in": 48}[way]
    return Finding(
        f"straight line {way}",
        f"Fig. 6.{figure}",
        "the other coordinates and the bucket's angle stay constant",
        f"{gone:+.2f} m; the other coordinate strays by {1e3 * stray:.0f} mm, sideways by"
        f" {1e3 * aside:.0f} mm, the bucket by {turned:.1f} deg",
        sign * gone > 1.0 and stray < _STRAY and aside < _STRAY and turned < _TURN,
        (
            Panel("tip [m]", time, {"r": pose["r"], "z": pose["z"]}),
            Panel("bucket [deg]", time, {"attitude": np.degrees(pose["attitude"])}),
            Panel("handle [mm]", time, {axis: 1e3 * run.measured[f"handle.{axis}"]}),
        ),
    )


def rate_against_position() -> Finding:
    """The same places reached by sight, under rate and under position control."""
    restless, panels = {}, []
    for mode in ("rate", "position"):
        _, run = perform("steer", {"pilot.mode": mode})
        pose, time = cylindrical(run), run.truth.time
        late = ((time > 7) & (time < 11)) | ((time > 16) & (time < 20)) | (time > 25)
        speed = [np.gradient(pose[c], time)[late] for c in ("r", "z")]
        restless[mode] = float(np.sqrt(np.mean(np.square(speed))))
        panels.append(Panel(f"tip under {mode} control [m]", time, {c: pose[c] for c in "rz"}))
        handle = {c: 1e3 * run.measured[f"handle.{c}"] for c in "xz"}
        panels.append(Panel(f"handle under {mode} control [mm]", time, handle))
    times = restless["position"] / restless["rate"]
    return Finding(
        "rate against position control",
        "Fig. 6.52, section 6.3.3",
        "position control of a slow machine by a fast joystick oscillates, rate control is smooth",
        f"RMS speed where the tip should rest: {1e3 * restless['rate']:.0f} mm/s under rate,"
        f" {1e3 * restless['position']:.0f} mm/s under position control ({times:.1f} times)",
        times > _CALM,
        tuple(panels),
    )


def feller_steps() -> tuple[Finding, Finding]:
    """Step responses of the feller-buncher, and the force that is felt falsely meanwhile."""
    _, run = perform("feller_steps")
    time, m = run.measured.time, run.measured
    begins = dict(zip(("r", "theta", "z", "attitude", "head"), (1.0, 6.0, 11.0, 16.0, 21.0),
                      strict=True))  # fmt: skip
    worst, smallest = 0.0, np.inf
    for name, begin in begins.items():
        inside = (time >= begin) & (time < begin + 4.9)
        for other in begins:
            change = np.ptp(m[f"tip_reference.{other}"][inside])
            if other == name:
                smallest = min(smallest, change)
            else:
                scale = np.ptp(m[f"tip_reference.{other}"])
                stray = np.abs(m[f"tip_pose.{other}"] - m[f"tip_reference.{other}"])[inside].max()
                worst = max(worst, float(stray / scale))
    panels = [
        Panel(f"{name} [{'m' if name in 'rz' else 'rad'}]", time,
              {"asked": m[f"tip_reference.{name}"], "measured": m[f"tip_pose.{name}"]})
        for name in begins
    ]  # fmt: skip
    steps = Finding(
        "feller-buncher: steps of all five coordinates",
        "Figs 6.56-6.58",
        "every joint follows its step under resolved rate control, with ringing pressures",
        f"every coordinate goes by at least {smallest:.2f} (m or rad); the others stray by at most"
        f" {100 * worst:.0f} % of their own step",
        smallest > 0.1 and worst < _CROSS,
        tuple(panels),
    )
    return steps, _false_force(run)


def _false_force(run) -> Finding:
    machine, time = run.plant.machine, run.measured.time
    moving = time > 1.0
    size, panels = {}, []
    pressure = {n: run.measured[f"pressure_head.{n}"] / 1e6 for n in ("boom", "stick", "tilt")}
    panels.append(Panel("head-side pressures [MPa]", time, pressure))
    felt = {}
    for kind in ("static", "dynamic"):
        sensors = machine.sensors.get(run.scenario.sensors)
        force = endpoint_force_of_log(machine, run.measured, kind, sensors=sensors)
        vertical, radial = force["z"][moving], force["r"][moving]
        size[kind] = float(np.sqrt(np.mean(vertical**2 + radial**2)))
        felt[kind] = force["z"] / 1e3
    panels.append(Panel("vertical force that is felt in the air [kN]", time, felt))
    share = size["dynamic"] / size["static"]
    return Finding(
        "feller-buncher: false force in free motion",
        "Figs 6.56-6.58",
        "a static model gives a large false force in free motion because pressures oscillate",
        f"RMS {size['static'] / 1e3:.2f} kN with the static model, {size['dynamic'] / 1e3:.2f} kN"
        f" with the dynamic one ({100 * share:.0f} %)",
        size["static"] > 500.0 and share < _FALSE,
        tuple(panels),
    )


def zhu1994(seeds: int = 20, jobs: int | None = None, progress: Progress | None = None
            ) -> list[Finding]:  # fmt: skip
    """Run all experiments.

    Args:
        seeds: operators that track a force, with and without reflection.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        The findings, in the order of the thesis.
    """
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        *((line, (way,)) for way in ("up", "down", "out", "in")),
        (hold_by_feel, ()),
        (direct_force, ()),
        (rate_against_position, ()),
        (tree, ()),
        (feller_steps, ()),
        (tip_over, ()),
    ]
    single = len(tasks)
    for reflection in ("stiffness", "none"):
        tasks += [(tracking_error, (reflection, seed)) for seed in range(1, seeds + 1)]
    results: list[Any] = []
    for number, result in enumerate(performed(tasks, jobs)):
        results.append(result)
        if progress:
            progress(_said(tasks[number]), (number + 1) / len(tasks))
    findings: list[Finding] = []
    for result in results[:single]:
        findings += [result] if isinstance(result, Finding) else list(result)
    tracked = results[single:]
    findings.insert(7, tracking(tracked[:seeds], tracked[seeds:]))
    return findings


def _said(task) -> str:
    function, arguments = task
    return " ".join([function.__name__.replace("_", " "), *map(str, arguments)])
