"""Poses to reach: all of them can be, the way there pays by its metres, and the end is success."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.episode import DISABLED, MAX_ARM_AXES
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.reach_feller import STEP_COST, SUCCESS_REWARD
from hydrotele.envs.task import Options, sample_start_positions
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.kinematics.task_space import REACHED, compute_tip_pose, solve_joint_angles

REACH = TASKS["ReachFeller"]
COUNT = 32


@pytest.fixture(scope="module")
def core() -> TaskCore:
    return TaskCore(REACH, Options(variants=4), COUNT, 1, DISABLED)


def arm_positions(core: TaskCore) -> np.ndarray:
    """Positions (n, 5) of the arm's axes from the swing outwards; the axes of a machine follow its pumps."""
    return np.ascontiguousarray(core.episodes["position"][:, core.parameters["driven_axis"][:5]])


def true_pose(core: TaskCore, n: int) -> np.ndarray:
    pose = np.zeros(MAX_ARM_AXES)
    compute_tip_pose(core.parameters["arm"], arm_positions(core)[n], pose)
    return pose


def left(core: TaskCore) -> tuple[np.ndarray, np.ndarray]:
    """Distance and largest angle that are left, of all episodes, by places in space."""
    e, target = core.episodes, core.episodes["goal"][:, :MAX_ARM_AXES]
    place = np.stack([target[:, 0] * np.cos(target[:, 1]), target[:, 0] * np.sin(target[:, 1]),
                      target[:, 2]], axis=1)  # fmt: skip
    joints = arm_positions(core)
    attitude = np.abs(joints[:, 1:4].sum(axis=1) - target[:, 3])
    head = np.abs(joints[:, 4] - target[:, 4])
    return np.linalg.norm(e["tip"] - place, axis=1), np.maximum(attitude, head)


def test_the_straight_way_to_every_pose_lies_in_the_workspace(core):
    arm, joints = core.parameters["arm"], np.zeros(5)
    ranges = core.parameters["ranges"][core.parameters["driven_axis"][:5]]
    core.reset(np.arange(COUNT))
    far = []
    for _ in range(6):
        core.reset()
        for n in range(COUNT):
            start, goal = true_pose(core, n), core.episodes["goal"][n, :MAX_ARM_AXES].copy()
            for part in np.linspace(0.0, 1.0, 50):
                pose = start + part * (goal - start)
                assert solve_joint_angles(arm, pose, pose[1], joints) == REACHED
                assert (ranges[:, 0] <= joints).all()
                assert (joints <= ranges[:, 1]).all()
            assert goal[2] >= 0.8
        far.append(left(core)[0])
    far = np.concatenate(far)
    assert np.median(far) > 2.0
    assert far.max() < 15.0


@pytest.mark.nightly
def test_the_way_pays_by_its_metres_and_time_costs(core):
    core.reset(np.arange(COUNT))
    before, paid, rng = sum(left(core)), np.zeros(COUNT), np.random.default_rng(0)
    for step in range(1, 61):
        if step % 20 == 1:
            action = rng.uniform(-1, 1, (COUNT, 5))
        core.step(action)
        paid += core.reward
        distance, angle = left(core)
        assert np.allclose(core.measures[:, 0], distance, atol=1e-9)
        assert np.allclose(core.measures[:, 1], angle, atol=1e-9)
        # rounding of sixty steps
        assert np.allclose(paid, before - distance - angle - STEP_COST * step, atol=1e-9)
    assert np.ptp(paid) > 0.5


def test_a_pose_that_is_kept_for_half_a_second_is_success(core):
    core.reset(np.arange(COUNT))
    offset = np.zeros((COUNT, MAX_ARM_AXES))
    offset[0::3, 2] = 0.04
    offset[1::3, 2] = 0.06
    offset[2::3, 4] = 0.035
    for n in range(COUNT):
        core.episodes["goal"][n, :MAX_ARM_AXES] = true_pose(core, n) + offset[n]
    core.episodes["goal"][:, 6] = sum(left(core))
    for step in range(1, 25):
        core.step(np.zeros((COUNT, 5)))
        assert not core.terminated.any()
        inside = np.where(np.arange(COUNT) % 3 == 0, 0.02 * step, 0.0)
        assert np.allclose(core.observation[:, -1], inside, atol=1e-6)
    core.step(np.zeros((COUNT, 5)))
    reached = np.arange(COUNT) % 3 == 0
    assert np.array_equal(core.terminated != 0, reached)
    assert np.array_equal(core.measures[:, 2] == 1.0, reached)
    assert (core.reward[reached] > SUCCESS_REWARD - 0.05).all()


def test_leaving_the_pose_begins_the_time_anew(core):
    core.reset(np.arange(COUNT))
    for n in range(COUNT):
        core.episodes["goal"][n, :MAX_ARM_AXES] = true_pose(core, n)
    for _ in range(10):
        core.step(np.zeros((COUNT, 5)))
    core.episodes["goal"][:, 2] += 0.2
    core.step(np.zeros((COUNT, 5)))
    assert not core.observation[:, -1].any()


def test_a_start_that_no_arm_can_take_is_refused(core):
    with pytest.raises(InputError, match="reached"):
        sample_start_positions(core.setup.machine, np.random.default_rng(0), (30.0,) * 5, (31.0,) * 5)
