"""Replay of the nominal runs of an independent simulator: open loop, 40 s, four runs."""

import functools
import json

import mujoco
import numpy as np
import pytest

from hydrotele.logs.log import load_log
from hydrotele.simulate.plant import initial_state
from tests.measured import TRUTH

RUNS = ("fit_1", "fit_2", "fit_3", "test_1")
RELIEF = 28.0e6


@pytest.fixture(scope="module")
def replayed(plant_of):
    """RMS errors of a replay: (angles [deg], pressures of 28 MPa [1], lengths [m])."""

    @functools.cache
    def replay(run, timestep):
        log, plant = load_log(TRUTH / f"{run}.parquet"), plant_of("none", timestep)
        data = initial_state(plant, json.loads(log.metadata["initial_state"]))
        commands = np.column_stack([log[f"command.{axis}"] for axis in plant.axes])
        angles, pressures, lengths = [], [], []
        for command in commands:  # row k: state at t_k, command held over [t_k, t_k + 20 ms)
            angles.append(data.qpos[plant.qpos])
            lengths.append(data.qpos[plant.rod_qpos[1:]])
            pressures.append(data.act.reshape(-1, 4)[:, 2:].ravel())
            data.ctrl[:] = command
            mujoco.mj_step(plant.model, data, nstep=round(0.02 / timestep))
        names = [f"pressure_{s}.{a}" for a in plant.axes for s in ("head", "rod")]
        true = [[f"angle.{a}" for a in plant.axes], names, ["length.boom", "length.stick"]]
        rms = [
            np.sqrt(np.mean((np.array(got) - np.column_stack([log[c] for c in want])) ** 2, axis=0))
            for got, want in zip((angles, pressures, lengths), true, strict=True)
        ]
        return np.degrees(rms[0]), rms[1] / RELIEF, rms[2]

    return replay


@pytest.mark.parametrize("run", RUNS)
def test_replay_at_1_ms_stays_with_the_independent_simulator(replayed, run):
    angles, pressures, lengths = replayed(run, 1e-3)
    # what a first-order step of 1 ms may cost over 40 s in open loop: a third of the resolver's
    # 0.1 deg, a fourth of the pressure sensors' 25 psi (0.6 %), a fourth of the length's 2 mm
    assert angles.max() < 0.03
    assert pressures.max() < 1.5e-3
    assert lengths.max() < 0.5e-3
    assert angles.min() > 0, "a replay that reads the log back would prove nothing"


@pytest.mark.nightly
def test_replay_converges_with_first_order(replayed):
    errors = [np.linalg.norm(replayed("test_1", dt)[0]) for dt in (1e-3, 5e-4, 2.5e-4)]
    ratios = np.array(errors[1:]) / errors[:-1]
    # semi-implicit Euler: one half per halving; the reference itself is good to 1e-6
    assert np.all((ratios > 0.4) & (ratios < 0.6)), errors


def test_initial_state_is_that_of_the_log(plant_of):
    log, plant = load_log(TRUTH / "fit_3.parquet"), plant_of("none")
    data = initial_state(plant, json.loads(log.metadata["initial_state"]))
    mujoco.mj_forward(plant.model, data)
    for i, axis in enumerate(plant.axes):
        assert data.qpos[plant.qpos[i]] == log[f"angle.{axis}"][0]
        assert data.qvel[plant.dof[i]] == log[f"truth.velocity.{axis}"][0]
        # the force is that of the pressures one step ahead: some Pa on 200 cm2 while it creeps
        assert data.actuator_force[i] == pytest.approx(log[f"truth.force.{axis}"][0], abs=100)
    for i, axis in enumerate(("boom", "stick"), start=1):
        # 1e-9 m: closed to 1e-12 m here, by another program there
        assert data.qpos[plant.rod_qpos[i]] == pytest.approx(log[f"length.{axis}"][0], abs=1e-9)
