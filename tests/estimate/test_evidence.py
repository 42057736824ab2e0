"""Evidence: errors of guesses at coarse steps, against the same at the full step."""

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import machine_data


@pytest.fixture(scope="module")
def evidence():
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, apply_effect(nominal, "angle_offset", "boom", {"offset": 2e-3}))
    found = Evidence(data, data.fit, 1)
    found.set_base(Guess())
    yield found
    found.close()


def guess(evidence, name, *deviation):
    nominal = evidence.data.machine
    (part,) = [h for h in hypotheses(nominal, [name]) if h.location == "boom"]
    return Guess(((part, np.array(deviation)),))


def test_a_coarse_step_changes_nothing_for_the_base(evidence):
    own = evidence.errors(Guess())
    for step in (2e-3, 4e-3, 10e-3):
        np.testing.assert_allclose(evidence.errors(Guess(), step), own, atol=1e-9)  # rounding


@pytest.mark.parametrize(
    ("name", "deviation"), [("angle_offset", (0.2,)), ("pin_offset", (0.1, 0.1))]
)
def test_the_gain_of_an_effect_does_not_depend_on_the_step(evidence, name, deviation):
    """At 10 ms the integrator's own errors would change the loss by more than the effect does."""
    effect = guess(evidence, name, *deviation)
    gains = []
    for step in (1e-3, 4e-3, 10e-3):
        before, after = evidence.errors(Guess(), step), evidence.errors(effect, step)
        gains.append(before @ before - after @ after)
    assert gains[1] == pytest.approx(gains[0], rel=0.02)
    assert gains[2] == pytest.approx(gains[0], rel=0.1)
    integrator = np.sum(evidence.step_effect(Guess(), 10e-3) ** 2)
    assert integrator > 0.5 * abs(gains[0])
