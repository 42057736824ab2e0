"""Compare predicted with simulated stability of sampled teleoperators with jitter.

python tools/studies/stability_study.py --trials 400 --seed 0 --jobs 2
"""

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hydrotele.machine.joystick import load_joystick
from hydrotele.teleop.case_file import TeleoperatorAxis, load_teleop_case
from hydrotele.teleop.robustness import case_impedance_ranges, evaluate_robustness
from hydrotele.teleop.sampled_simulation import simulate_initial_velocities
from hydrotele.teleop.sampled_stability import (
    SAMPLED_STRUCTURES,
    PacketAges,
    constant_delay_ages,
    measured_delay_ages,
    predict_stability,
)
from hydrotele.teleop.stiffness_switching import StiffnessAxis
from hydrotele.teleop.two_port import STRUCTURES, Impedance, StructureGains
from tools.studies.study import options, publish, side_by_side

SPREAD = 0.5  # decades by which every parameter of the shipped case is varied, up and down
PERIODS = (1e-3, 5e-2)  # s, of both sides' sampling
DELAYS = (1e-3, 0.2)  # s, mean each way, of each its own
JITTER = 0.5  # largest standard deviation of the delays over their mean
LOST = 0.05  # largest fraction of lost packets
FACTORS = (-1.5, 1.0)  # decades of the factor on the returned signal
SECONDS, TRIPS = 60.0, 100  # of a run, the longer of both
REACH, ASIDE = (0.03, 30.0), 0.4  # factors searched for a limit; e-folds aimed beside it
NEAR = 0.1  # relative distance to the predicted limit within which a case is close to it


def drawn_case(rng: np.random.Generator) -> tuple[TeleoperatorAxis, float, float]:
    """A case, its period and the factor on the returned signal."""
    shipped = load_teleop_case().to_axis()

    def drawn(value: float) -> float:
        return value * 10.0 ** rng.uniform(-SPREAD, SPREAD)

    def side(z: Impedance) -> Impedance:
        return Impedance(drawn(z.mass), drawn(z.damping), drawn(z.stiffness))

    names = ("master", "slave", "master_control", "slave_control", "hand", "task")
    sides = {name: side(getattr(shipped, name)) for name in names}
    if rng.random() < 0.5:
        sides["hand"] = Impedance()
    if rng.random() < 0.3:
        sides["task"] = Impedance()
    gains = StructureGains(drawn(1.0), drawn(1.0), drawn(1.0))
    case = replace(shipped, **sides, gains=gains, wave=drawn(sides["slave_control"].damping))
    period = float(np.exp(rng.uniform(*np.log(PERIODS))))
    return case, period, float(10.0 ** rng.uniform(*FACTORS))


def drawn_delays(rng: np.random.Generator, count: int, period: float) -> np.ndarray:
    """Delays of packets: a least one, and a gamma-distributed rest; some are lost."""
    mean = float(np.exp(rng.uniform(*np.log(DELAYS))))
    spread = rng.uniform(0.0, JITTER) * mean
    rest = rng.uniform(spread / mean, 1.0) * mean
    shape = (rest / max(spread, 1e-9)) ** 2
    delays = mean - rest + rng.gamma(shape, rest / shape, count)
    delays[rng.random(count) < rng.uniform(0.0, LOST)] = np.nan
    return delays


def scaled(case: TeleoperatorAxis, factor: float, linear: bool) -> tuple[TeleoperatorAxis, float]:
    """Case and factor on the returned signal; without such a factor, scaled slave gains."""
    if linear:
        return case, factor
    z = case.slave_control
    firm = Impedance(0.0, factor * z.damping, factor * z.stiffness)
    return replace(case, slave_control=firm, wave=factor * case.wave), 1.0


