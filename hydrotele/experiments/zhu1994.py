"""The machine experiments of Zhu 1994, chapter 6, with simulated operators.

Every row quotes the thesis or says that it is ours. Operators are drawn from the published spread,
one per seed; a claim has to hold for all of them.

Zhu 1994, section 6.3: a tree felled, a machine that could tip, force that is not there.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hydrotele.experiments import zhu_forces, zhu_motion
from hydrotele.experiments.finding import (
    Changes,
    Claim,
    Experiment,
    Finding,
    Panel,
    Progress,
    Sample,
    Verdict,
    cylindrical,
    drawn,
    largest,
    least,
    perform,
    performed,
    spread,
    truth,
)
from hydrotele.run.run import Run
from hydrotele.scenario.teleoperation import TeleopPilot, TipOver
from hydrotele.teleop.master import tipping_share

_JND = 0.23  # of a compliance: what a hand tells apart without other cues; Tan 1995
_RAPIDLY = 1.0  # s, from 10 to 90 % of the first force; Fig. 6.55 shows nine seconds
_HIT = 2.0  # s after the contact
_NEVER = np.inf  # s
_LAID = -50.0  # deg of the head: a stem that lies more than it stands


def tree(seed: int, changes: Changes) -> Sample:
    """Approach, contact, saw, grab and laying down; force and felt stiffness meanwhile.

    The operator aims forty centimetres beyond the stem's axis, so that the head meets the stem.
    """
    keys = {"pilot.operator.points.r": "[6.6, 8.4, 8.4, 8.0, 7.2, 7.2, 7.2]"} | drawn(seed)
    _, run = perform("fell_tree", keys | dict(changes))
    pose, time, m = cylindrical(run), run.truth.time, run.measured
    said = {
        key: next((float(n.rsplit(" ", 2)[-2]) for n in run.summary["notes"] if key in n), _NEVER)
        for key in ("is cut", "holds", "lets")
    }
    contact = np.hypot(truth(run, "truth.contact_force.x"), truth(run, "truth.contact_force.y"))
    touched = float(time[np.argmax(contact > 500.0)]) if (contact > 500.0).any() else _NEVER
    free = (m.time > 0.5) & (m.time < touched - 0.2)
    hit = (m.time >= touched - 0.2) & (m.time < touched + _HIT)
    force = np.abs(m["tip_force.r"])
    values = {
        "touched": touched,
        "cut": said["is cut"],
        "held": said["holds"],
        "let_go": said["lets"],
        "free_force": _high(force[free]),
        "contact_force": _high(force[hit]),
        "rise": _rise(m.time[hit], force[hit]),
    }
    stiff, push = m["handle_stiffness.x"], np.abs(m["handle_force.x"])
    before, after = stiff[free], stiff[hit]
    values["stiffness_free"] = float(np.median(before)) if before.size else np.nan
    ends = (after.min(), after.max()) if after.size else (np.nan, np.nan)
    values["stiffness_contact"] = float(max(ends, key=lambda k: abs(k - values["stiffness_free"])))
    values["centring_contact"] = _high(push[hit])
    laid = (time < min(said["lets"], time[-1])) & (time > said["lets"] - 2.0)
    values["laid"] = float(np.degrees(pose["attitude"][laid][-1])) if laid.any() else np.nan
    values["aside"] = float(np.degrees(pose["theta"][laid][-1])) if laid.any() else np.nan
    values["tripped"] = float(run.summary["teleoperation"]["tripped"])
    return Sample(values, (
        Panel("tip [m]", time, {"r": pose["r"], "z": pose["z"]}),
        Panel("swing and attitude [rad]", time,
              {"theta": pose["theta"], "attitude": pose["attitude"]}),
        Panel("force felt along r [kN]", m.time, {"r": m["tip_force.r"] / 1e3}),
        Panel("stiffness of the joystick along x [N/mm]", m.time, {"x": stiff / 1e3}),
        Panel("centring force along x [N]", m.time, {"x": m["handle_force.x"]}),
    ))  # fmt: skip


def _high(values: np.ndarray) -> float:
    return float(np.percentile(values, 98)) if values.size else np.nan


def _rise(time: np.ndarray, force: np.ndarray) -> float:
    """Time from 10 to 90 % of the first peak [s]."""
    if not force.size:
        return _NEVER
    peak = int(np.argmax(force[: int(3.0 / (time[1] - time[0]))]))
    high = np.flatnonzero(force[: peak + 1] <= 0.1 * force[peak])
    near = np.flatnonzero(force[: peak + 1] >= 0.9 * force[peak])
    start = high[-1] if high.size else 0
    return float(time[near[near >= start][0]] - time[start])


def _contact_verdict(samples: Sequence[Sample]) -> Verdict:
    rise, stands_out = largest(samples, "rise"), np.inf
    for sample in samples:
        v = sample.values
        stands_out = min(stands_out, v["contact_force"] / v["free_force"])
    told = (
        f"{spread(samples, 'contact_force', 1e-3)} kN after the contact against"
        f" {spread(samples, 'free_force', 1e-3)} kN that are felt in the air (98th percentiles);"
        f" from 10 to 90 % in {spread(samples, 'rise', 1.0, 2)} s"
    )
    why = f"rapidly: in less than {_RAPIDLY:g} s and twice as large as in the air, limits of ours"
    return Verdict(bool(rise < _RAPIDLY and stands_out > 2.0), told, why)


def _felt_verdict(samples: Sequence[Sample]) -> Verdict:
    changes = [abs(s.values["stiffness_contact"] / s.values["stiffness_free"] - 1.0)
               for s in samples]  # fmt: skip
    told = (
        f"stiffness along x from {spread(samples, 'stiffness_free', 1e-3)} N/mm in the air to"
        f" {spread(samples, 'stiffness_contact', 1e-3)} in contact (least change"
        f" {100 * min(changes):.0f} %); centring force up to"
        f" {spread(samples, 'centring_contact')} N"
    )
    why = (
        f"felt: a change of more than {100 * _JND:.0f} % (Tan 1995); of Table 6.9's 4 N/mm the"
        f" least is 3, so pulling away a hand feels at most 25 %"
    )
    return Verdict(bool(min(changes) > _JND), told, why)


def _process_verdict(samples: Sequence[Sample]) -> Verdict:
    ok, told = True, []
    for sample in samples:
        v = sample.values
        order = v["cut"] < v["held"] < v["let_go"] < _NEVER
        ok = bool(ok and order and v["laid"] < _LAID and v["aside"] > 30.0 and not v["tripped"])
    first = samples[0].values
    told = [
        f"{words} at {first[key]:.1f} s" if first[key] < _NEVER else f"not {words}"
        for words, key in (("contact", "touched"), ("cut", "cut"), ("held", "held"),
                           ("let go", "let_go"))
    ]  # fmt: skip
    told.append(
        f"laid down at {spread(samples, 'laid', 1.0, 0)} deg,"
        f" {spread(samples, 'aside', 1.0, 0)} deg to the side"
    )
    lain = sum(s.values["laid"] < _LAID for s in samples)
    why = (
        f"the order and the side in {len(samples)} runs, to the side: more than 30 deg of swing;"
        f" laid: the head beyond {_LAID:.0f} deg, a limit of ours, in {lain}"
    )
    if any(s.values["touched"] > s.values["cut"] for s in samples):
        why += "; the head bears on the stem after the cut: the simulated disc stands ahead of it"
    return Verdict(ok, ", ".join(told), why)


_FACTS = TipOver(mass=25.0e3, edge=1.6)
"""Of the feller-buncher: 25 t is its data sheet's; half the gauge of its tracks is assumed."""
_DEADBAND = 1.5e-3  # m
_SOIL = "[{kind: plate, position: [6.8, 0.0, 0.3], size: [1.0, 1.0], stiffness: 3.0e+5, damping: 3.0e+4}]"  # noqa: E501


