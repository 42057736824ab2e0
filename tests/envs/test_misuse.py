"""Environments used wrongly: refused with a reason, or right; never a hang, never freed memory."""

import copy
import os
import pickle

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.dm import load
from hydrotele.envs.gymnasium_env import MachineEnv, MachineVectorEnv

TASK = "TrackTrajectory"


@pytest.fixture(scope="module")
def three():
    env = MachineVectorEnv(TASK, num_envs=3, variants=2)
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"duration": float("nan")}, "duration.*finite"),
        ({"duration": float("inf")}, "duration.*finite"),
        ({"variants": "3"}, "variants.*integer"),
        ({"variants": 2.5}, "variants.*integer"),
        ({"effects": 5}, "effects"),
        ({"effects": ["dead band"]}, "effects"),
        ({"control_rate": "fast"}, "control_rate.*number"),
        ({"action": "fly"}, "action"),
        ({"timestep": -1.0}, "physics step"),
    ],
)
def test_options_of_another_type_are_refused(options, said):
    with pytest.raises(InputError, match=said):
        MachineEnv(TASK, **options)


def test_numbers_of_numpy_are_numbers():
    env = MachineEnv(TASK, variants=np.int64(1), duration=np.float32(2.0))
    assert env.core.setup.options.duration == 2.0
    env.close()


def test_a_first_reset_begins_all(three):
    env = MachineVectorEnv(TASK, num_envs=3, variants=1)
    with pytest.raises(RuntimeError, match="first reset must begin all"):
        env.reset(seed=1, options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(RuntimeError, match="reset before the first step"):
        env.step(np.zeros((3, 3)))
    env.reset(seed=1)
    env.reset(options={"reset_mask": np.array([True, False, True])})
    env.close()


@pytest.mark.parametrize("actions", [0.0, np.zeros(3), np.zeros((1, 3)), np.zeros((3, 1)), []])
def test_actions_are_not_stretched(three, actions):
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        three.step(actions)


@pytest.mark.parametrize("action", [0.0, np.zeros(1), np.zeros((1, 3)), np.zeros(4), []])
def test_one_environment_takes_one_action(action):
    env = MachineEnv(TASK, variants=1)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(3,\)"):
        env.step(action)
    env.close()


@pytest.mark.parametrize("seed", [2**200, 2**64 - 1])
def test_seeds_beyond_64_bits_are_refused(three, seed):
    with pytest.raises(ValueError, match="seed"):
        three.reset(seed=seed)
    three.reset(seed=2**62)


def test_single_environments_refuse_such_seeds_too():
    env = MachineEnv(TASK, variants=1)
    with pytest.raises(ValueError, match="seed"):
        env.reset(seed=2**200)
    env.close()


def test_after_closing_nothing_is_simulated_and_what_was_seen_stays():
    env = MachineVectorEnv(TASK, num_envs=2, variants=1)
    env.reset(seed=3)
    state, before = env.core.simulations.state, env.core.simulations.state.copy()
    env.close()
    trash = [np.full(before.size, 7.0) for _ in range(200)]
    np.testing.assert_array_equal(state, before)
    with pytest.raises(RuntimeError, match="closed"):
        env.step(np.zeros((2, 3)))
    with pytest.raises(RuntimeError, match="closed"):
        env.core.copy_model_and_data()
    assert len(trash) == 200
    env.close()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_child_is_told_so(three):
    """Its parent's threads are not there, which would wait for ever."""
    three.reset(seed=0)
    child = os.fork()
    if child == 0:
        try:
            three.step(np.zeros((3, 3)))
        except RuntimeError as error:
            os._exit(0 if "forked" in str(error) else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    three.step(np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"num_envs": 0}, "^num_envs: must be a whole number from 1 to 100000, not 0$"),
        ({"num_envs": 10**9}, "^num_envs: must be a whole number from 1 to 100000, not 1000000000$"),
        ({"num_envs": 2.0}, "^num_envs: must be a whole number from 1 to 100000, not 2.0$"),
        ({"threads": 10**6}, "^threads: must be a whole number from 0 to 1024, not 1000000$"),
        ({"variants": 10**9}, "^variants: must be a whole number from 1 to 10000, not 1000000000$"),
    ],
)
def test_counts_beyond_memory_are_refused(options, said):
    with pytest.raises(InputError, match=said):
        MachineVectorEnv(TASK, **options)


@pytest.mark.parametrize(
    "action", [["0", "0", "0"], np.zeros(3, complex), np.zeros(3, object), np.zeros(3, "datetime64[s]"), [None] * 3]
)
def test_actions_are_real_numbers(three, action):
    with pytest.raises(ValueError, match="the action must consist of real numbers, not of "):
        three.step(np.tile(action, (3, 1)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int64, np.uint8, bool])
def test_actions_of_any_real_type_count_and_large_ones_are_full(three, dtype):
    three.reset(seed=0)
    expected = three.step(np.ones((3, 3), np.float32))
    three.reset(seed=0)
    large = 1e300 if dtype == np.float64 else 1
    np.testing.assert_array_equal(three.step(np.full((3, 3), large, dtype))[0], expected[0])


def test_no_step_follows_the_end_of_an_episode():
    env = MachineEnv(TASK, variants=1, duration=0.1)
    env.reset(seed=0)
    while not any(env.step(np.zeros(3))[2:4]):
        pass
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"^the episode is over: call reset\(\) before the next step$"):
            env.step(np.zeros(3))
    env.reset()
    assert not any(env.step(np.zeros(3))[2:4])
    env.close()


def test_copies_and_pickles_are_refused_with_a_reason(three):
    for env in (three, MachineEnv(TASK, variants=1), load(TASK, variants=1)):
        for duplicate in (copy.copy, copy.deepcopy, pickle.dumps):
            with pytest.raises(TypeError, match="neither copied nor pickled"):
                duplicate(env)
