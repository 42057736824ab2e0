"""Loading a truck: no soil is lost, phases can be done, truck and ground push back, rewards are those stated."""

import math

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.controllers.catalogue import make_controller
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore, make_task_setup
from hydrotele.envs.load_truck import (
    BANK_AZIMUTH,
    DAMAGE_REWARD,
    ENERGY_COST,
    LOAD_TERRAIN_SIZE,
    PHASES,
    SPILL_COST,
    TIME_COST,
    VOLUME_REWARD,
)
from hydrotele.envs.soil_bed import CELL_COUNT
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.envs.truck_bed import (
    LOAD_CELL_COUNT,
    LOAD_CELL_LENGTH,
    RAIL_HEIGHT,
    TRUCK,
    drop_into_bed,
    level_load,
    loaded_volume,
)
from hydrotele.soil.parameters import CARRIED_VOLUME, CAT215, SOILS, pack_soil_parameters

TASK = TASKS["LoadTruck"]
LOADED, CARRIED, SPILLED, REMOVED, ENERGY, FORCE, LOADS, SUCCESS = range(8)
FOREVER = 1.0e3  # s, longer than any episode
NUMBERS = pack_soil_parameters(SOILS["soft"], CAT215, 2.5, 0.05)


def core_of(count: int, **choices) -> TaskCore:
    core = TaskCore(TASK, Options(**{"variants": count, **choices}), count, 1, DISABLED)
    core.reset(np.arange(count))
    return core


def run(core: TaskCore, seconds: float) -> np.ndarray:
    """Returns of the reference controller's episodes, which end or last for some seconds."""
    controller, total = make_controller("reference", core.setup), np.zeros(core.count)
    controller.begin(core.count)
    for _ in range(round(seconds * core.setup.options.control_rate)):
        alive = core.episodes["over"] == 0
        core.step(controller(core.observation))
        total += np.where(alive, core.reward, 0.0)
        if core.episodes["over"].all():
            break
    return total


def test_a_cycle_moves_soil_from_the_bank_to_the_truck_and_loses_none():
    core = core_of(2)
    total = run(core, 30.0)
    found = core.measures
    assert (found[:, LOADED] > 0.4).all() and (found[:, LOADS] >= 1).all()
    assert not found[:, FORCE].any() and not found[:, SUCCESS].any()
    balance = found[:, LOADED] + found[:, CARRIED] + found[:, SPILLED]
    assert found[:, REMOVED] == pytest.approx(balance, abs=1e-9)
    # with ends of equal potential, the sum is what the volumes, the energy and the time are worth
    paid = VOLUME_REWARD * found[:, LOADED] - SPILL_COST * found[:, SPILLED] - ENERGY_COST * found[:, ENERGY]
    paid -= TIME_COST * core.episodes["step"] / core.setup.options.control_rate
    assert np.abs(total - paid).max() < VOLUME_REWARD * 0.7 * found[:, CARRIED].max() + 2.0


@pytest.mark.nightly
def test_the_truck_is_filled():
    core = core_of(2)
    run(core, FOREVER)
    assert core.measures[:, SUCCESS].all()


@pytest.mark.parametrize("phase", PHASES[1:])
def test_the_reference_controller_does_every_phase(phase):
    core = core_of(2, phase=phase)
    start = core.terrain[:, 2 * CELL_COUNT + CARRIED_VOLUME].copy()
    total = run(core, FOREVER)
    assert core.measures[:, SUCCESS].all() and (total > 5.0).all()
    assert (start > 0.4).all() == (phase in ("haul", "dump"))
    if phase == "dump":
        assert core.measures[:, LOADED] + core.measures[:, CARRIED] == pytest.approx(start, abs=1e-9)


def test_every_kind_of_action_fills_the_bucket():
    for action in ("valve", "resolved_motion"):
        core = core_of(1, phase="dig", action=action)
        run(core, FOREVER)
        assert core.measures[0, SUCCESS] == 1.0


def test_phases_are_those_of_the_task():
    with pytest.raises(InputError, match="phase 'dum'.*dump"):
        make_task_setup(TASK, Options(variants=1, phase="dum"))
    with pytest.raises(InputError, match="no phases"):
        make_task_setup(TASKS["Grade"], Options(variants=1, phase="dig"))


def test_a_bucket_that_strikes_the_truck_ends_the_episode():
    core = core_of(1, phase="haul")
    for _ in range(400):  # the arm stays as low as it is
        core.step(np.array([1.0, 0.0, 0.0, 0.0]))
        if core.terminated[0]:
            break
    assert core.terminated[0] and core.measures[0, SUCCESS] == 0.0
    assert core.measures[0, FORCE] > 1.0e5 and core.reward[0] < DAMAGE_REWARD
    assert core.episodes["tip"][0, 2] < RAIL_HEIGHT + 1.0


def test_the_ground_beside_the_trench_stops_a_bucket_that_swings_in_it():
    core = core_of(1, phase="dig", duration=60.0)
    core.episodes["goal"][0, BANK_AZIMUTH] = math.atan2(core.episodes["tip"][0, 1], core.episodes["tip"][0, 0])
    free = core_of(1, phase="dig", duration=60.0)
    for step in range(300):  # in the ground, then the swing; the other one only swings
        core.step(np.array([0.0, -1.0, 0.0, 0.0]) if step < 200 else np.array([0.6, 0.0, 0.0, 0.0]))
        free.step(np.array([0.0, 0.0, 0.0, 0.0]) if step < 200 else np.array([0.6, 0.0, 0.0, 0.0]))
    moved = [float(c.episodes["rate"][0, 0]) for c in (core, free)]
    assert core.episodes["tip"][0, 2] < 0.5 and free.episodes["tip"][0, 2] > 1.0
    assert moved[0] < 0.5 * moved[1]


def test_a_new_episode_has_an_empty_truck_and_fresh_ground():
    core = core_of(1, phase="dump")
    fresh = core.terrain.copy()
    run(core, 4.0)
    assert core.terrain.shape[1] == LOAD_TERRAIN_SIZE and (core.terrain != fresh).any()
    core.reset(np.arange(1))
    assert np.array_equal(core.terrain, fresh)


def test_soil_that_misses_the_bed_is_spilled():
    load = np.zeros(LOAD_CELL_COUNT)
    x, y = TRUCK.position
    assert drop_into_bed(NUMBERS, load, x, y, 0.5) == pytest.approx(0.0, abs=1e-12)
    assert loaded_volume(load) == pytest.approx(0.5)
    assert drop_into_bed(NUMBERS, load, x + 0.5 * TRUCK.width, y, 0.5) == pytest.approx(0.25)
    assert drop_into_bed(NUMBERS, load, x, y - 0.6 * TRUCK.length, 0.5) == pytest.approx(0.5)
    assert loaded_volume(load) == pytest.approx(0.75)


def test_the_load_slides_to_repose_and_runs_over():
    load, spilled = np.zeros(LOAD_CELL_COUNT), 0.0
    for _ in range(40):
        spilled += drop_into_bed(NUMBERS, load, *TRUCK.position, 0.5)
        for _ in range(200):
            spilled += level_load(NUMBERS, load)
    steepest = math.tan(SOILS["soft"].repose) * LOAD_CELL_LENGTH
    assert np.abs(np.diff(load)).max() < 1.01 * steepest
    assert loaded_volume(load) + spilled == pytest.approx(20.0)
    struck = TRUCK.length * TRUCK.width * TRUCK.wall_height
    assert 0.9 * struck < loaded_volume(load) < 1.6 * struck
