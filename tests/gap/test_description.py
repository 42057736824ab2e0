"""A learned law as curve, formula and words; what is left, located."""

import numpy as np

from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.gap.description import describe, learned_laws
from hydrotele.gap.law_tables import Learned, Table
from hydrotele.gap.result import Lack, Prediction
from hydrotele.machine.machine_file import load_machine

_SMOOTHING = 0.01  # m/s
_TIME = np.linspace(0.0, 20.0, 1001)
SEEN = {
    "time": _TIME,
    "position": 0.5 + 0.2 * np.sin(_TIME),
    "velocity": 0.2 * np.cos(_TIME),
    "command": 0.4 * np.cos(_TIME),
    "velocity.swing": 0.3 + 0.2 * np.sin(2.0 * _TIME),
}


def learned(table, entries, balance="force", axis="boom", covariance=None):
    """The description of a law with these entries, each known to 1 N or so."""
    hypothesis = Hypothesis(f"learned_{balance}", f"{axis}.x", {}, lambda m, _: m)
    covariance = np.eye(len(entries)) if covariance is None else covariance
    law = Learned(hypothesis, balance, axis, table, np.array(entries, float), covariance, _SMOOTHING, SEEN)
    (found,) = learned_laws([law], load_machine("cat215"), {hypothesis.key: 0.4})
    return found


def test_a_curve_is_its_table_with_the_band_of_its_entries():
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 9.0]])
    found = learned(Table(("position",), ((0.3, 0.5, 0.7),)), [100.0, -200.0, 300.0], covariance=covariance)
    x = np.array(found.points)
    np.testing.assert_allclose(found.values, np.interp(x, (0.3, 0.5, 0.7), (100, -200, 300)))
    part = np.clip((x - 0.3) / 0.2, 0.0, 1.0)
    left = x < 0.5
    expected = np.sqrt(4 * (1 - part) ** 2 + part**2 + 2 * part * (1 - part))
    np.testing.assert_allclose(np.array(found.spread)[left], expected[left], rtol=1e-9)
    assert found.formula == "linear_table(position; 0.3: 100, 0.5: -200, 0.7: 300)"
    assert (found.unit, found.variable_unit, found.share) == ("N", "m", 0.4)
    assert x[0] >= SEEN["position"].min() and x[-1] <= SEEN["position"].max()
    assert "force on the boom drive" in found.description and found.resembles == ""


def test_a_table_that_is_friction_is_said_to_resemble_it():
    points = (-0.3, -_SMOOTHING, _SMOOTHING, 0.3)
    found = learned(Table(("velocity",), (points,)), [500.0, 500.0, -500.0, -500.0])
    assert found.resembles == "coulomb_friction" and found.variable_unit == "m/s"


def test_a_law_of_two_variables_is_shown_at_the_median_of_the_second():
    table = Table(("position", "velocity.swing"), ((0.3, 0.7), (-1.0, 0.0, 1.0)))
    found = learned(table, [1.0, 2.0, 3.0, 5.0, 6.0, 7.0])
    x, across = np.array(found.points), float(np.median(SEEN["velocity.swing"]))
    np.testing.assert_allclose(found.values, 2.0 + across + 4.0 * (x - 0.3) / 0.4)
    assert "varies with position and the velocity of the swing" in found.description
    told = describe((), (found,), [predictions((6.0, 9.0))])
    assert told.depends_on == ("position.boom", "velocity.swing")


def predictions(loud):
    """White errors at 50 Hz, and ten times as large in a channel over some seconds."""
    time = 0.02 * np.arange(1000)
    whitened = np.random.default_rng(1).normal(size=(1000, 2))
    inside = (time >= loud[0]) & (time < loud[1])
    whitened[inside, 1] *= 10.0
    nothing = np.zeros((1000, 2))
    return Prediction("made", time, ("angle.boom", "pressure_head.boom"), nothing, nothing, whitened)


def test_what_is_left_is_located_in_balance_channel_and_time():
    lacks = (Lack("flow_head", "boom", 2e-4, "m^3/s", 0.1), Lack("force", "boom", 10.0, "N", 1e-4))
    found = describe(lacks, (), [predictions((6.0, 9.0))])
    assert (found.law, found.channel) == ("flow", "pressure_head.boom")
    assert found.windows == ((6.0, 9.0),)
    assert "oil flow into the boom head side of 12 L/min" in found.description


def test_a_learned_law_tells_on_what_it_depends():
    law = learned(Table(("position",), ((0.3, 0.7),)), [100.0, 5.0])
    found = describe((), (law,), [predictions((6.0, 9.0))])
    assert found.law == "force" and found.depends_on == ("position.boom",)
    assert found.term == law.formula and law.description in found.description


def test_without_any_balance_the_sensor_is_suspected():
    found = describe((), (), [predictions((6.0, 9.0))])
    assert found.law == "sensor" and "sensor" in found.description
