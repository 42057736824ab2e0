"""Delays shift exactly; sensors that are off or late are so for the log, controller and replay."""

import json

import numpy as np
import pytest
from scipy.signal import lsim, lti

from hydrotele.effects import apply_effect
from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.replay import replay_log
from hydrotele.run.run import prepare_run, run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.simulate.plant import build_plant, rest_state
from hydrotele.simulate.record import Recorder, split_delay, start_leapfrog
from hydrotele.simulate.stepping import Stepper
from hydrotele.simulate.true_values import delayed_channels, true_channels


def planted(*effects):
    return [dict(zip(("name", "location", "parameters"), e, strict=True)) for e in effects]


def scenario(*effects, machine="cat215", rate=50, log_rate=50, duration=1.0, **more):
    """All axes driven by held sines."""
    axes = {"cat215": ("swing", "boom", "stick"), "emps": ("slide",), "rig": ("slide",)}[machine]
    time = (np.arange(round(50 * duration)) / 50.0).tolist()
    columns = {a: (0.1 + 0.5 * np.sin(6.0 * np.array(time) + i)).tolist() for i, a in enumerate(axes)}
    pilot = {
        "kind": "table",
        "quantity": "command",
        "interpolate": "hold",
        "time": time,
        "columns": columns,
    }
    keys = {
        "name": "t",
        "machine": machine,
        "control_rate": rate,
        "log_rate": log_rate,
        "duration": duration,
        "ground": False,
        "pilot": pilot,
        "effects": planted(*effects),
    }
    return Scenario(**(keys | more))  # fmt: skip


@pytest.mark.daily("0.02-all", "0.047-boom")
@pytest.mark.parametrize(("delay", "place"), [(0.02, "all"), (0.047, "boom"), (0.1305, "boom")])
def test_a_delayed_command_shifts_the_spool(delay, place):
    """Spools know nothing of the load, so that the whole response is shifted.

    Between two steps the command acts as its mean over the step, which shifts the spool's response
    by the exact delay but for the curvature of a response of 50 rad/s over 1 ms: 2e-3.
    """
    fine = {"rate": 1000, "log_rate": 1000}
    late = run_scenario(scenario(("command_delay", place, {"delay": delay}), **fine)).truth
    prompt = run_scenario(scenario(**fine)).truth
    for axis in ("swing", "boom", "stick"):
        shift = delay if place in ("all", axis) else 0.0
        wanted = np.interp(prompt.time - shift, prompt.time, prompt[f"truth.spool.{axis}"])
        wanted[prompt.time < shift] = 0.0
        exact = abs(shift * 1000 - round(shift * 1000)) < 1e-9
        np.testing.assert_allclose(late[f"truth.spool.{axis}"], wanted, atol=1e-12 if exact else 2e-3)
        assert np.array_equal(late[f"command.{axis}"], prompt[f"command.{axis}"])


def test_a_delayed_force_shifts_the_whole_motion():
    """EMPS holds still at rest, so that all of its motion comes later by as many rows."""
    fine = {"machine": "emps", "rate": 1000, "log_rate": 1000}
    late = run_scenario(scenario(("command_delay", "slide", {"delay": 0.013}), **fine)).truth
    prompt = run_scenario(scenario(**fine)).truth
    np.testing.assert_allclose(late["position.slide"][13:], prompt["position.slide"][:-13], atol=1e-12)
    assert np.ptp(prompt["position.slide"]) > 1e-3


def test_delay_at_all_keeps_what_differs():
    machine = apply_effect(load_machine("cat215"), "command_delay", "boom", {"delay": 0.05})
    later = apply_effect(machine, "command_delay", "all", {"delay": 0.02})
    assert {n: a.command_delay for n, a in later.axes.items()} == pytest.approx(
        {"swing": 0.02, "boom": 0.07, "stick": 0.02}
    )


@pytest.mark.parametrize("delay", [0.013, 0.0301])
def test_books_and_replay_of_a_delayed_run(delay):
    """The audit and a replay from the initial state see the same late commands, bit for bit.

    The books close as well as those of the run without delay, whose valves jump just as often.
    """
    run = run_scenario(scenario(("command_delay", "all", {"delay": delay})))
    prompt = run_scenario(scenario()).summary["balance"]
    for book, found in run.summary["balance"].items():
        assert found <= 2.0 * prompt[book]
    replay = replay_log(run.truth, run.plant.machine)
    for channel in ("angle.boom", "pressure_head.swing", "length.stick"):
        np.testing.assert_allclose(replay.simulated[channel], run.truth[channel], rtol=1e-12)


