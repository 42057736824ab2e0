"""Check machines with two pumps: steady state by hand, limit cases, and hidden faults found by `gap`.

    python tools/validation/two_pumps.py                                  # steady states and limit cases
    python tools/validation/two_pumps.py --trials 20 --out runs/pumps     # and 20 trials of each fault
    python tools/validation/two_pumps.py --trials 20 --out runs/pumps

Three vertical cylinders lift constant loads at full command. Their steady velocities are chosen;
pressures, pump flows and engine power follow in closed form, without functions of the package. A
trial simulates two runs of a machine with two pumps, with sensor noise and one fault of random
size, and searches the logs with the machine without the fault. The trials of a seed can be repeated.
"""

import argparse
import math
import time
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from hydrotele.gap.find import find_gap
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import save_log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.plant import build_plant, rest_state

MACHINE = Path(__file__).resolve().parents[2] / "tests" / "data" / "two_pumps"
GRAVITY, TANK, RELIEF, RATED_DROP = 9.81, 0.3e6, 30.0e6, 7.0e6
HEAD_AREA, ROD_AREA, VISCOUS, ROD_MASS = 0.012, 0.006, 5000.0, 50.0
RATED_FLOW = {"boom": 5.0e-3, "bucket": 6.0e-3, "arm": 5.5e-3}  # m^3/s at RATED_DROP
SHARE = 0.25  # of the rear pump's flow, to the front line at full travel of the boom valve


class Lift(NamedTuple):
    """Steady state of one lift: velocity [m/s], head, rod and supply pressure [Pa], load [kg]."""

    velocity: float
    head: float
    rod: float
    supply: float
    load: float


def steady_lift(axis: str, velocity: float, load: float | None = None, supply: float | None = None) -> Lift:
    """Return the steady state of a lift at full opening from its velocity, and its load or supply pressure."""
    gain = RATED_FLOW[axis] / math.sqrt(RATED_DROP)
    rod = TANK + (ROD_AREA * velocity / gain) ** 2
    drop = (HEAD_AREA * velocity / gain) ** 2
    if load is None:
        assert supply is not None
        force = HEAD_AREA * (supply - drop) - ROD_AREA * rod - VISCOUS * velocity
        load = force / GRAVITY - ROD_MASS
    head = ((load + ROD_MASS) * GRAVITY + VISCOUS * velocity + ROD_AREA * rod) / HEAD_AREA
    return Lift(velocity, head, rod, head + drop, load)


def make_lifts(loads: dict[str, float], supply: dict, **sections) -> Machine:
    """Return a machine with vertical cylinders that lift loads [kg], with the sections of its pumps."""
    links, axes = {}, {}
    for k, (name, load) in enumerate(loads.items()):
        links[name] = {
            "parent": "world", "position": (2.0 * k, 0.0, 7.0), "mass": load, "inertia": (50.0, 50.0, 50.0),
            "joint": {"name": name, "type": "slide", "axis": (0.0, 0.0, 1.0), "range": (0.0, 6.0)},
        }  # fmt: skip
        axes[name] = {
            "joint": name,
            "cylinder": {
                "base_pin": {"link": "world", "position": (2.0 * k, 0.0, 0.0)},
                "rod_pin": {"link": name, "position": (0.0, 0.0, 0.0)},
                "closed_length": 7.0, "stroke": 6.0, "area_head": HEAD_AREA, "area_rod": ROD_AREA,
                "dead_volume": 1.0e-3, "leakage": 0.0, "friction": {"coulomb": 0.0, "viscous": VISCOUS},
                "tube": {"mass": 50.0, "com": 1.0, "inertia": (1.0, 20.0, 20.0)},
                "rod": {"mass": ROD_MASS, "com": 1.0, "inertia": (1.0, 20.0, 20.0)},
            },
            "valve": {
                "rated_flow": RATED_FLOW[name], "rated_pressure_drop": RATED_DROP, "bandwidth": 50.0,
                "smoothing": 1.0, "port_relief": 40.0e6,
            },
        }  # fmt: skip
    supply = {"relief_pressure": RELIEF, "tank_pressure": TANK, "bulk_modulus": 0.9e9, **supply}
    return Machine.model_validate({"name": "lifts", "links": links, "axes": axes, "supply": supply, **sections})


def simulate(machine: Machine, command: dict[str, float], duration: float = 10.0):
    """Return velocity [m/s], head and rod pressure [Pa] of every axis at the end, by axis name."""
    plant = build_plant(machine)
    data = rest_state(plant)
    data.ctrl[:] = [command[name] for name in plant.axes]
    mujoco.mj_step(plant.model, data, nstep=round(duration / plant.model.opt.timestep))
    return {
        name: (data.qvel[plant.dof[i]], data.act[4 * i + 2], data.act[4 * i + 3]) for i, name in enumerate(plant.axes)
    }


