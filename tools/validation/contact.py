"""Measure which fraction of contact time and of free time is detected as contact in simulated digging logs.

    python tools/validation/contact.py --seeds 11 12 13 14 [--out docs/validation/contact.md]
        [--keep FOLDER]
    python tools/validation/contact.py --seeds --friction 301 302 303

Each seed simulates one log of a CAT 215 with a bucket: free motion, two digging cycles, the full
bucket carried and emptied. Soil, poses, durations and sensor noise are random. The simulated machine
differs from the model in all parameters, by their stated standard deviations. True contact is
a simulated force between ground and machine. `--friction` runs `gap` on two logs of a machine with
a hidden Coulomb friction of random size on a random cylinder, with and without the mask.
"""

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.control.contact import Contact, contact_masks, detect_contact, find_contact_rows
from hydrotele.estimate.hypothesis import calibration
from hydrotele.gap.find import find_gap
from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.log import Log, save_log
from hydrotele.logs.masked_intervals import MaskedInterval, find_unmasked_rows
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.soil.parameters import SOILS

SENSORS = "khoshzaban1992"
FRICTION = (3.0e3, 9.0e3)  # range of the additional Coulomb friction [N] of the hidden effect
FREE_MOTION = (8, 4.0)  # number and duration [s] of the moves of these logs
LIGHT_CONTACT = 1.0e3  # [N] contact with a larger force is also reported separately
LIGHT_LOAD = 100.0  # [kg] a smaller load does not count as a load


def digging_scenario(
    rng: np.random.Generator, machine: str, name: str, moves: int = 3, seconds: float = 2.5
) -> Scenario:
    """Return a scenario with a number of free moves of about `seconds` each, and two digging cycles."""
    points, r, z = [], rng.uniform(6.6, 7.4), 0.9

    def move(duration: float, r: float, z: float, attitude: float, pause: float = 0.0) -> None:
        pose = {"r": float(r), "z": float(z), "attitude": float(np.radians(attitude)),
                "theta": float(rng.uniform(-0.02, 0.02))}  # fmt: skip
        points.append({"duration": float(duration * rng.uniform(0.85, 1.2)), "pause": pause, "pose": pose})

    for _ in range(moves):
        move(seconds, rng.uniform(5.0, 6.0), rng.uniform(0.9, 2.0), rng.uniform(-150, -80))
    for _ in range(2):
        depth, reach = rng.uniform(0.15, 0.4), rng.uniform(6.6, 7.1)
        move(2.5, reach, 0.5, -68)
        move(1.5, reach, 0.05, -70)
        move(2.0, reach - 0.5, -depth, -80)
        move(4.0, 5.0, -depth, -110, pause=float(rng.choice([0.0, 1.0])))
        move(2.5, 4.6, 0.3, -170)
        move(2.0, 5.2, rng.uniform(1.3, 2.0), -175, pause=float(rng.choice([0.0, 1.5])))
        move(2.0, 5.8, 1.5, -150)
        move(2.0, 6.0, 1.4, -80)
    duration = round(0.5 + sum(p["duration"] + p["pause"] for p in points) + 1.0, 1)
    return Scenario.model_validate({
        "name": name, "machine": machine, "tool": "bucket", "seed": int(rng.integers(1 << 30)),
        "duration": duration, "sensors": SENSORS, "control_rate": 50.0,
        "surroundings": [{"kind": "soil", "soil": str(rng.choice(list(SOILS)))}],
        "start": {"pose": {"r": float(r), "z": z, "attitude": float(np.radians(-65))}},
        "pilot": {"kind": "waypoints", "settle": 0.5, "points": points},
    })  # fmt: skip


def draw_machine(seed: int, nominal: Machine) -> Machine:
    """Return a machine with random parameters, by the uncertainties of the nominal one."""
    uncertain = calibration(nominal)
    return uncertain.machine(nominal, np.clip(np.random.default_rng(seed).normal(size=uncertain.size), -2.0, 2.0))


def simulate(seed: int, machine: Machine, name: str, free_motion: tuple[int, float] = (3, 2.5)) -> tuple[Log, Log]:
    """Return the measured and the true log of a digging run, whose `free_motion` is (moves, seconds)."""
    with tempfile.TemporaryDirectory() as folder:
        save_machine(machine, Path(folder) / "machine.yaml")
        run = run_scenario(digging_scenario(np.random.default_rng([seed, 1]), folder, name, *free_motion))
    return run.measured, run.truth