def limit(case: TeleoperatorAxis, name: str, line: PacketAges, linear: bool) -> float | None:
    """Smallest factor at which the prediction changes."""

    def holds(factor: float) -> bool:
        one, back = scaled(case, factor, linear)
        return predict_stability(one, name, line, back).is_stable

    points = np.geomspace(*REACH, 13)
    told = [holds(float(p)) for p in points]
    change = [k for k in range(12) if told[k] != told[k + 1]]
    if not change:
        return None
    least, most = float(points[change[0]]), float(points[change[0] + 1])
    first = told[change[0]]
    for _ in range(8):
        middle = (least * most) ** 0.5
        least, most = (middle, most) if holds(middle) == first else (least, middle)
    return (least * most) ** 0.5


class Row(NamedTuple):
    """One case of one structure."""

    held: bool
    touching: bool
    told: bool
    seen: bool
    near: bool
    reason: str
    dies_out: bool


def trial(seed: int, number: int) -> list[Row]:
    """One random case for every structure; every second one aimed at the limit."""
    rng = np.random.default_rng([seed, number])
    case, period, factor = drawn_case(rng)
    aside = float(np.exp(rng.uniform(-ASIDE, ASIDE)))
    count = round(max(SECONDS, TRIPS * 2.0 * DELAYS[1]) / period)
    there, back = (drawn_delays(rng, 2 * count, period) for _ in range(2))
    # the prediction uses the first half of the packets, the simulation the second half
    line = measured_delay_ages(period, there[:count], back[:count])
    rows = []
    for name in SAMPLED_STRUCTURES:
        linear = name in STRUCTURES
        k = factor if linear else 1.0
        if number % 2:
            found = limit(case, name, line, linear)
            k = k if found is None else aside * found
        told = predict_stability(*scaled_for(case, name, line, k, linear))
        one, back_factor = scaled(case, k, linear)
        motion = simulate_initial_velocities(one, name, period, there[count:], back[count:], back_factor)
        sides = [predict_stability(*scaled_for(case, name, line, m * k, linear)).is_stable
                 for m in (1.0 - NEAR, 1.0 + NEAR)]  # fmt: skip
        held, touching = bool(case.hand.mass), bool(case.task.stiffness)
        rows.append(Row(held, touching, told.is_stable, not motion.is_growing, sides[0] != sides[1],
                        told.reason, motion.has_decayed))  # fmt: skip
    return rows


def scaled_for(case: TeleoperatorAxis, name: str, line: PacketAges, factor: float, linear: bool) -> tuple:
    """Arguments of `predict_stability`."""
    one, back = scaled(case, factor, linear)
    return one, name, line, back


def share(rows: list[Row]) -> str:
    """Correct predictions out of all, in words."""
    right = sum(r.told == r.seen for r in rows)
    return f"{right} of {len(rows)} ({100.0 * right / len(rows):.1f} %)" if rows else "-"


def table(found: list[list[Row]]) -> list[str]:
    lines = ["| structure | correct | handle held | handle released | stable | close to the limit |"
             " correct, close to the limit | correct, others |",
             "| --- |" + " ---: |" * 7]  # fmt: skip
    for name, rows in zip(SAMPLED_STRUCTURES, zip(*found, strict=True), strict=True):
        near = [r for r in rows if r.near]
        lines.append(
            f"| `{name}` | {share(rows)} | {share([r for r in rows if r.held])} |"
            f" {share([r for r in rows if not r.held])} |"
            f" {100 * sum(r.seen for r in rows) / len(rows):.0f} % |"
            f" {100 * len(near) / len(rows):.0f} % | {share(near)} |"
            f" {share([r for r in rows if not r.near])} |"
        )
    every = [r for rows in found for r in rows]
    lines.append(f"| all | {share(every)} | {share([r for r in every if r.held])} |"
                 f" {share([r for r in every if not r.held])} |"
                 f" {100 * sum(r.seen for r in every) / len(every):.0f} % |"
                 f" {100 * sum(r.near for r in every) / len(every):.0f} % |"
                 f" {share([r for r in every if r.near])} |"
                 f" {share([r for r in every if not r.near])} |")  # fmt: skip
    return lines


