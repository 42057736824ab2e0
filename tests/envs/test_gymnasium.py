"""Environments as gymnasium's users see them: checked, seeded, batched, started again."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import hydrotele.envs
from hydrotele.core.errors import InputError
from hydrotele.envs.episode import ACTIONS
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.task_parameters import TASK_CODES

TRACK = "hydrotele/TrackTrajectory-v0"
SHORT = {"duration": 0.1, "variants": 3}
# Valves daily in every task; an action in reference coordinates is the same code in all of them.
DAILY = {"joint_rate": "TrackTrajectory", "resolved_motion": "PlaceLog"}
EVERY_TASK_AND_ACTION = pytest.mark.parametrize(
    ("task", "action"),
    [
        (task, action) if DAILY.get(action, task) == task else pytest.param(task, action, marks=pytest.mark.nightly)
        for task in hydrotele.envs.TASK_NAMES
        for action in ACTIONS
    ],
)


@pytest.fixture(params=hydrotele.envs.TASK_NAMES)
def name(request) -> str:
    return f"hydrotele/{request.param}-v0"


def batched(name: str, count: int, **options):
    return gymnasium.make_vec(name, count, "vector_entry_point", **options)


def test_every_task_is_registered_and_has_native_code():
    assert set(hydrotele.envs.TASK_NAMES) == set(TASKS)
    assert sorted(task.kind for task in TASKS.values()) == sorted(TASK_CODES)


def test_importing_them_registers_them_and_nothing_heavy_comes_along():
    code = "import sys, gymnasium, hydrotele.envs; spec = gymnasium.spec('" + TRACK + "')"
    code += "; print(spec.id, 'numba' in sys.modules, 'mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [TRACK, "False", "False"]


@EVERY_TASK_AND_ACTION
def test_the_checker_of_gymnasium_has_nothing_to_say(task, action):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(f"hydrotele/{task}-v0", action=action, variants=2)
        check_env(env.unwrapped, skip_render_check=True)
        env.close()


@pytest.mark.daily("HoldForce-valve")
@EVERY_TASK_AND_ACTION
def test_random_actions_leave_no_space_and_raise_no_warning(task, action):
    options = {"action": action, "sensors": "real", "variants": 4, "control_rate": 20.0}
    env = batched(f"hydrotele/{task}-v0", 4, **options)
    core = env.unwrapped.core
    seen, _ = env.reset(seed=11)
    env.action_space.seed(11)
    for _ in range(100):
        assert env.observation_space.contains(seen)
        seen, reward, *_ = env.step(env.action_space.sample())
        assert np.isfinite(reward).all()
    assert not core.episodes["warnings"].any()
    assert not core.episodes["fault"].any()
    env.close()


@pytest.mark.daily("HoldForce")
def test_batched_is_single_with_the_same_seed(name):
    options = {**SHORT, "action": "valve", "sensors": "real"}
    one = batched(name, 4, **options)
    many = gymnasium.make_vec(name, 4, "sync", **options)
    first, other = one.reset(seed=5), many.reset(seed=5)
    for step in range(30):
        assert np.array_equal(first[0], other[0])
        action = np.random.default_rng(step).uniform(-1, 1, one.action_space.shape)
        first, other = (env.step(action.astype(np.float32)) for env in (one, many))
        for left, right in zip(first[:4], other[:4], strict=True):
            assert np.array_equal(left, right)
        assert_same_info(first[4], other[4])
    assert (one.unwrapped.core.episodes["episode"] > 1).all()


def assert_same_info(left: dict, right: dict) -> None:
    assert left.keys() == right.keys()
    for key in left:
        if isinstance(left[key], dict):
            assert_same_info(left[key], right[key])
        elif left[key].dtype == object:
            for a, b in zip(left[key], right[key], strict=True):
                assert (a is None and b is None) or np.array_equal(a, b)
        else:
            mask = left.get(f"_{key}", np.ones(len(left[key]), bool))
            assert np.array_equal(left[key][mask], right[key][mask])


def test_a_new_episode_in_the_same_step_shows_the_end_of_the_old_one():
    one = batched(TRACK, 3, autoreset_mode="SameStep", **SHORT)
    many = gymnasium.make_vec(TRACK, 3, "sync", vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP}, **SHORT)
    assert one.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    one.reset(seed=5), many.reset(seed=5)
    ends = 0
    for step in range(12):
        action = np.random.default_rng(step).uniform(-1, 1, (3, 3)).astype(np.float32)
        first, other = one.step(action), many.step(action)
        for left, right in zip(first[:4], other[:4], strict=True):
            assert np.array_equal(left, right)
        assert_same_info(first[4], other[4])
        ends += "final_obs" in first[4]
    assert ends == 2


def test_without_autoreset_a_mask_says_who_begins_again():
    env = batched(TRACK, 3, autoreset_mode=AutoresetMode.DISABLED, **SHORT)
    env.reset(seed=1)
    for _ in range(5):
        *_, truncated, _ = env.step(np.zeros((3, 3), np.float32))
    assert truncated.all()
    mask = np.array([True, False, True])
    env.reset(options={"reset_mask": mask})
    assert env.unwrapped.core.episodes["step"].tolist() == [0, 5, 0]
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.zeros(3, bool)})


def test_seeds():
    env = batched(TRACK, 3, variants=3)
    (first, _), (again, _), (later, _) = env.reset(seed=7), env.reset(seed=7), env.reset()
    assert np.array_equal(first, again)
    assert not np.array_equal(first, later)
    assert np.array_equal(env.reset(seed=[7, 8, 9])[0], first)
    with pytest.raises(ValueError, match="2 seeds"):
        env.reset(seed=[7, 8])
    assert not np.array_equal(env.reset(seed=[7, None, 9])[0][1], first[1])


@pytest.mark.nightly
def test_an_environment_in_a_process_of_its_own():
    many = gymnasium.make_vec(TRACK, 1, "async", vector_kwargs={"context": "spawn"}, **SHORT)
    one = batched(TRACK, 1, **SHORT)
    assert np.array_equal(many.reset(seed=2)[0], one.reset(seed=2)[0])
    action = np.full((1, 3), 0.4, np.float32)
    for _ in range(8):
        assert np.array_equal(many.step(action)[0], one.step(action)[0])
    many.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [({"sensor": "ideal"}, "sensors"), ({"task": "Track"}, "TrackTrajectory")],
)
def test_a_wrong_choice_is_refused_in_words(options, words):
    with pytest.raises(InputError, match=words):
        gymnasium.make(TRACK, **options)
