"""Measure batches of the reduced model on a CUDA device in less than ten minutes: speed, parity, compile time.

    python tools/validation/batch_gpu.py --out batch_gpu.json

Install `hydrotele[gpu]` first, and mujoco-warp for the comparison. The results are printed as they come and written
as JSON: first step with and without the cache, steps per second for 256 to 262 144 machines, differences from the CPU
after 2 s of random commands, equal bits of two runs on the device, machines whose state is not finite after 10^9 steps,
environment steps per second of TrackTrajectory, and steps per second of MuJoCo Warp for the bare mechanism.
`--device cpu` measures the last two on the CPU, to test the program.
"""

import argparse
import copy
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

import hydrotele.envs  # noqa: F401 - registers the environments
from hydrotele.batch import Batch
from hydrotele.batch.measure import CUDA_COUNTS, measure_batch, measure_parity
from hydrotele.core.device import import_cuda
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant

RANDOM_STEPS = 10**9  # time steps of all machines together without a state that is not finite
_FIRST_STEP = (
    "import sys; from hydrotele.batch.measure import measure_batch; from hydrotele.machine.machine_file import"
    " load_machine; print(measure_batch(load_machine('cat215', sys.argv[1]), 'cuda', (256,), 0.1)[0]['first_step_s'])"
)


def measure_first_step(tool: str) -> float:
    """Return the duration of the first step in a new process [s]."""
    done = subprocess.run([sys.executable, "-c", _FIRST_STEP, tool], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def count_failures(tool: str, machines: int) -> int:
    """Return the number of machines that are not finite after `RANDOM_STEPS` steps with full random commands."""
    batch, rng = Batch(load_machine("cat215", tool), machines, device="cuda"), np.random.default_rng(2)
    failed, done = np.zeros(machines, bool), 0
    while done < RANDOM_STEPS:
        batch.step(rng.uniform(-1.0, 1.0, (machines, len(batch.axes))), 10)
        failed |= batch.to_host(batch.machines.failed) > 0
        done += 200 * machines
    return int(failed.sum())


def measure_environments(device: str, count: int, seconds: float) -> dict[str, float]:
    """Return environment steps per second of TrackTrajectory at 50 Hz with noise, and time to the first step [s]."""
    begin = time.perf_counter()
    env: Any = gymnasium.make_vec(
        "hydrotele/TrackTrajectory-v0", count, device=device, sensors="real", autoreset_mode="SameStep"
    )
    env.reset(seed=0)
    action: Any = np.random.default_rng(0).uniform(-0.5, 0.5, env.action_space.shape).astype(np.float32)
    if device == "cuda":
        action = import_cuda().to_device(action)
    env.step(action)
    batch = env.unwrapped.core.batch
    batch.synchronise()
    first, steps, begin = time.perf_counter() - begin, 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        for _ in range(50 if device == "cuda" else 1):
            env.step(action)
            steps += count
        batch.synchronise()
    return {"steps_per_s": round(steps / (time.perf_counter() - begin)), "first_step_s": round(first, 1)}


def measure_warp(tool: str, device: str, counts: Sequence[int], seconds: float) -> dict[int, int] | str:
    """Return steps per second of MuJoCo Warp for numbers of machines; it does not integrate valves and oil."""
    try:
        import mujoco_warp  # pyright: ignore[reportMissingImports]
        import warp  # pyright: ignore[reportMissingImports]
    except ImportError:
        return "mujoco-warp is not installed"
    plant, found = copy.copy(build_plant(load_machine("cat215", tool)).model), {}
    plant.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT  # the reduced model has no contacts either
    with warp.ScopedDevice(device):
        model = mujoco_warp.put_model(plant)
        for count in counts:
            data, graph = mujoco_warp.make_data(plant, nworld=count, njmax=256), None
            mujoco_warp.step(model, data)  # compiles
            if device == "cuda":
                with warp.ScopedCapture() as capture:
                    for _ in range(20):
                        mujoco_warp.step(model, data)
                graph = capture.graph
            warp.synchronize()
            steps, begin = 0, time.perf_counter()
            while time.perf_counter() - begin < seconds:
                if graph is None:
                    mujoco_warp.step(model, data)
                else:
                    warp.capture_launch(graph)
                warp.synchronize()
                steps += count * (1 if graph is None else 20)
            found[count] = round(steps / (time.perf_counter() - begin))
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("batch_gpu.json"), help="file of the results")
    parser.add_argument("--tool", default="bucket", help="tool of the cat215")
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    chosen = parser.parse_args()
    if chosen.device == "cpu":
        print("environments", measure_environments("cpu", 256, 2.0))
        print("mujoco_warp", measure_warp(chosen.tool, "cpu", (256,), 2.0))
        return
    begin, machine = time.perf_counter(), load_machine("cat215", chosen.tool)
    found: dict = {"device": import_cuda().get_current_device().name.decode(), "tool": chosen.tool}
    for name, measure in (
        ("first_step_s", lambda: measure_first_step(chosen.tool)),
        ("second_process_s", lambda: measure_first_step(chosen.tool)),
        ("sizes", lambda: measure_batch(machine, "cuda", CUDA_COUNTS, 5.0)),
        ("parity", lambda: measure_parity(machine, 2.0)),
        ("failed_in_1e9_steps", lambda: count_failures(chosen.tool, 65536)),
        ("environments", lambda: measure_environments("cuda", 65536, 5.0)),
        ("mujoco_warp", lambda: measure_warp(chosen.tool, "cuda", CUDA_COUNTS[:4], 2.0)),
    ):
        found[name] = measure()
        print(f"{time.perf_counter() - begin:6.1f} s  {name}: {found[name]}", flush=True)
        chosen.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
