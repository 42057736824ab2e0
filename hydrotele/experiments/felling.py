"""Zhu's experiments with whole tasks: a tree is felled, a machine does not tip over."""

import numpy as np

from hydrotele.experiments.finding import Finding, Panel, cylindrical, perform, truth
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.teleop.tip_over import tipping_share


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
