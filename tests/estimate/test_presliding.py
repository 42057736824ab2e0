"""A drive on the bristles of its friction, in time: against scipy, against the plant, stiff."""

import json

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hydrotele.effects import apply_effect, with_value
from hydrotele.estimate.reduced_model import predicted_channels, simulate_rows, state_names
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.replay import replay_log
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.plant import build_plant, rest_state

PERIOD, ROWS = 0.005, 400
BREAKAWAY, VISCOUS, MASS, GAIN, OFFSET = 20.39, 203.5, 95.11, 35.150651882, -3.165  # EMPS
STIFFNESS, DAMPING = 4.0e5, 2.0e3  # N/m, N s/m: breaks away after some 50 um


def emps(stiffness=STIFFNESS, damping=DAMPING):
    machine = load_machine("emps")
    for name, value in (("stiffness", stiffness), ("damping", damping)):
        machine = with_value(machine, f"axes.slide.force.friction.presliding_{name}", value)
    return machine


def voltages(size):
    """Held voltages whose force swings about zero, `size` newtons high."""
    time = PERIOD * np.arange(ROWS)
    return (OFFSET + size * np.sin(2.0 * np.pi * time)) / GAIN


def integrated(volts):
    """Positions of the EMPS by scipy, row by row."""

    def rate(t, y, push):
        _, v, z = y
        bend = v - STIFFNESS * abs(v) * z / BREAKAWAY
        rubbing = STIFFNESS * z + DAMPING * bend + VISCOUS * v
        return [v, (push - rubbing) / MASS, bend]

    y, out = np.zeros(3), [0.0]
    for u in volts[:-1]:
        push = GAIN * u - OFFSET
        y = solve_ivp(rate, (0.0, PERIOD), y, args=(push,), rtol=1e-9, atol=1e-12).y[:, -1]
        out.append(y[0])
    return np.array(out)


def reduced_positions(reduced_of, machine, volts, steps):
    model, space, z = reduced_of(machine, ("position.slide",))
    out, states = np.zeros((ROWS, 1)), np.zeros((ROWS, len(z)))
    simulate_rows(model, space, z, volts[:, None].copy(), PERIOD, steps, out, states)
    return out[:, 0], states


@pytest.mark.parametrize("size", [12.0, 35.0], ids=["below breakaway", "beyond"])
def test_a_force_drive_moves_as_scipy_says(reduced_of, size):
    """From 12 N the carriage springs back; from 35 N it slides away by millimetres."""
    volts = voltages(size)
    truth = integrated(volts)
    errors = []
    for steps in (5, 10):
        found, states = reduced_positions(reduced_of, emps(), volts, steps)
        errors.append(np.abs(found - truth).max())
        assert np.abs(states[:, -1]).max() <= 1.0 + 1e-9
    assert np.ptp(truth) > (1e-3 if size > BREAKAWAY else 4e-5)
    # 1 ms against 10 ms of a radian on the bristles; of second order but where it turns round
    assert errors[0] < 1e-3 * np.ptp(truth)
    assert errors[1] < 0.5 * errors[0]


def test_the_plant_moves_as_scipy_says():
    """MuJoCo's step at 0.25 ms; rows read at equal times as the logs are."""
    volts, machine = voltages(35.0), emps()
    plant = build_plant(machine, PERIOD / 20, ground=False)
    data, shown = rest_state(plant), []
    for u in volts:
        shown.append(data.qpos[0])
        data.ctrl[:] = u
        mujoco.mj_step(plant.model, data, nstep=20)
    truth = integrated(volts)
    # velocities stand half a step before positions at the start: 1.25e-4 s of 20 mm/s, and friction
    assert np.abs(np.array(shown) - truth).max() < 4e-3 * np.ptp(truth)
    assert plant.extra_states == {"bristle.slide": 0}


def test_stiff_bristles_hold_at_coarse_steps(reduced_of):
    """1e9 N/m at 2.5 ms: below breakaway nothing moves, beyond it slides as without bristles."""
    for size in (15.0, 60.0):
        volts = voltages(size)
        hard, _ = reduced_positions(reduced_of, emps(1e9, 0.0), volts, 2)
        machine = emps(1e9, 0.0)
        plant = build_plant(machine, PERIOD / 2, ground=False)
        data, shown = rest_state(plant), []
        for u in volts:
            shown.append(data.qpos[0])
            data.ctrl[:] = u
            mujoco.mj_step(plant.model, data, nstep=2)
        if size < BREAKAWAY:
            # it gives by force over the stiffness that this step can follow, 8e6 N/m
            assert max(np.abs(hard).max(), np.abs(shown).max()) < 4.0 * size / 7.6e6
        else:
            fine, _ = reduced_positions(reduced_of, machine, volts, 40)
            plain, _ = reduced_positions(reduced_of, load_machine("emps"), volts, 40)
            for found in (hard, np.array(shown)):
                assert np.abs(found - fine).max() < 0.015 * np.ptp(fine)  # half a step: 1.25 ms
            # without bristles friction falls off below the smoothing velocity of 1 mm/s
            assert np.abs(fine - plain).max() < 0.03 * np.ptp(plain)


