"""The callbacks inside MuJoCo: the same numbers as the pure functions, on every way of stepping."""

import subprocess
import sys
import threading

import mujoco
import numpy as np
import pytest
from mujoco import rollout
from mujoco.batch import Batch

from hydrotele.hydraulics.circuit import (
    ACTIVATIONS_PER_AXIS,
    NO_EXTRA_STATES,
    SLOT_COUNT,
    Slot,
    actuator_friction,
    circuit_scratch,
    step_circuit,
)
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.actuator_callbacks import install_hydraulics
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import NO_TERMS

HOLD = 20  # steps of one command


def commands(plant, runs, holds, seed=0):
    """Random commands (runs, holds, nu)."""
    return np.random.default_rng(seed).uniform(-1, 1, (runs, holds, plant.model.nu))


@pytest.mark.parametrize("tool", ["none", "bucket", "grapple"])
def test_step_is_the_pure_circuit_bit_for_bit(plant_of, tool):
    plant = plant_of(tool)
    model, data = plant.model, rest_state(plant)
    user, scratch = model.actuator_user.ravel(), circuit_scratch()
    rate, dt = np.zeros(model.na), model.opt.timestep
    for hold in commands(plant, 1, 25)[0]:
        data.ctrl[:] = hold
        for _ in range(HOLD):
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            act, velocity = data.act.copy(), data.actuator_velocity.copy()
            drives = Drives(plant.hydraulic, act, data.actuator_length, velocity, data.ctrl)
            step_circuit(user, 0, drives, dt, rate, scratch, NO_TERMS, 0.0, NO_EXTRA_STATES)
            mujoco.mj_step(model, data)
            assert np.array_equal(data.act, act + dt * rate)
            ends = (act + dt * rate).reshape(-1, ACTIVATIONS_PER_AXIS)
            force = [
                user[i * SLOT_COUNT + Slot.AREA_HEAD] * ends[i, 2]
                - user[i * SLOT_COUNT + Slot.AREA_ROD] * ends[i, 3]
                - actuator_friction(user, i * SLOT_COUNT, velocity[i])
                for i in range(plant.hydraulic)
            ]
            assert np.array_equal(data.actuator_force, force)
    assert np.abs(data.act).reshape(-1, 4)[:, 0].max() > 0.1, "the spools have moved"


def stepped(plant, controls):
    finals = []
    for run in controls:
        data = rest_state(plant)
        for hold in run:
            data.ctrl[:] = hold
            mujoco.mj_step(plant.model, data, nstep=HOLD)
        finals.append(np.concatenate([[data.time], data.qpos, data.qvel, data.act]))
    return np.array(finals)


def rolled_out(plant, controls, threads):
    start = rest_state(plant)
    spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(plant.model, spec))
    mujoco.mj_getState(plant.model, start, state, spec)
    states, _ = rollout.rollout(
        plant.model,
        [mujoco.MjData(plant.model) for _ in range(threads)],
        np.tile(state, (len(controls), 1)),
        np.repeat(controls, HOLD, axis=1),
    )
    return states[:, -1, : 1 + plant.model.nq + plant.model.nv + plant.model.na]


def batched(plant, controls, threads):
    start = rest_state(plant)
    batch = Batch(plant.model, len(controls), nthread=threads)
    batch.qpos[:], batch.act[:] = start.qpos, start.act
    for k in range(controls.shape[1]):
        batch.ctrl[:] = controls[:, k]
        batch.step(nstep=HOLD)
    return np.concatenate([batch.time[:, None], batch.qpos, batch.qvel, batch.act], axis=1)


@pytest.mark.daily("none")
@pytest.mark.parametrize("tool", ["none", "bucket"])
def test_every_way_of_stepping_gives_the_same_bits(plant_of, tool):
    plant = plant_of(tool, ground=True)
    controls = commands(plant, 64, 10)
    truth = stepped(plant, controls)
    assert np.ptp(truth[:, 1], axis=0) > 1e-3, "the runs differ from one another"
    for threads in (1, 2):
        assert np.array_equal(rolled_out(plant, controls, threads), truth)
        assert np.array_equal(batched(plant, controls, threads), truth)


def test_threads_with_different_machines_do_not_disturb_each_other(plant_of):
    plants = [plant_of("none"), plant_of("bucket"), plant_of("none"), plant_of("bucket")]
    controls = [commands(plant, 1, 60, seed) for seed, plant in enumerate(plants)]
    alone = [stepped(plant, c) for plant, c in zip(plants, controls, strict=True)]
    together, barrier = [None] * len(plants), threading.Barrier(len(plants))

    def work(i):
        barrier.wait()
        together[i] = stepped(plants[i], controls[i])

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(plants))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, result in enumerate(together):
        assert np.array_equal(result, alone[i])


def test_parameters_are_read_from_the_model_at_every_step(plant_of):
    plant = plant_of("none")
    model, results = plant.model.__copy__(), []
    for relief in (28.0e6, 5.0e6):
        model.actuator_user[:, Slot.RELIEF_PRESSURE] = relief
        data = rest_state(plant)
        data.ctrl[:] = 0, 1, 0
        mujoco.mj_step(model, data, nstep=500)
        results.append(data.qvel[plant.dof[1]])
    assert results[0] > 0.1 > results[1], "5 MPa do not lift the boom"


def test_installing_again_changes_nothing():
    install_hydraulics()
    before = mujoco.get_mjcb_act_dyn(), mujoco.get_mjcb_act_bias()
    install_hydraulics()
    assert (mujoco.get_mjcb_act_dyn(), mujoco.get_mjcb_act_bias()) == before
    assert None not in before


