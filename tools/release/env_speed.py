"""Measure the speed of environments: native batch, gymnasium's sync and async vector environments.

    python tools/release/env_speed.py --out docs/validation/env_speed.md

All in one process run and in turns, the best of several, so that ratios hold on a noisy machine.
"""

import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
from mujoco.batch import Batch

import hydrotele.envs
from hydrotele.envs.episode_batch import TaskCore
from tools.studies.study import options, publish

RATES = (1000.0, 200.0, 50.0)  # Hz: 1, 5 and 20 physics steps per environment step
COUNTS = (64, 256, 1024, 4096)


def main() -> None:
    asked = options(__doc__, task="TrackTrajectory", turns=5, seconds=1.0, loop=64, processes=16, batch=1024)
    name = f"hydrotele/{asked.task}-v0"
    text = [
        "How fast are the environments, and how much memory do they need? For training, `gymnasium.make_vec` "
        "can make one object that simulates many environments at once (batched). It is compared with "
        "gymnasium's own vector environments, which step single environments in a loop (`Sync`) or in "
        f"processes (`Async`). Task {asked.task}, valve actions, real sensors, {multiprocessing.cpu_count()} "
        "cores.\n"
    ]
    text += ["## Physics steps per second, with hydraulics and sensors\n", *_ways(name, asked)]
    text += ["\n## Cost by batch size\n", *_sizes(name, asked)]
    text += ["\n## Memory\n", *_memory(name)]
    publish("\n".join(text) + "\n", "Speed of the environments", asked)


def _ways(name: str, asked) -> list[str]:
    lines = [
        "Physics steps of 1 ms per second of time, larger is better. Each row is one control rate; at a "
        f"lower rate, one call makes more physics steps, so the time that `Sync` needs for each call matters less. "
        f"The batch has {asked.batch} environments, "
        f"`Sync` {asked.loop}, `Async` {asked.processes}. `Physics alone` is MuJoCo's `mujoco.batch.Batch` "
        "with two threads on the same model and commands, without control, sensors and reward: a reference for "
        "the simulation alone. It is no upper limit: the batched environments do not use this class, and their "
        "loop over `mj_step` may be faster. "
        "The last three columns are ratios; above 1 the first is faster.",
        "",
        "| control rate [Hz] | physics steps per call | batched, 2 threads | 1 thread | Sync "
        "| Async | physics alone | batched / Sync | batched / Async | physics alone / Sync |",
        "| " + " | ".join(["---"] * 10) + " |",
    ]
    for rate in RATES:
        chosen = {"control_rate": rate, "sensors": "real", "duration": 1.0e4}
        made = [
            gymnasium.make_vec(name, asked.batch, "vector_entry_point", threads=2, **chosen),
            gymnasium.make_vec(name, asked.batch, "vector_entry_point", threads=1, **chosen),
            gymnasium.make_vec(name, asked.loop, "sync", **chosen),
            gymnasium.make_vec(name, asked.processes, "async", **chosen),
        ]
        jobs = [_stepper(env, asked.seconds) for env in made]
        jobs.append(_bare(made[0], round(1000.0 / rate), asked.seconds))
        speeds = [speed * 1000.0 / rate for speed in _speeds(jobs, asked.turns)]
        for env in made:
            env.close()
        batched, single, loop, processes, bare = speeds
        lines.append(
            f"| {rate:g} | {1000 / rate:g} | {batched:,.0f} | {single:,.0f} | {loop:,.0f} |"
            f" {processes:,.0f} | {bare:,.0f} | {batched / loop:.1f} | {batched / processes:.1f} |"
            f" {bare / loop:.1f} |"
        )
    return lines


def _stepper(env, seconds: float) -> Callable[[], float]:
    """Environment steps per second of a vector environment."""
    env.reset(seed=0)
    shape = env.action_space.shape
    action = np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)
    env.step(action)

    def job() -> float:
        begin, steps = time.perf_counter(), 0
        while True:
            env.step(action)
            steps += env.num_envs
            passed = time.perf_counter() - begin
            if passed > seconds:
                return steps / passed

    return job


def _bare(env, substeps: int, seconds: float) -> Callable[[], float]:
    """The same simulations stepped by MuJoCo, without control, sensors and reward."""
    core: TaskCore = env.unwrapped.core
    batch = Batch(core.setup.variants.plant.model, core.count, nthread=2)
    batch.state[:] = core.simulations.state
    batch.ctrl[:] = core.action.astype(float)

    def job() -> float:
        begin, steps = time.perf_counter(), 0
        while True:
            batch.step(nstep=substeps)
            steps += core.count
            passed = time.perf_counter() - begin
            if passed > seconds:
                return steps / passed

    return job


def _speeds(jobs: list[Callable[[], float]], turns: int) -> list[float]:
    best = [0.0] * len(jobs)
    for _ in range(turns):
        best = [max(b, job()) for b, job in zip(best, jobs, strict=True)]
    return best


def _sizes(name: str, asked) -> list[str]:
    made = [gymnasium.make_vec(name, count, "vector_entry_point", sensors="real", duration=1.0e4) for count in COUNTS]
    speeds = _speeds([_stepper(env, asked.seconds) for env in made], asked.turns)
    lines = ["| environments | us per environment and step of 20 ms | relative to 64 |"]
    lines += ["| --- | --- | --- |"]
    lines += [
        f"| {count} | {1e6 / speed:.2f} | {speeds[0] / speed:.3f} |"
        for count, speed in zip(COUNTS, speeds, strict=True)
    ]
    return lines


def _memory(name: str) -> list[str]:
    """Memory of a process by environments, the difference of two batches taken."""
    small, large = COUNTS[0], COUNTS[-1]
    context = multiprocessing.get_context("spawn")
    with context.Pool(1, maxtasksperchild=1) as pool:
        used = pool.starmap(_used, [(name, small), (name, large)], chunksize=1)
    each = (used[1] - used[0]) / (large - small)
    core: TaskCore = gymnasium.make(name, sensors="real").unwrapped.core  # pyright: ignore
    arrays = core.bytes_per_environment
    return [
        f"An environment takes {each / 1000:.2f} kB. This is the difference in resident memory"
        f" between processes with {large} and {small} environments after 20 steps, per environment."
        f" Its arrays take {arrays / 1000:.2f} kB."
    ]


def _used(name: str, count: int) -> float:
    env = gymnasium.make_vec(name, count, "vector_entry_point", sensors="real")
    _stepper(env, 0.5)()
    status = Path("/proc/self/status").read_text().splitlines()
    line = next(line for line in status if line.startswith("VmRSS"))
    return float(line.split()[1]) * 1024.0


assert hydrotele.envs.TASK_NAMES
if __name__ == "__main__":
    main()
