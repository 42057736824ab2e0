"""Zhu's experiments on contact force: held by feel, reflected directly, tracked on a screen."""

from collections.abc import Sequence

import numpy as np

from hydrotele.experiments.finding import Finding, Panel, perform, truth
from hydrotele.run.run import Run
from hydrotele.scenario.scenario import Scenario
from hydrotele.scenario.teleoperation import Regulate, TeleopPilot, Track

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
