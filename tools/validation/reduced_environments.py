"""Compare environments on the reduced model with those on MuJoCo: speed, and differences with the same actions.

    python tools/validation/reduced_environments.py --out docs/validation/reduced_environments.md

Speed is per second of processor time of the process, so that other programs on the machine do not change it.
"""

import time
from typing import Any

import gymnasium
import numpy as np

from hydrotele.envs.controllers.catalogue import make_controller
from hydrotele.envs.variants import typical_variation
from tools.studies.study import options, publish

TASKS: dict[str, dict[str, Any]] = {
    "TrackTrajectory": {"action": "valve"}, "StraightLine": {"action": "resolved_motion"},
    "ReachFeller": {"action": "resolved_motion"},
}  # fmt: skip


def make_environments(task: str, count: int, device: str | None, **more: Any) -> Any:
    chosen: dict[str, Any] = {**TASKS[task], **more, "device": device}
    return gymnasium.make_vec(f"hydrotele/{task}-v0", count, **chosen)


def measure_speed(task: str, count: int, device: str | None, seconds: float) -> float:
    """Return environment steps per second of processor time."""
    envs = make_environments(task, count, device, sensors="real", autoreset_mode="SameStep")
    envs.reset(seed=0)
    action = np.random.default_rng(0).uniform(-0.5, 0.5, envs.action_space.shape).astype(np.float32)
    for _ in range(3):
        envs.step(action)
    steps, begin = 0, time.process_time()
    while time.process_time() - begin < seconds:
        envs.step(action)
        steps += count
    return steps / (time.process_time() - begin)


def measure_differences(task: str, count: int) -> list[float]:
    """Return maximum and RMS difference of the tip [mm], RMS difference of pressures [bar], mean returns."""
    exact = make_environments(task, count, None)
    machine = exact.unwrapped.core.setup.machine
    exact, reduced = (
        make_environments(task, count, device, randomise=typical_variation(machine)) for device in (None, "cpu")
    )
    cores = exact.unwrapped.core, reduced.unwrapped.core
    controller = make_controller("reference", cores[0].setup)
    controller.begin(count)
    seen, same = exact.reset(seed=1)[0], reduced.reset(seed=1)[0]
    assert np.array_equal(seen, same)
    columns = [c for c, field in enumerate(cores[0].setup.fields) if field.unit == "Pa"]
    tips, pressures, returns, running = [], [], np.zeros((2, count)), np.ones(count, bool)
    for _ in range(cores[0].setup.clock.horizon):
        action = controller(seen)
        seen, reward, terminated, *_ = exact.step(action)
        same, other, over, *_ = reduced.step(action)
        returns += np.where(running, [reward, other], 0.0)
        running &= ~(terminated | over)
        tips.append((cores[0].episodes["tip"] - cores[1].episodes["tip"])[running])
        pressures.append((seen - same)[running][:, columns])
    tip = np.linalg.norm(np.concatenate(tips), axis=1)
    pressure = np.concatenate(pressures)
    return [1e3 * tip.max(), 1e3 * np.sqrt(np.mean(tip**2)), 1e-5 * np.sqrt(np.mean(pressure**2)), *returns.mean(1)]


def main() -> None:
    asked = options(__doc__, count=1024, episodes=32, seconds=3.0)
    text = [
        "Can a controller be trained faster without MuJoCo? Environments can run on the [reduced "
        "model](../how_it_works/closed_chains.md#two-models-of-one-machine) (`device='cpu'`), which solves "
        "the linkages exactly. They are compared with the same environments on MuJoCo.\n",
        f"Speed: {asked.count} environments with real sensors at 50 Hz and random actions. Cells: environment "
        "steps per second of processor time and core; larger is better.\n",
        "| task | actions | MuJoCo | reduced model | ratio |",
        "| --- | --- | --- | --- | --- |",
    ]
    for task, chosen in TASKS.items():
        exact, reduced = (measure_speed(task, asked.count, device, asked.seconds) for device in (None, "cpu"))
        text.append(f"| {task} | {chosen['action']} | {exact:,.0f} | {reduced:,.0f} | {reduced / exact:.1f} |")
    text += [
        f"\nAccuracy: {asked.episodes} whole episodes on randomised machines (`typical_variation`) with ideal "
        "sensors. Both simulations get the same actions, which the reference controller computes from the "
        "observations on MuJoCo. Nothing corrects the motion of the second simulation, except in tasks with "
        "`resolved_motion`, whose servo does. Cells: differences between the two simulations (smaller is "
        "better) and the mean return of each.\n",
        "| task | tip, largest [mm] | tip, RMS [mm] | pressures, RMS [bar] | mean return on MuJoCo | reduced model |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for task in TASKS:
        most, tip, pressure, exact, reduced = measure_differences(task, asked.episodes)
        text.append(f"| {task} | {most:.2f} | {tip:.2f} | {pressure:.2f} | {exact:.2f} | {reduced:.2f} |")
    text += [
        "\nGoals, machine variants and first observations are equal bit by bit. Both simulations have the "
        "same physical laws. They differ in the time integrator, and MuJoCo holds closed linkages by soft "
        "constraints.",
    ]
    publish("\n".join(text) + "\n", "Environments on the reduced model", asked)


if __name__ == "__main__":
    main()
