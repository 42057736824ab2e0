"""Pilots: the arrays that a scenario asks for are the motion that it describes."""

import math

import numpy as np
import pytest

from hydrotele.control.arm_kinematics import pose_to_joints
from hydrotele.control.plan import make_plan, quintic_step, tip_moves_duration
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.kinematics.arm import forward_kinematics
from hydrotele.kinematics.arm_dimensions import arm_geometry
from hydrotele.machine.machine_file import load_machine
from hydrotele.scenario.pilots import Pose
from hydrotele.scenario.scenario import Scenario

RATE = 200.0


def plan_of(pilot, duration=6.0, start=None, tool="bucket", rate=RATE, machine="cat215"):
    """A plan as a run makes it."""
    facts = load_machine(machine, tool)
    joints = {name: facts.home.get(name, 0.0) for name in facts.joints} | (start or {})
    whole = Scenario(name="t", duration=duration, pilot=pilot)
    axes, time = tuple(actuator_order(facts)), np.arange(round(duration * rate)) / rate
    return make_plan(facts, axes, whole.pilot, joints, time)


def tip(plan, tool="bucket"):
    """r, theta, z, attitude of the references, (n, 4)."""
    geometry = arm_geometry(load_machine("cat215", tool))
    order = [plan.axes.index(a) for a in ("swing", "boom", "stick", "bucket") if a in plan.axes]
    return np.array([forward_kinematics(geometry, row) for row in plan.reference[:, order]])


def start_at(tool="bucket", **pose):
    machine = load_machine("cat215", tool)
    here = {a: machine.home.get(x.joint, 0.0) for a, x in machine.axes.items()}
    return pose_to_joints(machine, Pose(**pose), here)


def rates_of(values, dt):
    """Central differences, (n - 2, k)."""
    return (values[2:] - values[:-2]) / (2 * dt)


def test_quintic_is_smooth():
    """From 0 to 1 with no speed at either end, its rate the derivative of its value."""
    time = np.linspace(-0.5, 3.5, 4001)
    s, ds = quintic_step(time, 3.0)
    assert s[time <= 0].max() == 0.0 and s[time >= 3].min() == 1.0
    assert np.all(np.diff(s) >= 0) and np.all(ds >= 0)
    np.testing.assert_allclose(rates_of(s, 1e-3), ds[1:-1], atol=1e-5)  # h^2 of 1e-6 times s'''
    assert np.trapezoid(ds, time) == pytest.approx(1.0, abs=1e-9)
    assert [v.tolist() for v in quintic_step(np.zeros(2), 0.0)] == [[1.0, 1.0], [0.0, 0.0]]


def test_constant():
    plan = plan_of({"kind": "constant", "commands": {"boom": 0.3, "bucket": -1.0}})
    assert plan.axes == ("swing", "boom", "stick", "bucket") and not plan.closed_loop.any()
    assert np.all(plan.command == [0.0, 0.3, 0.0, -1.0])


def test_table_holds_between_its_times():
    """A value begins with the tick of its time and lasts to the tick before the next one."""
    table = {"time": [0.0, 0.1, 0.235, 0.3], "columns": {"boom": [0.1, 0.2, 0.3, 0.4]}}
    plan = plan_of({"kind": "table", **table}, duration=0.5)
    boom = plan.command[:, 1]
    for k in range(len(boom)):
        due = max(i for i, t in enumerate(table["time"]) if round(t * RATE) <= k)
        assert boom[k] == table["columns"]["boom"][due]
    assert not np.delete(plan.command, 1, axis=1).any() and not plan.closed_loop.any()


@pytest.mark.parametrize("rate", [50.0, 200.0, 333.3, 1000.0])
def test_table_of_its_own_ticks_is_itself(rate):
    """Times that went through a log, k / rate or k * (1 / rate), meet their ticks."""
    n = 3000
    values = np.random.default_rng(1).uniform(-1, 1, n).tolist()
    for time in (
        np.arange(n) / rate,
        np.arange(n) * (1 / rate),
        np.arange(n) * float(f"{1 / rate:.15g}"),
    ):
        pilot = {"kind": "table", "time": time.tolist(), "columns": {"boom": values}}
        plan = plan_of(pilot, duration=n / rate, rate=rate)
        assert np.array_equal(plan.command[:, 1], values)


