"""Scores of the blind trials: which answers are right, and what many of them come to."""

import numpy as np
import pytest

from tools.validation.blind.judge import judge
from tools.validation.blind.score import closure, floor_scatter, score, share, swapped


def effect(name, location, probability=0.95, alternatives=(), value=1.0, ci=(0.5, 1.5)):
    others = [{"name": n, "location": at, "probability": 0.3} for n, at in alternatives]
    return {"name": name, "location": location, "probability": probability, "alternatives": others,
            "parameters": {"mass": {"value": value, "unit": "kg", "ci95": list(ci)}}}  # fmt: skip


def key(kind, *planted, visible=100.0, value=1.0):
    effects = [
        {"name": n, "location": at, "parameters": {"mass": {"value": value}},
         "visibility": {"total_fit_runs": visible}} for n, at in planted
    ]  # fmt: skip
    return {"class": kind, "effects": effects}


def result(verdict, *effects, trial="0000", before=2.0, after=1.0):
    gap = {"before": before, "after": after, "noise_floor": 1.0}
    answer = {"verdict": verdict, "effects": list(effects), "gap": gap, "seconds": 3.0}
    return {"trial": trial, "answer": answer, "error": None}


F = "coulomb_friction", "boom"
A, B, C = ("payload", "tool"), ("valve_gain", "boom"), ("valve_gain", "stick")


@pytest.mark.parametrize(
    ("planted", "answer", "right"),
    [
        (key("single", A), result("named", effect(*A)), True),
        (key("single", B), result("named", effect(*C)), False),  # the wrong place
        (key("single", A), result("named", effect(*A), effect(*B)), False),  # one too many
        (key("single", A), result("ambiguous", effect(*B, 0.5, [A])), True),
        (key("single", A), result("named", effect(*B, 0.9, [A])), False),  # not called ambiguous
        (key("single", A), result("unknown", effect(*A)), False),
        (key("single", A), result("no_gap"), False),
        (key("double", A, B), result("named", effect(*A), effect(*B)), True),
        (key("double", A, B), result("ambiguous", effect(*A), effect(*C, 0.6, [B])), True),
        (key("double", A, B), result("ambiguous", effect(*A, 0.6, [B])), False),  # one for two
        (key("double", A, B), result("named", effect(*A)), False),
        (key("clean"), result("no_gap"), True),
        (key("clean"), result("named", effect(*A)), False),
        (key("clean"), result("unknown"), False),
        (key("outside", ("pump_sag", "supply")), result("unknown"), True),
        (key("outside", ("pump_sag", "supply")), result("unknown", effect(*A, 0.95)), False),
        (key("outside", ("pump_sag", "supply")), result("unknown", effect(*A, 0.8)), False),
        (key("outside", ("pump_sag", "supply")), result("unknown", effect(*A, 0.3)), True),
        (key("outside", ("pump_sag", "supply")), result("named", effect(*A, 0.8)), False),
        (key("outside", ("pump_sag", "supply")), result("learned"), True),
        (key("outside", ("pump_sag", "supply")), result("no_gap"), False),
        (key("single", F), result("named", effect("coulomb_friction_by_position", "boom")), True),
        (key("single", F), result("named", effect("coulomb_friction_by_position", "stick")), False),
        (key("single", A), {"trial": "0", "answer": None, "error": "crashed"}, False),
    ],
)
def test_an_answer_is_right_or_not(planted, answer, right):
    assert judge(planted, answer).right is right


def perfect(count=12):
    """Keys of several truths and the right answers to them."""
    kinds = [key("single", A), key("single", B), key("clean"), key("outside", ("x", "y"))]
    answers = [
        lambda n: result("named", effect(*A), trial=n),
        lambda n: result("ambiguous", effect(*C, 0.6, [B]), trial=n),
        lambda n: result("no_gap", trial=n, before=1.0 + 0.001 * int(n)),
        lambda n: result("unknown", trial=n, before=1.5, after=1.5),
    ]
    names = [f"{k:04d}" for k in range(4 * count)]
    keys = {name: kinds[k % 4] for k, name in enumerate(names)}
    return keys, {name: answers[k % 4](name) for k, name in enumerate(names)}


def test_right_answers_score_full_and_swapped_keys_score_nothing():
    keys, results = perfect()
    scores = score([judge(keys[name], results[name]) for name in results])
    for kind in ("single", "clean", "outside"):
        assert scores["classes"][kind]["right"]["share"] == 1.0
    assert scores["targets"]["clean falsely named"]["reached"]
    assert scores["targets"]["outside surely named"]["value"] == 0.0
    assert scores["targets"]["double right, silence on weak ones set aside"]["reached"] is None
    assert not any(v.right for v in swapped(keys, results))


def test_weak_effects_stand_apart_and_count_in_the_total():
    verdicts = [
        judge(key("single", A, visible=3.0), result("no_gap")),
        judge(key("single", A, visible=80.0), result("named", effect(*A))),
    ]
    single = score(verdicts)["classes"]["single"]
    assert single["right"]["share"] == 0.5
    assert single["right_without_weak"]["share"] == 1.0
    assert single["weak"] == {"no_gap, wrong": 1}


def test_coverage_counts_intervals_of_what_was_named_rightly():
    inside = judge(key("single", A, value=1.4), result("named", effect(*A)))
    outside = judge(key("single", A, value=1.6), result("named", effect(*A)))
    wrong = judge(key("single", B), result("named", effect(*C)))
    assert score([inside, inside, outside, wrong])["coverage"]["share"] == pytest.approx(2 / 3, 1e-3)


def test_closure_regards_gaps_clear_of_the_floor():
    rng = np.random.default_rng(0)
    clean = [judge(key("clean"), result("no_gap", before=1 + s)) for s in 0.01 * rng.normal(size=200)]
    assert floor_scatter(clean) == pytest.approx(0.01, rel=0.2)  # 200 draws know it to 5 %
    near = judge(key("single", A), result("named", effect(*A), before=1.05, after=1.05))
    far = judge(key("single", A), result("named", effect(*A), before=2.0, after=1.02))
    assert closure([*clean, near, far]) == pytest.approx(
        {"median": 0.98, "tenth": 0.98, "of": 1, "floor_scatter": floor_scatter(clean)}, rel=1e-3
    )


def test_share_has_wilsons_interval():
    # 95 % interval of 8 of 10 by Wilson's formula, worked by hand.
    assert share([True] * 8 + [False] * 2) == {"share": 0.8, "of": 10, "ci95": [0.4902, 0.9433]}
