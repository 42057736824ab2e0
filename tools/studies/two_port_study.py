"""Compare linear predictions of the two-port with simulations of two masses.

python tools/studies/two_port_study.py --trials 20 --points 12 --seed 0 --jobs 2
"""

from dataclasses import replace

import numpy as np

from hydrotele.teleop.case_file import TeleoperatorAxis, load_teleop_case
from hydrotele.teleop.simulation_check import compare_stability, run_sine_sweep
from hydrotele.teleop.two_port import STRUCTURES, Impedance, StructureGains
from tools.studies.study import options, publish, side_by_side

SPREAD = 0.5  # decades by which every parameter of the shipped case is varied, up and down
LONGEST = 0.5  # s each way, the largest delay of a map
FACTORS = (0.01, 100.0)  # on the returned signal
SWEPT = 0.1  # s each way, the largest delay of a sweep


def varied(case: TeleoperatorAxis, rng: np.random.Generator) -> TeleoperatorAxis:
    def drawn(value: float) -> float:
        return value * 10.0 ** rng.uniform(-SPREAD, SPREAD)

    def side(z: Impedance) -> Impedance:
        return Impedance(drawn(z.mass), drawn(z.damping), drawn(z.stiffness))

    names = ("master", "slave", "master_control", "slave_control", "hand", "task")
    gains = StructureGains(drawn(1.0), drawn(1.0), drawn(1.0))
    delay = rng.uniform(0.0, SWEPT)
    sides = {name: side(getattr(case, name)) for name in names}
    return replace(case, **sides, gains=gains).with_delay(delay)


def compared(case: TeleoperatorAxis, points: int) -> list[tuple]:
    """For every structure: cells, cells that agree, stable ones, errors of the sweeps."""
    delays = LONGEST * np.linspace(0.0, 1.0, points) ** 2
    factors = np.geomspace(*FACTORS, points)
    rows = []
    for name in STRUCTURES:
        map_ = compare_stability(case, name, delays, factors)
        errors = [run_sine_sweep(one, name).max_relative_error for one in (case.with_delay(0.0), case)]
        agree = int((map_.predicted == map_.simulated).sum())
        rows.append((map_.simulated.size, agree, int(map_.simulated.sum()), errors))
    return rows


def trial(seed: int, number: int, points: int) -> list[tuple]:
    rng = np.random.default_rng([seed, number])
    return compared(varied(load_teleop_case().to_axis(), rng), points)


def percent(error: float | None) -> str:
    return "-" if error is None else f"{100.0 * error:.2g} %"


def shipped_table(points: int) -> list[str]:
    lines = ["| structure | impedance error, no delay | impedance error, 20 ms each way |"
             " cells that agree |",
             "| --- | ---: | ---: | ---: |"]  # fmt: skip
    for name, row in zip(STRUCTURES, compared(load_teleop_case().to_axis(), points), strict=True):
        many, agree, _, errors = row
        lines.append(f"| `{name}` | {' | '.join(map(percent, errors))} | {agree} of {many} |")
    return lines


def random_table(found: list[list[tuple]]) -> list[str]:
    lines = ["| structure | cells | stable cells | agree | worst case | sweeps | not measurable |"
             " over 3 % | median error | largest error |",
             "| --- |" + " ---: |" * 9]  # fmt: skip
    for name, rows in zip(STRUCTURES, zip(*found, strict=True), strict=True):
        many, agree = sum(r[0] for r in rows), sum(r[1] for r in rows)
        worst = min(r[1] / r[0] for r in rows)
        every = [error for r in rows for error in r[3]]
        errors = [error for error in every if error is not None]
        lines.append(
            f"| `{name}` | {many} | {100 * sum(r[2] for r in rows) / many:.0f} % |"
            f" {100 * agree / many:.2f} % | {100 * worst:.1f} % | {len(errors)} |"
            f" {len(every) - len(errors)} | {sum(e > 0.03 for e in errors)} |"
            f" {percent(float(np.median(errors)))} | {percent(max(errors))} |"
        )
    return lines


def main() -> None:
    asked = options(__doc__, trials=20, points=12, seed=0, jobs=2)
    shipped = shipped_table(2 * asked.points + 1)
    drawn = random_table(side_by_side(trial, asked, asked.points))
    text = "\n".join([
        "The [two-port](../how_it_works/teleoperation.md#analysis-as-a-two-port) is a linear model of a "
        "teleoperation system: handle and slave machine, each a mass, connected by a controller with delay. "
        "Its formula predicts the impedance (force per velocity) that the operator feels, and whether the "
        "loop is stable. This study checks both against simulations of the two masses. Required are an "
        "impedance error of at most 3 %, and the right stability in 95 % of the cases.",
        "",
        "Each row is one control structure. In `position_position` (coordinating force) positions are sent "
        "both ways. In `position_force` (direct force) a position is sent to the slave and a force back. "
        "`four_channel_position` sends motion and force both ways. `rate_position`, `rate_force` and "
        "`four_channel_rate` are the same three structures under rate control, where the deflection of the "
        "handle sets the velocity of the slave. Columns:",
        "",
        "- impedance error: largest error of the formula against a simulation in which the handle is moved "
        "by sines of 0.1 to 5 Hz; smaller is better;",
        "- cells that agree: stability is compared in the cells of a map over delay (0 to 500 ms each way) "
        "and the factor on the returned signal (0.01 to 100). A cell agrees if the formula (argument "
        "principle) and a simulated push of the hand give the same answer, stable or unstable.",
        "",
        "`hydrotele analyse teleop --confirm` computes the first table for your case.",
        "", "## The shipped case", "", *shipped, "",
        f"## {asked.trials} random cases", "",
        "Every mass, damper, spring and gain of the shipped case is multiplied by 10^u, with u uniform "
        f"between {-SPREAD} and {SPREAD}. `agree`: cells in which formula and simulation agree; worst case: "
        "the lowest value of a single random case. Sweeps: simulations that measure the impedance, without "
        f"delay and with one of up to {1e3 * SWEPT:g} ms. `over 3 %` is the number of sweeps with a larger "
        "impedance error than 3 %; the last two columns give the median and the largest error.",
        "", *drawn, "", "## Limits", "",
        "- A sweep is not measurable if the slave is unstable while the handle is held, because the motion then "
        "never settles.",
        "",
    ])  # fmt: skip
    publish(text, "The two-port against simulation", asked)


if __name__ == "__main__":
    main()
