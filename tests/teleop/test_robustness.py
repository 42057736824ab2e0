"""Any passive hand, drawn operators, a released handle, stiff tasks."""

from dataclasses import replace

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.teleop.case_file import TeleoperatorAxis, load_teleop_case
from hydrotele.teleop.linear_analysis import analyse_structure
from hydrotele.teleop.nyquist_criterion import is_stable
from hydrotele.teleop.robustness import (
    ImpedanceRanges,
    case_impedance_ranges,
    compute_llewellyn_parameter,
    compute_master_polynomial,
    compute_z_width,
    evaluate_random_hands_and_tasks,
    evaluate_robustness,
    is_absolutely_stable,
    port_with_task,
)
from hydrotele.teleop.sampled_stability import PASSIVITY_STRUCTURE, constant_delay_ages
from hydrotele.teleop.stiffness_switching import StiffnessAxis
from hydrotele.teleop.time_simulation import is_growing, simulate_impulse_response
from hydrotele.teleop.two_port import STRUCTURES, Impedance, StructureGains, transmitted_impedance

FACTS = load_teleop_case()
CASE = FACTS.to_axis()
FIRM = Impedance(0.0, 60.0, 900.0)
EQUAL = TeleoperatorAxis(Impedance(0.8, 2.0), Impedance(2.0, 3.0), FIRM, FIRM, Impedance(0.6, 8.0, 250.0),
             Impedance(0.0, 20.0, 3000.0), StructureGains())  # fmt: skip
ONE = Impedance()


def passive_pairs(count):
    """Springs, dampers and masses of many sizes on either side, most with next to no damping."""
    rng = np.random.default_rng(12)
    return [tuple(Impedance(*10.0 ** rng.uniform((-2, -4, 0), (2, 1, 5))) for _ in range(2)) for _ in range(count)]


def test_absolutely_stable_is_stable_with_every_passive_hand_and_task():
    port = EQUAL.make_port("position_position")
    assert is_absolutely_stable(port)
    assert all(is_stable(port, hand, task) for hand, task in passive_pairs(150))


@pytest.mark.parametrize("structure", ["position_force", "rate_force", "rate_position"])
def test_what_is_not_absolutely_stable_has_a_passive_pair_that_shows_it(structure):
    port = EQUAL.with_delay(0.05).make_port(structure)
    assert not is_absolutely_stable(port)
    assert not all(is_stable(port, hand, task) for hand, task in passive_pairs(150))


def test_the_parameter_tells_less_than_passivity_asks():
    """Direct force scaled down is not passive; with enough damping it is absolutely stable."""
    heavy = replace(EQUAL, master=Impedance(0.8, 400.0), gains=StructureGains(force=0.5),
                    slave=Impedance(2.0, 400.0))  # fmt: skip
    port = heavy.make_port("position_force")
    assert compute_llewellyn_parameter(port, 1j * np.geomspace(1.0, 100.0, 50)).min() > 1.0


def test_z_width():
    width = compute_z_width(CASE, "rate_force")
    port = CASE.make_port("rate_force")
    s = 1j * width.frequencies
    rigid = transmitted_impedance(port, s, Impedance(0.0, 0.0, 1e15))
    np.testing.assert_allclose(width.clamped_impedance, rigid, rtol=1e-6)
    np.testing.assert_allclose(width.free_impedance, transmitted_impedance(port, s, ONE), rtol=1e-6)
    late = CASE.with_delay(0.3)
    edge = compute_z_width(late, "rate_force").max_stiffness_held
    sides = [
        is_stable(port_with_task(late, "rate_force", replace(late.task, stiffness=k * edge)), late.hand,
               replace(late.task, stiffness=k * edge)) for k in (0.99, 1.01)
    ]  # fmt: skip
    assert sides == [True, False]


def test_the_released_handle_of_rate_position():
    """Zhu 1994, 3.71-3.72: without damping of the master's own it cannot be stable."""
    found = compute_master_polynomial(CASE, "rate_position")
    assert found.unstable_zeros == 2 and found.coefficients[1] == 0.0
    assert compute_master_polynomial(CASE, "rate_position", CASE.hand).unstable_zeros == 0
    one = analyse_structure(CASE, "rate_position")
    assert one.is_stable_held and not one.is_stable_released and one.unstable_poles_released == 2
    assert not is_growing(simulate_impulse_response(CASE, "rate_position"))
    assert is_growing(simulate_impulse_response(replace(CASE, hand=ONE), "rate_position"))


