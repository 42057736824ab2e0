"""A single run is split in time where it can be judged."""

import numpy as np
import pytest

from hydrotele.logs.dataset import split_runs
from hydrotele.logs.resampling import RunRows


def rows(command):
    n = len(command)
    return RunRows(0.0, 0.02, np.asarray(command, float)[:, None], np.ones(n, bool), np.zeros((n, 1)),
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
