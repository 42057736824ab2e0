"""Standard deviations of named effects: noise, scatter over runs, and the integrator's steps."""

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.machine_file import load_machine
from hydrotele.prediction.evidence import Evidence
from hydrotele.prediction.hypothesis import Guess, hypotheses
from hydrotele.prediction.intervals import spreads
from tests.prediction.test_filter import machine_data


def fitted(name, location, values, step=1e-3):
    """Evidence with the true guess as base, its fit, and the noise's part of the spread."""
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, apply_effect(nominal, name, location, values))
    (hypothesis,) = [h for h in hypotheses(nominal, [name]) if h.location == location]
    numbers = [(values[key] - p.nominal) / p.scale for key, p in hypothesis.parameters.items()]
    guess = Guess(((hypothesis, np.array(numbers)),))
    evidence = Evidence(data, data.fit, 1, step)
    evidence.set_base(guess)
    fit = evidence.fit(guess, 0.0)
    return evidence, fit, np.sqrt(np.diag(np.linalg.inv(fit.information)))


def test_only_scatter_beyond_chance_widens():
    evidence, fit, noise = fitted("angle_offset", "boom", {"offset": 0.01})
    # steps hardly matter to an offset
    assert spreads(evidence, fit.guess) == pytest.approx(noise, rel=0.05)
    assert spreads(evidence, fit.guess, 2.5) == pytest.approx(noise, rel=0.05)
    assert spreads(evidence, fit.guess, 16.0) == pytest.approx(4.0 * noise, rel=0.05)
    evidence.close()


def test_what_half_the_step_changes_is_added():
    """At 10 ms the steps show in a delay; a fit at half the step moves as far as is stated."""
    evidence, fit, noise = fitted("command_delay", "all", {"delay": 0.05}, step=10e-3)
    wide = spreads(evidence, fit.guess)
    finer = Evidence(evidence.data, evidence.data.fit, 1, 5e-3)
    finer.set_base(fit.guess)
    moved = finer.fit(fit.guess, 0.0).guess.deviation - fit.guess.deviation
    finer.close()
    assert np.abs(moved) > 3.0 * noise
    # one Gauss-Newton step against a whole fit, and gains of the other step
    assert np.sqrt(3.0 * (wide**2 - noise**2)) == pytest.approx(np.abs(moved), rel=0.2)
    evidence.close()
