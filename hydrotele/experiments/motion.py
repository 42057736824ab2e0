"""Zhu's experiments on motion: straight lines, rate against position control, step responses."""

import numpy as np

from hydrotele.control.endpoint_force import endpoint_force_of_log
from hydrotele.experiments.finding import Finding, Panel, cylindrical, perform

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
