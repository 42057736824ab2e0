"""Check in all tasks that an environment continues from a saved state with the same bits.

python tools/validation/state_roundtrip.py [--steps 1000]

Every task runs as a single environment and as a batch, with real sensors, command delays and sensor
lags where effects are drawn. After some steps the state is saved. Then the same actions are applied
twice, first from the state itself, then after `set_state` of the saved state; a new environment
continues from the state as well. The table counts values that differ, of observations, rewards, ends
and states. Episodes that end are reset, so that the random generators are compared, too.
"""

import argparse
import pickle

import gymnasium
import numpy as np

import hydrotele.envs

EFFECTS = (
    {"name": "command_delay", "location": "all", "parameters": {"delay": [0.0, 0.05]}},
    {"name": "angle_lag", "location": "boom", "parameters": {"time_constant": [0.01, 0.05]}},
    {"name": "valve_deadband", "location": "boom", "parameters": {"deadband": [0.02, 0.08]}},
)
STEPS_BEFORE = 137


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1000, help="environment steps that are compared")
    steps = parser.parse_args().steps
    print("| task | environments | state of one environment [bytes] | steps | ends of episodes | values compared"
          " | different |")  # fmt: skip
    print("| --- | --- | --- | --- | --- | --- | --- |")
    failed = 0
    for name in hydrotele.envs.TASK_NAMES:
        for count in (1, 4):
            size, resets, values, different = compare_runs(name, count, steps)
            failed += different
            print(f"| {name} | {count} | {size:,} | {steps:,} | {resets} | {values:,} | {different} |", flush=True)
    raise SystemExit(1 if failed else 0)


def compare_runs(name: str, count: int, steps: int) -> tuple[int, int, int, int]:
    """Return bytes of a state per environment, resets, compared values and different values."""
    first, second = make(name, count), make(name, count)
    rng = np.random.default_rng(7)
    actions = smooth_actions(rng, STEPS_BEFORE + steps, first.action_space.shape)
    first.reset(seed=3)
    second.reset(seed=99)
    for action in actions[:STEPS_BEFORE]:
        advance(first, action)
    saved = pickle.loads(pickle.dumps(first.unwrapped.get_state()))
    expected = run(first, actions[STEPS_BEFORE:])
    values = different = 0
    for env in (first, second):
        env.unwrapped.set_state(saved)
        for one, other in zip(expected, run(env, actions[STEPS_BEFORE:]), strict=True):
            a, b = one.view(np.uint8), other.view(np.uint8)
            values += one.size
            different += int((a != b).sum())
    resets = int(expected[-2].astype(bool).sum())
    size = sum(array.nbytes for array in saved.arrays.values()) // count
    for env in (first, second):
        env.close()
    return size, resets, values, different


def make(name: str, count: int):
    options = {"sensors": "real", "control_rate": 20.0, "variants": 3, "randomise": EFFECTS}
    if count == 1:
        return gymnasium.make(f"hydrotele/{name}-v0", disable_env_checker=True, **options).unwrapped
    return gymnasium.make_vec(f"hydrotele/{name}-v0", count, "vector_entry_point", **options)


def smooth_actions(rng: np.random.Generator, steps: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return random actions that change every half second."""
    held = rng.uniform(-1.0, 1.0, (steps // 10 + 1, *shape))
    return np.repeat(held, 10, axis=0)[:steps].astype(np.float32)


def advance(env, action) -> tuple:
    """Step an environment; a single one is reset after the end of an episode."""
    result = env.step(action)
    if isinstance(result[2], bool) and (result[2] or result[3]):
        env.reset()
    return result


def run(env, actions: np.ndarray) -> list[np.ndarray]:
    """Return observations, rewards, ends and the final state of a run, as arrays."""
    results = [advance(env, action) for action in actions]
    seen, rewards = np.array([r[0] for r in results]), np.array([r[1] for r in results], float)
    ends = np.array([np.logical_or(r[2], r[3]) for r in results], np.uint8)
    last = b"".join(array.tobytes() for array in env.unwrapped.get_state().arrays.values())
    return [seen.ravel(), rewards.ravel(), ends.ravel(), np.frombuffer(last, np.uint8)]


if __name__ == "__main__":
    main()