def robust_table(period: float = 0.005, pairs: int = 100) -> list[str]:
    """Robustness of the shipped case."""
    facts = load_teleop_case()
    case, spread = facts.to_axis(), case_impedance_ranges(facts)
    line = constant_delay_ages(period, case.delay_forward, case.delay_back)
    lines = ["| structure | handle held: with task, free motion |"
             " released: with task, free motion | master alone, released |"
             " stable operators | same tasks, released | Llewellyn | Z-width [decades] |",
             "| --- |" + " ---: |" * 7]  # fmt: skip
    for name in SAMPLED_STRUCTURES:
        one = evaluate_robustness(case, name, line, spread, pairs)
        told = ["stable" if p.is_stable else "unstable" for p in one.sampled]
        alone = f"{one.released_polynomial.unstable_zeros} unstable poles" if one.released_polynomial else "-"
        worst = one.sampled_pairs
        lines.append(
            f"| `{name}` | {told[0]}, {told[1]} | {told[2]}, {told[3]} | {alone} |"
            f" {pairs - worst.unstable_count} of {pairs} | {pairs - worst.unstable_released_count} of {pairs} |"
            f" {'-' if np.isnan(one.llewellyn) else f'{one.llewellyn:.3g}'} |"
            f" {f'{one.z_width_result.mean_width_decades:.2f}' if one.z_width_result else '-'} |"
        )
    return lines


def spring_table() -> list[str]:
    """Stiffness feedback with the published gains, along x, y and z."""
    stick = load_joystick()
    lines = ["| gains | axis | handle | B [N s/m] | M [kg] | K_min [N/m] | K_max [N/m] |"
             " B^2 - 4 M K_max | B required by the theorem | worst growth per half swing |"
             " B at growth 1 | stable by |",
             "| --- | --- | --- |" + " ---: |" * 8 + " --- |"]  # fmt: skip
    hand = stick.hand
    for gains in stick.gains:
        for axis in ("x", "y", "z"):
            row = stick.gains[gains][axis]
            free = StiffnessAxis(
                stick.flotor.mass, row.damping, row.nominal_stiffness, row.min_stiffness, row.max_stiffness
            )
            held = free.with_hand(Impedance(hand.mass, hand.damping, hand.stiffness))
            for name, one in (("held", held), ("released", free)):
                lines.append(
                    f"| {gains} | {axis} | {name} | {one.damping:g} | {one.mass:g} |"
                    f" {one.min_stiffness:g} | {one.max_stiffness:g}"
                    f" | {one.stability_theorem_margin:.0f} | {one.stability_theorem_damping:.0f}"
                    f" | {one.half_swing_growth:.2f} | {one.min_stable_damping:.0f} | {one.stability_criterion} |"
                )
    return lines