def steady_state_errors() -> dict[str, tuple[float, float]]:
    """Compare the steady state of three lifts, with merging and engine limit, with that by hand.

    The velocities are chosen, and the front supply pressure is that of the boom. The engine reduces
    both pumps to 0.8 of their flow: `Q_f = (q_boom + q_bucket) / 0.8 - SHARE Q_r` and
    `Q_r = q_arm / (0.8 (1 - SHARE))`, at the power `P = p_f (q_boom + q_bucket) + p_r q_arm`.

    Returns:
        Quantity -> (by hand, simulated) [SI].
    """
    boom = steady_lift("boom", 0.30, load=9000.0)
    bucket = steady_lift("bucket", 0.40, supply=boom.supply)
    arm = steady_lift("arm", 0.35, load=14000.0)
    front, rear = HEAD_AREA * (boom.velocity + bucket.velocity), HEAD_AREA * arm.velocity
    rear_pump = rear / (0.8 * (1.0 - SHARE))
    front_pump = front / 0.8 - SHARE * rear_pump
    power = boom.supply * front + arm.supply * rear
    machine = make_lifts(
        {"boom": boom.load, "arm": arm.load, "bucket": bucket.load}, {"pump_flow": front_pump},
        supplies={"front": {"axes": ("boom", "bucket")}, "rear": {"axes": ("arm",), "pump_flow": rear_pump}},
        merging={"boom": {"from_supply": "rear", "to_supply": "front", "travel": (0.5, 1.0), "share": (0.0, SHARE)}},
        engine={"power": power / 0.9, "efficiency": 0.9},
    )  # fmt: skip
    found = simulate(machine, dict.fromkeys(RATED_FLOW, 1.0))
    table = {}
    for name, lift in (("boom", boom), ("bucket", bucket), ("arm", arm)):
        velocity, head, rod = found[name]
        table[f"flow of the {name} [m^3/s]"] = HEAD_AREA * lift.velocity, HEAD_AREA * velocity
        table[f"head pressure of the {name} [Pa]"] = lift.head, head
        table[f"rod pressure of the {name} [Pa]"] = lift.rod, rod
        gain = RATED_FLOW[name] / math.sqrt(RATED_DROP)
        table[f"supply pressure of the {name} [Pa]"] = lift.supply, head + (HEAD_AREA * velocity / gain) ** 2
    flows = {name: HEAD_AREA * v for name, (v, _, _) in found.items()}
    supplies = {name: table[f"supply pressure of the {name} [Pa]"][1] for name in found}
    table["hydraulic power [W]"] = power, sum(flows[name] * supplies[name] for name in found)
    return table


def priority_errors() -> dict[str, tuple[float, float]]:
    """Compare two lifts of which the bucket has priority with the state by hand: its drop is the rated one."""
    bucket = steady_lift("bucket", RATED_FLOW["bucket"] / HEAD_AREA, load=8000.0)
    boom = steady_lift("boom", 0.15, load=8000.0)
    machine = make_lifts(
        {"boom": boom.load, "bucket": bucket.load, "arm": 500.0},
        {"pump_flow": HEAD_AREA * (boom.velocity + bucket.velocity)},
        supplies={"front": {"axes": ("boom", "bucket"), "priority": "bucket"}, "rear": {"axes": ("arm",)}},
    )
    found = simulate(machine, {"boom": 1.0, "bucket": 1.0, "arm": 0.0})
    flows = {name: (HEAD_AREA * lift.velocity, HEAD_AREA * found[name][0])
             for name, lift in (("boom", boom), ("bucket", bucket))}  # fmt: skip
    return {f"flow of the {name} with priority of the bucket [m^3/s]": pair for name, pair in flows.items()}


def equal_pump_errors() -> dict[str, float]:
    """Return the largest relative differences of two equal pumps from one pump of double size.

    `merged`: the rear pump delivers all of its flow to the front line. `separate`: two equal lifts,
    each with its own pump. Pumps with leakage, relief valves with override, motion from rest on.
    """

    def run(machine: Machine, command: dict[str, float]) -> np.ndarray:
        return np.array([list(simulate(machine, command, t).values()) for t in (0.05, 0.3, 1.0, 2.0)])

    def largest(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.max(np.abs(a - b) / np.max(np.abs(b), axis=(0, 1))))

    pump = {"pump_flow": 3.0e-3, "pump_droop": 2.0e-11, "time_constant": 0.1, "relief_override": 2.0e8}
    double = pump | {"pump_flow": 6.0e-3, "pump_droop": 4.0e-11}
    loads = {"boom": 9000.0, "bucket": 5000.0, "arm": 500.0}
    command = {"boom": 1.0, "bucket": 0.7, "arm": 0.0}
    merged = make_lifts(
        loads, pump,
        supplies={"front": {"axes": ("boom", "bucket")}, "rear": {"axes": ("arm",)}},
        merging={"boom": {"from_supply": "rear", "to_supply": "front", "travel": (-1.0, 1.0), "share": (1.0, 1.0)}},
    )  # fmt: skip
    one = make_lifts(loads, double, supplies={"front": {"axes": ("boom", "bucket")}, "rear": {"axes": ("arm",)}})
    errors = {"merged": largest(run(merged, command)[:, :2], run(one, command)[:, :2])}
    equal = {"boom": 9000.0, "bucket": 9000.0}
    separate = make_lifts(equal, pump, supplies={"a": {"axes": ("boom",)}, "b": {"axes": ("bucket",)}})
    shared = make_lifts(equal, double | {"relief_override": 1.0e8})
    with_equal_valves = [m.replace("axes.bucket.valve.rated_flow", RATED_FLOW["boom"]) for m in (separate, shared)]
    both = {"boom": 1.0, "bucket": 1.0}
    errors["separate"] = largest(*(run(m, both) for m in with_equal_valves))
    return errors


