"""PlaceLog: logs are held in their own simulations only, rewards are what the task says."""

import dataclasses
import math

import mujoco
import numpy as np
import pytest

from hydrotele.envs.controllers.catalogue import make_controller
from hydrotele.envs.controllers.place_log import SWING_PERIOD, trapezoidal_move_fraction
from hydrotele.envs.episode import DISABLED, SAME_STEP
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.place_log import (
    GOAL_POSE,
    GRIP_REWARD,
    LOST_REWARD,
    MAX_YAW_ERROR,
    STEP_COST,
    SUCCESS_REWARD,
    TILT_COST,
    undirected_yaw_difference,
)
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.simulate.batch import STATE_KIND

TASK = TASKS["PlaceLog"]
DISTANCE, YAW, HELD, PLACED, SWING = range(5)  # measures
_LOW = {"swing": 0.02, "boom": 0.23, "stick": -1.74, "grapple_pitch": -0.06, "claw": 1.1}
NEARLY = dataclasses.replace(TASK, name="PlaceLogNearly", start=lambda *_: _LOW)
"""The same with the grapple around where a log may lie, its jaw nearly closed."""

OPEN, SHUT = (np.array([0.0, 0.0, 0.0, 0.0, way], np.float32) for way in (-1.0, 1.0))
LIFT = np.array([0.0, 0.7, 0.0, 0.0, 0.3], np.float32)


def make(task=NEARLY, count=1, threads=1, mode=DISABLED, **options) -> TaskCore:
    chosen = {"action": "joint_rate", "variants": 1, "duration": 5.0} | options
    core = TaskCore(task, Options(**chosen), count, threads, mode)
    core.reset(np.arange(count))
    return core


def data_of(core: TaskCore, number: int = 0) -> mujoco.MjData:
    return core.copy_model_and_data(number)[1]


def lay(core: TaskCore, number: int, x: float, y: float, yaw: float) -> None:
    """Put the log of a simulation elsewhere."""
    model = core.setup.variants.plant.model
    data, state = mujoco.MjData(model), core.simulations.state[number]
    mujoco.mj_setState(model, data, state, STATE_KIND)
    at = model.joint("log_0").qposadr[0]
    data.qpos[at : at + 2] = x, y
    data.qpos[at + 3 : at + 7] = math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)
    mujoco.mj_getState(model, data, state, STATE_KIND)


def lay_in_pocket(core: TaskCore, number: int, along: float = 0.0, aside: float = 0.0) -> None:
    """Put the log below the grapple, its middle `along` [m] off along itself."""
    hand = data_of(core, number).body("claw_head")
    turn = hand.xmat.reshape(3, 3)
    x, y, _ = hand.xpos + along * turn[:, 1] + aside * turn[:, 2]
    lay(core, number, x, y, math.atan2(turn[1, 1], turn[0, 1]))


def in_hand(core: TaskCore, number: int) -> np.ndarray:
    """Where the log's middle is in the grapple's frame [m]."""
    data = data_of(core, number)
    hand = data.body("claw_head")
    return hand.xmat.reshape(3, 3).T @ (data.body("log_0").xpos - hand.xpos)


@pytest.mark.nightly
def test_each_log_is_held_where_its_own_grapple_took_it_and_let_go():
    core = make(count=4)
    for number, along in enumerate((0.0, 0.6, -1.2)):
        lay_in_pocket(core, number, along)
    lay_in_pocket(core, 3, aside=0.5)  # beside the jaws
    for _ in range(40):
        core.step(np.tile(SHUT, (4, 1)))
    assert core.measures[:, HELD].tolist() == [1.0, 1.0, 1.0, 0.0]
    taken = [in_hand(core, number) for number in range(3)]
    assert [place[1] for place in taken] == pytest.approx([0.0, 0.6, -1.2], abs=0.05)
    for _ in range(50):
        core.step(np.tile(LIFT, (4, 1)))
    heights = [data_of(core, number).body("log_0").xpos[2] for number in range(4)]
    assert min(heights[:3]) > 0.4 and heights[3] < 0.18
    for number in range(3):
        # the weld's solref of 10 ms gives g (10 ms)^2 = 1 mm, more at 1.2 m off its middle
        assert in_hand(core, number) == pytest.approx(taken[number], abs=0.01)
    for _ in range(90):  # the jaw opens by 0.3 rad, the log falls 1 m
        core.step(np.tile(OPEN, (4, 1)))
    assert not core.measures[:, HELD].any()
    fallen = [data_of(core, number).body("log_0").xpos[2] for number in range(3)]
    assert max(fallen) < 0.25


