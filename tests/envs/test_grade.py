"""Grading: mass stays, the wrench acts, the error is the profile's, the plane can be reached."""

import math

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.controller import find_observation_columns
from hydrotele.envs.controllers.grade import DUMP, GradeController
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.grade import (
    ERROR_PER_REWARD,
    FAILURE_DEPTH,
    FAILURE_REWARD,
    GRADE_SOILS,
    LAST_ERROR,
    MAX_GRADED_ERROR,
    MAX_RADIUS,
    MEAN_RADIUS,
    MIN_RADIUS,
    PLANE_HEIGHT,
    PLANE_SLOPE,
    SECTION_COUNT,
    SOIL_INDEX,
    SUCCESS_REWARD,
    TIME_COST,
    profile_section_radii,
)
from hydrotele.envs.soil_bed import CELL_COUNT, CELL_LENGTH, PROFILE_START, TERRAIN_SIZE, pack_soil_bed_parameters
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.kinematics.task_space import REACHED, solve_joint_angles
from hydrotele.soil.parameters import (
    CARRIED_VOLUME,
    CAT215,
    DENSITY,
    FORCE_R,
    FORCE_Z,
    GRAVITY,
    MASS,
    RESULT_SIZE,
    SOILS,
    STATE_SIZE,
    SWELL,
    pack_soil_parameters,
    total_soil_mass,
)
from hydrotele.soil.step import compute_bucket_wrench

TASK = TASKS["Grade"]
RADII = PROFILE_START + CELL_LENGTH * (np.arange(CELL_COUNT) + 0.5)


def core_of(count: int = 4, autoreset: int = DISABLED, **choices) -> TaskCore:
    core = TaskCore(TASK, Options(**{"variants": 4, **choices}), count, 1, autoreset)
    core.reset(np.arange(count))
    return core


def parts(core: TaskCore, number: int):
    """Surface, loose, state, result and numbers of the soil of an episode."""
    ends = np.cumsum([CELL_COUNT, CELL_COUNT, STATE_SIZE, RESULT_SIZE])
    return np.split(core.terrain[number], ends)


def mass(core: TaskCore, number: int) -> float:
    surface, loose, state, _, numbers = parts(core, number)
    return total_soil_mass(numbers, surface, loose, state)


def error(core: TaskCore, number: int) -> np.ndarray:
    """Heights over the plane in the stretch, from the goal's numbers."""
    goal = core.episodes["goal"][number]
    plane = goal[PLANE_HEIGHT] + math.tan(goal[PLANE_SLOPE]) * (RADII - MEAN_RADIUS)
    return (parts(core, number)[0] - plane)[(RADII > MIN_RADIUS) & (RADII < MAX_RADIUS)]


@pytest.fixture(scope="module")
def graded():
    """Three soils by the reference controller until all have been dumped once."""
    core = core_of(4, duration=60.0)
    before = [mass(core, n) for n in range(4)]
    start = core.episodes["goal"][:, LAST_ERROR].copy()
    controller = GradeController(core.setup)
    controller.begin(4)
    total, live, dumped = np.zeros(4), np.ones(4, bool), np.zeros(4, bool)
    least = np.full(4, np.inf)
    for _ in range(core.setup.clock.horizon):
        core.step(controller(core.observation))
        total += np.where(live, core.reward, 0.0)
        dumped |= controller._phase == DUMP
        least = np.minimum(least, core.measures[:, 0])
        live &= core.terminated == 0
        if not live.any() or (dumped.all() and core.episodes["step"].max() > 1250):
            break
    return core, before, start, total, least


@pytest.mark.nightly
def test_reference_controller_halves_the_error_in_every_soil(graded):
    core, _, start, total, least = graded
    assert set(core.episodes["goal"][:, SOIL_INDEX]) == set(range(len(GRADE_SOILS)))
    assert (least < 0.5 * start).all()
    done = core.measures[:, 4] > 0.0
    assert done.any()
    assert (core.measures[done, 0] < MAX_GRADED_ERROR).all()
    # what is paid is the error that went, less time, and the end's bonus
    time = core.episodes["step"] / core.setup.options.control_rate
    gone = (start - core.measures[:, 0]) / ERROR_PER_REWARD
    assert total == pytest.approx(gone - TIME_COST * time + SUCCESS_REWARD * done, abs=1e-6)


def test_no_soil_is_lost_or_made(graded):
    core, before, *_ = graded
    after = [mass(core, n) for n in range(core.count)]
    assert any(parts(core, n)[1].max() > 0.05 for n in range(core.count))  # it was moved
    # thousands of steps, each exact to rounding of some tons
    assert after == pytest.approx(before, abs=1e-6)


