"""Black boxes: they find what they can express, in the rows that they are not shown."""

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.estimate.baselines import BASELINES, fit_baseline
from hydrotele.estimate.free_run import free_run_errors
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.machine.machine_file import load_machine

DEADBAND, DELAY = 0.3, 0.12


def made(law, period=0.02, seconds=60.0, seed=0):
    """A slide that moves at `law(command)` after a delay, with commands that hold for a while."""
    rng = np.random.default_rng(seed)
    rows, hold = round(seconds / period), round(0.7 / period)
    command = np.repeat(rng.uniform(-1, 1, rows // hold + 1), hold)[:rows]
    past = command[np.maximum(np.arange(rows) - round(DELAY / period), 0)]
    position = np.concatenate([[0.0], np.cumsum(law(past) * period)[:-1]])
    log = Log(time=period * np.arange(rows), columns={}, units={})
    return RunData(f"made_{seed}", 0.0, period, command[:, None], np.ones(rows, bool),
                   position[:, None], log)  # fmt: skip


def data_of(law, periods=(0.02, 0.02, 0.02)):
    first, second, judge = (made(law, p, seed=k) for k, p in enumerate(periods))
    machine = load_machine("emps")
    return Dataset(machine, ("slide",), ("position.slide",), np.array([np.nan]), (first, second),
                   judge, ())  # fmt: skip


def valve(command):
    """Speed of a valve with a dead band, faster backwards [m/s]."""
    beyond = np.sign(command) * np.maximum(np.abs(command) - DEADBAND, 0.0)
    return np.where(beyond > 0.0, 0.1, 0.15) * beyond


def linear(command):
    return 0.1 * command


def error_over_still(name, data, horizon="5"):
    """RMS error of a baseline over the error of a machine that stands still."""
    run = data.heldout
    found = free_run_errors(fit_baseline(name, data)(run), run, (1.0, 5.0))
    rows = round(float(horizon) / run.period)
    moved = run.reading[rows:] - run.reading[:-rows]
    return float(found.horizons[horizon].rms[0] / np.sqrt(np.mean(moved**2)))


@pytest.mark.parametrize("periods", [(0.02, 0.02, 0.02), (0.004, 0.01, 0.02)])
def test_the_table_finds_delay_and_dead_band(periods):
    """Nodes 0.1 apart cut a kink by less than 0.004 m/s; the slide moves at 0.03 m/s mostly."""
    assert error_over_still("table", data_of(valve, periods)) < 0.1


@pytest.mark.nightly
def test_the_linear_model_finds_a_linear_slide_and_not_a_dead_band():
    assert error_over_still("arx", data_of(linear)) < 0.1
    assert error_over_still("arx", data_of(valve)) > error_over_still("table", data_of(valve))


@pytest.mark.nightly
def test_the_network_learns_the_dead_band():
    pytest.importorskip("sklearn", reason="scikit-learn is an extra")
    assert error_over_still("mlp", data_of(valve)) < 0.3


@pytest.mark.parametrize("name", ["table", "arx"])
def test_gaps_in_the_readings_cost_only_themselves(name):
    data = data_of(valve)
    for run in (*data.fit, data.heldout):
        run.reading[500:560] = np.nan
    assert error_over_still(name, data_of(valve)) < 1.0
    run = data.heldout
    found = free_run_errors(fit_baseline(name, data)(run), run, (1.0, 5.0))
    assert all(np.isfinite(h.rms).all() and h.diverged == 0 for h in found.horizons.values())


def test_what_cannot_be_fitted_is_refused(monkeypatch):
    with pytest.raises(InputError, match="table"):
        fit_baseline("tabel", data_of(valve))
    data = data_of(valve)
    for run in data.fit:
        run.reading[:-30] = np.nan
    with pytest.raises(InputError, match="samples"):
        fit_baseline("arx", data)
    monkeypatch.setitem(__import__("sys").modules, "sklearn.neural_network", None)
    with pytest.raises(InputError, match=r"hydrotele\[baselines\]"):
        fit_baseline("mlp", data_of(valve))
    assert set(BASELINES) == {"table", "arx", "mlp"}
