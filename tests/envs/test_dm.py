"""The same tasks for dm_control: dm_env's own tests, the bits of gymnasium's, its wrappers."""

import collections
import unittest

import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils

import hydrotele.envs
from hydrotele.core.errors import InputError
from hydrotele.envs import dm
from hydrotele.envs.gymnasium_env import MachineEnv

SHORT = {"duration": 0.2, "variants": 2}


@pytest.mark.parametrize("name", hydrotele.envs.TASK_NAMES)
@pytest.mark.parametrize("flat", [False, True])
def test_interface_of_dm_env(name, flat):
    """The tests that dm_env gives to environments, over two whole episodes."""

    class Environment(test_utils.EnvironmentTestMixin, absltest.TestCase):
        def make_object_under_test(self):
            return dm.load(name, random=1, flat_observation=flat, **SHORT)

        def make_action_sequence(self):
            for _ in range(25):  # beyond the 10 steps of an episode
                yield self.make_action()

    result = unittest.TestResult()
    unittest.defaultTestLoader.loadTestsFromTestCase(Environment).run(result)
    assert result.testsRun >= 4 and result.wasSuccessful(), result.failures + result.errors


@pytest.mark.parametrize("name", hydrotele.envs.TASK_NAMES)
def test_same_bits_as_gymnasium_over_episodes(name):
    theirs, ours = dm.load(name, random=9, **SHORT), MachineEnv(name, **SHORT)
    rng = np.random.default_rng(0)
    for episode in range(3):
        step, (seen, _) = theirs.reset(), ours.reset(seed=9 if episode == 0 else None)
        over = False
        while not over:
            assert np.concatenate(list(step.observation.values())).tobytes() == seen.tobytes()
            action = rng.uniform(-1.2, 1.2, ours.action_space.shape)
            step = theirs.step(action)
            seen, reward, terminated, truncated, info = ours.step(action)
            assert step.reward == reward
            assert theirs.last_info() == info
            over = terminated or truncated
            assert step.last() == over
            assert step.discount == (0.0 if terminated else 1.0)
    theirs.close()
    ours.close()


def test_a_task_that_ends_has_no_future():
    """A fault ends an episode; the time does not take the future away."""
    env = dm.load("TrackTrajectory", random=1, **SHORT)
    env.reset()
    for _ in range(9):
        assert env.step(np.zeros(3)).mid()
    late = env.step(np.zeros(3))
    assert late.last() and late.discount == 1.0
    assert env.step(np.zeros(3)).first()
    env.core.simulations.state[0, 1] = np.nan
    broken = env.step(np.zeros(3))
    assert broken.last() and broken.discount == 0.0 and env.last_info()["fault"]
    assert env.step(np.zeros(3)).first()
    env.close()


def test_observation_by_kind_is_the_flat_one():
    env, flat = (dm.load("TrackTrajectory", 3, some, **SHORT) for some in (False, True))
    seen, row = env.reset().observation, flat.reset().observation
    assert isinstance(seen, collections.OrderedDict) and list(row) == ["observations"]
    names = [field.name for fields in env.fields.values() for field in fields]
    assert names == [field.name for field in flat.fields["observations"]]
    assert np.array_equal(np.concatenate(list(seen.values())), row["observations"])
    assert env.fields["angle"][1].name == "angle.boom" and env.fields["angle"][1].unit == "rad"
    assert env.action_spec().name == "swing\tboom\tstick"
    assert env.control_timestep() == 0.02
    env.close()
    flat.close()


def test_seeds():
    """Integers and states of random numbers repeat; without either, episodes differ."""

    def start(random):
        env = dm.load("TrackTrajectory", random, True, **SHORT)
        rows = [env.reset().observation["observations"] for _ in range(2)]
        env.close()
        return np.array(rows).tobytes()

    assert start(5) == start(5) != start(6)
    assert start(np.random.RandomState(5)) == start(np.random.RandomState(5))
    assert start(None) != start(None)


def test_observations_are_kept():
    """What a step has given does not change in the next one."""
    env = dm.load("TrackTrajectory", 1, **SHORT)
    first = env.reset().observation
    kept = {key: values.copy() for key, values in first.items()}
    env.step(np.ones(3))
    assert all(np.array_equal(first[key], kept[key]) for key in kept)
    env.close()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dm.load("TrackTrajectry"), "did you mean 'TrackTrajectory'"),
        (lambda: dm.load("TrackTrajectory", durations=1.0), "did you mean 'duration'"),
    ],
)
def test_errors_of_the_user(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_physics_shows_the_simulation():
    """The machine with looks that dm_control's viewer gets stands where the simulated one does."""
    env = dm.load("TrackTrajectory", 1, **SHORT)
    env.reset()
    for _ in range(4):
        env.step(np.array([1.0, -1.0, 1.0]))
    physics = env.physics
    model, data = env.core.copy_model_and_data()
    assert physics.data.time == pytest.approx(0.08)
    for name in ("swing", "boom", "stick"):
        joint = env.core.setup.machine.axes[name].joint
        assert physics.named.data.qpos[joint] == data.joint(joint).qpos
    tip = data.site("hydrotele_tip").xpos
    assert np.array_equal(physics.named.data.site_xpos["hydrotele_tip"], tip)
    assert np.array_equal(physics.data.act, data.act)
    env.step(np.zeros(3))
    assert env.physics is physics and physics.data.time == pytest.approx(0.1)
    env.close()


@pytest.mark.nightly
def test_pictures():
    env = dm.load("TrackTrajectory", 1, **SHORT)
    env.reset()
    try:
        picture = env.render(60, 80)
    except InputError as error:
        pytest.skip(str(error))
    assert picture.shape == (60, 80, 3) and picture.dtype == np.uint8
    assert np.array_equal(env.physics.render(60, 80), picture)
    assert (env.physics.render(60, 80, "side") != picture).any()
    ours = MachineEnv("TrackTrajectory", "rgb_array", width=80, height=60, **SHORT)
    ours.reset(seed=1)
    assert np.array_equal(ours.render(), picture)
    ours.close()
    env.close()
