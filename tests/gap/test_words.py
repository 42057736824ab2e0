"""The verdict says what a mechanic needs: which, where, how much, how sure, what next."""

import dataclasses
import math

import pytest

from hydrotele.effects import EFFECTS
from hydrotele.gap.description import effect_title, gap_closed, headline, lack_words, verdict_words
from hydrotele.gap.result import (
    Alternative,
    Estimate,
    GapSize,
    Lack,
    NamedEffect,
    amount,
    in_customary_units,
)
from hydrotele.machine.machine_file import load_machine


def text_of(gap) -> str:
    return " ".join(verdict_words(gap))


def test_a_named_effect_is_said_with_size_interval_and_proof(gap_of):
    gap = gap_of("named")
    words = text_of(gap)
    assert headline(gap) == "Payload at the tool: mass 251.3 kg"
    assert "247.9 to 254.6 kg; the model has 0 kg" in words
    assert "over 99.9 %" in words and "run test_1, which was not fitted" in words
    assert f"from {gap.size.before:.2f} to {gap.size.after:.2f} times" in words
    assert EFFECTS["payload"].description in words
    assert "nan" not in words and "explanation is incomplete" not in words


def test_no_gap_asks_for_no_change(gap_of):
    gap = gap_of("no_gap")
    assert headline(gap) == "Model and machine agree"
    assert "The model needs no change" in text_of(gap)


def test_an_unknown_says_law_channel_and_dependence_in_plain_words(gap_of):
    words = text_of(gap_of("unknown"))
    for piece in ("balance of forces", "boom head side pressure", "boom piston position", "9 kN"):
        assert piece in words
    assert "pressure_head" not in words


def test_beside_an_unknown_only_what_is_likely_is_said_to_be_known(gap_of):
    (effect,) = gap_of("named").effects
    for probability, said in ((0.9, "apart from payload at the tool, "), (0.006, "")):
        told = (dataclasses.replace(effect, probability=probability),)
        gap = dataclasses.replace(gap_of("unknown"), effects=told)
        assert headline(gap).endswith(f"differ; {said}no known effect explains the difference")


def test_an_unknown_whose_gap_is_closed_does_not_say_that_nothing_explains_it(gap_of):
    """A learned law closes all of it: what is unknown is the cause."""
    partly = gap_of("partly")
    size = GapSize(5.0, 1.0, 1.0)
    gap = dataclasses.replace(partly, verdict="unknown", effects=(), calibration={}, size=size)
    words = text_of(gap)
    assert headline(gap) == (
        "Model and machine differ; learned laws close 100 % of the gap, but the cause is not identified"
    )
    assert "Learned laws close 100 % of the gap, but no known effect has their form" in words
    assert "no known effect explains" not in words


def test_an_effect_that_the_heldout_run_does_not_show_has_no_share_of_zero(gap_of):
    (effect,) = gap_of("named").effects
    gap = dataclasses.replace(gap_of("named"), effects=(dataclasses.replace(effect, share=0.001),))
    words = text_of(gap)
    assert "Without it" not in words
    assert "holds for the fitted runs; run test_1 does not show it" in words


def test_a_residual_input_at_its_bound_is_not_a_size(gap_of):
    at_limit = lack_words(Lack("flow_head", "boom", 1e-4, "m^3/s", 1.0))
    assert at_limit.startswith("The model cannot follow the boom") and "L/min" not in at_limit


def test_an_ambiguity_names_both_and_the_experiment(gap_of):
    gap = gap_of("ambiguous")
    assert headline(gap) == "Either length offset of the boom or pin offset of the boom"
    words = text_of(gap)
    for piece in (
        "62 %",
        "(37 %)",
        "-6.10 mm",
        "patched model contains the first",
        "Next experiment",
    ):
        assert piece in words


def test_a_mechanism_of_open_form_is_named_with_both_forms(gap_of):
    """A delay and a lag of one sensor are one mechanism; the pin of another place is none."""
    form, place = Alternative("angle_lag", "swing", 0.38), Alternative("angle_lag", "boom", 0.38)
    value = {"delay": Estimate(9.0e-3, "s", 8.9e-3, 9.1e-3, 0.0)}
    late = NamedEffect("angle_delay", "swing", 0.61, value, (form, place))
    assert late.other_forms == (form,)
    assert late.mechanism_probability == pytest.approx(0.99)
    words = text_of(dataclasses.replace(gap_of("named"), effects=(late,)))
    assert "do not distinguish angle delay of the swing from angle lag of the swing (38 %)" in words
    sure = dataclasses.replace(late, probability=0.99)
    assert "form is not identifiable" not in text_of(dataclasses.replace(gap_of("named"), effects=(sure,)))
    unlike = NamedEffect("length_offset", "boom", 0.61, {}, (Alternative("pin_offset", "boom", 0.3),))
    assert unlike.other_forms == () and unlike.mechanism_probability == 0.61
    same = Alternative("com_offset", "swing", 0.54, same=True)  # about a vertical axis
    inertia = NamedEffect("inertia_error", "swing", 0.45, {}, (same,))
    assert inertia.mechanism_probability == pytest.approx(0.99)


