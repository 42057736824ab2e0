"""A single run is split in time where it can be judged."""

import numpy as np
import pytest

from hydrotele.logs.dataset import describe_resting_axes, split_runs
from hydrotele.logs.resampling import RunRows


def rows(command):
    n = len(command)
    return RunRows(0.0, 0.02, np.asarray(command, float).reshape(n, -1), np.ones(n, bool), np.zeros((n, 1)),
                np.ones(n, bool))  # fmt: skip


def parts(command):
    found, _ = split_runs({"run": rows(command)}, {"run": "run"}, None)
    return sum(len(p.rows.command) for p in found.fit), len(found.heldout.rows.command)


def test_three_quarters_are_fitted_of_a_run_that_moves_to_its_end():
    assert parts(np.sin(0.1 * np.arange(2000))) == (1500, 500)
    assert parts(np.zeros(2000)) == (1500, 500)


def test_a_rest_at_the_end_judges_nothing():
    """It moves for 70 % of the time: the last quarter of its motion is held out, with the rest."""
    wave = np.sin(0.1 * np.arange(2000)) * (np.arange(2000) < 1400)
    fitted, held = parts(wave)
    assert fitted == pytest.approx(0.75 * 1400, rel=0.02) and fitted + held == 2000
    early = np.sin(0.1 * np.arange(2000)) * (np.arange(2000) < 1000)
    assert parts(early) == (1000, 1000)  # half of the run at least is fitted


def test_a_held_out_part_that_rests_on_an_axis_is_noted():
    """The axes move one after another, so that the last quarter moves the second one only."""
    t = np.linspace(0.0, 1.0, 4000)
    both = np.column_stack([np.sin(60.0 * t) * (t < 0.7), np.sin(60.0 * t) * (t > 0.6)])
    both += np.random.default_rng(0).uniform(-0.08, 0.08, both.shape)  # noise of a joystick
    alike = np.column_stack([np.sin(60.0 * t), np.cos(60.0 * t)])
    notes = [describe_resting_axes(split_runs({"run": rows(x)}, {"run": "run"}, None)[0], ("boom", "stick"))
             for x in (both, alike)]  # fmt: skip
    assert len(notes[0]) == 1 and "hardly moves boom," in notes[0][0] and notes[1] == ()
