"""Step a machine with random valve commands in every tool: no NaN, no warning, closed pins."""

import argparse
import sys
import time

import mujoco
import numpy as np
from mujoco.batch import Batch

from hydrotele.errors import InputError
from hydrotele.machine_file import load_machine
from hydrotele.simulate.closure import following_joints
from hydrotele.simulate.plant import Plant, build_plant, rest_state

HOLD = 20  # steps for which a command is held
STATES = 64  # reachable states to start from


def reachable_states(plant: Plant, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rest states at random joint positions, clear of the ground and inside every stroke.

    Args:
        plant: the plant.
        count: how many.
        rng: random numbers.

    Returns:
        (count, nq + na): `qpos` and `act`.
    """
    following = following_joints(plant.machine)
    free = {n: j for n, j in plant.machine.joints.items() if n not in following}
    states = []
    for _ in range(200 * count):
        joints = {n: rng.uniform(*(j.range or (-np.pi, np.pi))) for n, j in free.items()}
        try:
            data = rest_state(plant, joints)
        except InputError:
            continue
        mujoco.mj_forward(plant.model, data)
        if data.nefc == 3 * plant.model.neq:  # pins only: no contact, no joint limit
            states.append(np.concatenate([data.qpos, data.act]))
            if len(states) == count:
                return np.array(states)
    raise InputError(f"machine {plant.machine.name}", "its joint ranges hold no reachable state")


def run_tool(machine: str, tool: str, steps: int, args, rng: np.random.Generator) -> dict:
    """Random commands with one tool.

    Half of the simulations add a drift to their commands, which drives them into limits and ground.

    Returns:
        Counts and extremes: steps, rate [1/s], nan, warnings, gap [m], speed [rad/s].
    """
    plant = build_plant(load_machine(machine, tool), args.timestep)
    states = reachable_states(plant, STATES, rng)
    batch = Batch(plant.model, args.simulations, nthread=args.threads)
    nq, pins = plant.model.nq, (plant.model.eq_obj1id, plant.model.eq_obj2id)
    warnings = np.zeros(int(mujoco.mjtWarning.mjNWARNING), dtype=np.int64)
    drift, gap, speed, nan, done = np.zeros(batch.ctrl.shape), 0.0, 0.0, 0, 0
    start = time.perf_counter()
    for k in range(-(-steps // (args.simulations * HOLD))):
        if k % max(1, args.reset // HOLD) == 0:
            warnings += batch.warning[:, :, 1].sum(axis=0)  # a reset clears the counters
            batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
            chosen = states[rng.integers(len(states), size=args.simulations)]
            batch.qpos[:], batch.act[:] = chosen[:, :nq], chosen[:, nq:]
            drift[::2] = rng.uniform(-1.5, 1.5, drift[::2].shape)
        batch.ctrl[:] = np.clip(drift + rng.uniform(-1.0, 1.0, drift.shape), -1.0, 1.0)
        batch.step(nstep=HOLD)
        done += args.simulations * HOLD
        nan += int((~np.isfinite(batch.state)).any(axis=1).sum())
        opening = batch.site_xpos[:, pins[0]] - batch.site_xpos[:, pins[1]]
        gap = max(gap, float(np.sqrt((opening**2).sum(axis=2)).max(initial=0.0)))
        speed = max(speed, float(np.abs(batch.qvel[:, plant.dof]).max()))
    warnings += batch.warning[:, :, 1].sum(axis=0)
    return {
        "steps": done,
        "rate": done / (time.perf_counter() - start),
        "nan": nan,
        "warnings": {mujoco.mjtWarning(i).name: int(n) for i, n in enumerate(warnings) if n},
        "gap": gap,
        "speed": speed,
    }


def main() -> int:
    """Parse the arguments, run every tool, print one line each; 1 on a NaN or a warning."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machine", default="cat215")
    parser.add_argument("--tools", nargs="*", help="default: all tools of the machine")
    parser.add_argument("--steps", type=float, default=1e7, help="in all, over all tools")
    parser.add_argument("--simulations", type=int, default=256)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--reset", type=int, default=4000, help="steps between new states")
    parser.add_argument("--timestep", type=float, default=1.0e-3, help="[s]")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    tools = args.tools or load_machine(args.machine).tools
    rng = np.random.default_rng(args.seed)
    total, bad = 0, 0
    for tool in tools:
        result = run_tool(args.machine, tool, int(args.steps / len(tools)), args, rng)
        total += result["steps"]
        bad += result["nan"] + sum(result["warnings"].values())
        print(
            f"{tool}: {result['steps']} steps, {result['rate']:.0f} steps/s, NaN {result['nan']},"
            f" warnings {result['warnings'] or 'none'},"
            f" largest pin opening {1e3 * result['gap']:.4f} mm,"
            f" fastest driven joint {result['speed']:.1f} rad/s",
            flush=True,
        )
    print(f"in all {total} steps, {bad} NaN states and warnings")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
