"""Teleoperated runs: every reflection in both modes, energy, faults, lost packets, bad input."""

import json
import re

import numpy as np
import pytest

from hydrotele.cli.run_command import run_to_folder
from hydrotele.core.errors import InputError
from hydrotele.logs.log import load_log, save_log
from hydrotele.machine.joystick import load_joystick
from hydrotele.run.replay import replay_log
from hydrotele.run.run import run_scenario, start_session
from hydrotele.scenario.scenario import Scenario
from hydrotele.teleop.axis_table import (
    COUPLING,
    COUPLING_DAMPING,
    DAMPING,
    DEADBAND,
    GAIN,
    MAX_REFLECTED_FORCE,
)
from hydrotele.teleop.levitation import quaternion_to_rotation_vector
from hydrotele.teleop.master import build_master

PERIOD = 0.005
REFLECTIONS = (
    "none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance",
    "wave_variables", "passivity_control",
)  # fmt: skip
PASSIVE_LINES = REFLECTIONS[-2:]
PLATE = {"kind": "plate", "position": [6.0, -0.11, 0.3], "size": [0.8, 0.9]}
DOWN = {"kind": "follow", "time": [0.0, 0.3, 0.6, 4.0], "path": {"z": [0, 0, -0.0025, -0.0025]}}
SPEEDS = {"r": 0.3, "theta": 0.1, "z": 0.3, "attitude": 0.3}


def scenario(duration=4.0, plate=None, z=0.40, sensors="ideal", **pilot) -> Scenario:
    """The bucket above a plate; the hand goes down if it is not told otherwise."""
    scales = {"r": 100.0, "theta": 20.0, "z": 100.0, "attitude": 5.0}
    return Scenario.model_validate({
        "name": "station", "machine": "cat215", "tool": "bucket", "duration": duration,
        "sensors": sensors, "surroundings": [PLATE | plate] if plate is not None else [],
        "start": {"pose": {"r": 6.0, "z": z, "attitude": -1.745}},
        "pilot": {
            "kind": "teleop", "force": "true", "mount": "table", "operator": DOWN,
            "coordinates": {
                name: {"speed": SPEEDS[name], "scale": scales[name]} for name in SPEEDS
            },
        } | pilot,
    })  # fmt: skip


def numbers_of(run):
    return build_master(load_joystick(), run.scenario.pilot, run.station.coordinates)[0]


def check_sound(run, speeds=SPEEDS):
    """Finite, no trip, and task references that keep to speed and acceleration."""
    log = run.station.log
    assert np.isfinite(run.plan.reference).all() and not run.station.valves_closed
    pose, rate = log.slave("pose"), log.slave("rate")
    for c, name in enumerate(run.station.coordinates):
        assert np.abs(np.diff(pose[:, c])).max() <= speeds[name] * PERIOD + 1e-9
        assert np.abs(np.diff(rate[:, c])).max() <= 1.0 * PERIOD + 1e-9
    for values in run.measured.columns.values():
        assert np.isfinite(values).all()


@pytest.mark.daily(
    "direct_force-rate-0.1", "four_channel-rate-0.1", "wave_variables-position-0.1", "passivity_control-position-0.1"
)
@pytest.mark.parametrize(
    ("mode", "delay"),
    [
        ("rate", 0.1),
        pytest.param("position", 0.0, marks=pytest.mark.nightly),
        ("position", 0.1),
    ],
)
@pytest.mark.parametrize("reflection", REFLECTIONS)
def test_every_structure_goes_down_and_presses(reflection, mode, delay):
    """From free motion into the plate: it touches, and nothing leaves its bounds."""
    if reflection in PASSIVE_LINES and mode == "rate":
        with pytest.raises(ValueError, match="needs mode position"):
            scenario(reflection=reflection, mode=mode)
        return
    channel = {"delay_forward": delay, "delay_back": delay}
    run = run_scenario(scenario(
        3.0, plate={}, z=0.36, reflection=reflection, mode=mode, channel=channel, force="dynamic"
    ))  # fmt: skip
    check_sound(run)
    assert run.summary["max_contact_force_N"] > 1e3
    for key in ("handle_energy_J", "min_handle_energy_J"):
        assert np.isfinite(run.summary["teleoperation"][key])