def _tipping(run: Run, facts: TipOver) -> np.ndarray:
    pose, force = cylindrical(run), truth(run, "truth.contact_force.z")
    pairs = zip(pose["r"], force, strict=True)
    return np.array([tipping_share(facts, r, f) for r, f in pairs])


def pushing(seed: int, changes: Changes) -> Sample:
    """A hand that goes on pushing the feller-buncher's head down, with reflection and without.

    The hand keeps the force that moved the handle to 3.5 mm. Beside it: on softer ground, and a
    hand that keeps the place instead.
    """
    cases = {
        "with": {"pilot.reflection": "stiffness"},
        "without": {"pilot.reflection": "none"},
        "soil": {"surroundings": _SOIL},
        "stubborn": {"pilot.perception.muscle": "6.0"},
    }
    values, panels = {}, []
    for name, keys in cases.items():
        keys = drawn(seed) | keys | dict(changes)
        _, run = perform("press_over", keys)
        share, m = _tipping(run, _FACTS), run.measured
        touching = run.truth.time[np.argmax(share > 0.02)] if (share > 0.02).any() else 0.0
        late = m.time > run.scenario.duration - 5.0
        before = (m.time > touching - 0.5) & (m.time < touching)
        values[f"{name}_share"] = float(share.max())
        values[f"{name}_handle"] = float(np.abs(m["handle.z"][late]).max())
        values[f"{name}_before"] = float(np.abs(m["handle.z"][before]).mean())
        if name in ("with", "without"):
            words = f"{name} reflection"
            panels.append(Panel(f"share of the tipping moment, {words} [1]", run.truth.time,
                                {"share": share}))  # fmt: skip
            panels.append(Panel(f"handle, {words} [mm]", m.time, {"z": 1e3 * m["handle.z"]}))
    return Sample(values, tuple(panels))