def test_table_interpolates():
    table = {"time": [0.0, 0.1, 0.3], "columns": {"boom": [0.0, 0.1, 0.5], "stick": [-1, -1, -1]}}
    plan = plan_of({"kind": "table", "quantity": "joint", "interpolate": "linear", **table}, duration=0.5)
    assert plan.closed_loop.all()  # the others stay where they are
    expected = np.interp(plan.time, table["time"], table["columns"]["boom"])
    np.testing.assert_allclose(plan.reference[:, 1], expected, atol=1e-15)
    inner = (plan.time > 0.11) & (plan.time < 0.29)
    np.testing.assert_allclose(plan.rate[inner, 1], 2.0, atol=1e-9)
    # Differences of equal numbers up to rounding, over 5 ms.
    np.testing.assert_allclose(plan.rate[plan.time > 0.31, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(plan.rate[:, 2], 0.0, atol=1e-12)
    assert np.all(plan.reference[:, 0] == 0.0)


def test_fourier_is_its_series_and_its_derivative():
    """The wave itself after the fade; the rate is its derivative, also while it fades."""
    axes = {"boom": {"mean": 0.4, "sin": [0.1, 0.02], "cos": [0.0, 0.0, 0.03]}}
    pilot = {"kind": "fourier", "period": 5.0, "fade": 1.5, "axes": axes}
    plan = plan_of(pilot, duration=8.0, rate=1000.0, start={"boom": 0.2})
    w, t, boom = 2 * math.pi / 5.0, plan.time, plan.reference[:, 1]
    wave = 0.4 + 0.1 * np.sin(w * t) + 0.02 * np.sin(2 * w * t) + 0.03 * np.cos(3 * w * t)
    np.testing.assert_allclose(boom[t >= 1.5], wave[t >= 1.5], atol=1e-12)
    assert boom[0] == 0.2 and plan.rate[0, 1] == 0.0
    # h^2 / 6 of 1.7e-7 times the third derivative, below 20 rad/s^3 here.
    np.testing.assert_allclose(rates_of(boom, 1e-3), plan.rate[1:-1, 1], atol=1e-5)
    assert np.all(plan.reference[:, 2] == plan.reference[0, 2])


@pytest.mark.parametrize("mode", ["rate", "position"])
def test_lines_reach_their_end(mode):
    """Each move ends where it says, on a straight way, with the speed it says."""
    moves = [{"r": 0.3, "z": -0.4, "speed": 0.5, "pause": 0.2}, {"theta": 0.3, "speed": 0.2},
             {"attitude": -0.3, "r": -0.2, "speed": 0.25}]  # fmt: skip
    pilot = {"kind": "lines", "mode": mode, "settle": 0.5, "moves": moves}
    begin = start_at(r=5.5, z=1.0, attitude=-1.6)
    plan = plan_of(pilot, duration=9.0, start=begin)
    assert not plan.notes and plan.closed_loop.all()
    pose, first = tip(plan), np.array([5.5, 0.0, 1.0, -1.6])
    total = np.array([0.1, 0.3, -0.4, -0.3])
    # 5 mm: speeds are held over ticks of 5 ms, so a ramp of 1 m/s^2 is off by up to v dt.
    np.testing.assert_allclose(pose[-1] - first, total, atol=5e-3)
    np.testing.assert_allclose(pose, plan.pose, atol=1e-9)  # what it says is what the joints give
    speed = np.linalg.norm(np.diff(pose, axis=0)[:, [0, 2]], axis=1) * RATE
    assert speed.max() == pytest.approx(0.5, rel=1e-6)
    moving = (plan.time > 0.55) & (plan.time < 1.5)
    way = pose[moving] - first
    np.testing.assert_allclose(way[:, 0] * -0.4, way[:, 2] * 0.3, atol=1e-9)
    still = plan.time < 0.5
    assert np.all(plan.reference[still] == plan.reference[0]) and not plan.rate[still].any()


def test_lines_rates_are_the_derivative_of_the_references():
    pilot = {"kind": "lines", "settle": 0.2, "moves": [{"r": 0.5, "z": 0.2, "theta": 0.1}]}
    plan = plan_of(pilot, duration=2.5, start=start_at(r=5.0, z=1.0, attitude=-1.6), rate=1000.0)
    backward = np.diff(plan.reference, axis=0) * 1000.0
    # A held rate of 1 m/s^2 ramps differs from its neighbour by 1e-3 m/s, over arms of 1 m or more;
    # joint accelerations of 2 rad/s^2 add the same again.
    np.testing.assert_allclose(backward, plan.rate[1:], atol=3e-3)


def test_rate_and_position_commands_agree():
    """The same moves, integrated or commanded: the same joints to rounding of 1000 sums."""
    moves = [{"r": 0.4, "z": -0.3, "attitude": 0.2}, {"theta": 0.5, "speed": 0.3}]
    both = [plan_of({"kind": "lines", "mode": mode, "moves": moves}, duration=7.0) for mode in ("rate", "position")]
    np.testing.assert_allclose(both[0].reference, both[1].reference, atol=1e-10)
    np.testing.assert_allclose(both[0].rate, both[1].rate, atol=1e-9)


@pytest.mark.parametrize("mode", ["rate", "position"])
@pytest.mark.parametrize(
    "moves",
    [
        [{"r": 4.0}, {"r": -4.0}],  # out of reach and back
        [{"r": 4.0}, {"z": 1.5}, {"r": -4.0}],  # back on another way
        [{"r": 4.0, "theta": 0.5}, {"z": -1.0}, {"theta": -1.0}],
        [{"r": -4.0}, {"r": 4.0}],  # into the machine
        [{"z": 6.0}, {"z": -6.0}],
    ],
)
def test_edge_of_the_workspace_stops_without_a_jump(mode, moves):
    """References move no further per tick than the largest speed allows, and a note says why.

    3 rad/s: 0.5 m/s at the tip, and an arm that is nearly stretched turns several times as fast as
    0.5 m/s over its 5 m.
    """
    moves = [m | {"speed": 0.5, "pause": 0.2} for m in moves]
    plan = plan_of({"kind": "lines", "mode": mode, "moves": moves}, duration=40.0)
    assert any("edge of the workspace" in note for note in plan.notes)
    jumps = np.abs(np.diff(plan.reference, axis=0)).max()
    assert jumps < 3.0 / RATE + 0.02  # where it goes on again it may be 2 cm or 0.02 rad off
    machine = load_machine("cat215", "bucket")
    for column, axis in enumerate(plan.axes):
        low, high = machine.joints[machine.axes[axis].joint].range or (-9, 9)
        assert low <= plan.reference[:, column].min() <= plan.reference[:, column].max() <= high


def test_blocked_motion_comes_back():
    """Out of reach and back by the same way: under position command it ends where it began."""
    moves = [{"r": 4.0, "speed": 0.5}, {"r": -4.0, "speed": 0.5}]
    plan = plan_of({"kind": "lines", "mode": "position", "moves": moves}, duration=20.0)
    np.testing.assert_allclose(plan.reference[-1], plan.reference[0], atol=1e-6)


def test_arm_without_a_tool_joint():
    """Three joints hold r, theta and z; the attitude follows."""
    pilot = {"kind": "lines", "settle": 0.2, "moves": [{"r": 0.4, "z": 0.3, "theta": 0.2}]}
    plan = plan_of(pilot, duration=3.0, tool="none")
    pose = tip(plan, "none")
    assert not plan.notes and plan.axes == ("swing", "boom", "stick")
    np.testing.assert_allclose(pose[-1] - pose[0], [0.4, 0.2, 0.3], atol=5e-3)  # as above
    np.testing.assert_allclose(pose, plan.pose[:, :3], atol=1e-9)
    np.testing.assert_allclose(plan.pose[:, 3], plan.reference[:, 1:3].sum(axis=1), atol=1e-12)


def test_waypoints_pause_and_arrive():
    points = [{"duration": 1.0, "pause": 0.5, "joints": {"boom": 0.6}},
              {"duration": 0.5, "joints": {"stick": -1.2, "boom": 0.3}}]  # fmt: skip
    plan = plan_of({"kind": "waypoints", "settle": 0.25, "points": points}, duration=3.0, rate=1000)
    t, boom = plan.time, plan.reference[:, 1]
    assert np.all(boom[t < 0.25] == boom[0])
    held = (t > 1.25 + 1e-9) & (t < 1.75 - 1e-9)
    assert np.all(boom[held] == 0.6) and not plan.rate[held].any()
    assert np.all(plan.reference[t > 2.25 + 1e-9, 1] == 0.3)
    assert np.all(plan.reference[t > 2.25 + 1e-9, 2] == -1.2)
    # h^2 / 6 of 1.7e-7 times the third derivative, 60 * 0.6 rad / (0.5 s)^3.
    np.testing.assert_allclose(rates_of(plan.reference, 1e-3), plan.rate[1:-1], atol=1e-4)
    assert not plan.notes


def test_waypoint_pose_goes_straight():
    """r, z and attitude keep their proportions all the way."""
    first = {"r": 5.0, "z": 0.5, "attitude": -1.8}
    last = {"r": 5.8, "z": 1.5, "attitude": -1.2}
    points = [{"duration": 2.0, "pose": last}]
    plan = plan_of({"kind": "waypoints", "settle": 0.0, "points": points}, start=start_at(**first),
                   duration=2.5, rate=1000.0)  # fmt: skip
    pose = tip(plan)
    share = (pose[:, 0] - 5.0) / 0.8
    np.testing.assert_allclose(pose[:, 2], 0.5 + share, atol=1e-9)
    np.testing.assert_allclose(pose[:, 3], -1.8 + 0.6 * share, atol=1e-9)
    np.testing.assert_allclose(share, quintic_step(plan.time, 2.0)[0], atol=1e-9)
    np.testing.assert_allclose(rates_of(plan.reference, 1e-3), plan.rate[1:-1], atol=1e-4)


def test_pose_way_through_the_edge_is_refused():
    """Straight up past the machine the stick would have to fold further than it can."""
    near, far = {"r": 3.6, "z": -0.5, "theta": 0.0}, {"r": 3.6, "z": 3.9, "theta": 0.0}
    pilot = {"kind": "waypoints", "points": [{"duration": 2.0, "pose": far}]}
    with pytest.raises(InputError, match=r"points\.0\.pose: the straight path leaves the workspace"):
        plan_of(pilot, start=start_at("none", **near), tool="none")


def test_run_that_ends_early_says_so():
    """With the time that is missing."""
    pilot = {"kind": "lines", "settle": 1.0, "moves": [{"z": 1.2, "speed": 0.5, "pause": 0.5}]}
    needed = tip_moves_duration(Scenario(name="t", duration=1, pilot=pilot).pilot)
    assert needed == pytest.approx(1.0 + 1.2 / 0.5 + 0.5 + 0.5)  # settle, way, one ramp, pause
    assert plan_of(pilot, duration=3.0).notes == ("the run ends 1.4 s before its pilot",)
    assert plan_of(pilot, duration=4.4).notes == ()
    points = [{"duration": 1.0, "joints": {"boom": 0.5}}] * 3
    notes = plan_of({"kind": "waypoints", "settle": 0.0, "points": points}, duration=2.0).notes
    assert notes == ("the run ends 1 s before its pilot",)


def test_force_drive_commands_keep_their_unit():
    plan = plan_of({"kind": "constant", "commands": {"slide": 9.5}}, tool=None, machine="emps")
    assert np.all(plan.command == 9.5)
    with pytest.raises(InputError, match=r"slide is 10.5; its drive accepts -10 .. 10 \[V\]"):
        plan_of({"kind": "constant", "commands": {"slide": 10.5}}, tool=None, machine="emps")


def test_closed_valves_are_not_held_by_the_servo():
    pilot = {"kind": "fourier", "period": 5.0, "axes": {"stick": {"mean": -1.4, "sin": [0.1]}},
             "closed_valves": ["boom"]}  # fmt: skip
    plan = plan_of(pilot)
    assert dict(zip(plan.axes, plan.closed_loop, strict=True)) == {
        "swing": True, "boom": False, "stick": True, "bucket": True}  # fmt: skip
    assert not plan.command.any()
    with pytest.raises(InputError, match="did you mean 'boom'"):
        plan_of({**pilot, "closed_valves": ["bom"]})
    with pytest.raises(ValueError, match="stick also has a reference"):
        plan_of({**pilot, "closed_valves": ["stick"]})