def test_direct_force_is_ratio_times_force():
    """The coils push ratio times the force at the tip, less spring and damper of the handle."""
    run = run_scenario(scenario(plate={}, reflection="direct_force", ratio=1e-4))
    log, row = run.station.log, numbers_of(run).axis[2]
    counted = np.clip(log.force[:, 2], -row[MAX_REFLECTED_FORCE], row[MAX_REFLECTED_FORCE])
    wanted = 1e-4 * counted - row[0] * log.master("handle")[:, 2]
    wanted -= row[DAMPING] * log.master("speed")[:, 2]
    np.testing.assert_allclose(log.master("push")[:, 2], wanted, atol=1e-9)
    assert log.force[-100:, 2].mean() > 1e3  # the environment pushes up


def test_coordinating_force_against_the_reference_is_what_the_machine_lags():
    run = run_scenario(scenario(plate={}, reflection="coordinating_force", coordinating_position="reference"))
    log, row = run.station.log, numbers_of(run).axis[2]
    start = log.slave("pose")[0, 2]
    pose, seen = log.slave("pose")[:, 2] - start, log.slave("measured")[:, :, 2]
    behind, slower = pose - (seen[:, 0] - start), log.slave("rate")[:, 2] - seen[:, 1]
    wanted = -row[COUPLING] * behind - row[COUPLING_DAMPING] * slower
    wanted -= row[0] * log.master("handle")[:, 2] + row[DAMPING] * log.master("speed")[:, 2]
    np.testing.assert_allclose(log.master("push")[:, 2], wanted, atol=1e-9)
    assert -(row[COUPLING] * behind)[-1] > 0.0  # reference below the machine: the hand is lifted


@pytest.mark.parametrize("mode", ["rate", "position"])
def test_coordinating_force_of_the_document_compares_with_the_handle(mode):
    """Zhu 1994, 3.52: C_m (x_h - x_e); 3.53 under rate control: of the integral of the handle."""
    run = run_scenario(scenario(plate={}, reflection="coordinating_force", mode=mode))
    log, row = run.station.log, numbers_of(run).axis[2]
    start, handle, speed = log.slave("pose")[0, 2], log.master("handle"), log.master("speed")
    seen = log.slave("measured")[:, :, 2] - [start, 0.0]
    x, v = handle[:, 2], speed[:, 2]
    if mode == "position":
        behind, slower = x - seen[:, 0] / row[GAIN], v - seen[:, 1] / row[GAIN]
    else:
        rate = row[GAIN] * np.sign(x) * np.maximum(np.abs(x) - row[DEADBAND], 0.0)
        behind, slower = log.master("integral")[:, 2] - seen[:, 0], rate - seen[:, 1]
        np.testing.assert_allclose(  # the machine follows within the limit of 0.1 m
            log.master("integral")[-1, 2], PERIOD * rate.sum(), atol=0.1
        )
    wanted = -row[COUPLING] * behind - row[COUPLING_DAMPING] * slower
    wanted -= row[DAMPING] * v + (row[0] * x if mode == "rate" else 0.0)
    np.testing.assert_allclose(log.master("push")[:, 2], wanted, atol=1e-9)


@pytest.mark.nightly
@pytest.mark.parametrize("reflection", PASSIVE_LINES)
def test_passive_lines_bring_place_and_force_over_a_bad_network(reflection):
    """100 ms each way, 20 ms of jitter, 2 % lost: the tip follows; the handle gives no energy.

    10 mm of 200 mm: two steps of the handle's tremor of 50 um, times 100, as for four channels.
    """
    hand = {"kind": "follow", "time": [0.0, 0.5, 3.5, 12.0],
            "path": {"z": [0, 0, -0.002, -0.002]}}  # fmt: skip
    channel = {"delay_forward": 0.1, "delay_back": 0.1, "jitter": 0.02, "loss_probability": 0.02}
    keys = {"reflection": reflection, "mode": "position", "ratio": 2e-5, "channel": channel}
    run = run_scenario(scenario(12.0, z=0.9, operator=hand, **keys))
    pose = run.station.log.slave("pose")[:, 2]
    handle = run.station.log.master("handle")[:, 2]
    assert pose[-200:].mean() - pose[0] == pytest.approx(100.0 * handle[-200:].mean(), abs=0.01)
    run = run_scenario(scenario(
        12.0, plate={"stiffness": 1e5, "damping": 3e4}, z=0.4, operator=hand, **keys
    ))  # fmt: skip
    log, late = run.station.log, slice(-600, None)
    assert log.force[late, 2].mean() > 500.0  # it bounces: the plate's force is felt late
    assert run.summary["teleoperation"]["min_handle_energy_J"] > -1e-3
    # without delay the hand holds the ratio times the machine's force in the mean; 15 %: it swings
    # by a fifth, and the estimate of the hand's force is a tenth off
    down = hand | {"path": {"z": [0, 0, -0.003, -0.003]}}
    keys |= {"operator": down, "channel": {}}
    run = run_scenario(scenario(12.0, plate={"stiffness": 1e5, "damping": 3e4}, z=0.5, **keys))
    log = run.station.log
    force = log.force[late, 2].mean()
    assert force > 5e3
    assert log.master("hand")[late, 2].mean() == pytest.approx(-2e-5 * force, rel=0.15)