def _pushed_verdict(samples: Sequence[Sample]) -> Verdict:
    back, stays = largest(samples, "with_handle"), least(samples, "without_handle")
    told = (
        f"a hand that keeps its force is pushed from {spread(samples, 'with_before', 1e3)} to"
        f" {spread(samples, 'with_handle', 1e3)} mm; without reflection it stays at"
        f" {spread(samples, 'without_handle', 1e3)} mm"
    )
    why = (
        f"dead band of 1.5 mm; a hand that keeps its place is not pushed back"
        f" ({spread(samples, 'stubborn_handle', 1e3)} mm)"
    )
    return Verdict(back < _DEADBAND < stays, told, why)


def _avoided_verdict(samples: Sequence[Sample]) -> Verdict:
    rock, without = largest(samples, "with_share"), least(samples, "without_share")
    soil = largest(samples, "soil_share")
    told = (
        f"largest share of the tipping moment {spread(samples, 'with_share', 1.0, 2)} with"
        f" reflection on rock of 2 MN/m, {spread(samples, 'soil_share', 1.0, 2)} on soil of 0.3"
        f" MN/m, {spread(samples, 'without_share', 1.0, 2)} without reflection on rock"
    )
    why = "it tips at 1, on either ground; mass and gauge are not in the thesis"
    if rock >= 1.0:
        why += (
            "; the handle is back in its dead band, but while the machine's force is felt late by"
            " 0.3 s and K saturates at Table 6.10's 30 kN, the head is driven on into the rock"
        )
    return Verdict(max(rock, soil) < 1.0 < without, told, why)


def protected(seed: int, changes: Changes) -> Sample:
    """An operator who aims at too large a force, with the added spring of ours and without."""
    values, panels = {}, []
    for name, keys in (("protected", {}), ("bare", {"pilot.tip_over": "null"})):
        scenario, run = perform("tip_over", drawn(seed) | keys | dict(changes))
        assert isinstance(scenario.pilot, TeleopPilot)
        facts = scenario.pilot.tip_over or TipOver(mass=20.0e3, edge=1.6)
        share, handle = _tipping(run, facts), run.measured["handle.z"]
        values[f"{name}_share"] = float(share.max())
        late = run.measured.time > 10.0
        values[f"{name}_handle"] = float(np.abs(handle[late]).max())
        panels.append(Panel(f"share of the tipping moment, {name} [1]", run.truth.time,
                            {"share": share}))  # fmt: skip
        panels.append(Panel(f"handle, {name} [mm]", run.measured.time, {"z": 1e3 * handle}))
    return Sample(values, tuple(panels))


def _protected_verdict(samples: Sequence[Sample]) -> Verdict:
    kept, bare = largest(samples, "protected_share"), least(samples, "bare_share")
    place = largest(samples, "protected_handle")
    told = (
        f"largest share of the tipping moment {spread(samples, 'protected_share', 1.0, 2)} with the"
        f" spring, {spread(samples, 'bare_share', 1.0, 2)} without; once in danger the handle"
        f" stays within {1e3 * place:.1f} mm"
    )
    why = "8 kN/m and 100 N s/m beyond half of the tipping moment; the thesis has no such spring"
    if bare <= 1.0:
        why += (
            "; not every operator presses hard enough to tip the machine without it (least share"
            f" {bare:.2f} of 1), so that it is not shown for all"
        )
    return Verdict(kept < 1.0 < bare and place < _DEADBAND, told, why)


