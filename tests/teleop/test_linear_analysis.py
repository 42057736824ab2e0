"""Analysis of a teleoperator: margins against exact ones, passivity, worst-case switching."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from hydrotele.core.errors import InputError
from hydrotele.show.teleop_text import describe_stability
from hydrotele.teleop.analysis_document import findings_to_dict
from hydrotele.teleop.case_analysis import analyse_structures
from hydrotele.teleop.case_file import TeleoperatorAxis, load_teleop_case
from hydrotele.teleop.linear_analysis import (
    analyse_structure,
    find_gain_margin,
    find_max_delay,
    is_passive,
    loop_gain,
    stability_map,
)
from hydrotele.teleop.nyquist_criterion import count_unstable_poles_held, is_stable
from hydrotele.teleop.stiffness_switching import StiffnessAxis, worst_switching_growth
from hydrotele.teleop.time_simulation import (
    choose_time_step,
    is_growing,
    measure_sine_impedance,
    simulate_impulse_response,
)
from hydrotele.teleop.two_port import (
    STRUCTURES,
    Impedance,
    StructureGains,
    characteristic_function,
    transmitted_impedance,
)

CASE = TeleoperatorAxis(
    Impedance(0.8, 0.5), Impedance(2.0, 3.0), Impedance(0.0, 12.0, 150.0),
    Impedance(0.0, 60.0, 900.0), Impedance(0.6, 8.0, 250.0), Impedance(0.0, 20.0, 3000.0),
    StructureGains(1.0, 0.7, 0.5),
)  # fmt: skip
REFINED = 2e-3  # margins are bisected to 1e-3


def crossings(case, structure):
    """(frequency, loop gain) where the loop's phase without delay is -180 degrees."""
    port, w = case.make_port(structure), np.geomspace(0.1, 1e3, 20_000)
    values = loop_gain(port, 1j * w, case.hand, case.task)
    found = []
    for k in np.flatnonzero((np.diff(np.sign(values.imag)) != 0) & (values.real[1:] < 0.0)):
        root = brentq(lambda v: loop_gain(port, 1j * v, case.hand, case.task).imag, w[k], w[k + 1])
        found.append((root, -loop_gain(port, 1j * root, case.hand, case.task).real))
    return found


@pytest.mark.parametrize("structure", ["position_force", "rate_force"])
def test_gain_margin_is_that_of_the_phase_crossing(structure):
    case = CASE.with_delay(0.01)
    margin = 1.0 / max(size for _, size in crossings(case, structure))
    assert find_gain_margin(case, structure) == pytest.approx(margin, rel=REFINED)


def test_largest_delay_is_that_of_the_gain_crossing():
    """The delay turns the loop's phase to -180 degrees where its gain is 1."""
    case, port = CASE, CASE.make_port("rate_force")
    w = np.geomspace(0.1, 1e3, 20_000)
    values = loop_gain(port, 1j * w, case.hand, case.task)
    k = np.flatnonzero((np.abs(values[:-1]) > 1.0) & (np.abs(values[1:]) <= 1.0))
    assert len(k) == 1
    left = math.pi + np.unwrap(np.angle(values))[k[0]]
    delay = (left % (2.0 * math.pi)) / w[k[0]] / 2.0
    assert find_max_delay(case, "rate_force") == pytest.approx(delay, rel=REFINED)


def test_loop_gain_and_characteristic_are_one():
    port, s = (
        CASE.with_delay(0.03).make_port("four_channel_rate"),
        1j * np.geomspace(0.1, 100.0, 30),
    )
    near = port.master(s) + port.master_control(s) + CASE.hand(s)
    far = port.slave(s) + port.slave_control(s) + CASE.task(s)
    whole = near * far * (1.0 + loop_gain(port, s, CASE.hand, CASE.task))
    assert np.allclose(whole, characteristic_function(port, s, CASE.hand, CASE.task))


