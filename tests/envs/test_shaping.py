"""Potential-based shaping telescopes exactly, difficulty scales the goals, and a start pose is kept."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.task_catalogue import TASKS, make_task_core

SHORT = {"variants": 2, "duration": 1.0, "control_rate": 25.0}
GAMMA = 0.95


def run(core, seed=3):
    """Return the rewards (steps, n) of random actions and the last observation."""
    rng, rewards = np.random.default_rng(seed), []
    core.reset(seed + np.arange(core.count))
    while not (core.episodes["over"] != 0).all():
        core.step(rng.uniform(-1.0, 1.0, core.action.shape))
        rewards.append(core.reward.copy())
    return np.array(rewards), core.observation.copy()


@pytest.mark.parametrize("task", TASKS)
def test_the_shaping_is_the_discounted_difference_of_potentials(task):
    plain, shaped = (make_task_core(task, SHORT | more, 2, 1, DISABLED) for more in ({}, {"shaping": GAMMA}))
    shaped.reset(3 + np.arange(2))
    first = shaped.episodes["potential"].copy()
    without, seen = run(plain)
    having, seen_too = run(shaped)
    assert np.array_equal(seen, seen_too)
    weights = GAMMA ** np.arange(len(without))
    added = weights @ (having - without)
    last = np.where(shaped.terminated, 0.0, GAMMA ** len(without) * shaped.episodes["potential"])
    assert added == pytest.approx(last - first, abs=1e-9)  # rounding of 25 terms of size 100
    assert not plain.episodes["potential"].any()


@pytest.mark.parametrize("task", ["TrackTrajectory", "StraightLine"])
def test_a_larger_error_has_a_smaller_potential(task):
    core = make_task_core(task, SHORT | {"shaping": GAMMA, "duration": 4.0}, 4, 1, DISABLED)
    core.reset(np.arange(4))
    potentials, errors = [], []
    for _ in range(100):
        core.step(np.zeros(core.action.shape))
        potentials.append(core.episodes["potential"].copy())
        errors.append(np.abs(core.measures[:, : 3 if task == "StraightLine" else 1]).sum(axis=1))
    order = np.argsort(np.ravel(errors))
    assert (np.diff(np.ravel(potentials)[order]) <= 1e-9).all()


def test_the_potential_of_a_pose_is_the_discounted_success_after_all_coordinates_have_moved():
    core = make_task_core("ReachFeller", SHORT | {"shaping": GAMMA}, 8, 1, DISABLED)
    core.reset(np.arange(8))
    place = {field.name: number for number, field in enumerate(core.setup.fields)}
    names = ("r", "theta", "z", "attitude", "head")
    goal, tip = (
        core.observation[:, [place[f"{what}.{n}"] for n in names]].astype(float) for what in ("reference", "tip")
    )
    seconds = 0.5 + (np.abs(goal - tip) / core.setup.task.pose_rates).sum(axis=1)  # 0.5 s: holding time
    # sensors are ideal; float32 rounds errors of 10 m to 1e-6 m, which are 1e-4 steps
    assert core.episodes["potential"] == pytest.approx(10.0 * GAMMA ** (25.0 * seconds), rel=1e-4)


def test_difficulty_scales_the_references():
    whole, half = (make_task_core("TrackTrajectory", SHORT | {"difficulty": d}, 8, 1, DISABLED) for d in (1.0, 0.5))
    for core in (whole, half):
        core.reset(np.arange(8))
        core.step(np.zeros(core.action.shape))
    columns = [i for i, field in enumerate(whole.setup.fields) if field.name.startswith("reference_rate.")]
    assert half.observation[:, columns] == pytest.approx(0.5 * whole.observation[:, columns], abs=1e-6)


def test_difficulty_shortens_paths():
    near, far = (make_task_core("ReachFeller", SHORT | {"difficulty": d}, 16, 1, DISABLED) for d in (0.2, 1.0))
    distances = []
    for core in (near, far):
        core.reset(np.arange(16))
        core.step(np.zeros(core.action.shape))
        distances.append(core.measures[:, 0].mean())
    assert distances[0] < 0.5 * distances[1]


def test_difficulty_brings_log_and_goal_closer():
    near, far = (make_task_core("PlaceLog", SHORT | {"difficulty": d}, 16, 1, DISABLED) for d in (0.25, 1.0))
    ways = []
    for core in (near, far):
        core.reset(np.arange(16))
        places = {field.name: i for i, field in enumerate(core.setup.fields)}
        where = [core.observation[:, [places[f"{what}.r"], places[f"{what}.theta"]]] for what in ("tip", "log", "goal")]
        points = [r * np.exp(1j * theta) for r, theta in (np.moveaxis(values, 1, 0) for values in where)]
        core.step(np.zeros(core.action.shape))
        yaw = core.measures[:, 1]
        ways.append((abs(points[1] - points[0]), abs(points[2] - points[1]), yaw))
    (to_log, to_goal, turn), (all_the_way, whole, full_turn) = ways
    assert to_log.mean() < 0.4 * all_the_way.mean()
    assert to_goal.mean() < 0.4 * whole.mean() and to_goal.min() > 0.5  # outside the tolerance of 0.3 m
    assert turn.mean() < 0.4 * full_turn.mean()


def test_difficulty_widens_the_tolerances_of_a_pose():
    core = make_task_core("ReachFeller", SHORT | {"difficulty": 0.01}, 4, 1, DISABLED)  # 5 m and 3 rad
    core.reset(np.arange(4))
    for _ in range(13):  # 0.5 s at 25 Hz
        core.step(np.zeros(core.action.shape))
    assert core.measures[:, 2].all() and core.terminated.all()


def test_an_episode_starts_in_the_given_pose():
    start = {"boom": 0.3, "stick": -1.5}
    core = make_task_core("TrackTrajectory", SHORT | {"start": start}, 3, 1, DISABLED)
    core.reset(np.arange(3))
    for axis, angle in start.items():
        assert core.episodes["position"][:, core.setup.axes.index(axis)] == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize(
    ("option", "value"), [("shaping", 1.5), ("shaping", -0.1), ("difficulty", 0.0), ("difficulty", 2.0)]
)
def test_values_out_of_range_are_refused(option, value):
    with pytest.raises(InputError, match=option):
        make_task_core("TrackTrajectory", SHORT | {option: value}, 1, 1, DISABLED)


def test_an_unknown_axis_of_the_start_is_refused():
    with pytest.raises(InputError, match="boom"):
        make_task_core("TrackTrajectory", SHORT | {"start": {"bom": 0.3}}, 1, 1, DISABLED)