def test_a_trace_of_measured_delays(tmp_path):
    """A trace of one constant delay is that delay."""
    (tmp_path / "delays.csv").write_text("forward,back\n0.05,0.1\n", "utf-8")
    steady = run_scenario(scenario(2.0, channel={"delay_forward": 0.05, "delay_back": 0.1}))
    case = scenario(2.0, channel={"trace": str(tmp_path / "delays.csv")})
    traced = run_scenario(case)
    np.testing.assert_array_equal(steady.station.log.slave("pose"), traced.station.log.slave("pose"))
    (tmp_path / "delays.csv").write_text("forward,back\n,0.1\n", "utf-8")
    with pytest.raises(InputError, match="all packets of one direction are lost"):
        run_scenario(case)
    with pytest.raises(ValueError, match="trace has the delays"):
        scenario(channel={"trace": "delays.csv", "jitter": 0.1})


def test_decoupled_axes_in_the_loop():
    """Decoupled axes turn the flotor that a hand pushes: the coils then act at its centre of mass.

    The torque of 2.4 N at 0.1 m turns it by degrees until the operator corrects it; with springs at
    the handle, which is what scenarios use, there is next to none.
    """
    hand = {"kind": "follow", "time": [0.0, 0.2, 0.4, 2.0], "path": {"x": [0, 0, 0.004, 0.004]}}
    turns = {}
    for kind in ("springs", "decoupled"):
        run = run_scenario(scenario(2.0, operator=hand, reflection="none", compliance=kind))
        check_sound(run)
        turns[kind] = np.abs(run.station.log.master("handle")[:, 3:5]).max()
        place = run.station.log.master("handle")[-50:, 0].mean()
        assert place == pytest.approx(0.004, abs=2e-4)  # tremor of 50 um
    assert turns["springs"] < 0.1 * turns["decoupled"]


@pytest.mark.nightly
def test_four_channels_under_position_control_are_transparent_at_rest():
    """Hand = ratio x force, place = scale x handle, in the mean over 1.5 s in contact.

    10 %: the machine still swings on the plate by 10 % of its force. 10 mm of 300 mm: two steps of
    the handle's tremor of 50 um, times 100.
    """
    hand = {"kind": "follow", "time": [0.0, 0.5, 3.5, 9.0], "path": {"z": [0, 0, -0.003, -0.003]}}
    run = run_scenario(scenario(
        9.0, plate={"stiffness": 1e5, "damping": 3e4}, z=0.5, reflection="four_channel",
        mode="position", ratio=2e-5, operator=hand,
    ))  # fmt: skip
    log, late = run.station.log, slice(-300, None)
    force = log.force[late, 2].mean()
    assert force > 5e3
    assert log.master("hand")[late, 2].mean() == pytest.approx(-2e-5 * force, rel=0.1)
    pose = log.slave("pose")[:, 2]
    place = (pose[late] - pose[0]).mean()
    assert place == pytest.approx(100.0 * log.master("handle")[late, 2].mean(), abs=0.01)


@pytest.mark.nightly
def test_four_channels_under_rate_control_leave_a_constant_force_unfelt():
    """Some 14 kN would be 3 N by the ratio; the hand rests at the centre and feels nothing.

    0.1 N is the mean of its tremor, and of what the force still swings.
    """
    hand = {"kind": "follow", "time": [0.0, 0.5, 3.5, 4.5, 9.0],
            "path": {"z": [0, 0, -0.0012, 0, 0]}}  # fmt: skip
    run = run_scenario(scenario(
        9.0, plate={}, z=0.5, reflection="four_channel", operator=hand
    ))  # fmt: skip
    log, late = run.station.log, slice(-300, None)
    assert log.force[late, 2].mean() > 1e4
    assert abs(log.master("hand")[late, 2].mean()) < 0.1