FAULTS = {
    "pump_droop": ("supply.rear", "droop", (0.08, 0.30)),  # fraction of the flow lost at the relief pressure
    "merging_valve": ("boom", "scale", (0.0, 0.6)),  # share that is left
}


def random_motion(random: np.random.Generator) -> dict:
    """Return a pilot with a random Fourier series for each axis, fast enough to need all of the pumps' flow."""
    means, sizes = {"swing": 0.1, "boom": 0.45, "stick": -1.5}, {"swing": 0.7, "boom": 0.40, "stick": 0.45}
    orders = np.arange(1, 9)
    axes = {}
    for name, size in sizes.items():
        weight = size / (1.0 + np.abs(orders - random.uniform(1.0, 5.0)))
        sin, cos = (weight * random.normal(size=len(orders)) / math.sqrt(2.0) for _ in range(2))
        peak = np.max(np.abs(sum(
            a * np.sin(k * t) + b * np.cos(k * t)
            for t in [np.linspace(0.0, 2.0 * np.pi, 400)] for k, a, b in zip(orders, sin, cos, strict=True)
        )))  # fmt: skip
        scale = size / peak
        axes[name] = {"mean": means[name], "sin": (scale * sin).tolist(), "cos": (scale * cos).tolist()}
    return {"kind": "fourier", "period": 20.0, "fade": 2.0, "axes": axes}


def run_trial(fault: str, seed: int, out: Path, jobs: int) -> dict:
    """Simulate two runs with a fault of random size, search them, and return truth and answer."""
    random = np.random.default_rng((seed, sorted(FAULTS).index(fault)))
    machine = load_machine(MACHINE)
    place, parameter, (low, high) = FAULTS[fault]
    value = random.uniform(low, high)
    if fault == "pump_droop":
        pump = machine.pumps["rear"]
        value *= pump.pump_flow / pump.relief_pressure
    folder = out / f"{fault}_{seed:03d}"
    for k in range(2):
        scenario = Scenario.model_validate({
            "name": f"run_{k}", "machine": str(MACHINE), "tool": "none", "seed": int(random.integers(1 << 30)),
            "duration": 20.0, "control_rate": 50.0, "sensors": "khoshzaban1992", "ground": False,
            "start": {"joints": {"swing": 0.1, "boom": 0.45, "stick": -1.5}}, "pilot": random_motion(random),
            "servo": {"lead": 0.06}, "effects": [{"name": fault, "location": place, "parameters": {parameter: value}}],
        })  # fmt: skip
        (folder / f"run_{k}").mkdir(parents=True, exist_ok=True)
        save_log(run_scenario(scenario).measured.without_truth(), folder / f"run_{k}" / "measured.parquet")
    begun = time.process_time()
    gap = find_gap(load_dataset(folder, machine, force=True), jobs=jobs)
    named = [(e.name, e.location, e.parameters) for e in gap.effects]
    return {
        "fault": fault, "seed": seed, "value": value, "verdict": gap.verdict, "named": named,
        "exact": [(name, where) for name, where, _ in named] == [(fault, place)],
        "place": {where for _, where, _ in named} == {place}, "seconds": time.process_time() - begun,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=0, help="hidden trials of each fault")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first trial")
    parser.add_argument("--faults", nargs="+", choices=sorted(FAULTS), default=sorted(FAULTS))
    parser.add_argument("--out", type=Path, default=Path("runs/two_pumps"), help="folder of the logs")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    print("| quantity | by hand | simulated | relative difference |\n| --- | ---: | ---: | ---: |")
    for name, (hand, simulated) in {**steady_state_errors(), **priority_errors()}.items():
        print(f"| {name} | {hand:.6g} | {simulated:.6g} | {abs(simulated / hand - 1.0):.1e} |")
    for name, error in equal_pump_errors().items():
        print(f"equal pumps, {name}, from one pump of double size: {error:.1e}")
    trials = []
    for seed in range(given.seed, given.seed + given.trials):
        for fault in given.faults:
            trials.append(run_trial(fault, seed, given.out, given.jobs))
            t = trials[-1]
            answer = ", ".join(
                f"{name}({where}) " + " ".join(f"{k} {p.value:.4g}" for k, p in values.items())
                for name, where, values in t["named"]
            )
            print(f"{fault} {seed}: {t['value']:.4g}; {t['verdict']}: {answer}; {t['seconds']:.0f} s", flush=True)
    for fault in given.faults if trials else ():
        own = [t for t in trials if t["fault"] == fault]
        exact, place = (sum(t[key] for t in own) for key in ("exact", "place"))
        print(f"{fault}: effect and place right in {exact}, place right in {place} of {len(own)} trials")


if __name__ == "__main__":
    main()