def test_passive_are_equal_springs_and_the_transparent_one_without_delay():
    firm = TeleoperatorAxis(CASE.master, CASE.slave, CASE.slave_control, CASE.slave_control, CASE.hand,
                CASE.task)  # fmt: skip
    for structure in ("position_position", "four_channel_position"):
        assert is_passive(firm.make_port(structure))
        assert not is_passive(firm.with_delay(0.1).make_port(structure))
    assert not is_passive(firm.make_port("rate_position"))


@pytest.mark.nightly
def test_an_analysis_agrees_with_itself():
    for structure in STRUCTURES:
        found = analyse_structure(CASE.with_delay(0.02), structure)
        assert found.hybrid_matrices.shape == (*found.frequencies.shape, 2, 2)
        assert found.is_stable_held == (found.gain_margin > 1.0)  # this case is stable when free
        assert found.is_stable_held == (found.max_delay > 0.02)
        assert found.has_passive_port <= (found.scattering_norms.max() < 1.0 + 1e-6)
        edge = found.gain_margin
        case = CASE.with_delay(0.02)
        if 0.0 < edge < math.inf:
            sides = [is_stable(case.make_port(structure, edge * k), CASE.hand, CASE.task)
                     for k in (0.99, 1.01)]  # fmt: skip
            assert sides == [True, False]


def test_a_map_has_its_rows_over_factors():
    delays, factors = np.array([0.0, 0.1, 0.3]), np.array([1e-3, 1e2])
    cells = stability_map(CASE, "position_force", delays, factors)
    assert cells.shape == (2, 3) and cells[0].all() and not cells[1, 1:].any()


def test_poles_on_the_axis_are_not_stable():
    bare = TeleoperatorAxis(Impedance(1.0), Impedance(1.0), Impedance(0.0, 0.0, 100.0),
                Impedance(0.0, 0.0, 100.0), Impedance(), Impedance(0.0, 0.0, 50.0))  # fmt: skip
    found = analyse_structure(bare, "position_position")
    assert not found.is_stable_held and "axis" in describe_stability(found)


def test_an_undamped_swing_grows_by_the_root_of_the_stiffnesses():
    # half a step at each of two switches, with steps of 0.01 of the time constant: below 1e-3
    assert worst_switching_growth(2.0, 0.0, 50.0, 800.0) == pytest.approx(4.0, rel=1e-3)
    assert worst_switching_growth(1.0, 0.0, 0.0, 1.0) == math.inf


def test_growth_is_that_of_the_damped_oscillations():
    """Closed form of two quarter swings, each under-damped."""
    mass, damping, least, most = 1.5, 6.0, 40.0, 900.0
    decay = damping / (2.0 * mass)
    soft, firm = (math.sqrt(k / mass - decay**2) for k in (least, most))
    out = math.atan2(soft, decay) / soft  # time to the turning point
    peak = math.exp(-decay * out) * math.sin(soft * out) / soft
    back = (math.pi - math.atan2(firm, decay)) / firm  # time from there to the centre
    speed = peak * (most / mass) / firm * math.exp(-decay * back) * math.sin(firm * back)
    assert worst_switching_growth(mass, damping, least, most) == pytest.approx(speed, rel=1e-3)


def test_the_theorem_is_sufficient_and_not_necessary():
    rng = np.random.default_rng(5)
    for _ in range(50):
        mass, most = rng.uniform(0.1, 5.0), rng.uniform(100.0, 5e3)
        least = rng.uniform(0.02, 1.0) * most
        firm = StiffnessAxis(mass, 2.05 * math.sqrt(mass * most), least, least, most)
        assert firm.stability_theorem_margin > 0.0 and firm.half_swing_growth < 1e-6  # never crosses the centre again
    between = StiffnessAxis(0.85, 60.0, 600.0, 300.0, 4000.0)  # Zhu 1994, Table 6.7
    assert between.stability_theorem_margin < 0.0 and between.half_swing_growth < 1.0
    loose = StiffnessAxis(0.85, 2.0, 600.0, 300.0, 4000.0)
    assert loose.half_swing_growth > 1.0


