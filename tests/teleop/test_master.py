"""The master's control: its kernels are the plain laws, statics hold, bad numbers do no harm."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.core.contiguous_state import flat_view
from hydrotele.core.errors import InputError
from hydrotele.machine.joystick import AXES, load_joystick
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.simulate.joystick import SimulatedFlotor
from hydrotele.teleop.axis_table import COORDINATE, DEADBAND, SIGN, build_axis_table
from hydrotele.teleop.coils import make_three_station_coils
from hydrotele.teleop.master import (
    build_master,
    compute_reflected_forces,
    drive_coils,
    step_master,
    unpack_master_parameters,
    unpack_master_state,
)
from tools.studies.handle_laws import Detent, StiffnessFeedback

STICK = load_joystick()
NAMES = ("r", "theta", "z", "attitude")
PERIOD = 0.005
STILL = {"kind": "follow"}


def pilot(**changed) -> TeleopPilot:
    return TeleopPilot.model_validate({"kind": "teleop", "operator": STILL, **changed})


def built(**changed):
    return build_master(STICK, pilot(**changed), NAMES)


def pushed(numbers, s, packet=None, fresh=1.0):
    compute_reflected_forces(numbers, np.zeros((8, 4)) if packet is None else packet, fresh, PERIOD, s)
    return s.push


@given(
    number=st.sampled_from([0, 1, 2, 4]),
    x=st.floats(-5e-3, 5e-3),
    v=st.floats(-0.1, 0.1),
    force=st.floats(-2e5, 2e5) | st.just(np.nan),
)
def test_stiffness_feedback_is_the_plain_law(number, x, v, force):
    """1e-12 of its largest force: the same sums in another order."""
    numbers, s = built(reflection="stiffness")
    row, gains = numbers.axis[number], STICK.gains["excavator"][AXES[number]]
    law = StiffnessFeedback(
        gains.nominal_stiffness, gains.min_stiffness, gains.max_stiffness,
        (gains.max_stiffness - gains.nominal_stiffness) / gains.force_limit, gains.damping, gains.force_limit,
        gains.deadband,
    )  # fmt: skip
    packet = np.zeros((8, 4))
    packet[0, int(row[COORDINATE])] = force
    s.handle[number], s.speed[number] = x, v
    contact = -row[SIGN] * force  # against a positive command
    wanted = law.force(x, v, contact)
    assert pushed(numbers, s, packet)[number] == pytest.approx(wanted, abs=1e-12 * 4000)
    assert s.stiffness[number] == pytest.approx(law.stiffness(x, contact), rel=1e-12)


@given(number=st.integers(0, 4), x=st.floats(-5e-3, 5e-3))
def test_detent_is_the_plain_law(number, x):
    """1e-9 N: the same sums in another order."""
    numbers, s = built(reflection="none", gains="feller", detent=True)
    gains = STICK.gains["feller"][AXES[number]]
    law = Detent(gains.deadband, gains.detent.drop, gains.nominal_stiffness, gains.detent.slope)
    s.handle[number] = x * (1.0 if number < 3 else 20.0)
    assert pushed(numbers, s)[number] == pytest.approx(law.force(s.handle[number]), abs=1e-9)


def test_detent_never_pushes_outwards_and_needs_rate_control():
    """A task that softens the spring below what the drop takes leaves no force, not a push out."""
    numbers, s = built(gains="feller", detent=True, stiffness={"z": {"min_stiffness": 0.0}})
    packet = np.zeros((8, 4))
    packet[0, 2] = 1e6
    s.handle[2] = 1.6e-3
    assert pushed(numbers, s, packet)[2] <= 0.0
    numbers, s = built(gains="feller", detent=True, mode="position", reflection="direct_force")
    s.handle[2] = 1.6e-3
    assert pushed(numbers, s)[2] == 0.0


def turned(rng) -> np.ndarray:
    q = np.array([1.0, *rng.uniform(-0.06, 0.06, 3)])
    return q / np.linalg.norm(q)


@pytest.mark.parametrize("seed", range(5))
def test_coils_put_the_push_on_the_handle_and_carry_the_weight(seed):
    """All forces on the flotor together are the push at the handle; 1e-9 N is rounding."""
    rng = np.random.default_rng(seed)
    numbers, s = built()
    s.push[:] = rng.uniform(-3, 3, 6) * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    quaternion = turned(rng)
    drive_coils(numbers, quaternion, PERIOD, s)
    w, v = quaternion[0], quaternion[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    turn = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    coils = make_three_station_coils(STICK.coils.radius, STICK.coils.force_per_ampere, STICK.coils.max_current)
    made = coils.wrench_map @ s.currents
    weight = turn.T @ np.array([0, 0, -9.81 * STICK.flotor.mass])
    handle, com = np.array(STICK.flotor.handle), np.array(STICK.flotor.com)
    np.testing.assert_allclose(turn @ (made[:3] + weight), s.push[:3], atol=1e-9)
    about_handle = made[3:] - np.cross(handle, made[:3]) + np.cross(com - handle, weight)
    np.testing.assert_allclose(about_handle, s.push[3:], atol=1e-9)
    assert s.limited[0] == 1.0


def test_currents_are_limited_as_a_whole():
    """The wrench keeps its direction and the hand's estimate knows what was given."""
    numbers, s = built()
    s.push[0] = 1000.0
    drive_coils(numbers, np.array([1.0, 0, 0, 0]), PERIOD, s)
    assert np.abs(s.currents).max() == pytest.approx(STICK.coils.max_current)
    assert 0.0 < s.limited[0] < 1.0
    assert s.momentum[0] == pytest.approx(PERIOD * 1000.0 * s.limited[0])


