"""The native loop against the scenario runs' own parts: same physics, same readings, same bits."""

import mujoco
import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.envs.episode import DISABLED
from hydrotele.envs.episode_batch import TaskCore
from hydrotele.envs.task import Options
from hydrotele.envs.task_catalogue import TASKS
from hydrotele.simulate.batch import STATE_KIND
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.simulate.record import start_leapfrog
from hydrotele.simulate.sensor_models import create_feedback
from hydrotele.simulate.stepping import Stepper

TRACK = TASKS["TrackTrajectory"]
LATE = (
    {"name": "command_delay", "location": "boom", "parameters": {"delay": 0.0123}},
    {"name": "command_delay", "location": "swing", "parameters": {"delay": 0.010}},
)
DEFECTS = (
    {"name": "angle_offset", "location": "boom", "parameters": {"offset": 0.01}},
    {"name": "angle_delay", "location": "stick", "parameters": {"delay": 0.0137}},
    {"name": "angle_lag", "location": "swing", "parameters": {"time_constant": 0.03}},
    {"name": "pressure_delay", "location": "boom", "parameters": {"delay": 0.020}},
    {"name": "pressure_lag", "location": "stick", "parameters": {"time_constant": 0.017}},
    {"name": "pressure_offset", "location": "stick.head", "parameters": {"offset": 2.0e5}},
)


def commands(steps: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 3)).astype(np.float32)


def state_of(core: TaskCore, number: int = 0) -> np.ndarray:
    return core.simulations.state[number]


@pytest.mark.parametrize("effects", [(), LATE], ids=["plain", "late"])
def test_a_step_is_that_of_a_scenario_run(effects):
    core = TaskCore(TRACK, Options(control_rate=200.0, effects=effects, variants=1))
    core.reset(np.array([4]))
    machine = core.setup.variants.machines[0]
    plant = build_plant(machine, ground=False)
    position = core.episodes["position"][0]
    names = [machine.axes[name].joint for name in plant.axes]
    data = rest_state(plant, dict(zip(names, position[:3].tolist(), strict=True)))
    start_leapfrog(plant.model, data)
    start = np.zeros(mujoco.mj_stateSize(plant.model, STATE_KIND))
    mujoco.mj_getState(plant.model, data, start, STATE_KIND)
    # the start is computed from aligned positions, which were rounded once on the way
    assert np.allclose(state_of(core), start, rtol=1e-9, atol=1e-9)
    mujoco.mj_setState(plant.model, data, state_of(core), STATE_KIND)
    stepper = Stepper(plant, data, 5)
    for command in commands(200):
        core.step(command)
        stepper.advance(command.astype(float))
    mujoco.mj_getState(plant.model, data, start, STATE_KIND)
    assert np.array_equal(state_of(core), start)


def test_readings_are_those_of_a_scenario_run():
    core = TaskCore(TRACK, Options(control_rate=200.0, effects=DEFECTS, variants=1))
    core.reset(np.array([4]))
    plant = build_plant(core.setup.variants.machines[0], ground=False)
    data = mujoco.MjData(plant.model)
    mujoco.mj_setState(plant.model, data, state_of(core), STATE_KIND)
    seen, stepper = create_feedback(plant, None, 0, 300, 200.0), Stepper(plant, data, 5)
    seen.update(0, stepper)
    for tick, command in enumerate(commands(200)):
        e = core.episodes[0]
        for own, theirs in (("joint", seen.joint), ("head", seen.head), ("rod", seen.rod)):
            assert np.array_equal(e[own][:3], theirs)
        assert np.array_equal(e["supply"][: len(seen.supply)], seen.supply)
        core.step(command)
        stepper.advance(command.astype(float))
        seen.update(tick + 1, stepper)


def test_real_sensors_err_within_their_accuracy_and_are_held():
    core = TaskCore(TRACK, Options(control_rate=200.0, sensors="real", variants=1))
    core.reset(np.array([4]))
    sensor = core.setup.machine.sensors["khoshzaban1992"].angle
    assert sensor.span and sensor.bits
    bound = sensor.accuracy + 0.5 * sensor.span / 2**sensor.bits
    errors, changes = [], 0
    for tick, command in enumerate(commands(400)):
        before = core.episodes["joint"][0].copy()
        core.step(command)
        e = core.episodes[0]
        if (tick + 1) % 4 == 0:
            errors.append(e["joint"][:3] - e["position"][:3])
            changes += not np.array_equal(e["joint"], before)
        else:
            assert np.array_equal(e["joint"], before)
    assert np.abs(errors).max() <= bound * (1.0 + 1e-9)
    # uniform errors of 300 readings come within a tenth of their bound all but surely
    assert np.abs(errors).max() > 0.9 * sensor.accuracy
    assert changes == 100


def test_threads_and_company_change_no_bit():
    noisy = Options(action="joint_rate", sensors="real", duration=0.3)
    cores = [TaskCore(TRACK, noisy, count, threads) for count, threads in ((7, 1), (7, 2))]
    alone = [TaskCore(TRACK, noisy) for _ in range(7)]
    for core in cores:
        core.reset(np.arange(7))
    for number, core in enumerate(alone):
        core.reset(np.array([number]))
    for action in np.random.default_rng(0).uniform(-1, 1, (40, 7, 3)).astype(np.float32):
        for core in cores:
            core.step(action)
        for number, core in enumerate(alone):
            core.step(action[number])
        for name in ("observation", "reward", "terminated", "truncated"):
            first = getattr(cores[0], name)
            assert np.array_equal(first, getattr(cores[1], name))
            assert np.array_equal(first, np.concatenate([getattr(c, name) for c in alone]))
    assert (cores[0].episodes["episode"] == 3).all()


