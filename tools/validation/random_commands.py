"""Step a machine with random valve commands with every tool and check every state.

Wanted: no NaN, no warning of MuJoCo, closed pins, no pressure at or below vacuum, and none above
what the chamber's relief valve lets stand at the flow that the piston presses through it.
"""

import argparse
import sys

import mujoco
import numpy as np
from mujoco.batch import Batch

from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.hydraulics.circuit import ACTIVATIONS_PER_AXIS
from hydrotele.hydraulics.laws import ATMOSPHERE
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.closed_loops import dependent_joints
from hydrotele.simulate.plant import Plant, build_plant, rest_state


def reachable_states(plant: Plant, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rest states at random joint positions, clear of the ground and inside every stroke.

    Args:
        plant: the plant.
        count: how many.
        rng: random numbers.

    Returns:
        (count, nq + na): `qpos` and `act`.
    """
    following = dependent_joints(plant.machine)
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


class Pressures:
    """Extremes of the chambers' pressures over all states of a batch.

    Attributes:
        least: lowest pressure [Pa above vacuum].
        most: highest pressure [Pa above vacuum].
        beyond: most by which a chamber exceeded `p_port + q / k_r` [Pa], negative if none did; q is
            the largest flow that the piston and the leakage pressed in since the relief opened, as
            the pressure follows a falling flow late.
    """

    def __init__(self, plant: Plant) -> None:
        """Look at no state yet."""
        machine = plant.machine
        axes = [machine.axes[n] for n in actuator_order(machine) if machine.axes[n].is_hydraulic]
        self.least, self.most, self.beyond = np.inf, -np.inf, -np.inf
        self._count = len(axes)
        self._areas = np.array([a.hydraulic_drive.effective_areas for a in axes]).reshape(-1, 2)
        self._port = np.array([a.valve.port_relief if a.valve else np.inf for a in axes])
        self._gain = np.array([a.valve.port_relief_gain if a.valve else 1.0 for a in axes])
        self._leak = np.array([a.hydraulic_drive.leakage for a in axes])
        self._pressed: np.ndarray | None = None
        self._before = self._now = np.empty(0)

    def look(self, batch: Batch, fresh: bool) -> None:
        """Take the present states in; `fresh` where they do not follow from those seen last."""
        if not self._count:
            return
        act = batch.act[:, : ACTIVATIONS_PER_AXIS * self._count].reshape(-1, self._count, ACTIVATIONS_PER_AXIS)
        chambers = act[:, :, 2:]
        self.least = min(self.least, float(chambers.min()) + ATMOSPHERE)
        self.most = max(self.most, float(chambers.max()) + ATMOSPHERE)
        speed = batch.actuator_velocity[:, : self._count]
        pressed = np.stack([-speed * self._areas[:, 0], speed * self._areas[:, 1]], axis=2)
        drop = self._leak * (chambers[:, :, 0] - chambers[:, :, 1])
        pressed = np.maximum(0.0, pressed) + np.maximum(0.0, np.stack([-drop, drop], axis=2))
        if not fresh and self._pressed is not None:
            was_open = self._before > self._port[:, None]
            most = np.maximum(pressed, self._now)
            self._pressed = np.where(was_open, np.maximum(most, self._pressed), most)
        else:
            self._pressed = pressed
        self._before, self._now = chambers.copy(), pressed
        allowed = self._port[:, None] + self._pressed / self._gain[:, None]
        self.beyond = max(self.beyond, float((chambers - allowed).max()))


def run_tool(machine: str, tool: str, steps: int, args, rng: np.random.Generator) -> dict:
    """Random commands with one tool.

    Half of the simulations add a random mean to their commands, which drives them into limits and ground;
    a quarter has commands of -1 or 1 only; the rest has commands with the mean 0.

    Returns:
        Counts and extremes: steps, nan, warnings, gap [m], speed [rad/s], pressures.
    """
    plant = build_plant(load_machine(machine, tool), args.timestep)
    states = reachable_states(plant, args.states, rng)
    batch = Batch(plant.model, args.simulations, nthread=args.threads)
    nq, pins = plant.model.nq, (plant.model.eq_obj1id, plant.model.eq_obj2id)
    warnings = np.zeros(int(mujoco.mjtWarning.mjNWARNING), dtype=np.int64)
    drift, gap, speed, nan, done = np.zeros(batch.ctrl.shape), 0.0, 0.0, 0, 0
    pressures = Pressures(plant)
    for k in range(-(-steps // (args.simulations * args.hold))):
        fresh = k % max(1, args.reset // args.hold) == 0
        if fresh:
            warnings += batch.warning[:, :, 1].sum(axis=0)  # a reset clears the counters
            batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
            chosen = states[rng.integers(len(states), size=args.simulations)]
            batch.qpos[:], batch.act[:] = chosen[:, :nq], chosen[:, nq:]
            drift[::2] = rng.uniform(-1.5, 1.5, drift[::2].shape)
        batch.ctrl[:] = np.clip(drift + rng.uniform(-1.0, 1.0, drift.shape), -1.0, 1.0)
        batch.ctrl[1::4] = np.sign(batch.ctrl[1::4])
        for step in range(args.hold):
            batch.step(nstep=1)
            pressures.look(batch, fresh and step == 0)
        done += args.simulations * args.hold
        nan += int((~np.isfinite(batch.state)).any(axis=1).sum())
        opening = batch.site_xpos[:, pins[0]] - batch.site_xpos[:, pins[1]]
        gap = max(gap, float(np.sqrt((opening**2).sum(axis=2)).max(initial=0.0)))
        speed = max(speed, float(np.abs(batch.qvel[:, plant.dof]).max()))
    warnings += batch.warning[:, :, 1].sum(axis=0)
    return {
        "steps": done,
        "nan": nan,
        "warnings": {mujoco.mjtWarning(i).name: int(n) for i, n in enumerate(warnings) if n},
        "gap": gap,
        "speed": speed,
        "pressures": pressures,
    }


def _said(pressures: Pressures) -> str:
    """The table's two columns of pressures."""
    if not np.isfinite(pressures.least):
        return "- | -"
    beyond = f"{pressures.beyond / 1e6:+.2f}" if np.isfinite(pressures.beyond) else "-"
    return f"{pressures.least / 1e6:.4f} .. {pressures.most / 1e6:.1f} | {beyond}"


def main() -> int:
    """Parse the arguments, run every tool, print one line each; 1 where one is not as wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", nargs="+", default=["cat215"])
    parser.add_argument("--tools", nargs="*", help="default: all tools of each machine")
    parser.add_argument("--steps", type=float, default=1e7, help="in all: machines, then tools")
    parser.add_argument("--simulations", type=int, default=256)
    parser.add_argument("--hold", type=int, default=20, help="steps for which a command is held")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--reset", type=int, default=4000, help="steps between new states")
    parser.add_argument("--states", type=int, default=64, help="reachable states to start from")
    parser.add_argument("--timestep", type=float, default=1.0e-3, help="[s]")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    total, bad = 0, 0
    print(
        "| machine | tool | steps | NaN | warnings | largest pin gap [mm] |"
        " largest speed [rad/s, m/s] | pressures [MPa absolute] | above relief [MPa] |\n"
        + "| --- " * 2
        + "| ---: " * 7
        + "|"
    )
    for name in args.machines:
        tools = args.tools or load_machine(name).tools
        for tool in tools:
            steps = int(args.steps / len(args.machines) / len(tools))
            result = run_tool(name, tool, steps, args, rng)
            pressures = result["pressures"]
            total += result["steps"]
            bad += result["nan"] + sum(result["warnings"].values())
            bad += pressures.least <= 0.0
            bad += pressures.beyond > 0.0
            print(
                f"| {name} | {tool} | {result['steps']} | {result['nan']} |"
                f" {result['warnings'] or 0} | {1e3 * result['gap']:.4f} |"
                f" {result['speed']:.1f} | {_said(pressures)} |",
                flush=True,
            )
    print(f"\nTotal: {total} steps, {bad} states with NaN, warnings or impossible pressures.")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