@pytest.mark.daily("khoshzaban1992-0.3")
@pytest.mark.parametrize(("sensors", "near"), [("ideal", 0.05), ("khoshzaban1992", 0.3)])
def test_impedance_finds_the_plates_stiffness(sensors, near):
    """The task at the tip is the plate's spring behind a firm contact.

    5 %: contact and lever of the bucket; 30 %: noise of angles hides some of a way of 30 mm.
    """
    hand = {"kind": "follow", "time": [0.0, 2.0, 4.0, 6.0, 8.0],
            "path": {"z": [-0.0013, -0.0016, -0.0013, -0.0016, -0.0013]}}  # fmt: skip
    asked = scenario(
        8.0, plate={}, z=0.42, sensors=sensors, reflection="impedance", mode="position",
        ratio=2e-6, operator=hand, force="dynamic",
    )  # fmt: skip
    run = run_scenario(asked.model_copy(update={
        "servo": asked.servo.model_copy(update={"position_gain": 8.0, "deadband_compensation": 0.8})
    }))  # fmt: skip
    row = numbers_of(run).axis[2]
    felt = run.station.log.master("stiffness")[-1, 2] - row[0]
    assert felt == pytest.approx(2e-6 * 100.0 * 1.0e6, rel=near)


def worked(duration, **pilot):
    """The energy that the hand truly gave the handle, and what the observer says, by tick [J].

    Of MuJoCo: the work of the muscles, which are held for a period, less what the hand's own
    spring, damper and mass have taken; only the speed within a period is a mean.
    """
    session = start_session(scenario(duration, **pilot))
    flotor, joystick = session.station._flotor, load_joystick()
    hand, data = joystick.hand, flotor.data
    true, told, before, turn = [0.0], [0.0], np.zeros(3), np.zeros(3)
    while session.tick < session.scenario.tick_count:
        place = data.qpos[:3].copy()
        session.advance()
        speed = (data.qpos[:3] - place) / PERIOD
        turn, turned = quaternion_to_rotation_vector(data.qpos[3:7]), turn
        spin = (turn - turned) / PERIOD
        force = session.station.operator.muscles.force[:3].copy()
        force[2] -= 9.81 * hand.mass
        force -= hand.stiffness * (place + 0.5 * PERIOD * speed) + hand.damping * speed
        own = 0.5 * hand.mass * float(speed @ speed - before @ before)
        torque = session.station.operator.muscles.force[3:] - hand.rotation_damping * spin
        torque -= hand.rotation_stiffness * 0.5 * (turn + turned)
        true.append(true[-1] + PERIOD * float(force @ speed + torque @ spin) - own)
        told.append(float(session.station._m.energy[0]))
        before = speed
    return np.array(true[:-1]), np.array(told[1:]), session.station  # read before it moves on


@pytest.mark.parametrize("reflection", ["none", "stiffness", "direct_force"])
def test_energy_at_the_handle_is_the_hands_work(reflection):
    """Within a tenth of the largest: speeds are differences over 5 ms."""
    true, told, station = worked(4.0, plate={}, reflection=reflection, z=0.36)
    assert told[-1] == station.summary()["handle_energy_J"]
    assert told.min() >= station.summary()["min_handle_energy_J"]
    assert np.abs(told - true).max() < 0.1 * np.abs(true).max()
    if reflection == "none":
        assert told.min() > -1e-5  # a spring and a damper are passive


@pytest.mark.parametrize(("aside", "at_stops"), [(0.001, False), (0.004, True)])
def test_a_joystick_that_shakes_the_hand_is_seen_as_active(aside, at_stops):
    """Direct force of a bouncing machine: energy comes out, as much as MuJoCo says.

    Speeds are differences over 5 ms: 5 %. What stops take away looks as if it went into the hand.
    """
    hand = {"kind": "follow", "time": [0, 0.5, 1, 2, 2.5, 4],
            "path": {"y": [0, 0, aside, aside, -aside, -aside],
                     "z": [0, 0, -0.0025, -0.0025, 0, 0]}}  # fmt: skip
    true, told, station = worked(4.0, plate={}, reflection="direct_force", z=0.36, operator=hand)
    coils = np.abs(station.log.master("handle")[:, :3]).max()
    if at_stops:
        assert coils > 5e-3 and told[-1] < true[-1] < -0.05
    else:
        assert coils < 5e-3 and true[-1] < -5e-4
        assert told[-1] == pytest.approx(true[-1], rel=0.05)


