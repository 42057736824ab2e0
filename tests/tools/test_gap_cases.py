"""Answers of the gap search compared with the hidden effects."""

from pathlib import Path

import pytest

from tools.validation.gap_cases import Case, judge_case

FRICTION, GAIN = ("coulomb_friction", "stick"), ("valve_gain", "boom")


def named(*effects, verdict="named"):
    """A document of a search that names some effects."""
    return {"verdict": verdict,
            "effects": [{"name": n, "location": at, "probability": p} for n, at, p in effects]}  # fmt: skip


def case(*hidden, is_known=True):
    return Case("made", Path("."), "cat215", tuple((pair,) for pair in hidden), is_known)


@pytest.mark.parametrize(("hidden", "document", "found", "false"), [
    (case(FRICTION), named((*FRICTION, 0.97)), True, 0),
    (case(FRICTION), named(("coulomb_friction_by_position", "stick", 0.97)), True, 0),  # a form of it
    (case(FRICTION), named(("coulomb_friction_by_position", "boom", 0.97)), False, 1),
    (case(FRICTION), named(("viscous_friction_by_position", "stick", 0.97)), False, 1),
    (case(FRICTION), named((*FRICTION, 0.4), verdict="partly"), False, 0),  # below one half
    (case(FRICTION), named((*FRICTION, 0.97), verdict="unknown"), False, 0),
    (case(FRICTION, GAIN), named((*FRICTION, 0.97)), False, 0),
    (case(FRICTION, GAIN), named((*FRICTION, 0.97), (*GAIN, 0.9)), True, 0),
    (case(), named(verdict="no_gap"), True, 0),
    (case(), named((*GAIN, 0.97)), False, 1),
    (case(is_known=False), named(verdict="unknown"), True, 0),
])  # fmt: skip
def test_an_answer_is_compared_with_the_hidden_effects(hidden, document, found, false):
    judged = judge_case(hidden, document)
    assert (judged["found"], judged["false"]) == (found, false)
