"""Calibration: numbers that are off everywhere are recovered within their intervals."""

import numpy as np
import pytest

from hydrotele.effects import EFFECTS
from hydrotele.effects.effect import with_value
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, calibration, numbers
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data

_KINDS = ("mass", "valve_gain", "valve_deadband", "viscous_friction", "internal_leakage", "area")
_ROUNDS = 2  # of new gains: the first errors are large


@pytest.mark.nightly
def test_numbers_off_everywhere_are_recovered_within_their_intervals():
    """All numbers of some kinds on boom and stick, drawn from their priors; 12 s of data.

    Of about 15 numbers none may be 4 standard deviations off (chance: 1 in 1000), and their mean
    square must be that of a chi-square, which scatters by 0.37.
    """
    nominal = load_machine("cat215")
    left_out = frozenset(
        key for key in numbers(nominal)
        if key.split(".")[0] not in _KINDS or key.split(".")[1] not in ("boom", "stick")
    )  # fmt: skip
    group = calibration(nominal, left_out)
    assert 10 <= group.size <= 20
    drawn = np.clip(np.random.default_rng(4).normal(size=group.size), group.low, group.high)
    data, _ = machine_data(nominal, group.change(nominal, group.values(drawn)))
    evidence = Evidence(data, data.fit, 2, 2e-3)
    guess = Guess().plus(group, np.zeros(group.size))
    try:
        for _ in range(_ROUNDS):
            evidence.set_base(guess)
            fit = evidence.fit(guess, 0.0, steps=3)
            guess = fit.guess
    finally:
        evidence.close()
    spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
    off = (guess.deviation - drawn) / spread
    assert np.all(np.abs(off) < 4.0), dict(zip(group.parameters, off.round(1), strict=True))
    assert 0.2 < np.mean(off**2) < 2.5
    # 12 s say much more of most numbers than a data sheet does
    assert np.median(spread) < 0.3


def test_the_machine_file_states_what_is_uncertain():
    """By kind and place, by kind, or for all; 0 takes a number for exact."""
    stated = {"default": 0.01, "mass": 0.03, "mass.stick": 0.2, "valve_gain": 0.0}
    machine = load_machine("cat215").model_copy(update={"uncertainty": stated})
    found = numbers(machine)
    shares = {
        key: number.parameter.prior_std / abs(number.parameter.nominal)
        for key, number in found.items() if number.parameter.nominal
    }  # fmt: skip
    assert np.isclose(shares["mass.stick"], 0.2) and np.isclose(shares["mass.boom"], 0.03)
    assert np.isclose(shares["valve_damping.boom"], 0.01)
    assert not any(key.startswith("valve_gain.") for key in found)


def test_a_loss_that_a_data_sheet_leaves_out_is_uncertain_if_the_file_says_so():
    """A number that is 0 has no relative size: its effect's typical size takes the place."""
    machine = with_value(load_machine("eha"), "axes.piston.pump.motor.drag", 0.0)
    silent = numbers(with_value(machine, "uncertainty", {}))
    assert "motor_drag.piston.drag" not in silent
    assert "pressure_offset.piston.rod.offset" not in silent
    stated = numbers(with_value(machine, "uncertainty", {"motor_drag": 2.0, "pressure_offset": 1.0}))
    typical = EFFECTS["motor_drag"].parameters(machine, "piston")["drag"].prior_std
    assert stated["motor_drag.piston.drag"].parameter.prior_std == 2.0 * typical
    assert stated["motor_drag.piston.drag"].parameter.lower_bound == 0.0  # drag drives nothing
    offset = stated["pressure_offset.piston.rod.offset"].parameter
    assert offset.prior_std == pytest.approx(abs(offset.nominal))  # not 0 in this machine: relative
    dragged = stated["motor_drag.piston.drag"].change(machine, 0.4)
    assert dragged.axes["piston"].pump.motor.drag == 0.4


@pytest.mark.nightly
def test_a_scale_of_all_areas_flows_and_masses_does_not_show():
    """Pressures and positions do not tell it: 1 % of all is known no better than by the priors.

    Each number alone shows by tens of standard deviations; what they leave together is what slopes
    are wrong by. Stick and boom have cylinders, the swing a motor; port relief and make-up, which
    are not among the numbers, break the scale a little.
    """
    scaled = (
        "area", "displacement", "valve_gain", "pump_flow_limit", "mass", "dead_volume",
        "inertia_error", "coulomb_friction", "viscous_friction", "stribeck_friction",
        "internal_leakage",
    )  # fmt: skip
    nominal = load_machine("cat215")
    group = calibration(nominal)
    data, _ = machine_data(nominal, nominal)
    evidence = Evidence(data, data.fit, 2, 2e-3)
    guess = Guess().plus(group, np.zeros(group.size))
    try:
        evidence.set_base(guess)
        slopes = evidence.base_slopes(evidence.slope_step)
    finally:
        evidence.close()
    percent = np.array([
        0.01 * p.nominal / p.prior_std if key.split(".")[0] in scaled else 0.0
        for key, p in group.parameters.items()
    ])  # fmt: skip
    alone = np.linalg.norm(slopes * percent, axis=0)
    assert alone.max() > 20.0
    assert np.linalg.norm(slopes @ percent) < 0.4  # 1.7 by single slopes, 0.08 here