FOREIGN = """
import mujoco, numpy as np
# the numbers of a cylinder, all but the marker: only the marker keeps the callbacks off
USER = (1, 1, 2, 1, 0.02, 0.01, 4e-3, 4e-3, 1, 2e-12, 50, 0.9, 0.04, 2e-6, 5e4, 32e6, 1e-9, 5e-9,
        9e8, 3e5, 28e6, 5e-3, 3000, 1500, 0.02, 6000, 0.005)
XML = '''<mujoco><size nuser_actuator="{nuser}"/><worldbody><body><joint name="a"/>
<geom size="0.1" pos="0.3 0 0"/><body pos="0.6 0 0"><joint name="b" axis="0 1 0"/>
<geom size="0.1" pos="0.3 0 0"/></body></body></worldbody><actuator>
<muscle joint="a" lengthrange="0 1"/>
<general joint="b" dyntype="filter" dynprm="0.1" gainprm="3" biastype="affine" biasprm="1 -2 -1"/>
<general joint="a" dyntype="user" actdim="4" biastype="user" gainprm="2" user="{user}"/>
<general joint="b" dyntype="integrator" biastype="none"/></actuator></mujoco>'''

def run(nuser):
    user = ' '.join(map(str, USER[:nuser]))
    text = XML.replace('{nuser}', str(nuser)).replace('{user}', user)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.act[:] = 0.1 * np.arange(model.na)
    for k in range(500):
        data.ctrl[:] = np.sin(0.05 * k + np.arange(model.nu))
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel, data.act, data.actuator_force])

before = [run(n) for n in (3, 5, 32)]
from hydrotele.simulate.actuator_callbacks import install_hydraulics
install_hydraulics()
after = [run(n) for n in (3, 5, 32)]
assert np.abs(before).max() > 0.5
assert all(np.array_equal(a, b) for a, b in zip(before, after)), (before, after)
print("identical")
"""

TAKEN = """
import mujoco
from hydrotele.simulate.actuator_callbacks import install_hydraulics
for take in (mujoco.set_mjcb_act_dyn, mujoco.set_mjcb_act_bias):
    take(lambda m, d, i: 0.0)
    try:
        install_hydraulics()
    except RuntimeError as error:
        print("refused:", error)
    take(None)
"""


def in_a_process_of_its_own(text, *words):
    result = subprocess.run(
        [sys.executable, "-c", text, *words],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.nightly
def test_models_of_others_are_left_alone():
    assert "identical" in in_a_process_of_its_own(FOREIGN)


@pytest.mark.nightly
def test_callbacks_of_others_are_not_replaced():
    """One after the other in one process: that of activations, that of forces."""
    said = in_a_process_of_its_own(TAKEN)
    assert said.count("refused: another package has installed") == 2
    assert said.count("process of its own") == 2, "says what to do"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["cat215", "emps", "eha", "ec20"])
def test_a_command_that_is_no_number_counts_as_mujoco_counts_it(name):
    """One NaN makes all commands 0, with a warning; an infinite one is at its end."""
    plant = build_plant(load_machine(name))

    def reached(command):
        data = rest_state(plant)
        for _ in range(50):
            data.ctrl[:] = command
            mujoco.mj_step(plant.model, data)
        warned = data.warning[mujoco.mjtWarning.mjWARN_BADCTRL].number
        return np.concatenate([data.qpos, data.qvel, data.act]), warned

    half = np.full(plant.model.nu, 0.5)
    broken, endless, most = half.copy(), half.copy(), half.copy()
    broken[-1], endless[-1], most[-1] = np.nan, np.inf, plant.model.actuator_ctrlrange[-1, 1]
    still, told = reached(0.0 * half)[0], reached(broken)
    assert np.array_equal(told[0], still) and told[1] > 0
    np.testing.assert_array_equal(reached(endless)[0], reached(most)[0])
    assert not np.array_equal(reached(half)[0], still)


WRITTEN_OVER = """
import sys, mujoco, numpy as np
from hydrotele.hydraulics.circuit import Slot
from hydrotele.machine.machine_file import load_machine
from hydrotele.simulate.plant import build_plant, rest_state
random = np.random.default_rng(0)
INDICES = [Slot.FIRST, Slot.COUNT, Slot.EXTRA_STATES, Slot.BRISTLE, Slot.DELIVERY, Slot.CURVES]
SWITCHES = [Slot.BRISTLE_STIFFNESS, Slot.PUMP_TIME_CONSTANT, Slot.KIND, Slot.DRIVE_INERTIA]
for name in ("cat215", "emps", "rig"):
    plant = build_plant(load_machine(name))
    for trial in range(int(sys.argv[1])):
        model, data = plant.model.__copy__(), rest_state(plant)
        for slot in random.choice(INDICES, 2):
            model.actuator_user[:, slot] = random.choice([np.nan, -1e8, 1e8, 3.7, 2.0**31, 1e18])
        model.actuator_user[:, random.choice(SWITCHES)] = random.choice([1.0, 3.0, np.nan])
        data.ctrl[:] = random.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data, nstep=3)
print("alive")
"""


@pytest.mark.nightly
@pytest.mark.parametrize("trials", [50, pytest.param(500, marks=pytest.mark.nightly)])
def test_numbers_that_are_written_over_index_nothing_that_is_not_there(trials):
    assert "alive" in in_a_process_of_its_own(WRITTEN_OVER, str(trials))