FELLING = (
    Experiment("tree", tree, (
        Claim(
            "a tree felled: contact",
            "The endpoint force increased rapidly after contact with the tree was made",
            "p. 105, Fig. 6.55",
            "document",
            _contact_verdict,
            {"surroundings": "[{kind: tree, position: [8.0, 3.0], diameter: 0.34, height: 9.0}]"},
            "the tree three metres aside",
        ),
        Claim(
            "a tree felled: felt stiffness",
            "Through the change of stiffness of the joystick, the operator could feel this contact"
            " kinesthetically",
            "p. 105, Fig. 6.55",
            "document",
            _felt_verdict,
            {"pilot.reflection": "none"},
            "no reflection",
        ),
        Claim(
            "a tree felled: the process",
            "the rotating saw started cutting the tree, and the grab arm on the felling-head closed"
            " and grabbed it. The cut tree was then laid to the side in bunches",
            "p. 105",
            "document",
            _process_verdict,
            {"pilot.buttons": "[{at: 0.0, axis: saw, command: 1.0}]"},
            "the grab arm never closes",
        ),
    ), most=3),
    Experiment("hand that goes on pushing", pushing, (
        Claim(
            "tip-over: the stick pushed back",
            "the most effective way is via force reflection which automatically pushes the"
            " joystick back into its position deadband",
            "p. 99",
            "document",
            _pushed_verdict,
            {"pilot.reflection": "none"},
            "no reflection in both",
        ),
        Claim(
            "tip-over avoided by stiffness feedback alone",
            "machine tip-over can be avoided by pushing the joystick back to the center under"
            " computer control",
            "p. 6",
            "document",
            _avoided_verdict,
            {"pilot.reflection": "none"},
            "no reflection in both",
        ),
    ), most=5),
    Experiment("added spring", protected, (
        Claim(
            "tip-over: an added spring",
            "a further spring of 8 kN/m beyond half of the tipping moment keeps an operator who"
            " aims at too large a force from tipping the machine",
            "beyond p. 99",
            "ours",
            _protected_verdict,
            {"pilot.tip_over": "null"},
            "without the spring in both",
        ),
    ), most=5),
)  # fmt: skip


EXPERIMENTS: tuple[Experiment, ...] = (
    *zhu_motion.EXPERIMENTS,
    *zhu_forces.EXPERIMENTS,
    *FELLING,
    *zhu_forces.FALSE_FORCE,
)


def zhu1994(seeds: int = 20, jobs: int | None = None, progress: Progress | None = None
            ) -> list[Finding]:  # fmt: skip
    """Run all experiments.

    Args:
        seeds: operators of every experiment; long ones take fewer.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        The findings.
    """
    asked = [(one, {}, one.repetitions(seeds)) for one in EXPERIMENTS]
    measured = _measured(asked, jobs, progress)
    return [
        claim.finding(samples)
        for one, samples in zip(EXPERIMENTS, measured, strict=True)
        for claim in one.claims
    ]


def broken_findings(
    names: Sequence[str] = (), jobs: int | None = None, progress: Progress | None = None
) -> list[Finding]:
    """Judge every claim by a run that is deliberately broken, as the claim says.

    Args:
        names: of the claims; all by default.
        jobs: processes; as many as there are cores by default.
        progress: called with what is done and the share that is done.

    Returns:
        Per claim a finding that should not be ok; `explanation` says how it was broken.
    """
    chosen = [(one, claim) for one in EXPERIMENTS for claim in one.claims
              if not names or claim.name in names]  # fmt: skip
    asked = [(one, claim.broken, 1) for one, claim in chosen]
    findings = []
    for (_, claim), samples in zip(chosen, _measured(asked, jobs, progress), strict=True):
        findings.append(claim.finding(samples)._replace(explanation=claim.broken_how))
    return findings


def _measured(
    asked: Sequence[tuple[Experiment, Changes, int]], jobs: int | None, progress: Progress | None
) -> list[list[Sample]]:
    """Samples of every experiment, each with its changes and number of repetitions."""
    tasks: list[tuple[Callable[..., Any], tuple]] = [
        (one.measure, (seed, dict(changes)))
        for one, changes, count in asked
        for seed in range(1, count + 1)
    ]
    names = [one.name for one, _, count in asked for _ in range(count)]
    results = []
    for number, result in enumerate(performed(tasks, jobs)):
        results.append(result)
        if progress:
            progress(names[number], (number + 1) / len(tasks))
    found, begin = [], 0
    for *_, count in asked:
        found.append(results[begin : begin + count])
        begin += count
    return found