@pytest.mark.parametrize(
    ("channel", "force"),
    [
        ("angle.boom", "true"),
        ("pressure_head.boom", "dynamic"),
        pytest.param("angle.boom", "dynamic", marks=pytest.mark.nightly),
        pytest.param("pressure_head.boom", "true", marks=pytest.mark.nightly),
        pytest.param("pressure_rod.stick", "dynamic", marks=pytest.mark.nightly),
        pytest.param("pressure_rod.stick", "true", marks=pytest.mark.nightly),
    ],
)
def test_frozen_sensor_closes_the_valves(channel, force):
    """Within `safety.frozen_time`, a tenth of a second between looks, and a sample."""
    run = run_scenario(scenario(
        3.0, sensors="khoshzaban1992", force=force, faults=[{"channel": channel, "start": 1.0}], z=1.4,
        operator={"kind": "follow", "time": [0, 3], "path": {"z": [0.003, 0.003]}},
    ))  # fmt: skip
    assert run.station.valves_closed
    commands = np.column_stack([run.measured[f"command.{a}"] for a in run.plant.axes])
    moving = np.flatnonzero(np.any(commands != 0.0, axis=1))
    assert run.measured.time[moving[-1]] < 1.0 + 0.5 + 0.1 + 0.05
    assert any("closed permanently" in note for note in run.summary["notes"])


def test_frozen_ideal_angle_trips_by_its_following_error():
    run = run_scenario(scenario(
        5.0, faults=[{"channel": "angle.boom", "start": 0.5}], z=1.4,
        safety={"following_error": 0.1},
        operator={"kind": "follow", "time": [0, 5], "path": {"z": [0.0045, 0.0045]}},
    ))  # fmt: skip
    assert any("boom does not follow" in note for note in run.summary["notes"])


@pytest.mark.parametrize("mode", ["rate", "position"])
def test_a_dead_line_stops_the_machine_softly(mode):
    """All packets lost from 1 s on: references stand after the silence and the braking."""
    run = run_scenario(scenario(
        3.0, z=1.4, mode=mode, channel={"loss_probability": 1.0, "loss_start": 1.0}, reflection="stiffness",
        operator={"kind": "follow", "time": [0, 3], "path": {"z": [0.003, 0.003]}},
    ))  # fmt: skip
    check_sound(run)
    rate = run.station.log.slave("rate")[:, 2]
    stopped = round((1.0 + 0.15 + SPEEDS["z"] / 1.0) / PERIOD) + 2
    assert np.all(rate[stopped:] == 0.0)
    assert any("packets are missing" in note for note in run.summary["notes"])


@pytest.mark.nightly
def test_half_of_the_packets_do_as_well():
    """A held packet now and then is no jump; the tip comes 2 cm near where it comes with all."""
    hand = {"kind": "follow", "time": [0, 3], "path": {"z": [0.003, 0.003]}}
    whole, half = (
        run_scenario(scenario(3.0, z=1.4, operator=hand, channel={"loss_probability": lost})) for lost in (0.0, 0.5)
    )
    check_sound(half)
    ends = [run.station.log.slave("pose")[-1, 2] for run in (whole, half)]
    assert ends[0] == pytest.approx(ends[1], abs=0.02)


def test_steered_out_of_reach_it_stands_at_the_edge():
    hand = {"kind": "follow", "time": [0, 4.5, 5, 8], "path": {"x": [0.005, 0.005, -0.004, -0.004]}}
    asked = scenario(8.0, operator=hand, reflection="none")
    data = asked.model_dump(mode="json")
    data["start"] = {"pose": {"r": 7.4, "z": 1.4, "attitude": -1.2}}
    run = run_scenario(Scenario.model_validate(data))
    assert any("edge of the workspace" in note for note in run.summary["notes"])
    assert not run.station.valves_closed
    pose = run.station.log.slave("pose")[:, 0]
    assert np.abs(np.diff(pose)).max() < SPEEDS["r"] * PERIOD + 1e-9
    assert pose[-1] < pose.max() - 0.2