def scenario(name, commands, effects, steps):
    """A machine driven open loop by held commands."""
    time = PERIOD * np.arange(ROWS)
    pilot = {"kind": "table", "quantity": "command", "interpolate": "hold", "time": time.tolist(),
             "columns": {"slide": commands.tolist()}}  # fmt: skip
    return Scenario(
        name="t", machine=name, control_rate=1 / PERIOD, log_rate=1 / PERIOD, ground=False,
        duration=ROWS * PERIOD, timestep=PERIOD / steps, pilot=pilot,
        effects=[dict(zip(("name", "location", "parameters"), e, strict=True)) for e in effects],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "effects"),
    [
        ("rig", (("presliding", "slide", {"compliance": 4e-7}),)),
        ("rig", (("pump_lag", "supply", {"time_constant": 0.1}),)),
        ("rig", (("presliding", "slide", {"compliance": 4e-7}),
                 ("pump_lag", "supply", {"time_constant": 0.1}))),
        ("emps", (("presliding", "slide", {"compliance": 2.5e-6}),)),
    ],
)  # fmt: skip
def test_open_loop_the_plant_and_the_reduced_model_are_one(reduced_of, name, effects):
    """The plant at a quarter of the reduced model's step, as its error is of first order."""
    time = PERIOD * np.arange(ROWS)
    wave = np.sin(2.0 * np.pi * 1.5 * time) * np.where(time > 0.05, 1.0, 0.0)
    commands = voltages(0.0) + 1.2 * wave if name == "emps" else 0.5 * wave
    run = run_scenario(scenario(name, commands, effects, 40))
    machine = load_machine(name)
    for effect in effects:
        machine = apply_effect(machine, *effect)
    start = json.loads(run.truth.metadata["initial_state"])
    shown = {}
    for facts in (machine, load_machine(name)):
        channels = predicted_channels(facts)
        model, space, z = reduced_of(facts, channels)
        keys = {"position": "angle", "rate": "velocity"}
        for s, state in enumerate(state_names(facts)):
            kind, _, owner = state.partition(".")
            given = start[keys.get(kind, kind)]
            z[s] = given[owner] if isinstance(given, dict) else given[0]
        out, states = np.zeros((ROWS, len(channels))), np.zeros((ROWS, len(z)))
        held = np.ascontiguousarray(run.truth["command.slide"][:, None])
        simulate_rows(model, space, z, held, PERIOD, 10, out, states)
        shown[facts is machine] = {c: out[:, k] for k, c in enumerate(channels)}
        if facts is machine:
            for s, state in enumerate(state_names(facts)):
                if state.startswith(("bristle", "delivery")):
                    truth = "delivery" if state.startswith("delivery") else state
                    kept = run.truth[f"truth.{truth}"]
                    assert np.ptp(kept) > 0.3, "it has something to remember"
                    assert np.median(np.abs(states[:, s] - kept)) < 0.01
    channels = [c for c in shown[True] if np.ptp(run.truth[c]) > 0.0]
    with_it, without = (
        {c: np.abs(shown[which][c] - run.truth[c]) / np.ptp(run.truth[c]) for c in channels} for which in (True, False)
    )
    for c in channels:  # of second order: a quarter of it at half the step, see the other tests
        assert with_it[c].max() < 4e-3 and np.sqrt(np.mean(with_it[c] ** 2)) < 5e-4, c
    assert max(e.max() for e in without.values()) > 5 * max(e.max() for e in with_it.values())


def test_a_replay_of_a_run_begins_with_what_it_remembered():
    """Started anew from a log's initial state, the plant repeats the run."""
    effects = (("presliding", "slide", {"compliance": 4e-7}),
               ("pump_lag", "supply", {"time_constant": 0.1}))  # fmt: skip
    commands = 0.5 * np.sign(np.sin(2.0 * np.pi * PERIOD * np.arange(ROWS)))
    run = run_scenario(scenario("rig", commands, effects, 5))
    state = json.loads(run.truth.metadata["initial_state"])
    assert state["bristle"] == {"slide": 0.0} and state["delivery"] == {"supply": 0.0}
    again = replay_log(run.truth, run.plant.machine, PERIOD / 5)
    for channel, difference in again.channels.items():
        assert difference.max < 1e-9 * max(difference.range, 1e-3), channel  # rounding


def test_the_exported_mjcf_steps_like_the_plant():
    machine = apply_effect(load_machine("rig"), "presliding", "slide", {"compliance": 4e-7})
    plant = build_plant(machine, 1e-3, ground=False)
    exported = mujoco.MjModel.from_xml_string(plant.mjcf)
    assert np.array_equal(exported.actuator_user, plant.model.actuator_user)
    assert exported.na == plant.model.na == 5