@dataclasses.dataclass(frozen=True)
class Score:
    """Seconds of a log: contact, contact above 1 kN, free, free with and without soil in the bucket.

    `*_found` is how much of it is detected: as contact, or (`loaded_found`, `empty_found`) as a load.
    """

    contact: float
    contact_found: float
    heavy: float
    heavy_found: float
    free: float
    free_found: float
    loaded: float
    loaded_found: float
    empty: float
    empty_found: float

    def __add__(self, other: "Score") -> "Score":
        """Return the sums over two logs."""
        return Score(*(a + b for a, b in zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)))

    def row(self, name: str) -> str:
        """Return a row of the table."""
        values = dataclasses.astuple(self)
        shares = [f"{100 * found / whole:.1f}" for whole, found in zip(values[::2], values[1::2], strict=True)]
        contact, heavy, free, loaded, empty = shares
        return (f"| {name} | {self.contact:.1f} | {contact} | {heavy} | {self.free:.1f} | {free}"
                f" | {self.loaded:.1f} | {loaded} | {empty} |")  # fmt: skip


def score(found: Contact, truth: Log) -> Score:
    """Compare detected with true contact, row by row."""
    force = np.linalg.norm([truth[f"truth.contact_force.{axis}"] for axis in "xyz"], axis=0)
    masked = find_contact_rows(found, truth.time)
    loaded = ~find_unmasked_rows(
        [MaskedInterval("", *i) for i in found.find_intervals(found.is_loaded)], "", truth.time
    )
    free, full = force == 0.0, truth["truth.load"] > LIGHT_LOAD
    parts = [(force > 0.0, masked), (force > LIGHT_CONTACT, masked), (free, masked),
             (free & full, loaded | masked), (free & (truth["truth.load"] == 0.0), loaded)]  # fmt: skip
    return Score(*(float(rows.sum()) / truth.rate for part, found in parts for rows in (part, part & found)))


def friction_trial(seed: int, nominal: Machine, keep: Path | None) -> None:
    """Print what `gap` finds in digging logs of a machine with a hidden friction, with and without the mask."""
    rng = np.random.default_rng(seed)
    axis, more = str(rng.choice([n for n, a in nominal.axes.items() if a.cylinder])), rng.uniform(*FRICTION)
    friction = nominal.axes[axis].drive.friction.coulomb
    hidden = nominal.replace(f"axes.{axis}.cylinder.friction.coulomb", friction + more)
    logs = [simulate(seed + 100 * k, hidden, f"dig_{k}", FREE_MOTION)[0] for k in range(2)]
    files = [RunFiles(f"dig_{k}", (dataclasses.replace(log, source=f"dig_{k}"),)) for k, log in enumerate(logs)]
    if keep:
        for k, log in enumerate(logs):
            save_log(log, keep / f"friction_{seed}_{k}.parquet")
    found = detect_contact(files, nominal)
    for name, masks in (("mask", contact_masks(found, files)), ("ignore", ())):
        gap = find_gap(make_dataset(files, nominal, masks=masks))
        named = ", ".join(
            f"{e.name} at {e.location} ({e.probability:.2f}) "
            + " ".join(f"{key} {p.value:.4g} [{p.low:.4g}, {p.high:.4g}]" for key, p in e.parameters.items())
            for e in gap.effects
        )
        print(f"| {seed} | {axis} {friction + more:.0f} N | {name} | {gap.verdict} | {named or 'none'} |", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the arguments, simulate, detect, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="*", default=[11, 12, 13, 14])
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--keep", type=Path, help="existing folder for the logs")
    parser.add_argument("--friction", type=int, nargs="*", default=[], help="seeds of gap runs with a hidden friction")
    chosen = parser.parse_args(arguments)
    nominal, total, rows = load_machine("cat215", "bucket"), None, []
    print("| seed | contact [s] | contact found [%] | contact above 1 kN found [%] | free [s]"
          " | free taken for contact [%] | loaded [s] | loaded found [%] | empty taken for loaded [%] |")  # fmt: skip
    print("| --- " + "| ---: " * 8 + "|")
    for seed in chosen.seeds:
        log, truth = simulate(seed, draw_machine(seed, nominal), f"dig_{seed}")
        (found,) = detect_contact([RunFiles(f"dig_{seed}", (log,))], nominal)
        one = score(found, truth)
        total = one if total is None else total + one
        rows.append(one.row(str(seed)))
        print(rows[-1], flush=True)
        if chosen.keep:
            save_log(log, chosen.keep / f"dig_{seed}.parquet")
            save_log(truth, chosen.keep / f"truth_{seed}.parquet")
    if total:
        print(total.row("all"))
    for seed in chosen.friction:
        friction_trial(seed, nominal, chosen.keep)
    if chosen.out and total:
        chosen.out.write_text(json.dumps(dataclasses.asdict(total)))


if __name__ == "__main__":
    main()
