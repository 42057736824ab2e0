"""Gains are found where they are best."""

import math

import pytest

from hydrotele.envs.controllers.catalogue import tune_gains


def test_a_ridge_is_climbed_to_its_top_within_bounds():
    def value(gains):
        across = math.log(gains["a"] / 7.0)
        along = math.log(gains["b"] / 0.2)
        return -(across**2) - along**2 - 0.5 * across * along + min(gains["c"], 3.0)

    best, score = tune_gains(value, {"a": 1.0, "b": 1.0, "c": 1.0}, 1.1, 4, upper_bounds={"c": 2.0})
    # a step of 10 % may leave half a step to either side
    assert best["a"] == pytest.approx(7.0, rel=0.11)
    assert best["b"] == pytest.approx(0.2, rel=0.11)
    assert best["c"] == 2.0
    assert score == value(best)
