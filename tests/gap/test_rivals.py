"""Rivals of an effect: what is but another way of saying it is none."""

import numpy as np
import pytest

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.gap.rivals import is_case_of
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data


@pytest.fixture(scope="module")
def evidence():
    machine = load_machine("cat215")
    data, _ = machine_data(machine, machine)
    found = Evidence(data, data.fit, 1)
    found.set_base(Guess())
    yield found
    found.close()


@pytest.mark.parametrize(
    ("name", "other", "case"),
    [
        ("valve_deadband", "valve_deadband_direction", True),
        ("valve_gain", "valve_gain_direction", True),
        ("valve_deadband", "valve_gain_direction", False),
        ("valve_gain", "flow_curve", False),
    ],
)
def test_a_number_is_a_case_of_its_numbers_by_direction(evidence, name, other, case):
    table = {h.key: h for h in hypotheses(evidence.data.machine)}
    guess = Guess(((table[name, "stick"], np.ones(1)),))
    assert is_case_of(evidence, guess, 0, table[other, "stick"]) is case