def test_an_episode_that_is_over_stands_still_without_autoreset():
    core = TaskCore(TRACK, Options(duration=0.04), 1, 1, DISABLED)
    core.reset(np.array([1]))
    core.step(np.zeros(3))
    core.step(np.zeros(3))
    assert core.truncated[0]
    before = state_of(core).copy()
    core.step(np.ones(3))
    assert np.array_equal(state_of(core), before)


RANGES = (
    {"name": "valve_deadband", "location": "boom", "parameters": {"deadband": [0.02, 0.08]}},
    {"name": "payload", "location": "tool", "parameters": {"mass": [0.0, 800.0]}},
    {"name": "link_length", "location": "stick", "parameters": {"length": [-0.05, 0.05]}},
    {"name": "base_tilt", "location": "base", "parameters": {"roll": [-0.05, 0.05],
                                                            "pitch": [0.0, 0.0]}},
)  # fmt: skip


def test_every_variant_behaves_as_its_own_machine():
    core = TaskCore(TRACK, Options(randomise=RANGES, variants=4), 6)
    core.reset(np.arange(6))
    chosen = core.episodes["variant"].copy()
    starts = core.simulations.state.copy()
    assert len(set(chosen.tolist())) > 1
    machines = core.setup.variants.machines
    assert len({machine.axes["boom"].valve.deadband for machine in machines}) == 4
    actions = commands(20)
    for action in actions:
        core.step(np.tile(action, (6, 1)))
    for number, variant in enumerate(chosen):
        plant = build_plant(machines[variant], ground=False)
        data = mujoco.MjData(plant.model)
        mujoco.mj_setState(plant.model, data, starts[number], STATE_KIND)
        for action in actions:
            data.ctrl[:] = action
            mujoco.mj_step(plant.model, data, nstep=20)
        state = np.zeros_like(starts[number])
        mujoco.mj_getState(plant.model, data, state, STATE_KIND)
        assert np.array_equal(core.simulations.state[number], state)


def test_the_first_reading_of_an_episode_is_of_its_own_machine():
    ranges = ({"name": "relief_pressure", "parameters": {"relief_pressure": [15e6, 30e6]}},)
    core = TaskCore(TRACK, Options(randomise=ranges, variants=5, duration=0.04), 3)
    core.reset(np.arange(3))
    seen = set()
    for _ in range(10):
        fresh = core.episodes["step"] == 0
        for e in core.episodes[fresh]:
            # valves are closed, so that the pump's flow goes over its relief valve
            machine = core.setup.variants.machines[e["variant"]]
            assert e["supply"][0] == pytest.approx(machine.supply.relief_pressure, rel=1e-9)
            seen.add(int(e["variant"]))
        core.step(np.zeros((3, 3)))
    assert len(seen) > 2


def test_variants_stand_still_under_their_own_load():
    core = TaskCore(TRACK, Options(randomise=RANGES, variants=4), 8)
    core.reset(np.arange(8))
    start = core.episodes["position"].copy()
    for _ in range(25):
        core.step(np.zeros((8, 3)))
    # leakage of 2e-12 m^3/(s Pa) at 10 MPa moves the boom's piston by 0.5 mm in half a second, on
    # an arm of 0.35 m; a payload that the chambers do not hold would give 7 mrad by compression
    assert np.abs(core.episodes["position"] - start).max() < 1.5e-3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (Options(action="torque"), "valve"),  # pyright: ignore - a wrong name on purpose
        (Options(sensors="none"), "khoshzaban1992"),
        (Options(control_rate=300.0), "whole physics steps"),
        (Options(control_rate=float("nan")), "Hz"),
        (Options(duration=0.001), "shorter than one step"),
        (Options(variants=0), "variants: must be a whole number from 1 to 10000, not 0"),
        (Options(effects=({"name": "payload", "mass": 3},)), "parameters"),
        (Options(effects=({"name": "pay_load"},)), "payload"),
        (Options(randomise=({"name": "payload", "parameters": {"mass": 3.0}},)), "range"),
        (Options(randomise=({"name": "payload", "parameters": {"mass": [3.0, 1.0]}},)), "range"),
        (Options(randomise=({"name": "payload", "parameters": {"mass": [0, 9e9]}},)), "outside"),
    ],
)
def test_what_cannot_be_is_refused_in_words(options, words):
    with pytest.raises(InputError, match=words):
        TaskCore(TRACK, options)


def test_an_action_that_is_no_number_is_refused():
    core = TaskCore(TRACK, Options(variants=1))
    with pytest.raises(RuntimeError, match="seeds"):
        core.reset()
    with pytest.raises(RuntimeError, match="reset before"):
        core.step(np.zeros(3))
    core.reset(np.array([0]))
    with pytest.raises(ValueError, match="finite"):
        core.step(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ValueError, match="shape|broadcast"):
        core.step(np.zeros(4))


def test_a_closed_task_says_so():
    core = TaskCore(TRACK, Options(variants=1))
    core.reset(np.array([0]))
    core.close()
    core.close()
    with pytest.raises(RuntimeError, match="closed"):
        core.step(np.zeros(3))
    with pytest.raises(RuntimeError, match="closed"):
        core.reset()