def test_the_damping_that_lets_a_released_handle_rest():
    """Routh: B (K_v K + B_mc) > M K_mc for 3.72, with K = 0: B > M K_mc / B_mc."""
    control = CASE.master_control
    edge = CASE.master.mass * control.stiffness / control.damping
    for factor, many in ((0.99, 2), (1.01, 0)):
        own = Impedance(CASE.master.mass, factor * edge)
        assert compute_master_polynomial(replace(CASE, master=own), "rate_position").unstable_zeros == many


@pytest.mark.parametrize("structure", STRUCTURES)
def test_letting_go_is_seen_in_simulation(structure):
    case = replace(CASE, hand=ONE, gains=StructureGains(1.0, 0.5, 0.05))
    found = analyse_structure(replace(case, hand=CASE.hand), structure)
    assert is_growing(simulate_impulse_response(case, structure)) == (found.unstable_poles_released != 0)


def test_the_theorem_needs_a_least_stiffness():
    """Zhu 1994, 4.11-4.14: K_min > 0 besides B^2 > 4 M K_max."""
    assert StiffnessAxis(1.0, 50.0, 100.0, 50.0, 400.0).stability_criterion == "theorem"
    assert StiffnessAxis(1.0, 50.0, 100.0, 0.0, 400.0).stability_criterion == "nothing"
    assert StiffnessAxis(1.0, 1.0, 100.0, 50.0, 400.0).stability_criterion == "nothing"


@pytest.mark.parametrize(("spring", "margin"), [
    (StiffnessAxis(0.85, 60.0, 600.0, 300.0, 4000.0), -20_026.0),  # Zhu 1994, Table 6.7
    (StiffnessAxis(0.85, 60.0, 4000.0, 3000.0, 9000.0), -49_026.0),  # Table 6.9
])  # fmt: skip
def test_the_published_gains_are_stable_by_the_switching_bound(spring, margin):
    held = spring.with_hand(CASE.hand)
    assert held.stability_theorem_margin == pytest.approx(margin)
    assert held.stability_criterion == "switching bound" and held.half_swing_growth < 1.0
    edge = replace(held, damping=held.min_stable_damping)
    assert edge.half_swing_growth == pytest.approx(1.0, abs=0.01) and edge.damping < held.damping


@pytest.mark.nightly
def test_worst_of_drawn_hands_and_tasks():
    line = constant_delay_ages(0.005, 0.1, 0.1)
    spread = case_impedance_ranges(FACTS)
    found = evaluate_random_hands_and_tasks(CASE, "rate_force", line, spread, 10)
    worst = replace(CASE, hand=found.worst_hand, task=found.worst_task)
    assert 0 < found.unstable_count < 10  # 123 ms is the limit of the one operator of the case
    assert found.worst_growth_rate > 0.0
    again = evaluate_random_hands_and_tasks(
        worst,
        "rate_force",
        line,
        ImpedanceRanges((found.worst_hand,) * 2, (found.worst_task,) * 2),
        1,
    )
    assert again.worst_growth_rate == pytest.approx(found.worst_growth_rate, abs=1e-3)


@pytest.mark.nightly
def test_everything_of_one_structure():
    line = constant_delay_ages(0.005, 0.02, 0.02)
    found = evaluate_robustness(CASE, "rate_position", line, case_impedance_ranges(FACTS), 3)
    held, free, let_go, _ = found.sampled
    assert held.is_stable and free.is_stable and not let_go.is_stable
    assert not found.has_absolute_stability and found.z_width_result and found.released_polynomial
    other = evaluate_robustness(CASE, PASSIVITY_STRUCTURE, line, case_impedance_ranges(FACTS), 3)
    assert other.z_width_result is None and other.has_absolute_stability is None
    with pytest.raises(InputError, match="known"):
        evaluate_robustness(CASE, "telepathy", line, case_impedance_ranges(FACTS), 3)