def levitated(push, seconds=1.5, **changed):
    """The joystick in a hand, its control, and what muscles (6,) do beyond carrying the hand."""
    numbers, s = built(**changed)
    flotor, packet = SimulatedFlotor(STICK), np.zeros((8, 4))
    muscles = np.asarray(push, float) + np.array([0, 0, 9.81 * STICK.hand.mass, 0, 0, 0])
    for tick in range(round(seconds / PERIOD)):
        step_master(numbers, flotor.data.qpos, packet, 1.0, PERIOD, tick == 0, s)
        flotor.step(s.currents, muscles)
    return numbers, s, flotor


def test_handle_stands_still_without_a_push():
    """In MuJoCo: 2 um is the sensing's step either way, 1 N/m of a spring would let 8 N sag."""
    _, s, flotor = levitated(np.zeros(6))
    assert np.abs(flotor.data.qpos[:3]).max() < 2e-6
    assert np.abs(flotor.data.qpos[4:7]).max() < 2e-5


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_straight_push_moves_the_handle_straight(axis):
    """F / K along the axis, nothing across and no turning; steps of the sensing are 1 um, 17 urad.

    The joystick's spring and that of the hand share the push, and what the hand puts on the handle
    is what is estimated: 0.013 N is one step of the sensing in a period, 0.2 mm/s, times 60 N s/m.
    """
    push = np.zeros(6)
    push[axis] = 1.2
    numbers, s, flotor = levitated(push)
    away = flotor.data.qpos[:3].copy()
    both = numbers.axis[axis, 0] + STICK.hand.stiffness
    assert away[axis] == pytest.approx(1.2 / both, abs=3e-6)
    assert np.abs(np.delete(away, axis)).max() < 3e-6
    assert np.abs(2 * flotor.data.qpos[4:7]).max() < 1e-4
    np.testing.assert_allclose(s.hand, push * (1.0 - STICK.hand.stiffness / both), atol=0.013)


def test_flat_arrays_show_the_parts():
    rng = np.random.default_rng(0)
    numbers, s = built()
    for whole, parts, unpack in (
        (flat_view(numbers), numbers, unpack_master_parameters), (flat_view(s), s, unpack_master_state),
    ):  # fmt: skip
        whole[:] = rng.standard_normal(len(whole))
        for shown, part in zip(unpack(whole), parts, strict=True):
            np.testing.assert_array_equal(shown, part)
            assert np.shares_memory(shown, part)


@pytest.mark.parametrize("mode", ["rate", "position"])
@pytest.mark.parametrize(
    "kind",
    ["none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance"],
)
def test_a_huge_force_and_none_at_all_leave_the_push_bounded(kind, mode):
    """1 kN is beyond any coil; silence takes away all that came from the machine."""
    numbers, s = built(reflection=kind, mode=mode)
    packet = np.full((7, 4), 1e6)
    packet[1:5] = 0.5
    s.handle[:3] = 2e-3
    for _ in range(400):
        push = pushed(numbers, s, packet)
    assert np.isfinite(push).all() and np.abs(push).max() < 1e3
    for _ in range(400):
        push = pushed(numbers, s, packet, fresh=0.0)
    still, alone = built(reflection=kind, mode=mode)
    alone.handle[:3] = 2e-3
    if kind != "four_channel" or mode == "position":
        np.testing.assert_allclose(push, pushed(still, alone, fresh=0.0), atol=1e-9)


def test_identified_damping_stays_below_what_a_sampled_flotor_bears():
    """At most the joystick's own once more: the handle comes to rest instead of shaking."""
    numbers, s = built(reflection="impedance")
    packet = np.zeros((8, 4))
    packet[5:] = 1e9
    flotor = SimulatedFlotor(STICK)
    muscles = np.array([0, 0, 9.81 * STICK.hand.mass, 0, 0, 0])
    flotor.set_pose(np.array([0.0, 0.0, 2e-3, 0.0, 0.0, 0.0]))
    for tick in range(200):
        step_master(numbers, flotor.data.qpos, packet, 1.0, PERIOD, tick == 0, s)
        flotor.step(s.currents, muscles)
    assert np.abs(s.currents).max() < 0.5 * STICK.coils.max_current
    assert abs(flotor.data.qpos[2]) < 1e-4


@pytest.mark.parametrize(
    ("changed", "where"),
    [
        ({"gains": "digger"}, "pilot.gains"),
        ({"stiffness": {"z": {"min_stiffness": 700.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"min_stiffness": -1.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"max_stiffness": 10.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"force_limit": 0.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"damping": -1.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"stifness": 1.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"detent": 1.0}}}, "pilot.stiffness.z"),
        ({"stiffness": {"z": {"deadband_mm": 6.0}}, "coordinates": {"z": {}}}, "coordinates.z"),
        ({"coordinates": {"head": {}}}, "pilot.coordinates"),
        ({"coordinates": {"z": {"axis": "x"}}}, "pilot.coordinates"),
        ({"operator": {"kind": "steer", "time": [0], "points": {"head": [0]}}}, "points.head"),
        (
            {"operator": {"kind": "track",
                          "target": {"coordinate": "head", "time": [0], "force": [1]}}},
            "target.coordinate",
        ),
        (
            {"coordinates": {}, "stiffness": {"z": {"deadband": 0.01}},
             "operator": {"kind": "regulate", "target": {"time": [0], "force": [1]}}},
            "target.coordinate",
        ),
    ],
)  # fmt: skip
def test_impossible_gains_are_refused_by_name(changed, where):
    with pytest.raises(InputError) as error:
        built(**changed)
    assert where in error.value.where


def test_gains_of_the_scenario_may_carry_units():
    table = build_axis_table(STICK, pilot(stiffness={"z": {"deadband_mm": 2.0}}), NAMES)
    assert table[2, DEADBAND] == pytest.approx(2e-3)
