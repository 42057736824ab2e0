"""Compare a batch with the MuJoCo plant over 10 s of nominal excitation, and the speed of both.

    python tools/validation/batch_fidelity.py

Speeds are time steps of 1 ms per second of processor time of one core, the best of several runs, taken alternately.
"""

import time

import numpy as np
from mujoco.batch import Batch as MujocoBatch

from hydrotele.batch import Batch
from hydrotele.batch.measure import compare_with_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.plant import build_plant, rest_state

MACHINES, REPEATS, STEPS = 256, 8, 200


def measure_speeds(tool: str) -> tuple[float, float]:
    """Return time steps per second of processor time of MuJoCo and of the batch, with the cat215 and a tool."""
    machine = load_machine("cat215", tool)
    plant = build_plant(machine)
    start, batch = rest_state(plant), Batch(machine, MACHINES, threads=1)
    simulated = MujocoBatch(plant.model, MACHINES, nthread=1)
    commands, best = np.random.default_rng(0).uniform(-0.3, 0.3, (MACHINES, len(batch.axes))), [np.inf, np.inf]
    for _ in range(REPEATS):
        simulated.qpos[:], simulated.qvel[:], simulated.act[:] = start.qpos, start.qvel, start.act
        simulated.ctrl[:] = commands
        batch.reset()
        for k, step in enumerate((lambda: simulated.step(nstep=STEPS), lambda: batch.step(commands, STEPS // 20))):
            begin = time.process_time()
            step()
            best[k] = min(best[k], time.process_time() - begin)
    return MACHINES * STEPS / best[0], MACHINES * STEPS / best[1]


def main() -> None:
    """Print differences and speeds."""
    truth = run_scenario(load_scenario("excitation", {"duration": "10"})).truth
    for channel, (rms, largest) in compare_with_log(load_machine("cat215", "none"), truth).items():
        print(f"{channel:22} rms {rms:.2e}  max {largest:.2e}")
    for tool in ("none", "bucket"):
        mujoco, batch = measure_speeds(tool)
        print(f"{tool:8} MuJoCo {mujoco:10,.0f}  batch {batch:10,.0f} steps per second of one core")


if __name__ == "__main__":
    main()
