"""Any passive hand, drawn operators, a released handle, stiff tasks."""

from dataclasses import replace

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.teleop.analysis import Case, analyse, load_teleop_case
from hydrotele.teleop.findings import impulse_response, is_growing
from hydrotele.teleop.robust import (
    Spread,
    absolutely_stable,
    llewellyn,
    port_for,
    released_master,
    robustness,
    spread_of,
    worst_case,
    z_width,
)
from hydrotele.teleop.sampled import PASSIVITY, steady_line
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import STRUCTURES, Gains, Impedance, stable, transmitted

FACTS = load_teleop_case()
CASE = FACTS.case()
FIRM = Impedance(0.0, 60.0, 900.0)
EQUAL = Case(Impedance(0.8, 2.0), Impedance(2.0, 3.0), FIRM, FIRM, Impedance(0.6, 8.0, 250.0),
             Impedance(0.0, 20.0, 3000.0), Gains())  # fmt: skip
ONE = Impedance()


def passive_pairs(count):
    """Springs, dampers and masses of many sizes on either side, most with next to no damping."""
    rng = np.random.default_rng(12)
    return [
        tuple(Impedance(*10.0 ** rng.uniform((-2, -4, 0), (2, 1, 5))) for _ in range(2))
        for _ in range(count)
    ]


def test_absolutely_stable_is_stable_with_every_passive_hand_and_task():
    port = EQUAL.port("position_position")
    assert absolutely_stable(port)
    assert all(stable(port, hand, task) for hand, task in passive_pairs(150))


@pytest.mark.parametrize("structure", ["position_force", "rate_force", "rate_position"])
def test_what_is_not_absolutely_stable_has_a_passive_pair_that_shows_it(structure):
    port = EQUAL.with_delay(0.05).port(structure)
    assert not absolutely_stable(port)
    assert not all(stable(port, hand, task) for hand, task in passive_pairs(150))


def test_the_parameter_tells_less_than_passivity_asks():
    """Direct force scaled down is not passive; with enough damping it is absolutely stable."""
    heavy = replace(EQUAL, master=Impedance(0.8, 400.0), gains=Gains(force=0.5),
                    slave=Impedance(2.0, 400.0))  # fmt: skip
    port = heavy.port("position_force")
    assert llewellyn(port, 1j * np.geomspace(1.0, 100.0, 50)).min() > 1.0


def test_z_width():
    width = z_width(CASE, "rate_force")
    port = CASE.port("rate_force")
    s = 1j * width.frequencies
    rigid = transmitted(port, s, Impedance(0.0, 0.0, 1e15))
    np.testing.assert_allclose(width.clamped, rigid, rtol=1e-6)
    np.testing.assert_allclose(width.free, transmitted(port, s, ONE), rtol=1e-6)
    late = CASE.with_delay(0.3)
    edge = z_width(late, "rate_force").stiffest_held
    sides = [
        stable(port_for(late, "rate_force", replace(late.task, stiffness=k * edge)), late.hand,
               replace(late.task, stiffness=k * edge)) for k in (0.99, 1.01)
    ]  # fmt: skip
    assert sides == [True, False]


def test_the_released_handle_of_rate_position():
    """Zhu 1994, 3.71-3.72: without damping of the master's own it cannot be stable."""
    found = released_master(CASE, "rate_position")
    assert found.unstable == 2 and found.coefficients[1] == 0.0
    assert released_master(CASE, "rate_position", CASE.hand).unstable == 0
    one = analyse(CASE, "rate_position")
    assert one.stable and not one.stable_let_go and one.unstable_let_go == 2
    assert not is_growing(impulse_response(CASE, "rate_position"))
    assert is_growing(impulse_response(replace(CASE, hand=ONE), "rate_position"))


def test_the_damping_that_lets_a_released_handle_rest():
    """Routh: B (K_v K + B_mc) > M K_mc for 3.72, with K = 0: B > M K_mc / B_mc."""
    control = CASE.master_control
    edge = CASE.master.mass * control.stiffness / control.damping
    for factor, many in ((0.99, 2), (1.01, 0)):
        own = Impedance(CASE.master.mass, factor * edge)
        assert released_master(replace(CASE, master=own), "rate_position").unstable == many


@pytest.mark.parametrize("structure", STRUCTURES)
def test_letting_go_is_seen_in_simulation(structure):
    case = replace(CASE, hand=ONE, gains=Gains(1.0, 0.5, 0.05))
    found = analyse(replace(case, hand=CASE.hand), structure)
    assert is_growing(impulse_response(case, structure)) == (found.unstable_let_go != 0)


def test_the_theorem_needs_a_least_stiffness():
    """Zhu 1994, 4.11-4.14: K_min > 0 besides B^2 > 4 M K_max."""
    assert Spring(1.0, 50.0, 100.0, 50.0, 400.0).stable_by == "theorem"
    assert Spring(1.0, 50.0, 100.0, 0.0, 400.0).stable_by == "nothing"
    assert Spring(1.0, 1.0, 100.0, 50.0, 400.0).stable_by == "nothing"


@pytest.mark.parametrize(("spring", "margin"), [
    (Spring(0.85, 60.0, 600.0, 300.0, 4000.0), -20_026.0),  # Zhu 1994, Table 6.7
    (Spring(0.85, 60.0, 4000.0, 3000.0, 9000.0), -49_026.0),  # Table 6.9
])  # fmt: skip
def test_the_published_gains_are_stable_by_the_switching_bound(spring, margin):
    held = spring.held(CASE.hand)
    assert held.margin == pytest.approx(margin)
    assert held.stable_by == "switching bound" and held.growth < 1.0
    edge = replace(held, damping=held.least_damping)
    assert edge.growth == pytest.approx(1.0, abs=0.01) and edge.damping < held.damping


@pytest.mark.nightly
def test_worst_of_drawn_hands_and_tasks():
    line = steady_line(0.005, 0.1, 0.1)
    spread = spread_of(FACTS)
    found = worst_case(CASE, "rate_force", line, spread, 10)
    worst = replace(CASE, hand=found.hand, task=found.task)
    assert 0 < found.unstable < 10  # 123 ms is the limit of the one operator of the case
    assert found.rate > 0.0
    again = worst_case(worst, "rate_force", line, Spread((found.hand,) * 2, (found.task,) * 2), 1)
    assert again.rate == pytest.approx(found.rate, abs=1e-3)


def test_everything_of_one_structure():
    line = steady_line(0.005, 0.02, 0.02)
    found = robustness(CASE, "rate_position", line, spread_of(FACTS), 3)
    held, free, let_go, _ = found.sampled
    assert held.stable and free.stable and not let_go.stable
    assert not found.absolutely_stable and found.width and found.released
    other = robustness(CASE, PASSIVITY, line, spread_of(FACTS), 3)
    assert other.width is None and other.absolutely_stable is None
    with pytest.raises(InputError, match="known"):
        robustness(CASE, "telepathy", line, spread_of(FACTS), 3)