def test_a_partly_named_gap_says_what_is_named_learned_and_left(gap_of):
    gap = gap_of("partly")
    assert headline(gap) == "Payload at the tool: mass 251.3 kg; the remaining difference has no known cause"
    words = text_of(gap)
    for piece in (
        "one place with an identified effect",
        "Without it, 63 % of the gap on run test_1 reappears",
        "2 uncertain parameters were calibrated",
        "valve gain of the boom: ratio 104.00 % (model 100)",
        "unexplained residual is in the balance of forces",
        "One law was learned",
        "With all these changes",
    ):
        assert piece in words, piece


def test_numbers_off_alone_are_no_gap_but_said(gap_of):
    gap = dataclasses.replace(gap_of("no_gap"), calibration=gap_of("partly").calibration)
    assert headline(gap) == "Model and machine agree within the uncertainty of its parameters"
    words = text_of(gap)
    assert "2 uncertain parameters were calibrated" in words and "The model needs no change" not in words


def test_failed_tests_are_not_kept_quiet(gap_of):
    tests = {"window means": {"value": 9.0, "limit": 4.0, "passed": False}}
    gap = dataclasses.replace(gap_of("named"), tests=tests)
    assert "remaining errors fail the test window means" in text_of(gap)


def test_a_gap_within_the_noise_is_called_weak(gap_of):
    gap = dataclasses.replace(gap_of("named"), size=GapSize(1.04, 1.0, 1.0))
    assert "weak" in text_of(gap) and "of the gap is closed" not in text_of(gap)


def test_closed_part():
    assert gap_closed(GapSize(3.0, 1.1, 1.0)) == pytest.approx(0.95, abs=1e-12)  # rounding
    assert gap_closed(GapSize(3.0, 0.99, 1.0)) == 1.0
    assert math.isnan(gap_closed(GapSize(0.99, 0.99, 1.0)))


@pytest.mark.parametrize(
    ("value", "unit", "parameter", "expected"),
    [
        (0.0853, "1", "deadband", "8.53 %"),
        (1.6e-11, "m^3/(s Pa)", "leakage", "9.6 L/min per 100 bar"),
        (5e-3, "m^3/s", "pump_flow", "300 L/min"),
        (24.5e6, "Pa", "relief_pressure", "24.5 MPa"),
        (0.06, "s", "delay", "60 ms"),
        (math.radians(1.0), "rad", "offset", "1 deg"),
        (2 * math.pi * 8, "rad/s", "bandwidth", "8 Hz"),
        (48000.0, "N s/m", "viscous", "48 kN s/m"),
        (math.nan, "Pa", "offset", "- bar"),
        (0.9e9, "Pa", "bulk_modulus", "900 MPa"),
    ],
)
def test_customary_numbers(value, unit, parameter, expected):
    shown = amount(value, unit, parameter)
    assert shown == expected or (math.isnan(value) and shown.startswith("- "))


def test_digits_follow_the_interval():
    wide = in_customary_units(Estimate(251.27, "kg", 210.0, 290.0, 0.0))
    narrow = in_customary_units(Estimate(251.27, "kg", 251.24, 251.3, 0.0))
    assert (wide.value, narrow.value) == ("251", "251.270")
    assert in_customary_units(Estimate(1.0, "kg", math.nan, math.nan, 0.0)).low == "-"


def test_every_effect_has_a_title_and_known_units():
    """A unit that no mechanic uses would show up here when an effect is added."""
    machine = load_machine("cat215", "none")
    for effect in EFFECTS.values():
        for location in effect.locations(machine):
            title = effect_title(Alternative(effect.name, location, 1.0))
            assert "_" not in title and "." not in title and title.startswith(effect.name[:3])
            for name, facts in effect.parameters(machine, location).items():
                size = max(abs(facts.nominal), facts.prior_std)
                assert "Pa" not in amount(size, facts.unit, name).replace("MPa", ""), facts.unit
