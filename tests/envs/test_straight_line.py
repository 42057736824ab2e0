"""Straight lines: all of them can be gone, and errors and reward are what they say."""

import numpy as np
import pytest

from hydrotele.envs.episode import MAX_ARM_AXES
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.straight_line import SETTLE_TIME, compute_line_pose, compute_line_travel
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.task_setup import full_action_rate
from hydrotele.kinematics.task_space import REACHED, solve_joint_angles

LINE = TASKS["StraightLine"]
COUNT = 48


@pytest.fixture(scope="module")
def core() -> TaskCore:
    return TaskCore(LINE, Options(variants=4, action="resolved_motion"), COUNT)


@pytest.fixture(scope="module")
def goals(core) -> np.ndarray:
    """Goals of many episodes."""
    core.reset(np.arange(COUNT))
    found = []
    for _ in range(6):
        core.reset()
        found.append(core.episodes["goal"].copy())
    return np.concatenate(found)


def place(goal, time) -> tuple[np.ndarray, np.ndarray]:
    pose, rate = np.empty(MAX_ARM_AXES), np.empty(MAX_ARM_AXES)
    compute_line_pose(goal, time, pose, rate)
    return pose, rate


@pytest.mark.nightly
def test_every_line_lies_in_the_workspace_and_asks_less_than_the_drives_have(core, goals):
    arm, ranges = core.parameters["arm"], core.parameters["ranges"][:4]
    fastest = [full_action_rate(core.setup.machine, axis) for axis in core.setup.axes]
    times = np.arange(0.0, core.setup.clock.horizon * 0.02, 0.1)
    for goal in goals:
        joints = np.zeros((len(times), 4))
        for row, time in zip(joints, times, strict=True):
            pose = place(goal, time)[0]
            assert solve_joint_angles(arm, pose, pose[1], row) == REACHED
            assert pose[2] > 0.0
        assert (ranges[:, 0] <= joints).all()
        assert (joints <= ranges[:, 1]).all()
        # 90 % is drawn; between the places that were looked at it may be a little more
        assert (np.abs(np.diff(joints, axis=0) / 0.1) / fastest).sum(axis=1).max() < 0.95


def test_lines_are_as_long_and_as_fast_as_they_say(goals):
    lengths = []
    for goal in goals:
        (begin, _), (end, rate) = place(goal, SETTLE_TIME), place(goal, 16.0)
        lengths.append(np.hypot(end[0] - begin[0], end[2] - begin[2]))
        assert not rate.any()
        assert end[3] == begin[3]
    # a start from which no full line is found would shrink it
    assert min(lengths) >= 1.0
    assert max(lengths) <= 3.0
    turned = np.array([place(goal, 16.0)[0][1] - place(goal, 0.0)[0][1] for goal in goals])
    assert 0.2 < (turned != 0.0).mean() < 0.6  # asked for: 0.4; six standard deviations to a side


def test_the_speed_is_that_of_the_way_and_changes_no_faster_than_drawn(goals):
    step = 1e-3
    times = np.arange(0.0, 16.0, step)
    for goal in goals[:5]:
        way, speed = np.array([compute_line_travel(goal, time) for time in times]).T
        # a trapezoid's mean over a step is its middle, but for the steps with a corner
        assert np.allclose(np.diff(way) / step, 0.5 * (speed[1:] + speed[:-1]), atol=step)
        assert 0.5 <= np.abs(np.diff(speed)).max() / step <= 1.0 + 1e-9
        assert 0.2 <= speed.max() <= 0.6


def test_the_preview_is_what_is_wanted_later(core):
    core.reset(np.arange(COUNT))
    names = [field.name for field in core.setup.fields]
    now = [names.index(f"reference.{c}") for c in ("r", "theta", "z")]
    seen = []
    for _ in range(60):
        core.step(np.zeros((COUNT, 4)))
        seen.append(core.observation.copy())
    for steps in (5, 10, 20):
        ahead = [names.index(f"reference_in_{20 * steps}_ms.{c}") for c in ("r", "theta", "z")]
        for early, late in zip(seen, seen[steps:], strict=False):
            # both are float32 of the same number but for the last bits of the time
            assert np.allclose(early[:, ahead], late[:, now], rtol=0.0, atol=1e-6)
    rate = names.index("reference_rate.r")
    slope = (seen[41][:, now[0]] - seen[39][:, now[0]]) / 0.04
    # float32 of 7 m over 40 ms, and a corner of the trapezoid between the two
    assert np.allclose(slope, seen[40][:, rate], atol=0.02)


@pytest.mark.nightly
def test_reward_and_errors_are_those_of_the_true_tip(core):
    core.reset(np.arange(COUNT))
    rng = np.random.default_rng(3)
    for _ in range(40):
        core.step(rng.uniform(-1, 1, (COUNT, 4)))
    time = core.episodes["tick"][0] * core.setup.clock.period
    for n in range(COUNT):
        e = core.episodes[n]
        pose, _ = place(e["goal"], time)
        after, _ = place(e["goal"], time + 0.01)
        radial = np.array([np.cos(pose[1]), np.sin(pose[1]), 0.0])
        aside = np.array([-radial[1], radial[0], 0.0])
        off = e["tip"] - (pose[0] * radial + np.array([0.0, 0.0, pose[2]]))
        way = (after[0] - pose[0]) * radial + pose[0] * (after[1] - pose[1]) * aside
        way[2] = after[2] - pose[2]
        along = off @ way / np.linalg.norm(way)
        across = np.linalg.norm(off - along * way / np.linalg.norm(way))
        attitude = e["position"][1:4].sum() - pose[3]
        # an arc of 0.5 m around 5 m differs from its tangent by some 25 mm
        curved = 0.1 * float(off @ off)
        assert core.measures[n, 0] == pytest.approx(across, abs=1e-6 + curved)
        assert core.measures[n, 1] == pytest.approx(along, abs=1e-6 + curved)
        assert core.measures[n, 2] == pytest.approx(attitude, abs=1e-9)
        figures = np.abs(core.measures[n, :3]) / [0.1, 0.2, 0.2]
        assert core.reward[n] == pytest.approx(max(-1.0, 1.0 - figures.sum()), abs=1e-9)
    assert np.ptp(core.reward) > 0.1