@pytest.mark.nightly
def test_what_acts_on_the_bucket_is_the_wrench_of_soil_and_load():
    core = core_of(1, action="valve", control_rate=200.0)
    down = np.array([0.0, -0.5, 0.3, 0.0])
    seen = 0.0
    for step in range(600):
        action = down if step < 300 else np.array([0.0, 0.3, 0.3, 0.6])
        core.step(action)
        model, data = core.copy_model_and_data()
        body = model.body("bucket").id
        acting = data.xfrc_applied.copy()
        # the force was computed where mj_step last evaluated positions: a physics step ago
        data.qpos[:] -= model.opt.timestep * data.qvel
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        out, wrench = parts(core, 0)[3], np.zeros(6)
        tip = data.site("hydrotele_tip").xpos
        theta = math.atan2(tip[1], tip[0])
        compute_bucket_wrench(out, tip, theta, data.xipos[body], wrench)
        scale = max(1.0, np.abs(wrench).max())
        # closed chains: loop joints' integration and the given positions differ by rounding
        assert acting[body] / scale == pytest.approx(wrench / scale, abs=1e-9)
        acting[body] = 0.0
        assert not acting.any()
        seen = max(seen, float(math.hypot(out[FORCE_R], out[FORCE_Z])))
    assert seen > 3.0e3
    out = parts(core, 0)[3]
    load = parts(core, 0)[2][CARRIED_VOLUME]
    numbers = parts(core, 0)[4]
    assert load > 0.01
    assert out[MASS] == pytest.approx(load / numbers[SWELL] * numbers[DENSITY])
    assert out[FORCE_Z] - data.xfrc_applied[body, 2] == pytest.approx(GRAVITY * out[MASS])


def test_error_and_observation_are_those_of_the_profile():
    core = core_of(6)
    for n in range(6):
        over = error(core, n)
        assert core.episodes["goal"][n, LAST_ERROR] == pytest.approx(np.sqrt(np.mean(over**2)))
        assert core.measures[n, 0] == core.episodes["goal"][n, LAST_ERROR]
        seen = core.observation[
            n, find_observation_columns(core.setup, "profile_error", map(str, range(SECTION_COUNT)))
        ]
        assert seen == pytest.approx(over.reshape(SECTION_COUNT, -1).mean(1), abs=1e-6)
        middles = RADII[(RADII > MIN_RADIUS) & (RADII < MAX_RADIUS)].reshape(SECTION_COUNT, -1).mean(1)
        assert middles == pytest.approx(profile_section_radii())
        # cut, never filled: the ground lies over the plane everywhere, which lies over z = 0
        assert (over > 0.0).all()
        r, z = core.observation[n, find_observation_columns(core.setup, "tip", "rz")]
        height = core.observation[n, find_observation_columns(core.setup, "edge_height", [""])[0]]
        assert z - height == pytest.approx(np.interp(r, RADII, parts(core, n)[0]), abs=1e-5)


def test_a_new_episode_has_fresh_ground():
    core = core_of(3, action="joint_rate", duration=60.0)
    fresh = core.terrain.copy()
    for step in range(150):
        core.step(np.array([1.0, -1.0 if step < 100 else 0.0, 0.0, 0.0]))
    assert (core.terrain != fresh).any(1).all()
    assert np.abs(core.copy_model_and_data(0)[1].xfrc_applied).max() > 0.0
    core.reset(np.arange(3))
    assert np.array_equal(core.terrain, fresh)
    for n in range(3):
        assert not core.copy_model_and_data(n)[1].xfrc_applied.any()


@pytest.mark.parametrize("action", ["valve", "joint_rate", "resolved_motion"])
def test_the_swing_is_locked(action):
    core = core_of(2, action=action)
    place = 1 if action == "resolved_motion" else 0
    start = core.episodes["position"][:, 0].copy()
    for _ in range(50):
        core.step(np.eye(4)[place])
    assert np.abs(core.episodes["position"][:, 0] - start).max() < 1e-3
    assert not core.episodes["reference_rate"][:, 0].any()


def test_an_edge_deep_below_the_plane_ends_the_episode():
    core = core_of(2, action="resolved_motion")
    for _ in range(500):
        core.step(np.array([0.0, 0.0, -1.0, 0.0]))
        if core.terminated.any():
            break
    ended = np.flatnonzero(core.terminated)
    assert len(ended)
    for n in ended:
        depth = core.episodes["goal"][n, PLANE_HEIGHT] - core.episodes["tip"][n, 2]
        assert depth > FAILURE_DEPTH - 0.1  # the plane slopes by up to 0.06 over 1.5 m
        assert core.measures[n, 5] == 1.0
        assert core.reward[n] < FAILURE_REWARD + 1.0


def test_all_planes_that_are_drawn_can_be_reached():
    core = core_of(64, variants=1)
    arm, ranges, q = core.parameters["arm"], core.parameters["ranges"][:4], np.zeros(4)
    for n in range(64):
        goal = core.episodes["goal"][n]
        for r, attitude in ((MIN_RADIUS, -121.0), (MEAN_RADIUS, -113.0), (MAX_RADIUS, -106.0)):
            z = goal[PLANE_HEIGHT] + math.tan(goal[PLANE_SLOPE]) * (r - MEAN_RADIUS)
            pose = np.array([r, 0.0, z, math.radians(attitude), 0.0])
            assert solve_joint_angles(arm, pose, 0.0, q) == REACHED
            assert ((ranges[:, 0] < q) & (q < ranges[:, 1])).all()


def test_episodes_have_the_soils_they_are_said_to_have():
    core = core_of(32, variants=1)
    for n in range(32):
        soil = SOILS[GRADE_SOILS[int(core.measures[n, 3])]]
        assert np.array_equal(parts(core, n)[4], pack_soil_parameters(soil, CAT215, PROFILE_START, CELL_LENGTH))
    assert core.terrain.shape[1] == TERRAIN_SIZE
    with pytest.raises(InputError, match="1 to 3 soils"):
        pack_soil_bed_parameters([SOILS["firm"]] * 4)
