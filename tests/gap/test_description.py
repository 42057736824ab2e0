"""A learned law as curve, formula and words; what is left, located."""

from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.effects import Parameter
from hydrotele.gap.description import describe, learned_laws
from hydrotele.gap.discover import Discovery, Learned
from hydrotele.gap.law_shapes import Shape
from hydrotele.gap.result import Lack, Prediction
from hydrotele.machine_file import load_machine
from hydrotele.prediction.hypothesis import Guess, Hypothesis

_SMOOTHING = 0.01  # m/s
_TIME = np.linspace(0.0, 20.0, 1001)
SEEN = {
    "time": _TIME,
    "position": 0.5 + 0.2 * np.sin(_TIME),
    "velocity": 0.2 * np.cos(_TIME),
    "command": 0.4 * np.cos(_TIME),
}


def learned(shape, coefficients, balance="force", axis="boom"):
    """The description of a law with these coefficients, each known to a tenth of its scale."""
    scale = 10.0
    parameters = {p: Parameter("N", 0.0, -1e6, 1e6, scale, 0.0) for p in shape.products}
    hypothesis = Hypothesis(f"learned_{balance}", f"{axis}.x", parameters, lambda m, _: m)
    law = Learned(hypothesis, balance, axis, shape, _SMOOTHING, SEEN)
    guess = Guess(((hypothesis, np.array(coefficients) / scale),))
    spread = np.full(len(coefficients), 0.1)
    (found,) = learned_laws(
        Discovery(SimpleNamespace(guess=guess), (law,)), load_machine("cat215"), spread,
        {hypothesis.key: 0.4},
    )  # fmt: skip
    return found


def test_a_curve_is_its_formula_with_the_band_of_its_coefficients():
    found = learned(Shape("position", "", (0.55,)), [100.0, -200.0, 3000.0])
    x, share = np.array(found.points), found.share
    kink = np.maximum(0.0, x - 0.55)
    np.testing.assert_allclose(found.values, 100.0 - 200.0 * x + 3000.0 * kink, rtol=1e-9)
    np.testing.assert_allclose(found.spread, np.sqrt(1.0 + x**2 + kink**2), rtol=1e-9)
    assert found.formula == "100 - 200 position + 3e+03 above(position, 0.55)"
    assert (found.unit, found.variable_unit, share) == ("N", "m", 0.4)
    assert x[0] >= SEEN["position"].min() and x[-1] <= SEEN["position"].max()
    assert "force on the boom drive" in found.description and found.resembles == ""


def test_a_law_with_the_sign_of_the_motion_is_shown_for_positive_motion():
    """A constant times the sign is Coulomb friction, and is said to resemble it."""
    found = learned(Shape("position", f"sign(velocity, {_SMOOTHING})", ()), [-500.0, 0.0])
    np.testing.assert_allclose(found.values, -500.0, rtol=1e-9)
    assert found.resembles == "coulomb_friction"
    assert "changes sign with the motion" in found.description


@pytest.mark.parametrize(
    ("balance", "axis", "unit"),
    [("force", "boom", "N s/m"), ("force", "swing", "N m s/rad"), ("flow_head", "boom", "m^2")],
)
def test_a_law_in_proportion_to_the_speed_is_per_speed(balance, axis, unit):
    found = learned(Shape("position", "velocity", ()), [-50.0, 0.0], balance, axis)
    np.testing.assert_allclose(found.values, -50.0, rtol=1e-9)
    assert found.unit == unit
    assert found.variable_unit == ("rad" if axis == "swing" else "m")


def predictions(loud):
    """White errors at 50 Hz, and ten times as large in a channel over some seconds."""
    time = 0.02 * np.arange(1000)
    whitened = np.random.default_rng(1).normal(size=(1000, 2))
    inside = (time >= loud[0]) & (time < loud[1])
    whitened[inside, 1] *= 10.0
    nothing = np.zeros((1000, 2))
    return Prediction(
        "made", time, ("angle.boom", "pressure_head.boom"), nothing, nothing, whitened
    )


def test_what_is_left_is_located_in_balance_channel_and_time():
    lacks = (Lack("flow_head", "boom", 2e-4, "m^3/s", 0.1), Lack("force", "boom", 10.0, "N", 1e-4))
    found = describe(lacks, (), [predictions((6.0, 9.0))])
    assert (found.law, found.channel) == ("flow", "pressure_head.boom")
    assert found.windows == ((6.0, 9.0),)
    assert "oil flow into the boom head side of 12 L/min" in found.description


def test_a_learned_law_tells_on_what_it_depends():
    law = learned(Shape("position", "", ()), [100.0, 5.0])
    found = describe((), (law,), [predictions((6.0, 9.0))])
    assert found.law == "force" and found.depends_on == ("position.boom",)
    assert found.term == law.formula and law.description in found.description


def test_without_any_balance_the_sensor_is_suspected():
    found = describe((), (), [predictions((6.0, 9.0))])
    assert found.law == "sensor" and "sensor" in found.description
