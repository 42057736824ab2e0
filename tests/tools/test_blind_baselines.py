"""The baselines: what they read from logs, and what their table says."""

import numpy as np
import pytest

from hydrotele.effects import EFFECTS
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.baselines import (
    changed,
    errors,
    floor,
    library_numbers,
    make_problem,
    table,
    world_prediction,
)
from tools.validation.blind.world import PA, Q, S, W
from tools.validation.blind.world_runs import Noise, nominal_world, record_run, references

CAT = load_machine("cat215")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("logs"), np.random.default_rng(3)
    runs = [record_run(nominal_world(CAT), CAT, asked, Noise({}), rng) for asked in references(CAT, rng, 6.0)]
    for run in runs:
        save_log(run.log, folder / f"{run.name}.parquet")
    return make_problem(folder, CAT, 60.0), runs


@pytest.mark.nightly
def test_smoothed_states_are_near_the_true_ones(recorded):
    problem, runs = recorded
    for states, run in zip(problem.states, runs, strict=True):
        inner = slice(15, -15)  # half of the widest window, where local cubics are good
        error = (states - run.states)[inner]
        assert np.abs(error[:, :, Q]).max() < np.radians(0.15)  # the noise is 0.1 deg
        assert np.sqrt(np.mean(error[:, :, W] ** 2)) < 0.03  # rad/s, of some 0.5
        assert np.sqrt(np.mean(error[:, :, PA] ** 2)) < 2e5  # Pa, twice the noise of a reading
        assert np.abs(error[:, :, S]).max() < 0.03  # Euler's rule at 1 ms for an 8 Hz spool


@pytest.mark.nightly
def test_the_true_model_reaches_the_floor_and_a_wrong_one_does_not(recorded):
    problem, _ = recorded
    last = len(problem.commands) - 1

    def size(facts):
        return np.sqrt(np.mean(errors(problem, world_prediction(problem, facts), last) ** 2))

    perfect = floor(problem, np.random.default_rng(0))
    group = next(g for g in library_numbers(CAT) if g[0][:2] == ("command_delay", "all"))
    # one window of 5 s, whose start is off by what smoothing leaves: that differs by draw
    assert size(CAT) < 2.0 * perfect
    assert size(changed(CAT, group, np.array([2.0]))) > 2.0 * perfect


def test_numbers_are_those_of_the_library():
    for group in library_numbers(CAT):
        known = EFFECTS[group[0].effect].parameters(CAT, group[0].place)
        assert [p.key for p in group] == list(known)


def test_the_table_counts_by_method_and_kind():
    row = {"method": "single", "kind": "near", "planted": True, "right": True, "named": "a(b)",
           "closed": 0.5, "seconds": 10.0}  # fmt: skip
    bare = {**row, "kind": "clean", "planted": False, "right": False, "closed": None}
    page = table([row, {**row, "right": False, "named": None}, bare])
    assert "| single | near | 2 | 50 % of 2 | - | 0.50 | 10 |" in page
    assert "| single | clean | 1 | - | 100 % of 1 | - | 10 |" in page
