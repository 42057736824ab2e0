"""get_state and set_state: the next steps give the same bits; wrong states are refused."""

import pickle

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.dm import load
from hydrotele.envs.gymnasium_env import MachineEnv, MachineVectorEnv
from tests.envs.test_python_task import LevelTip
from tools.validation import state_roundtrip

OPTIONS = {"sensors": "real", "control_rate": 20.0, "variants": 3, "randomise": state_roundtrip.EFFECTS}


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("name", ["TrackTrajectory", "PlaceLog"])
def test_a_run_continues_with_the_same_bits(name, count):
    _, _, values, different = state_roundtrip.compare_runs(name, count, 60)
    assert values > 1000 and different == 0


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["StraightLine", "HoldForce", "ReachFeller", "Grade", "PlaceLog"])
def test_all_tasks_continue_with_the_same_bits_over_1000_steps(name):
    assert state_roundtrip.compare_runs(name, 4, 1000)[3] == 0


@pytest.mark.parametrize("part", ["physics", "episodes", "commands", "sensed", "sensed_before"])
def test_each_part_of_the_state_is_needed(part):
    """Without delay lines, sensor histories or any other part, the run differs."""
    env = MachineEnv("TrackTrajectory", **OPTIONS)
    actions = np.random.default_rng(2).uniform(-1.0, 1.0, (40, 3))
    env.reset(seed=1)
    for action in actions[:20]:
        env.step(action)
    saved = env.get_state()
    expected = [env.step(action)[0] for action in actions[20:]]
    env.set_state(type(saved)(saved.environment, {**saved.arrays, part: env.get_state().arrays[part]}))
    assert not np.array_equal(expected, [env.step(action)[0] for action in actions[20:]])
    env.set_state(saved)
    assert np.array_equal(expected, [env.step(action)[0] for action in actions[20:]])
    env.close()


def test_one_state_starts_a_batch_of_predictions():
    """As in sampling-based model predictive control: 8 action sequences from the state of a single environment."""
    one, many = MachineEnv("TrackTrajectory", **OPTIONS), MachineVectorEnv("TrackTrajectory", num_envs=8, **OPTIONS)
    one.reset(seed=3)
    for _ in range(10):
        one.step(np.array([0.2, 0.5, -0.3]))
    seen = many.set_state(one.get_state())
    assert (seen == seen[0]).all()
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, (15, 8, 3))
    rows = [many.step(action)[0] for action in actions]
    expected = [one.step(action[5])[0] for action in actions]
    assert np.array_equal([row[5] for row in rows], expected)
    state = pickle.loads(pickle.dumps(many.get_state()))
    assert len(state) == 8 and np.array_equal(one.set_state(state[5]), expected[-1])
    many.set_state(state[[0, 1]], index=[6, 7])
    assert np.array_equal(many.core.observation[6:], rows[-1][:2])
    one.close()
    many.close()


def test_python_tasks_and_dm_control_have_it_too():
    env = load(LevelTip, random=2, variants=2, duration=1.0)
    env.reset()
    saved = env.get_state()
    actions = np.random.default_rng(2).uniform(-1.0, 1.0, (20, 4))
    first = [env.step(action) for action in actions]
    env.set_state(saved)
    second = [env.step(action) for action in actions]
    assert [a.reward for a in first] == [b.reward for b in second]
    env.close()


def test_a_state_of_another_environment_is_refused():
    env, other = (
        MachineEnv("TrackTrajectory", variants=2),
        MachineEnv("TrackTrajectory", variants=2, action="joint_rate"),
    )
    many = MachineVectorEnv("TrackTrajectory", num_envs=3, variants=2)
    for each in (env, other, many):
        each.reset(seed=0)
    with pytest.raises(InputError, match="action='joint_rate'; this one has action='valve'"):
        env.set_state(other.get_state())
    with pytest.raises(InputError, match="3 episodes, but 1"):
        env.set_state(many.get_state())
    with pytest.raises(InputError, match="needs the result of get_state"):
        env.set_state({})
    env.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.get_state()
    other.close()
    many.close()