def test_what_holds_a_spring_adds_to_it():
    held = StiffnessAxis(1.0, 10.0, 100.0, 50.0, 200.0).with_hand(Impedance(0.5, 2.0, 30.0))
    assert held == StiffnessAxis(1.5, 12.0, 130.0, 80.0, 230.0)
    with pytest.raises(InputError, match="ordered"):
        StiffnessAxis(1.0, 1.0, 100.0, 200.0, 300.0)


def test_a_kick_without_a_loop_decays_as_its_poles_say():
    """No reflection: the master alone, whose slowest pole ends the motion."""
    run = simulate_impulse_response(CASE, "position_force", 0.0, 4.0)
    assert not is_growing(run)
    mass = CASE.master.mass + CASE.hand.mass
    damping = CASE.master.damping + CASE.hand.damping + CASE.master_control.damping
    decay = damping / (2.0 * mass)  # under-damped
    # the largest of one block over that two blocks later; phases within blocks differ by less
    ratio = math.log(run.max_speeds[2] / run.max_speeds[8]) / (6 * 4.0 / 20)
    assert ratio == pytest.approx(decay, rel=0.15)


def test_what_is_too_fast_is_not_simulated():
    light = TeleoperatorAxis(Impedance(1e-9), CASE.slave, CASE.master_control, CASE.slave_control, CASE.hand,
                 CASE.task)  # fmt: skip
    with pytest.raises(InputError, match="too fast"):
        choose_time_step(light)
    with pytest.raises(InputError, match="without mass"):
        TeleoperatorAxis(CASE.master, CASE.slave, Impedance(1.0), CASE.slave_control, CASE.hand, CASE.task)


@pytest.mark.nightly
def test_different_delays_there_and_back():
    """What is felt depends on both, stability on their sum only."""
    uneven = TeleoperatorAxis(**{**vars(CASE), "delay_forward": 0.08, "delay_back": 0.0})
    w = 6.0
    expected = transmitted_impedance(uneven.make_port("rate_force"), 1j * w, uneven.task)
    # 3 % are asked for; the delay is rounded to steps
    assert abs(measure_sine_impedance(uneven, "rate_force", w) / expected - 1.0) < 0.01
    for structure in STRUCTURES:
        same = CASE.with_delay(0.04)
        assert analyse_structure(uneven, structure).unstable_poles == analyse_structure(same, structure).unstable_poles


@pytest.mark.nightly
def test_the_document_of_the_shipped_case_is_complete():
    facts = load_teleop_case()
    found = analyse_structures(
        facts.name, facts.to_axis(), ("rate_force",), np.array([0.0, 0.1]), np.array([0.1, 1.0]),
        facts.stiffness.to_stiffness_axis(), confirm=True,
    )  # fmt: skip
    document = findings_to_dict(found)
    assert document["structures"]["rate_force"]["stable"]
    assert document["confirmed"]["agreement"] == {"rate_force": 1.0}
    assert [s["error"] < 0.03 for s in document["confirmed"]["sweeps"]] == [True, True]
    assert document["stiffness_feedback"]["held"]["margin"] < 0.0


@pytest.mark.parametrize("structure", STRUCTURES)
def test_tasks_with_mass_and_sides_with_springs(structure):
    """A task with a mass needs the slave's jerk under rate control with all four channels."""
    heavy = TeleoperatorAxis(
        Impedance(0.8, 0.5, 30.0), Impedance(2.0, 3.0, 40.0), CASE.master_control,
        CASE.slave_control, CASE.hand, Impedance(0.5, 20.0, 3000.0), StructureGains(1.0, 0.4, 0.5),
    )  # fmt: skip
    w = 9.0
    for delay in (0.0, 0.0207):  # no whole number of steps
        case = heavy.with_delay(delay)
        if count_unstable_poles_held(case.make_port(structure), case.task):
            continue  # nothing settles
        expected = transmitted_impedance(case.make_port(structure), 1j * w, case.task)
        # second order in steps of at most 0.5 ms: (w h)^2 is 2e-5; settled to 1e-3
        assert abs(measure_sine_impedance(case, structure, w) / expected - 1.0) < 2e-3
        kick = simulate_impulse_response(case, structure)
        assert is_growing(kick) != is_stable(case.make_port(structure), case.hand, case.task)