@pytest.mark.parametrize("timestep", [1e-3, 5e-4, 1e-3 / 3])
def test_a_whole_number_of_steps_is_one(timestep):
    for steps in range(1, 400):
        assert split_delay(steps * timestep, timestep) == (steps, 0.0)
    assert split_delay(3.25 * timestep, timestep) == (3, pytest.approx(0.25))


DEFECTS = [
    ("angle_offset", "boom", {"offset": 0.02}),
    ("angle_scale", "boom", {"ratio": 1.01}),
    ("angle_delay", "swing", {"delay": 0.013}),
    ("length_offset", "stick", {"offset": -0.004}),
    ("pressure_offset", "boom.head", {"offset": 60e3}),
    ("pressure_delay", "stick", {"delay": 0.0275}),
    ("pressure_lag", "swing", {"time_constant": 0.017}),
    ("angle_lag", "stick", {"time_constant": 0.03}),
    ("pressure_scale", "boom.rod", {"ratio": 0.98}),
]


def test_the_log_shows_the_defects_and_the_truth_does_not():
    """A delay of 13 ms is exact to the step, one of 27.5 ms linear within it: 1e-6 of 28 MPa."""
    run = run_scenario(scenario(*DEFECTS, duration=2.0))
    fine = run_scenario(scenario(*DEFECTS, duration=2.0, log_rate=1000, rate=1000)).truth
    truth, seen = run.truth, run.measured
    plain = run_scenario(scenario(duration=2.0)).truth
    assert all(np.array_equal(plain[c], truth[c]) for c in plain.columns)

    def late(channel, lag):
        return np.interp(truth.time - lag, fine.time, fine[channel])

    np.testing.assert_allclose(seen["angle.boom"], 1.01 * truth["angle.boom"] + 0.02, rtol=1e-14)
    np.testing.assert_allclose(seen["length.stick"], truth["length.stick"] - 0.004, rtol=1e-14)
    head = truth["pressure_head.boom"] + 60e3
    np.testing.assert_allclose(seen["pressure_head.boom"], head, rtol=1e-14)
    np.testing.assert_allclose(seen["angle.swing"], late("angle.swing", 0.013), atol=1e-12)
    for channel in ("pressure_head.stick", "pressure_rod.stick"):
        np.testing.assert_allclose(seen[channel], late(channel, 0.0275), atol=28.0)
    np.testing.assert_allclose(seen["pressure_rod.boom"], 0.98 * truth["pressure_rod.boom"], rtol=1e-14)
    for channel in ("length.boom", "pressure_supply"):
        assert np.array_equal(seen[channel], truth[channel])


def lagged(values, time, constant):
    """First-order lag of densely sampled values, by SciPy; at rest before the first."""
    system = lti([1.0], [constant, 1.0])
    return values[0] + lsim(system, values - values[0], time)[1]


def test_a_lag_filters_what_the_log_shows():
    """SciPy's simulation of `1 / (T s + 1)` gives the readings, also behind a delay.

    Both run straight between the steps of 1 ms, so that only rounding differs.
    """
    effects = [
        ("pressure_lag", "swing", {"time_constant": 0.017}),
        ("angle_lag", "stick", {"time_constant": 0.03}),
        ("pressure_lag", "stick", {"time_constant": 0.002}),
        ("pressure_delay", "stick", {"delay": 0.012}),
    ]
    run = run_scenario(scenario(*effects, duration=2.0, log_rate=1000, rate=1000))
    truth, seen = run.truth, run.measured
    for channel, constant in (
        ("pressure_head.swing", 0.017), ("pressure_rod.swing", 0.017), ("angle.stick", 0.03),
    ):  # fmt: skip
        wanted = lagged(truth[channel], truth.time, constant)
        np.testing.assert_allclose(seen[channel], wanted, rtol=1e-9, atol=1e-9)
        assert np.abs(seen[channel] - truth[channel]).max() > 0.01 * np.ptp(truth[channel])
    wanted = lagged(truth["pressure_rod.stick"], truth.time, 0.002)
    np.testing.assert_allclose(seen["pressure_rod.stick"][12:], wanted[:-12], rtol=1e-9)
    assert np.array_equal(seen["angle.boom"], truth["angle.boom"])