@pytest.mark.nightly
@pytest.mark.parametrize("sensors", ["ideal", "real"])
def test_threads_company_and_episodes_before_change_no_bit(sensors):
    options = {"sensors": sensors, "duration": 0.9, "mode": SAME_STEP}
    cores = [make(count=3, threads=threads, **options) for threads in (1, 2)]
    alone = [make(**options) for _ in range(3)]
    for number, core in enumerate(alone):
        core.reset(np.array([number]))
    for number, along in enumerate((0.0, 0.7)):
        for core in cores:
            lay_in_pocket(core, number, along)
        lay_in_pocket(alone[number], 0, along)
    were_held = 0
    for step in range(60):  # an episode of 45 steps, and a part of the next one
        action = np.array([SHUT, SHUT if step < 30 else LIFT, SHUT])
        for core in cores:
            core.step(action)
        for number, core in enumerate(alone):
            core.step(action[number])
        were_held = max(were_held, int(cores[0].final_measures[:, HELD].sum()))
        for name in ("observation", "final_observation", "reward", "truncated", "measures"):
            first = getattr(cores[0], name)
            assert np.array_equal(first, getattr(cores[1], name))
            assert np.array_equal(first, np.concatenate([getattr(c, name) for c in alone]))
    assert were_held == 2 and (cores[0].episodes["episode"] == 2).all()


def test_an_episode_after_one_that_held_its_log_is_as_a_first_one():
    used, fresh = make(), make()
    lay_in_pocket(used, 0, 0.5)
    for _ in range(40):
        used.step(SHUT)
    assert used.measures[0, HELD] == 1.0
    for core in (used, fresh):
        core.episodes["random"] = 4711
        core.reset()
        for _ in range(25):
            core.step(LIFT)
    assert np.array_equal(used.simulations.state, fresh.simulations.state)
    assert np.array_equal(used.observation, fresh.observation)
    models = [core.copy_model_and_data()[0] for core in (used, fresh)]
    assert np.array_equal(models[0].eq_data, models[1].eq_data)
    assert np.array_equal(models[0].eq_data, used.setup.variants.plant.model.eq_data)


def test_taking_and_nearing_pay_and_time_and_swinging_cost():
    core = make()
    lay_in_pocket(core, 0)
    core.step(SHUT)
    start = core.measures[0].copy()
    total = costs = 0.0
    while not core.measures[0, HELD]:
        core.step(SHUT)
        total += core.reward[0]
        costs += STEP_COST + TILT_COST * core.measures[0, SWING]
    assert total > GRIP_REWARD - costs
    before = core.measures[0].copy()
    core.step(LIFT)
    now = core.measures[0]
    nearer = before[DISTANCE] + before[YAW] - now[DISTANCE] - now[YAW]
    assert core.reward[0] == pytest.approx(nearer - STEP_COST - TILT_COST * now[SWING], abs=1e-12)
    assert start[DISTANCE] == pytest.approx(before[DISTANCE], abs=0.05)


@pytest.mark.parametrize(
    ("off", "turned", "ends"),
    [
        (0.25, 0.0, True),
        (0.25, math.pi, True),
        (0.25, math.pi - 0.9 * MAX_YAW_ERROR, True),
        (0.35, 0.0, False),
        (0.0, 1.1 * MAX_YAW_ERROR, False),
    ],
)
def test_a_log_that_lies_at_its_goal_for_half_a_second_ends_the_episode(off, turned, ends):
    core = make()
    x, y, yaw = core.episodes["goal"][0, GOAL_POSE]
    lay(core, 0, x + off, y, yaw + turned)
    paid = []
    for _ in range(27):
        core.step(0.0 * OPEN)
        paid.append(core.reward[0])
        if core.terminated[0]:
            break
    assert bool(core.terminated[0]) is ends is bool(core.measures[0, PLACED])
    if ends:
        assert len(paid) == 25 and paid[-1] == pytest.approx(SUCCESS_REWARD, abs=0.05)


def test_a_log_out_of_reach_ends_the_episode():
    core = make()
    lay(core, 0, 9.0, 0.0, 0.0)
    core.step(0.0 * OPEN)
    assert core.terminated[0] and core.reward[0] == pytest.approx(LOST_REWARD, abs=0.05)
    assert core.measures[0, PLACED] == 0.0


