"""Standard deviations of named effects: noise, scatter over runs, and the integrator's steps."""

import dataclasses

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.evidence import Evidence, standard_deviations
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.machine.machine_file import load_machine
from tests.estimate.test_filter import PERIOD, machine_data


def fitted(name, location, values, step=1e-3):
    """Evidence with the true guess as base, its fit, and the noise's part of the spread."""
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, apply_effect(nominal, name, location, values))
    (hypothesis,) = [h for h in hypotheses(nominal, [name]) if h.location == location]
    numbers = [(values[key] - p.nominal) / p.prior_std for key, p in hypothesis.parameters.items()]
    guess = Guess(((hypothesis, np.array(numbers)),))
    evidence = Evidence(data, data.fit, 1, step)
    evidence.set_base(guess)
    fit = evidence.fit(guess, 0.0)
    return evidence, fit, np.sqrt(np.diag(np.linalg.inv(fit.information)))


@pytest.mark.nightly
def test_only_scatter_beyond_chance_widens():
    evidence, fit, noise = fitted("angle_offset", "boom", {"offset": 0.01})
    # steps hardly matter to an offset; 40 stretches tell a spread to 11 %
    plain = standard_deviations(evidence, fit.guess)
    assert np.all((plain > 0.99 * noise) & (plain < 1.3 * noise))
    assert standard_deviations(evidence, fit.guess, 2.5) == pytest.approx(plain, rel=0.05)
    assert standard_deviations(evidence, fit.guess, 16.0) == pytest.approx(4.0 * plain, rel=0.05)
    evidence.close()


@pytest.mark.nightly
def test_errors_that_hang_together_widen():
    """Readings of one sensor off by a slow wave, as of a law of another form."""
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, nominal)
    place, run = data.channels.index("angle.boom"), data.fit[0]
    (hypothesis,) = [h for h in hypotheses(nominal, ["angle_offset"]) if h.location == "boom"]

    def spread(wave: float) -> float:
        reading = run.reading.copy()
        reading[:, place] += wave * np.sin(2.0 * np.pi * PERIOD * np.arange(len(reading)) / 3.0)
        moved = dataclasses.replace(run, reading=reading)
        evidence = Evidence(dataclasses.replace(data, fit=(moved,)), (moved,), 1)
        guess = Guess(((hypothesis, np.zeros(1)),))
        evidence.set_base(guess)
        (found,) = standard_deviations(evidence, evidence.fit(guess, 0.0).guess)
        evidence.close()
        return found

    # 4 times the noise for 1.5 s each way: as if 37 readings of each half-wave were one
    assert spread(4e-3) > 2.0 * spread(0.0)


def test_what_half_the_step_changes_is_added():
    """At 10 ms the steps show in a delay; a fit at half the step moves as far as is stated."""
    evidence, fit, noise = fitted("command_delay", "all", {"delay": 0.05}, step=10e-3)
    wide = standard_deviations(evidence, fit.guess)
    finer = Evidence(evidence.data, evidence.data.fit, 1, 5e-3)
    finer.set_base(fit.guess)
    moved = finer.fit(fit.guess, 0.0).guess.deviation - fit.guess.deviation
    finer.close()
    assert np.abs(moved) > 3.0 * noise
    # one Gauss-Newton step against a whole fit, gains of the other step, pulls of 40 stretches
    assert np.sqrt(3.0 * (wide**2 - noise**2)) == pytest.approx(np.abs(moved), rel=0.3)
    evidence.close()
