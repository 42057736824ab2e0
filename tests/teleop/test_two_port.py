"""Teleoperators as two-ports: published closed forms, passivity, and stability in simulation."""

import itertools

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.nyquist_criterion import count_unstable_poles, count_unstable_poles_held, is_stable
from hydrotele.teleop.simulation_check import compare_stability
from hydrotele.teleop.time_simulation import is_growing, measure_sine_impedance, simulate_impulse_response
from hydrotele.teleop.two_port import (
    STRUCTURES,
    Impedance,
    StructureGains,
    characteristic_function,
    hybrid_matrix,
    make_two_port,
    scattering_norm,
    stability_theorem_margin,
    transmitted_impedance,
)

MASTER, SLAVE = Impedance(0.8, 0.5), Impedance(2.0, 3.0)
CM, CS = Impedance(0.0, 12.0, 150.0), Impedance(0.0, 60.0, 900.0)
HAND, TASK = Impedance(0.6, 8.0, 250.0), Impedance(0.0, 20.0, 3000.0)
S = 1j * np.geomspace(0.05, 200.0, 60)


def test_transparent_under_position_control():
    port = make_two_port("four_channel_position", MASTER, SLAVE, CM, CS)
    assert np.allclose(hybrid_matrix(port, S), [[0.0, 1.0], [-1.0, 0.0]])
    assert np.allclose(transmitted_impedance(port, S, TASK), TASK(S))


def test_transparent_under_rate_control_needs_jerk():
    kv = 1.7
    port = make_two_port("four_channel_rate", SLAVE, SLAVE, CS, CS, StructureGains(velocity=kv), jerk=True)
    found = hybrid_matrix(port, S)
    assert np.allclose(found[:, 0, 1], S / kv) and np.allclose(found[:, 1, 0], -kv / S)
    assert np.allclose(found[:, [0, 1], [0, 1]], 0.0, atol=1e-6)
    assert np.allclose(transmitted_impedance(port, S, TASK), TASK(S))
    # the form without jerk leaves the master itself (Zhu 1994, 3.61)
    port = make_two_port("four_channel_rate", SLAVE, SLAVE, CS, CS, StructureGains(velocity=kv))
    assert np.allclose(transmitted_impedance(port, S, TASK), SLAVE(S) + TASK(S))


@pytest.mark.parametrize("structure", STRUCTURES)
def test_the_transmitted_impedance_is_that_of_the_thesis(structure):
    port = make_two_port(
        structure,
        MASTER,
        SLAVE,
        CM,
        CS,
        StructureGains(0.8, 1.3, 0.6),
        delay_forward=0.03,
        delay_back=0.07,
    )
    c1, c2, c3, c4 = port.channels(S)
    near, far, task = MASTER(S) + port.master_control(S), SLAVE(S) + CS(S), TASK(S)
    over = near * far + c1 * c4 + task * (near + c1 * c2)
    assert np.allclose(transmitted_impedance(port, S, TASK), over / (far - c3 * c4 + task * (1.0 - c2 * c3)))
    # the loop's poles are where hand and transmitted impedance cancel
    whole = (HAND(S) + transmitted_impedance(port, S, TASK)) * (far - c3 * c4 + task * (1.0 - c2 * c3))
    assert np.allclose(characteristic_function(port, S, HAND, TASK), whole)


def test_passivity_is_lost_by_delay_and_by_rate_control():
    """Position-position with equal controllers is a spring and damper between two masses."""
    slow = 1j * np.geomspace(0.05, 50.0, 80)
    passive = make_two_port("position_position", MASTER, SLAVE, CS, CS)
    assert scattering_norm(passive, slow).max() < 1.0 + 1e-9
    for changed in (
        make_two_port("position_position", MASTER, SLAVE, CS, CS, delay_forward=0.1, delay_back=0.1),
        make_two_port("rate_position", MASTER, SLAVE, CS, CS),
        make_two_port("position_force", MASTER, SLAVE, CM, CS),
    ):
        assert scattering_norm(changed, slow).max() > 1.001
    # whether a norm is above 1 does not depend on the unit
    both = [scattering_norm(passive, slow, unit).max() for unit in (1e-2, 1e3)]
    assert max(both) < 1.0 + 1e-9


