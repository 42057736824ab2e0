"""Run environments with random actions for millions of steps and check every observation.

    python tools/validation/env_soak.py --steps 10000000 --out docs/validation/env_soak.md

The steps are shared by all tasks, kinds of actions and sensors.
"""

import time
import warnings

import gymnasium
import numpy as np

import hydrotele.envs
from hydrotele.envs.episode import ACTIONS
from tools.studies.study import options, publish


def main() -> None:
    asked = options(__doc__, steps=10_000_000, batch=1024, seed=20261121, hold=5)
    warnings.simplefilter("error")
    cases = [
        (name, action, sensors)
        for name in hydrotele.envs.TASK_NAMES
        for action in ACTIONS
        for sensors in ("ideal", "real")
    ]
    each = -(-asked.steps // (len(cases) * asked.batch))
    rows = [_soak(*case, each, asked) for case in cases]
    lines = [
        "Can random actions break a control task? Long sequences of random steps test that no environment "
        "produces a value that is not finite, an observation outside its stated space, a MuJoCo warning or "
        "an unstable simulation. These four columns must be 0.\n",
        "Each row is one task with one kind of actions and sensors. Actions are valve commands, rates of the "
        "axes (`joint_rate`) or rates of the tip (`resolved_motion`); they are uniformly random, each held "
        "for a random number of steps. Sensors are exact (`ideal`) or have the errors of the machine's "
        "sensor set (`real`). Observations are tested after every step. Saturated readings count sensor "
        "values beyond the limits of the observation space; they are set to the limit, so they are allowed. "
        "The last column is the speed of the test.\n",
        "| task | actions | sensors | steps | episodes | not finite | outside the space | MuJoCo's"
        " warnings | unstable | saturated readings | physics steps/s |",
        "| " + " | ".join(["---"] * 11) + " |",
        *["| " + " | ".join(row) + " |" for row in rows],
        f"\n{sum(int(row[3].replace(',', '')) for row in rows):,} environment steps in all.",
    ]
    publish("\n".join(lines) + "\n", "Random actions in every environment", asked)


def _soak(name: str, action: str, sensors: str, steps: int, asked) -> list[str]:
    env = gymnasium.make_vec(f"hydrotele/{name}-v0", asked.batch, "vector_entry_point", action=action, sensors=sensors)
    core = env.unwrapped.core  # pyright: ignore
    chance, space = np.random.default_rng(asked.seed), env.observation_space
    seen, _ = env.reset(seed=asked.seed)
    chosen = chance.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
    infinite = outside = 0
    begin = time.perf_counter()
    for _ in range(steps):
        fresh = chance.random(asked.batch) < 1.0 / asked.hold
        drawn = chance.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
        chosen[fresh] = drawn[fresh]
        seen, reward, *_ = env.step(chosen)
        infinite += int(not (np.isfinite(seen).all() and np.isfinite(reward).all()))
        outside += int(not space.contains(seen))
    speed = steps * asked.batch * 1000.0 / core.setup.options.control_rate
    speed /= time.perf_counter() - begin
    memory = core.episodes
    row = [name, action, sensors, f"{steps * asked.batch:,}", f"{memory['episode'].sum():,}"]
    row += [str(infinite), str(outside), str(memory["warnings"].sum())]
    row += [str(memory["faults"].sum()), f"{memory['saturated'].sum():,}", f"{speed:,.0f}"]
    print(" ".join(row), flush=True)
    env.close()
    return row


if __name__ == "__main__":
    main()