def test_channels_survive_a_file(tmp_path):
    """Names, units and values of what the station measured come back."""
    run = run_scenario(scenario(1.0))
    save_log(run.measured, tmp_path / "log.parquet")
    back = load_log(tmp_path / "log.parquet")
    new = [c for c in run.measured.columns if c.startswith(("handle", "hand_", "coil", "tip_"))]
    assert len(new) >= 6 * 5 + 3 * 4
    for name in new:
        assert back.units[name] == run.measured.units[name]
        np.testing.assert_allclose(back[name], run.measured[name], rtol=1e-9, atol=1e-12)


def test_replay_works_in_the_open_and_refuses_what_stands_around():
    free = run_scenario(scenario(1.0, z=1.4))
    replayed = replay_log(free.measured, free.plant.machine)
    assert replayed.channels["angle.boom"].rms < 1e-3
    beside = run_scenario(scenario(1.0, plate={}))
    for log in (beside.measured, beside.truth):
        with pytest.raises(InputError, match="contained plate"):
            replay_log(log, beside.plant.machine)


BAD = {
    "reflection": ({"reflection": "haptic"}, "pilot.*reflection.*'stiffness'"),
    "mode": ({"mode": "speed"}, "pilot.*mode"),
    "coordinate": ({"coordinates": {"height": {}}}, "pilot.*coordinates.*height"),
    "lost": ({"channel": {"loss_probability": 1.5}}, "loss_probability"),
    "delay": ({"channel": {"delay_back": -0.1}}, "delay_back"),
    "long delay": ({"channel": {"delay_back": 2.0}}, "delay_back: 2 s is not shorter than the run"),
    "joystick": ({"joystick": "mine.yaml"}, "joystick 'mine.yaml'"),
    "gains": ({"gains": "digger"}, "pilot.gains.*excavator"),
    "bandwidth": ({"bandwidth_hz": 6.0}, "bandwidth"),
    "nan": ({"ratio": float("nan")}, "ratio"),
    "stiffness": ({"stiffness": {"z": {"min_stiffness": 5e3}}}, "pilot.stiffness.z.*ordered"),
    "arm button": ({"buttons": [{"start": 0, "axis": "boom", "command": 1}]}, "boom is controlled by the joystick"),
    "button": ({"buttons": [{"start": 0, "axis": "saw", "command": 1}]}, "'saw' is not an axis"),
    "fault": ({"faults": [{"channel": "angle.saw", "start": 1}]}, "axes are swing"),
    "fault kind": ({"faults": [{"channel": "speed.boom", "start": 1}]}, "kinds are angle"),
    "time": ({"operator": DOWN | {"time": [0, 2, 1, 3]}}, "time must start at 0 and rise"),
    "path": ({"operator": DOWN | {"path": {"z": [0.0]}}}, "path.z has 1 values"),
    "steer": (
        {"operator": {"kind": "steer", "time": [0, 1], "points": {"z": [1.0]}}},
        "points.z has 1 values",
    ),
    "head": (
        {"operator": {"kind": "steer", "time": [0], "points": {"head": [1.0]}}},
        "points.head.*the arm has r, theta, z, attitude",
    ),
    "target": (
        {"operator": {"kind": "regulate", "target": {"time": [0, 2, 1], "force": [1, 1, 1]}}},
        "time must start at 0 and rise",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_scenarios_are_refused_by_key_and_write_nothing(name, tmp_path):
    """Key and allowed values are named (`main` ends with code 2 then), and there is no folder."""
    changed, said = BAD[name]
    data = json.loads(scenario(1.0).model_dump_json())
    data["pilot"] |= changed
    data.pop("folder")
    (tmp_path / "bad.yaml").write_text(json.dumps(data).replace("NaN", ".nan"))
    out = tmp_path / "out"
    with pytest.raises(InputError) as error:
        run_to_folder(str(tmp_path / "bad.yaml"), out, {}, False, True)
    assert re.search(said, str(error.value)) and not out.exists()


def test_a_machine_without_an_arm_has_no_station():
    data = scenario(1.0).model_dump(mode="json")
    data |= {"machine": "emps", "tool": None, "start": {}}
    with pytest.raises(InputError, match="has no arm"):
        run_scenario(Scenario.model_validate(data))