def main() -> None:
    asked = options(__doc__, trials=400, seed=0, jobs=2)
    found = side_by_side(trial, asked)
    plain, aimed = found[::2], found[1::2]
    wrong = Counter(
        (name, row.reason, "stable" if row.told else "unstable")
        for rows in found for name, row in zip(SAMPLED_STRUCTURES, rows, strict=True)
        if row.told != row.seen
    )  # fmt: skip
    guarded = [rows[-1] for rows in found if rows[-1].seen]
    decayed = sum(r.dies_out for r in guarded)
    shipped = "`hydrotele/teleop/cat215_axis.yaml`"
    every = [row for rows in found for row in rows]
    text = "\n".join([
        "This page tests the stability prediction of `hydrotele analyse teleop --robust` for a "
        "teleoperator that is sampled and connected by a network. It is for readers who want to "
        f"rely on that prediction. Prediction and simulation agree in {share(every)} random "
        "cases. Most wrong predictions concern `passivity_control` and `wave_variables`, or "
        "cases close to the stability limit.",
        "",
        f"Each case is simulated from a kick, that is an initial velocity, for {SECONDS:g} s or "
        "more. The simulation transmits every packet with its own random delay and uses the "
        "nonlinear laws of wave variables and passivity control. The prediction uses delays of "
        "other packets of the same network, not those of the simulated packets.",
        "",
        "Random cases:",
        "",
        f"- **Parameters.** Every parameter of the shipped case ({shipped}: joystick, one axis of "
        "the machine, controllers, hand, task) is multiplied by 10^u, with u uniform between "
        f'{-SPREAD} and {SPREAD}. In half of the cases no operator holds the handle ("handle '
        'released"). In 30 % the machine touches nothing ("free motion").',
        f"- **Network.** Sampling periods from {1e3 * PERIODS[0]:g} to {1e3 * PERIODS[1]:g} ms. "
        f"Delays each way are gamma-distributed, with a mean of {1e3 * DELAYS[0]:g} to "
        f"{1e3 * DELAYS[1]:g} ms and a standard deviation (jitter) of up to {100 * JITTER:g} % of "
        f"it. Packets overtake each other; up to {100 * LOST:g} % are lost.",
        "- **Factor.** The signal that returns from the machine to the joystick is multiplied by "
        "a factor. The factor is random (0.03 to 10) in every second case. In the others it is "
        f"within {ASIDE:g} e-folds (a factor of {np.exp(-ASIDE):.2g} to {np.exp(ASIDE):.2g}) of "
        "the predicted stability limit, where there is one. For wave variables and passivity "
        "control, the slave's controller and wave impedance are scaled instead.",
        "",
        "The rows of the tables are the control structures:",
        "",
        "| structure | from joystick (master) to machine (slave) | from machine to joystick |",
        "| --- | --- | --- |",
        "| `position_position` | position | position: a spring and damper couples both sides |",
        "| `position_force` | position | contact force |",
        "| `rate_position`, `rate_force` | deflection as velocity (rate control) | position; "
        "contact force |",
        "| `four_channel_position`, `four_channel_rate` | motion and force, under position or "
        "rate control | motion and force |",
        "| `wave_variables` | a sum of force and velocity (wave), with which a channel of constant delay "
        "produces no energy | the difference of both |",
        "| `passivity_control` | position, limited so that no more energy leaves the channel than has entered "
        "it | force of the slave's controller, limited in the same way |",
        "",
        "The columns:",
        "",
        "| column | meaning |",
        "| --- | --- |",
        "| correct | cases in which prediction and simulation agree, of all cases (higher is "
        "better) |",
        "| handle held, handle released | the same, for cases with and without an operator |",
        "| stable | fraction of the cases that are stable in simulation; neither high nor low is "
        "better |",
        "| close to the limit | fraction of the cases in which a change of the factor by "
        f"{100 * NEAR:g} % changes the prediction. This range is narrower than that of the section "
        "*Factor near the predicted limit* |",
        "| correct, close to the limit; correct, others | correct predictions of these cases and "
        "of all other cases |",
        "",
        "No case is excluded.",
        "", "## All cases", "", *table(found),
        "", "## Random factor", "", *table(plain),
        "", "## Factor near the predicted limit", "", *table(aimed),
        "", "## Wrong predictions", "",
        "The next table lists all wrong predictions by the criterion on which the prediction was "
        "based:",
        "",
        "- poles: the poles of the loop with the mean delay",
        "- jitter: the mean loop is stable, but the noise that jitter causes grows",
        "- slave alone (passivity control): the slave with its own controller is unstable",
        "- bounded (passivity control): the slave is stable but not passive",
        "",
        "| structure | predicted | criterion | cases |", "| --- | --- | --- | ---: |",
        *(f"| `{n}` | {what} | {why} | {k} |" for (n, why, what), k in sorted(wrong.items())),
        "",
        "Passivity control keeps a motion bounded but may not stop it. Its cases count as stable "
        f"if the late motion has no more kinetic energy than the kick gave. In {decayed} of its "
        f"{len(guarded)} stable cases the motion also decayed.",
        "", "## The shipped case: operators and a released handle", "",
        "This section applies the analysis to the shipped case: 200 Hz, 20 ms each way, with 100 "
        "random operators. `hydrotele analyse teleop --robust --operators 100` gives these "
        "results; without `--operators` it uses 20 random operators.",
        "",
        "| column | meaning |",
        "| --- | --- |",
        "| handle held: with task, free motion | predicted stability with the operator of the "
        "case: while the machine touches the task, and while it moves freely |",
        "| released: with task, free motion | the same without a hand on the handle |",
        "| master alone, released | unstable poles of the released master without the slave's "
        "channel (Zhu 1994, 3.71 and 3.72); 0 is stable |",
        "| stable operators | stable cases among 100 random operators, from a loose to a firm "
        "grip, with tasks up to three times softer or stiffer |",
        "| same tasks, released | stable cases among the same 100 tasks with the handle released "
        "|",
        "| Llewellyn | smallest value of Llewellyn's stability parameter over all frequencies; "
        "from 1 on the structure is stable with every passive hand and task (absolutely stable); "
        "higher is better |",
        "| Z-width | log10 of the impedance that the hand feels with the slave clamped over that "
        "in free motion, averaged over the frequencies (Colgate and Brown 1994); higher is "
        "better |",
        "",
        '"-": not defined for this nonlinear structure.',
        "", *robust_table(), "",
        "The same at 1 kHz. The columns *master alone*, *Llewellyn* and *Z-width* are computed in "
        "continuous time and do not depend on the rate; only the other columns can change. "
        "`wave_variables` is now stable with the handle "
        "released:",
        "", *robust_table(0.001),
        "", "## Stiffness feedback with the published gains (Zhu 1994, Tables 6.7 and 6.9)", "",
        "With stiffness feedback, the contact force changes the stiffness of the joystick "
        "between K_min and K_max. Zhu's Theorem 4-2 guarantees stability if K_min > 0 and B^2 > "
        "4 M K_max (mass M, damping B of joystick and hand). No published translational axis (x, "
        "y, z) meets the second condition. The motion decays nevertheless, at any time and for "
        "any cause of the stiffness changes. This follows from the worst case: the stiffness "
        "switches so that every half swing grows as much as possible. The growth per half swing "
        "is the ratio of the speeds after and before it. Below 1 the motion decays (lower is "
        "better). The rotations are not examined.",
        "",
        "| column | meaning |",
        "| --- | --- |",
        "| handle | held: with mass, damping and stiffness of the hand; released: without |",
        "| B^2 - 4 M K_max | positive if the theorem guarantees stability |",
        "| B required by the theorem | damping [N s/m] at which this expression is 0 |",
        "| worst growth per half swing | with the worst switching between K_min and K_max |",
        "| B at growth 1 | damping [N s/m] at which the worst growth is 1; the printed B must be "
        "larger |",
        '| stable by | criterion that shows stability: "switching bound" is growth below 1 |',
        "", *spring_table(), "", "## Limits", "",
        "- Wave variables are unstable at 200 Hz with the handle released. Their wave impedance "
        "is the slave's damping, and the flotor (moving part of the joystick) is too light for "
        "it: wave impedance times sampling period over mass of the flotor is 2.4. At 1 kHz they "
        "are stable.",
        "- No published translational axis meets the sufficient condition of Theorem 4-2. Rotations are not examined.",
        "- The switching bound holds for the assumed masses of flotor and hand "
        "(models/joystick). Twice the mass raises the required damping by a factor of 1.41.",
        "- Passivity control may leave a bounded motion that does not decay. It counts as stable here.",
        "",
    ])  # fmt: skip
    publish(text, "Stability of sampled teleoperators: analysis against simulation", asked)


if __name__ == "__main__":
    main()