def test_poles_are_those_of_a_polynomial():
    """Position-force without delay: a polynomial whose roots numpy finds."""
    for force in (0.1, 1.0, 3.0, 10.0, 40.0):
        port = make_two_port("position_force", MASTER, SLAVE, CM, CS, StructureGains(force=force))
        near = np.array([MASTER.mass + HAND.mass, MASTER.damping + CM.damping + HAND.damping,
                         CM.stiffness + HAND.stiffness])  # fmt: skip
        far = np.array([SLAVE.mass, SLAVE.damping + CS.damping + TASK.damping,
                        CS.stiffness + TASK.stiffness])  # fmt: skip
        cross = force * np.polymul([TASK.damping, TASK.stiffness], [CS.damping, CS.stiffness])
        roots = np.roots(np.polyadd(np.polymul(near, far), cross))
        assert count_unstable_poles(port, HAND, TASK) == int(np.sum(roots.real > 0))


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("turns", [0.3, 1.0, 4.0])
def test_what_is_felt_in_a_sine_sweep(structure, turns):
    """Force over velocity of an imposed sine of some turns a second, within the 3 % asked for."""
    w = 2.0 * np.pi * turns
    for delay in (0.0, 0.05):
        case = TeleoperatorAxis(MASTER, SLAVE, CM, CS, HAND, TASK, StructureGains(1.0, 0.4, 0.4), delay, delay)
        if count_unstable_poles_held(case.make_port(structure), TASK):
            assert structure == "four_channel_position" and delay  # nothing settles then
            continue
        expected = transmitted_impedance(case.make_port(structure), 1j * w, TASK)
        assert abs(measure_sine_impedance(case, structure, w) - expected) < 0.03 * abs(expected)


@pytest.mark.daily("position_position", "position_force", "four_channel_position", "rate_force", "four_channel_rate")
@pytest.mark.parametrize("structure", STRUCTURES)
def test_predicted_stability_is_that_of_a_simulation(structure):
    """A grid of delays and of gains that reaches both kinds; at least the 95 % asked for."""
    case = TeleoperatorAxis(MASTER, SLAVE, CM, CS, HAND, TASK, StructureGains(1.0, 0.7, 0.5))
    delays, factors = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4]), np.geomspace(0.03, 30.0, 7)
    found = compare_stability(case, structure, delays, factors)
    wrong = np.argwhere(found.predicted != found.simulated)
    assert found.agreement_fraction >= 0.95, wrong
    assert 0.1 < np.mean(found.simulated) < 0.95  # both kinds are there


@pytest.mark.parametrize(
    "structure, gains",
    [
        ("position_force", (0.05, 0.15, 0.4, 1.0, 3.0, 8.0)),
        ("rate_position", (0.3, 1.0, 3.0, 12.0, 40.0, 100.0)),
        ("rate_force", (0.1, 0.3, 1.0, 3.0, 6.0, 12.0)),
        ("four_channel_rate", (0.3, 1.0, 3.0, 12.0, 40.0, 100.0)),
    ],
)
def test_predicted_stability_over_the_gains_themselves(structure, gains):
    """The same where not the reflection but the force gain or the velocity gain changes."""
    agree = []
    for gain, delay in itertools.product(gains, (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)):
        own = StructureGains(velocity=gain) if "rate" in structure else StructureGains(force=gain)
        case = TeleoperatorAxis(MASTER, SLAVE, CM, CS, HAND, TASK, own, delay, delay)
        agree.append(
            is_stable(case.make_port(structure), HAND, TASK) != is_growing(simulate_impulse_response(case, structure))
        )
    assert np.mean(agree) >= 0.95


def test_the_theorem_of_stiffness_feedback_holds_where_stiffness_jumps():
    """Inside the margin no switching of the stiffness makes it grow; far outside one does."""
    step, mass, stiffest = 1e-3, 1.0, 400.0

    def worst(damping):
        x, v, sizes = 0.01, 0.0, []
        for _ in range(20_000):  # soft outwards, stiff inwards feeds most
            k = stiffest if x * v < 0.0 else 0.05 * stiffest
            v += step * (-(damping * v + k * x) / mass)
            x += step * v
            sizes.append(abs(x))
        return max(sizes[-5000:]) / max(sizes[:5000])

    assert stability_theorem_margin(mass, 41.0, stiffest) > 0.0 and worst(41.0) < 1e-3
    assert stability_theorem_margin(mass, 2.0, stiffest) < 0.0 and worst(2.0) > 10.0


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="not known"):
        make_two_port("telepathy", MASTER, SLAVE, CM, CS)
    with pytest.raises(InputError, match="delays"):
        make_two_port("rate_force", MASTER, SLAVE, CM, CS, delay_back=-0.1)
    with pytest.raises(InputError, match="velocity gain"):
        make_two_port("rate_force", MASTER, SLAVE, CM, CS, StructureGains(velocity=0.0))
    light = Impedance(0.0, 1.0, 1.0)
    with pytest.raises(InputError, match="masses"):
        is_stable(make_two_port("position_position", light, light, CM, CS), light, light)