def test_what_is_observed_is_what_stands_in_the_simulation():
    core = make(TASK, 3, sensors="real", variants=3)
    names = [field.name for field in core.setup.fields]
    for _ in range(20):
        core.step(np.tile(LIFT, (3, 1)))
    for number in range(3):
        data = data_of(core, number)
        seen = dict(zip(names, core.observation[number].tolist(), strict=True))
        x, y, z = data.body("log_0").xpos
        axis = data.body("log_0").xmat.reshape(3, 3)[:, 0]
        yaw = math.atan2(axis[1], axis[0])
        gx, gy, goal = core.episodes["goal"][number, GOAL_POSE]
        for what, true in (
            ("log.r", math.hypot(x, y)), ("log.theta", math.atan2(y, x)), ("log.z", z),
            ("log.sin_2_yaw", math.sin(2.0 * yaw)), ("log.cos_2_yaw", math.cos(2.0 * yaw)),
            ("goal.r", math.hypot(gx, gy)), ("goal.theta", math.atan2(gy, gx)),
            ("goal.sin_2_yaw", math.sin(2.0 * goal)), ("goal.cos_2_yaw", math.cos(2.0 * goal)),
        ):  # fmt: skip
            assert seen[what] == pytest.approx(true, abs=1e-6), what  # float32
        sensor = core.setup.machine.sensors["khoshzaban1992"].angle
        assert sensor.span and sensor.bits
        error = sensor.accuracy + 0.5 * sensor.span / 2**sensor.bits
        for name in ("grapple_pitch", "grapple_roll"):
            true = data.joint(name).qpos[0] - 1.0e-3 * data.joint(name).qvel[0]
            assert seen[f"pendulum.{name}"] == pytest.approx(true, abs=1.01 * error)


def test_goals_lie_where_a_log_can_be_brought():
    core = make(TASK, 64, variants=8)
    fields = {field.name: c for c, field in enumerate(core.setup.fields)}
    seen = core.observation.astype(float)
    turn = seen[:, fields["goal.theta"]] - seen[:, fields["log.theta"]]
    assert (np.abs(turn) > math.radians(29.9)).all() and (np.abs(turn) < math.radians(90.1)).all()
    for what in ("log.r", "goal.r"):
        radius = seen[:, fields[what]]
        assert radius.min() >= 4.5 and radius.max() <= 6.5
        assert np.ptp(radius) > 1.5  # 64 draws of 2 m
    apart = seen[:, fields["log.theta"]] - seen[:, fields["tip.theta"]]
    assert np.abs(apart).min() > 0.14


@pytest.mark.parametrize(
    ("first", "second", "between"),
    [(0.1, 0.1 + math.pi, 0.0), (0.2, -0.3, 0.5), (0.0, math.pi / 2.0, math.pi / 2.0),
     (math.pi - 0.1, 0.2, 0.3)],
)  # fmt: skip
def test_ends_of_a_log_are_alike(first, second, between):
    angle = undirected_yaw_difference.py_func(math.sin(2.0 * first), math.cos(2.0 * first), second)
    assert angle == pytest.approx(between, abs=1e-12)


@pytest.mark.parametrize("length", [0.7, 3.1])
def test_moves_leave_a_pendulum_of_their_period_at_rest(length):
    """X'' + (2 pi / T)^2 x = -a(t), a the move's acceleration, by small exact steps."""
    step, turning = 1.0e-3, 2.0 * math.pi / SWING_PERIOD
    time = np.arange(-5, int((length + SWING_PERIOD) / step) + 5) * step
    one = np.ones(len(time))
    share = trapezoidal_move_fraction(time, length * one, SWING_PERIOD * one)
    assert share[0] == 0.0 and share[-1] == pytest.approx(1.0)
    push = -np.diff(share, 2) / step**2
    c, s = math.cos(turning * step), math.sin(turning * step)
    x = v = most = 0.0
    for force in push:
        rest = force / turning**2
        x, v = rest + (x - rest) * c + v / turning * s, -(x - rest) * turning * s + v * c
        most = max(most, abs(x))
    left = math.hypot(x, v / turning)
    assert left < 5e-3 * most  # the sum of the ramps is exact but for the grid's step of T / 2000


@pytest.mark.nightly
def test_the_reference_controller_places_logs():
    core = make(TASK, 2, action="resolved_motion", sensors="real", duration=50.0, variants=2)
    controller = make_controller("reference", core.setup)
    controller.begin(2)
    placed, over = np.zeros(2), np.zeros(2, bool)
    for _ in range(core.setup.clock.horizon):
        core.step(controller(core.observation))
        over |= (core.terminated | core.truncated) != 0
        placed = np.maximum(placed, core.measures[:, PLACED])
        if over.all():
            break
    assert placed.all()
