"""The batched environments as stable-baselines3 wants them, and learning at its smallest."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3", reason="the extra `learn` is not installed")

from hydrotele.envs.controllers.catalogue import make_controller  # noqa: E402 - after the skip
from hydrotele.envs.episode import SAME_STEP  # noqa: E402 - after the skip
from hydrotele.envs.gymnasium_env import MachineVectorEnv  # noqa: E402 - after the skip
from hydrotele.envs.stable_baselines import AgentInterface, StableVecEnv  # noqa: E402 - after the skip
from hydrotele.envs.task_catalogue import make_task_core  # noqa: E402 - after the skip

_SHORT = {"variants": 2, "duration": 0.1}


def test_steps_and_ends_are_those_of_the_vector_environment():
    ours = StableVecEnv("TrackTrajectory", 3, 1, **_SHORT)
    theirs = MachineVectorEnv("TrackTrajectory", 3, None, 1, "SameStep", **_SHORT)
    ours.seed(5)
    assert np.array_equal(ours.reset(), theirs.reset(seed=[5, 6, 7])[0])
    rng = np.random.default_rng(1)
    for step in range(12):
        action = rng.uniform(-1, 1, (3, 3)).astype(np.float32)
        seen, reward, over, infos = ours.step(action)
        observation, paid, terminated, truncated, told = theirs.step(action)
        assert np.array_equal(seen, observation)
        assert np.array_equal(reward, paid.astype(np.float32))
        assert np.array_equal(over, terminated | truncated)
        assert over.all() == (step % 5 == 4)
        for number, info in enumerate(infos):
            assert bool(info) == over[number]
            if info:
                assert info["TimeLimit.truncated"]
                assert np.array_equal(info["terminal_observation"], told["final_obs"][number])
                assert info["episode"]["l"] == 5
                assert info["tip_error"] == told["final_info"]["tip_error"][number] > 0.0


def test_a_run_continues_from_its_state_with_the_same_bits():
    """The history of the agent and the state of the controller that it corrects belong to the state."""
    core = make_task_core("TrackTrajectory", {"variants": 2}, 1, 1, SAME_STEP)
    view = AgentInterface(core.setup, 3, make_controller("reference", core.setup), 0.5)
    env = StableVecEnv("TrackTrajectory", 4, view=view, variants=2)
    env.seed(3)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 4, 3))
    for action in actions[:10]:
        env.step(action)
    state = env.get_state()
    expected = [env.step(action)[0] for action in actions[10:]]
    env.set_state(state)
    assert np.array_equal(expected, [env.step(action)[0] for action in actions[10:]])
    env.close()
    core.close()