def test_a_clock_offset_shifts_a_whole_group():
    offset = [("clock_offset", "pressures", {"offset": 0.02})]
    run = run_scenario(scenario(*offset, log_rate=1000, rate=1000))
    for channel in run.measured.columns:
        if channel.startswith("pressure"):
            late, true = run.measured[channel][20:], run.truth[channel][:-20]
            np.testing.assert_allclose(late, true, rtol=1e-12)
        else:
            assert np.array_equal(run.measured[channel], run.truth[channel])


def test_the_supply_sensor_can_be_late_too():
    machine = load_machine("cat215")
    supply, old = supply_and_reading(machine, {"delay": 0.1, "offset": 1e5})
    np.testing.assert_allclose(old[5:], supply[:-5], rtol=1e-12)
    assert (old[:5] == supply[0]).all() and np.ptp(supply) > 1e6
    supply, old = supply_and_reading(machine, {"time_constant": 0.05, "delay": 0.02})
    slow = lagged(supply, 1e-3 * np.arange(len(supply)), 0.05)
    np.testing.assert_allclose(old[20:], slow[:-20], rtol=1e-9)


def supply_and_reading(machine, error):
    """Supply pressure and what its sensor shows of it, at every row or every step."""
    steps = 1 if "time_constant" in error else 20
    machine = type(machine).model_validate(machine.model_dump() | {"sensor_errors": {"pressure_supply": error}})
    plant = build_plant(machine, ground=False)
    data = rest_state(plant)
    start_leapfrog(plant.model, data)
    rows = 600 // steps
    stepper, recorder = Stepper(plant, data, steps), Recorder(plant, rows)
    for row in range(rows):
        recorder.record_state(row, 0.02 * row, data, stepper.sensor_values())
        stepper.advance(np.array([0.9, 0.9, 0.9]))
    record = recorder.to_record()
    supply = true_channels(plant, record)[0]["pressure_supply"]
    return supply, delayed_channels(plant, record)["pressure_supply"]


def test_the_controller_sees_what_the_log_shows():
    """Same defects, noise and converter in the fed-back reading and in the log's row."""
    asked = scenario(*DEFECTS, sensors="khoshzaban1992")
    measured = run_scenario(asked).measured
    plant, data, plan, seen, *_ = prepare_run(asked)
    start_leapfrog(plant.model, data)
    stepper = Stepper(plant, data, 20)
    for tick in range(50):
        seen.update(tick, stepper)
        for i, axis in enumerate(plant.axes):
            assert seen.joint[i] == measured[f"angle.{axis}"][tick]
            assert seen.head[i] == measured[f"pressure_head.{axis}"][tick]
            assert seen.rod[i] == measured[f"pressure_rod.{axis}"][tick]
        stepper.advance(plan.command[tick])


def test_a_patched_model_replays_defective_sensors():
    """With ideal noise-free sensors the replay of a measured log is off by nothing."""
    run = run_scenario(scenario(*DEFECTS))
    state = run.truth.metadata["initial_state"]
    log = Log(
        time=run.measured.time, columns=run.measured.columns, units=run.measured.units,
        metadata={**run.measured.metadata, "initial_state": state}, source="test",
    )  # fmt: skip
    assert json.loads(state)["order"] == ["swing", "boom", "stick"]
    replay = replay_log(log, run.plant.machine)
    for channel, difference in replay.channels.items():
        assert difference.max <= 1e-9 * max(1.0, np.abs(log[channel]).max()), channel


def test_a_replay_starts_where_the_angle_truly_is():
    run = run_scenario(scenario(("angle_offset", "boom", {"offset": 0.05})))
    replay = replay_log(run.measured, run.plant.machine)
    assert replay.simulated["angle.boom"][0] == pytest.approx(run.measured["angle.boom"][0])
    assert run.truth["angle.boom"][0] == pytest.approx(0.45, abs=1e-6)
    assert run.measured["angle.boom"][0] == pytest.approx(0.50, abs=1e-6)
