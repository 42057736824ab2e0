"""Stability of sampled teleoperators with jitter: predicted against simulated, random cases.

python tools/stability_study.py --trials 400 --seed 0 --jobs 2
"""

from collections import Counter
from dataclasses import replace

import numpy as np
from study import options, publish, side_by_side

from hydrotele.teleop.analysis import Case, load_teleop_case
from hydrotele.teleop.sampled import SAMPLED_STRUCTURES, jittering_line, predict
from hydrotele.teleop.sampled_run import kick
from hydrotele.teleop.two_port import Gains, Impedance

SPREAD = 0.5  # decades by which every number of the shipped case is varied, up and down
PERIODS = (1e-3, 1e-2)  # s, of both sides' sampling
DELAYS = (1e-3, 0.2)  # s, mean each way, of each its own
JITTER = 0.5  # largest standard deviation of the delays over their mean
LOST = 0.05  # largest share of lost packets
FACTORS = (-1.5, 1.0)  # decades of the factor on what comes back
SECONDS, TRIPS = 60.0, 100  # of a run, the longer of both
NEAR = 0.1  # of the factor on what comes back: so near to it stability is predicted to change


def drawn_case(rng: np.random.Generator) -> tuple[Case, float, float]:
    """A case, its period and the factor on what comes back."""
    shipped = load_teleop_case().case()

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
    gains = Gains(drawn(1.0), drawn(1.0), drawn(1.0))
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


def trial(seed: int, number: int) -> list[tuple]:
    """For every structure: hands on, contact, predicted, simulated, near its limit, reason."""
    rng = np.random.default_rng([seed, number])
    case, period, factor = drawn_case(rng)
    count = round(max(SECONDS, TRIPS * 2.0 * DELAYS[1]) / period)
    there, back = (drawn_delays(rng, 2 * count, period) for _ in range(2))
    # what is predicted sees the first half of the packets, what is simulated the second half
    line = jittering_line(period, there[:count], back[:count])
    rows = []
    for name in SAMPLED_STRUCTURES:
        told = predict(case, name, line, factor)
        seen = not kick(case, name, period, there[count:], back[count:], factor).grows
        near = {predict(case, name, line, factor * k).stable for k in (1 - NEAR, 1 + NEAR)}
        rows.append((bool(case.hand.mass), bool(case.task.mass), told.stable, seen, len(near) > 1,
                     told.reason, told.rate))  # fmt: skip
    return rows
