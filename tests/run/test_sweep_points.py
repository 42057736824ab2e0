"""Points: all combinations once, samples that depend on nothing but their seed, place and key."""

import math

import numpy as np
import pytest

from hydrotele.run.sweep_file import Sweep, draw_samples, iterate_points, point_overrides

KEYS = {
    "servo.lead": {"uniform": [0.0, 0.2]},
    "servo.load_time": {"log_uniform": [0.01, 1.0]},
    "servo.position_gain": {"normal": [4.0, 0.5]},
    "sensors": {"choice": ["ideal", "khoshzaban1992"]},
}


def sampled(count: int, keys=None, seed: int = 5) -> Sweep:
    return Sweep.model_validate({"scenario": "zhu_up", "sample": {"count": count, "seed": seed, "keys": keys or KEYS}})


def test_a_grid_is_the_full_product_with_every_sample_and_repeat():
    sweep = Sweep.model_validate({
        "scenario": "zhu_up", "grid": {"servo.lead": [0, 0.1], "tool": ["bucket", "none", "x"]},
        "sample": {"count": 4, "keys": {"servo.load_time": {"uniform": [0.1, 1]}}}, "repeat": 5,
    })  # fmt: skip
    found = list(iterate_points(sweep))
    assert len(found) == sweep.runs == 2 * 3 * 4 * 5
    assert [point.run for point in found] == list(range(1, sweep.runs + 1))
    seen = {(*point.values.values(), point.repetition_number) for point in found}
    assert len(seen) == sweep.runs
    at_each = {tuple(p.values[k] for k in sweep.grid): [] for p in found}
    for point in found:
        if point.repetition_number == 0:
            key = tuple(point.values[k] for k in sweep.grid)
            at_each[key].append(point.values["servo.load_time"])
    assert len(at_each) == 6  # and the same samples everywhere, so that differences are the grid's
    assert all(drawn == samples_of(sweep) for drawn in at_each.values())


def test_many_values_and_many_keys_are_checked_in_linear_time():
    """Comparing all pairs would take minutes."""
    values = {"scenario": "zhu_up", "grid": {"servo.lead": list(range(30_000))}}
    assert Sweep.model_validate(values).runs == 30_000
    keys = {f"servo.k{i}": [0] for i in range(10_000)} | {"servo.lead": [0, 1]}
    assert Sweep.model_validate({"scenario": "zhu_up", "grid": keys}).runs == 2


def samples_of(sweep: Sweep) -> list[float]:
    return [sample["servo.load_time"] for sample in draw_samples(sweep)]


def test_samples_are_reproducible_and_independent_of_count_order_and_other_keys():
    few, many = draw_samples(sampled(3)), draw_samples(sampled(50))
    assert few == many[:3]
    turned = dict(reversed(KEYS.items()))
    assert draw_samples(sampled(3, turned)) == [dict(reversed(s.items())) for s in few]
    alone = draw_samples(sampled(3, {"servo.lead": KEYS["servo.lead"]}))
    assert [s["servo.lead"] for s in alone] == [s["servo.lead"] for s in few]
    assert draw_samples(sampled(3, seed=6)) != few


def test_samples_are_distributed_as_asked():
    # Of 4000 samples a mean is off by less than 5 standard errors, but for one time in a million.
    drawn = draw_samples(sampled(4000))
    error = 5.0 / math.sqrt(4000)
    lead = np.array([s["servo.lead"] for s in drawn])
    assert lead.min() >= 0.0 and lead.max() <= 0.2
    assert abs(lead.mean() - 0.1) < error * 0.2 / math.sqrt(12)
    load = np.log([s["servo.load_time"] for s in drawn])
    width = math.log(100.0)
    assert load.min() >= math.log(0.01) and load.max() <= 0.0
    assert abs(load.mean() + width / 2) < error * width / math.sqrt(12)
    gain = np.array([s["servo.position_gain"] for s in drawn])
    assert abs(gain.mean() - 4.0) < error * 0.5
    assert abs(gain.std() - 0.5) < error * 0.5 / math.sqrt(2)
    ideal = np.array([s["sensors"] == "ideal" for s in drawn])
    assert abs(ideal.mean() - 0.5) < error * 0.5
    assert abs(np.corrcoef(lead, gain)[0, 1]) < error


@pytest.mark.parametrize(
    "value", [1, 1e-7, 2.5e300, True, None, "yes", "1.0", "a: b # c", 'x"\n', [1, {"a": [2]}], "é"]
)
def test_values_survive_the_way_into_overrides(value):
    from hydrotele.core.datafile import parse_yaml_value

    sweep = Sweep.model_validate({"scenario": "a", "grid": {"servo.lead": [value]}, "repeat": 2})
    (text,) = point_overrides(sweep, next(iterate_points(sweep)).values).values()
    read = parse_yaml_value(text)
    assert read == value and type(read) is type(value)
