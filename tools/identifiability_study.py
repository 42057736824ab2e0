"""What the complete model of the CAT 215 tells: counts beside those of Khoshzaban's Table 13.

    python tools/identifiability_study.py [--out docs/results/identifiability.md]

82 parameters: swing, boom, stick, two tubes and two rods with ten each, friction and offset of the
drives, friction of joints and pins. Two motions: three joints from rest to rest in 5 s (in the
style of his Figures 30 to 32), and a wide sum of sines. Khoshzaban deletes the columns that others
can stand for and marks them unidentifiable together with those that have no effect; those that
stand for a combination he calls linearly identifiable. In these terms a model of rank r has 82 - r
deleted parameters. One counts as fully identifiable here if no more than a stated part of it lies
in the null space.
"""

import numpy as np

from hydrotele.identify.identifiability import identifiability
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.inverse_dynamics import (
    FrictionTerm,
    Regressor,
    pin_friction,
    project,
    regressor,
)
from hydrotele.simulate.closure import closed_chain
from tools.study import options, publish

TABLE_13 = (31, 24, 27)
PARTS = (1e-5, 0.01, 0.05)
DURATION = 5.0  # s
GOALS = {"swing": (0, -40), "boom": (45, 5), "stick": (-140, -35)}  # deg


def rest_to_rest() -> list[np.ndarray]:
    """Positions, rates and accelerations (n, 3) of fifth-order moves."""
    s = np.arange(0.0, DURATION, 0.02)[:, None] / DURATION
    starts, ends = np.deg2rad(np.array(list(GOALS.values()), float)).T
    way = ends - starts
    return [
        starts + way * (10 * s**3 - 15 * s**4 + 6 * s**5),
        way * (30 * s**2 - 60 * s**3 + 30 * s**4) / DURATION,
        way * (60 * s - 180 * s**2 + 120 * s**3) / DURATION**2,
    ]


def sines() -> list[np.ndarray]:
    """Positions, rates and accelerations (n, 3) of sums of three sines."""
    t = 0.02 * np.arange(1664)[:, None]
    rate = np.array([0.9, 0.7, 1.1]) * np.array([[1.0], [2.3], [3.7]])[:, None]
    width = np.array([0.5, 0.25, 0.3]) / np.array([[1.0], [2.0], [3.0]])[:, None]
    turn = rate * t + np.arange(9.0).reshape(3, 1, 3)
    return [
        np.array([0.0, 0.3, -1.6]) + (width * np.sin(turn)).sum(0),
        (width * rate * np.cos(turn)).sum(0), -(width * rate**2 * np.sin(turn)).sum(0),
    ]  # fmt: skip


def complete(motion: list[np.ndarray]) -> Regressor:
    """Regressor of the 82 parameters."""
    chain = closed_chain(load_machine("cat215"))
    found = project(chain, ("swing", "boom", "stick"), *motion)
    drives = [FrictionTerm(joint, {"coulomb": 0.0}) for joint in chain.drives]
    return regressor(
        chain, found, bodies=[b for b in chain.bodies if b != "chassis"],
        rubbing=[*drives, *pin_friction(chain)],
    )  # fmt: skip


def hidden_parts(table: Regressor, rank: int) -> np.ndarray:
    """Part (82,) of every parameter that lies in the null space."""
    flat = table.matrix.reshape(-1, len(table.names))
    size = np.linalg.norm(flat, axis=0)
    scaled = np.linalg.qr(flat / np.where(size > 0, size, 1.0), mode="r")
    rows = np.linalg.svd(scaled)[2][:rank]
    return np.sqrt(np.maximum(1.0 - np.sum(rows**2, axis=0), 0.0))


def report() -> str:
    """The tables."""
    lines = [
        "| motion | full means a hidden part below | without effect | in combinations | full |"
        " deleted | standing for a combination | full |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        "| Khoshzaban, Table 13 | | | | | " + " | ".join(map(str, TABLE_13)) + " |",
    ]
    names = {}
    for said, motion in (("rest to rest", rest_to_rest()), ("sines", sines())):
        table = complete(motion)
        flat = table.matrix.reshape(-1, len(table.names))
        told = identifiability(flat, table.names, table.units)
        none = told.counts["unidentifiable"]
        rank = len(told.base)
        if said == "rest to rest":  # too short a motion to tell rank from rounding
            rank = int(np.sum(_values(flat) > 1e-13))
        hidden = hidden_parts(table, rank)
        for part in PARTS:
            full = hidden < part
            lines.append(
                f"| {said}, rank {rank} | {part:g} | {none} | {82 - none - full.sum()} |"
                f" {full.sum()} | {82 - rank} | {rank - full.sum()} | {full.sum()} |"
            )
            names[said, part] = [n for n, f in zip(table.names, full, strict=True) if f]
    lines += ["", "Fully identifiable with a hidden part below 0.05:", ""]
    for said in ("rest to rest", "sines"):
        lines.append(f"- {said}: {', '.join(names[said, PARTS[-1]])}")
    return "\n".join(lines) + "\n"


def _values(flat: np.ndarray) -> np.ndarray:
    """Singular values of columns of length 1, over the largest."""
    size = np.linalg.norm(flat, axis=0)
    there = size > 1e-11 * size.max()
    values = np.linalg.svd(np.linalg.qr(flat[:, there] / size[there], mode="r"), compute_uv=False)
    return values / values[0]


if __name__ == "__main__":
    asked = options(__doc__)
    text = report()
    publish(text, "Identifiability of the complete model", asked)
