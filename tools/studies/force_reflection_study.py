"""Study force reflection under rate control: stability limits, delays and held forces.

python tools/studies/force_reflection_study.py --seeds 5 --held 12 --jobs 2

`--part held` prints the table of the forces held by feel only.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from hydrotele.cli.analyse_command import analyse_scenario
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from tools.studies.study import options, publish

TARGET = 2.2e4  # N, of parts a to c
SHARE = 0.25  # of the target: half the 5 to 95 % spread of an unstable contact force, last third
LADDER = 0.5 * 1.25 ** np.arange(15)  # times the prediction, up to the first that is unstable
DAMPED = 150.0  # N s/m in the coils: with the hand's 8 the theorem asks for 157
PICTURE_RATIO = 2.0e-4  # of the drawn run of press_direct
PLATE = 0.03  # s, damping over stiffness of every plate
PRESS = {"duration": "30", "pilot.operator.target.time": "[0.0]",
         "pilot.operator.target.force": f"[{TARGET}]"}  # fmt: skip
AXES = ("swing", "boom", "stick", "bucket")
NO_OVERLAP = ", ".join(f"{{name: valve_deadband, location: {axis}, parameters: {{deadband: 0.0}}}}" for axis in AXES)

SETTINGS = {
    "reference: z 0.3 m/s, 1 MN/m, no delay, 1.5 Hz": {},
    "z 0.15 m/s": {"speed": 0.15},
    "z 0.6 m/s": {"speed": 0.6},
    "plate 0.5 MN/m": {"plate": 0.5e6},
    "plate 2 MN/m": {"plate": 2.0e6},
    "delay 50 ms each way": {"delay": 0.05},
    "delay 100 ms each way": {"delay": 0.1},
    "estimate 0.75 Hz": {"bandwidth": 0.75},
    "estimate 3 Hz": {"bandwidth": 3.0},
}


def changes(setting: dict[str, float], bare: bool) -> dict[str, str]:
    """Overrides of a setting; bare: without dead bands, with the same speed per displacement."""
    speed, plate = setting.get("speed", 0.3), setting.get("plate", 1.0e6)
    delay = str(setting.get("delay", 0.0))
    found = {
        **PRESS, "surroundings.0.stiffness": str(plate),
        "surroundings.0.damping": str(PLATE * plate),
        "pilot.coordinates.z.speed": str(speed / 0.7 if bare else speed),  # 5 mm instead of 3.5 mm
        "pilot.channel.delay_forward": delay, "pilot.channel.delay_back": delay,
        "pilot.bandwidth_hz": str(setting.get("bandwidth", 1.5)),
    }  # fmt: skip
    if bare:
        found |= {"pilot.stiffness": "{z: {deadband: 0.0}}", "sensors": "ideal"}
        found |= {"effects": f"[{NO_OVERLAP}]"}
    return found


def contact(name: str, overrides: dict[str, str]):
    """Time [s] and true contact force upwards [N] of a run, with its station."""
    ran = run_scenario(load_scenario(name, overrides))
    log = ran.truth
    force = log.columns.get("truth.contact_force.z", np.zeros(len(log)))
    return log.time, force, ran.station


def swing(name: str, overrides: dict[str, str]) -> float:
    """Half the spread of the contact force in the last third, over the target."""
    force = contact(name, overrides)[1]
    low, high = np.percentile(force[2 * len(force) // 3 :], [5.0, 95.0])
    return 0.5 * float(high - low) / TARGET


def limit(number: int, bare: bool) -> tuple[float, float, float, float]:
    """Predicted ratio, the same with the dead band, its frequency, and the simulated ratio."""
    overrides = changes(list(SETTINGS.values())[number], bare)
    loop = analyse_scenario(load_scenario("press_direct", overrides)).loop

    def unstable(factor: float) -> bool:
        ratio = {"pilot.ratio": str(factor * loop.max_ratio)}
        return swing("press_direct", overrides | ratio) > SHARE

    found = next((f for f in LADDER if unstable(float(f))), np.inf) / np.sqrt(LADDER[1] / LADDER[0])
    return (
        loop.max_ratio,
        loop.max_ratio_with_deadband,
        loop.frequency,
        float(found * loop.max_ratio),
    )


def side(number: int, seed: int) -> tuple[float, float, float]:
    """Direct force and stiffness feedback that reflect as much, swings; and that ratio."""
    overrides = changes(list(SETTINGS.values())[number], False) | {"seed": str(seed)}
    ratio = analyse_scenario(load_scenario("press_stiffness", overrides)).deadband_edge_ratio
    direct = swing("press_direct", overrides | {"pilot.ratio": str(ratio)})
    return direct, swing("press_stiffness", overrides), ratio


def delayed(delay: float, damping: float, seed: int) -> tuple[float, float, float]:
    """Stiffness feedback with a delay: swing of the force, of the handle [m], theorem's margin."""
    overrides = changes({"delay": delay}, False)
    overrides |= {"seed": str(seed), "pilot.stiffness": f"{{z: {{damping: {damping}}}}}"}
    _, force, station = contact("press_stiffness", overrides)
    assert station
    handle = station.log.master("handle")[:, 2]
    last, late = force[2 * len(force) // 3 :], handle[2 * len(handle) // 3 :]
    low, high = np.percentile(last, [5.0, 95.0])
    margin = analyse_scenario(load_scenario("press_stiffness", overrides)).held_spring.stability_theorem_margin
    return 0.5 * float(high - low) / TARGET, float(np.std(late)), margin


def held(seed: int) -> list[float]:
    """Relative mean and RMS error of the force in the last 6 s before each target's end."""
    scenario = load_scenario("press_stiffness", {"seed": str(seed)})
    time, force, _ = contact("press_stiffness", {"seed": str(seed)})
    target = scenario.pilot.operator.target  # pyright: ignore - a regulating operator
    found = []
    for end, goal in zip(target.time[1::2], target.force[1::2], strict=True):
        error = force[(time >= end - 6.0) & (time < end)] / goal - 1.0
        found += [float(error.mean()), float(np.sqrt(np.mean(error**2)))]
    return found


def small(value: float) -> str:
    return f"{1e5 * value:.2f}" if 0.0 < value < np.inf else "-"


def over(simulated: float, predicted: float) -> str:
    return f"{simulated / predicted:.2f}" if np.isfinite(simulated) else "none found"


def limits_table(bare: list, shipped: list) -> list[str]:
    lines = [
        "| setting | predicted | frequency [Hz] | simulated, no dead bands | over predicted |"
        " predicted with dead band | simulated, dead bands | over predicted with dead band |",
        "| --- |" + " ---: |" * 7,
    ]
    for name, one, two in zip(SETTINGS, bare, shipped, strict=True):
        lines.append(
            f"| {name} | {small(one[0])} | {one[2]:.2f} | {small(one[3])} |"
            f" {over(one[3], one[0])} | {small(two[1])} | {small(two[3])} |"
            f" {over(two[3], two[1])} |"
        )
    return lines


def sides_table(found: list, seeds: int) -> list[str]:
    lines = ["| setting | direct: unstable runs | largest swing | stiffness: unstable runs |"
             " largest swing |", "| --- |" + " ---: |" * 4]  # fmt: skip
    for number, name in enumerate(SETTINGS):
        table = np.array(found[number * seeds : (number + 1) * seeds])[:, :2]
        many, most = (table > SHARE).sum(axis=0), table.max(axis=0)
        lines.append(
            f"| {name} | {many[0]} of {seeds} | {100 * most[0]:.0f} % | {many[1]} of {seeds} | {100 * most[1]:.0f} % |"
        )
    return lines


def delays_table(cases: list, found: list, seeds: int) -> list[str]:
    lines = ["| delay each way | damping of the coils | B² - 4 M K_max | unstable runs |"
             " largest swing of the force | RMS swing of the handle |",
             "| ---: |" + " ---: |" * 5]  # fmt: skip
    for first in range(0, len(cases), seeds):
        table, (delay, damping, _) = np.array(found[first : first + seeds]), cases[first]
        lines.append(
            f"| {1e3 * delay:.0f} ms | {damping:g} N s/m | {table[0, 2]:.0f} |"
            f" {(table[:, 0] > SHARE).sum()} of {seeds} | {100 * table[:, 0].max():.0f} % |"
            f" {1e3 * table[:, 1].max():.2f} mm |"
        )
    return lines


def held_table(found: list) -> list[str]:
    table = np.array(found)
    lines = ["| target | mean error, all seeds | largest | RMS error, median | largest |"
             " mean within 10 % | RMS within 10 % |", "| ---: |" + " ---: |" * 6]  # fmt: skip
    for name, mean, rms in (("20 kN", 0, 1), ("35 kN", 2, 3)):
        errors, spread = table[:, mean], table[:, rms]
        lines.append(
            f"| {name} | {100 * errors.mean():+.1f} % | {100 * np.abs(errors).max():.1f} % |"
            f" {100 * np.median(spread):.1f} % | {100 * spread.max():.1f} % |"
            f" {(np.abs(errors) < 0.1).sum()} of {len(table)} |"
            f" {(spread < 0.1).sum()} of {len(table)} |"
        )
    return lines


def draw(bare: list, path: Path) -> None:
    """Limits, predicted and simulated; contact forces of both structures."""
    from hydrotele.show.report_html import figure_to_png, open_report_figure

    with open_report_figure(3.2) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
        table = np.array([(one[0], one[3]) for one in bare])
        table = table[np.isfinite(table[:, 1]) & (table[:, 1] > 0.0)]
        edge = np.array([0.5 * table.min(), 2.0 * table.max()])
        left.plot(edge, edge, color="#8a94a0", lw=1)
        left.plot(table[:, 0], table[:, 1], "o", color="#1769aa", ms=5)
        left.set(xscale="log", yscale="log", xlabel="predicted ratio", ylabel="simulated ratio")
        left.set_title("largest stable reflection")
        ratio = {"pilot.ratio": str(PICTURE_RATIO)}
        for name, more, colour in (("press_direct", ratio, "#e07b00"),
                                   ("press_stiffness", {}, "#1769aa")):  # fmt: skip
            time, force, _ = contact(name, PRESS | more)
            right.plot(time, 1e-3 * force, color=colour, lw=1, label=name)
        right.axhline(1e-3 * TARGET, color="#8a94a0", lw=1, ls=":")
        right.set(xlabel="time [s]", ylabel="contact force [kN]")
        right.legend(loc="upper left", frameon=False)
        path.write_bytes(figure_to_png(figure))


def report(bare, shipped, sides, cases, late, kept, asked: argparse.Namespace) -> str:
    factor = [one[3] / one[0] for one in bare if 0.0 < one[3] < np.inf]
    return "\n".join([
        "Force reflection under rate control becomes unstable above a limit. The linear "
        "prediction of this limit is compared with simulations, and direct force with stiffness "
        "feedback. The CAT 215 presses its bucket on a plate. Ratio: hand force per machine "
        "force, in 1e-5. A run is unstable if the true contact force swings by more than "
        f"{100 * SHARE:.0f} % of the target of {TARGET / 1e3:g} kN. The swing is half the 5 to 95 "
        "% range in the last third of the run.",
        "", "![Limits and contact forces](force_reflection.png)", "",
        "Left: limits of the first table without dead bands, simulated against predicted; the line marks equal values. "
        f"Right: contact force with the target of {TARGET / 1e3:g} kN (dotted), dead bands and the reference setting; "
        f"`press_direct` has the ratio {1e5 * PICTURE_RATIO:g}.",
        "", "## Direct force under rate control: predicted and simulated limit", "",
        "Settings: speed of the tip along z with the handle at its stop, stiffness of the plate, delay of the channel, "
        "bandwidth of the force estimate. The reference is the first row; each other row changes one setting.",
        "", *limits_table(bare, shipped), "",
        "Predicted: `hydrotele analyse teleop`, from the same parameters as the simulation, with "
        "the frequency of the oscillation at the limit. No "
        "dead bands: those of joystick and valves are zero, with ideal sensors and the same "
        "speed per displacement. This is the case that a linear loop describes. Simulated over "
        f"predicted (1 is best): {min(factor):.2f} to {max(factor):.2f}, median "
        f"{np.median(factor):.2f}.",
        "",
        "Dead bands: 1.5 mm at the joystick, overlap of the valves, with the sensors of Khoshzaban 1992, as in "
        "the shipped scenarios. "
        "Both limits are the geometric mean of the last stable and the first unstable ratio. The "
        f"ratios are a ladder with steps of 1.25 from {LADDER[0]:g} to {LADDER[-1]:.0f} times the "
        "linear prediction for the settings of the column. With dead bands this prediction is not listed and a few "
        "per cent smaller than the listed one. Each limit comes from one run per ratio. With dead bands, whether a run "
        "near its limit "
        "becomes unstable also depends on the seed (sensor noise, operator), as the next table shows.",
        "", "## Stiffness feedback with the same reflection", "",
        f"Direct force has the ratio {small(sides[0][2])}. With it, both structures give the same "
        "force in the hand at the edge of the dead band. Both have the dead band and real sensors. Swing: lower is "
        "better.",
        "", *sides_table(sides, asked.seeds), "",
        "## Stiffness feedback with delay", "",
        "Zhu's theorem 4-2 has the sufficient condition B² > 4 M K_max (mass M, damping B, largest stiffness K_max of "
        "joystick and hand). B is the damping of the coils plus 8 N s/m of the hand. The published damping of the "
        f"coils, 60 N s/m, does not meet it; {DAMPED:g} N s/m are chosen to meet it. The published gains are stable "
        "by the "
        "[bound on the worst switching](stability.md) between the stiffnesses, with which every change of "
        "stiffness decays. The handle swings because the operator corrects the force by short "
        "pushes.",
        "", *delays_table(cases, late, asked.seeds), "",
        f"## A force held by feel, `press_stiffness`, {asked.held} seeds", "",
        f"`python tools/studies/force_reflection_study.py --part held --held {asked.held}`", "",
        "True contact force against the target in the last 6 s before the end of each target. "
        "Error: lower is better; negative: too little force. The operator knows the nominal "
        "stiffness and the gain of the stiffness feedback. He feels the stiffness with the error "
        "of a human hand. [Experiments of Zhu](zhu1994.md) give the result over a population of "
        "operators.",
        "", *held_table(kept), "", "## Limits", "",
        "- A loop with a dead band always rests inside it. Its limit is the one above which an "
        "existing swing persists.",
        "- The prediction with dead band is conservative. It assumes a centred swing from stop "
        "to stop; pushes off the centre, valve overlap and stops stabilise the loop.",
        "- The theorem's condition is sufficient, not necessary.",
        "- A force held by feel misses the target by more than 10 % in many runs.",
        "",
    ])  # fmt: skip


def main() -> None:
    asked = options(__doc__, seeds=5, held=12, jobs=2, part="all")
    if asked.part == "held":
        with ProcessPoolExecutor(asked.jobs) as pool:
            print("\n".join(held_table(list(pool.map(held, range(asked.held))))))
        return
    many, seeds = range(len(SETTINGS)), range(asked.seeds)
    cases = [
        (t, b, s) for b in (DAMPED, 60.0) for t in (0.0, 0.05, 0.1, 0.15) for s in seeds
    ]  # fmt: skip
    with ProcessPoolExecutor(asked.jobs) as pool:
        bare = list(pool.map(limit, many, [True] * len(many)))
        shipped = list(pool.map(limit, many, [False] * len(many)))
        pairs = [(n, s) for n in many for s in seeds]
        sides = list(pool.map(side, *zip(*pairs, strict=True)))
        late = list(pool.map(delayed, *zip(*cases, strict=True)))
        kept = list(pool.map(held, range(asked.held)))
    if asked.out:
        draw(bare, asked.out.with_suffix(".png"))
    text = report(bare, shipped, sides, cases, late, kept, asked)
    publish(text, "Force reflection under rate control", asked)


if __name__ == "__main__":
    main()
