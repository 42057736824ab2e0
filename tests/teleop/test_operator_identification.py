"""Operators are recovered from records of tracking, within the intervals that are stated."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.scenario.teleoperation import OperatorSettings
from hydrotele.teleop import operator_identification
from hydrotele.teleop.manual_control import (
    DOUBLE_INTEGRATOR,
    FORMS,
    GAIN,
    INTEGRATOR,
    TrackingRecord,
    make_sum_of_sines,
    simulate_tracking,
)
from hydrotele.teleop.operator_identification import identify_operator, read_tracking_record
from hydrotele.teleop.operator_parameters import (
    load_operator_file,
    make_operator,
    make_scenario_operator,
)

FILE = load_operator_file()


def record(number, duration=120.0, form=INTEGRATOR):
    target, _ = make_sum_of_sines(np.arange(0.0, duration + 30.0, 0.01), 1.5, 120.0, number)
    made = simulate_tracking(make_operator(FILE, number), form, 2.0, target, seed=40 + number)
    return TrackingRecord(*(values[3000:] for values in made))


def noisy(made, seed):
    """0.5 % of noise on everything, as a laboratory has it; samples at 40 Hz."""
    rng, time = np.random.default_rng(seed), np.arange(made.time[0], made.time[-1] - 0.1, 0.025)
    values = [np.interp(time, made.time, v) for v in made[1:]]
    return TrackingRecord(time, *(v + 0.005 * v.std() * rng.standard_normal(len(v)) for v in values))


@pytest.mark.nightly
@pytest.mark.parametrize(("form", "kind"), [(GAIN, "integral"), (INTEGRATOR, "gain"), (DOUBLE_INTEGRATOR, "lead")])
def test_drawn_operators_are_recovered_within_their_intervals(form, kind):
    """16 intervals of 95 %: three misses or fewer in 99 % of all cases."""
    misses = []
    for number in range(4):
        him = make_operator(FILE, number)
        fit = identify_operator(noisy(record(number, form=form), number), kind)
        assert fit.element == FORMS[form] and fit.explained_fraction > 0.3
        late = him.visual_delay + him.lead_delay * (form == DOUBLE_INTEGRATOR)
        truth = {"delay": late, "remnant": him.remnant,
                 "neuromuscular_frequency": him.neuromuscular_frequency,
                 "neuromuscular_damping": him.neuromuscular_damping}  # fmt: skip
        for name, value in truth.items():
            one = fit.estimates[name]
            assert one.high / one.low < (4.0 if name == "remnant" else 2.5), "tells nothing"
            if not one.low <= value <= one.high:
                misses.append((number, name, value, one))
    assert len(misses) <= 3, misses


def test_a_fit_that_did_not_settle_tells_nothing(monkeypatch):
    """Its intervals are endless and no parameter counts as identified."""
    settled = operator_identification._fit_equalisation

    def unsettled(data, kind):
        return settled(data, kind)._replace(has_converged=False)

    monkeypatch.setattr(operator_identification, "_fit_equalisation", unsettled)
    fit = identify_operator(record(0), "gain")
    assert not any(one.identified for one in fit.estimates.values())
    assert all(one.high > 1e6 * one.low for one in fit.estimates.values())
    assert "did not converge" in fit.notes[0] and fit.element == ""


def write(path, made, rate=40.0, missing=(), header="Time [ms],target,response,hand"):
    """A laboratory's file: milliseconds, its own rate, noise, missing cells."""
    rng = np.random.default_rng(3)
    time = np.arange(made.time[0], made.time[-1] - 0.1, 1.0 / rate)
    time += rng.uniform(-0.3, 0.3, len(time)) / rate
    columns = [np.interp(time, made.time, v) + 0.01 * rng.standard_normal(len(time))
               for v in made[1:]]  # fmt: skip
    lines = [header]
    for k, t in enumerate(time):
        cells = [f"{1e3 * t:.2f}", *(f"{c[k]:.5f}" for c in columns)]
        if k in missing:
            cells[3] = ""
        lines.append(",".join(cells))
    path.write_text("\n".join(lines) + "\n")


def test_command_writes_an_operator_that_a_scenario_takes(tmp_path):
    write(tmp_path / "trial.csv", record(1), missing=(200, 201))
    words = ["identify-operator", str(tmp_path / "trial.csv"), "--out", str(tmp_path / "o")]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["controlled_element"] == "K/s"
    assert any("2 missing values of hand" in note for note in found["notes"])
    him = make_scenario_operator(OperatorSettings(file="o/operator.yaml"), str(tmp_path))
    assert him.visual_delay == pytest.approx(found["estimates"]["delay"]["value"], abs=1e-4)
    assert CliRunner().invoke(app, [*words[:2], "--equalisation", "gain"]).exit_code == 0


def test_a_force_serves_where_there_is_no_hand(tmp_path):
    write(tmp_path / "t.csv", record(2, 60.0), header="time [ms],target,response,force")
    read, said = read_tracking_record(tmp_path / "t.csv")
    assert "force" in said[0] and np.ptp(read.hand) > 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r._replace(time=r.time[::-1]), "does not increase"),
        (lambda r: TrackingRecord(*(v[:1000] for v in r)), "20 s are needed"),
        (lambda r: TrackingRecord(*(v[::20] for v in r)), "10 are needed"),
        (lambda r: r._replace(hand=np.zeros(len(r.time))), "is constant"),
        (lambda r: TrackingRecord(*(np.delete(v, slice(500, 900)) for v in r)), "gap of"),
    ],
)
def test_what_cannot_be_used_is_refused(tmp_path, change, message):
    made, path = change(record(0, 40.0)), tmp_path / "t.csv"
    table = np.column_stack(made)
    np.savetxt(path, table, delimiter=",", header="time,target,response,hand", comments="")
    with pytest.raises(InputError, match=message):
        identify_operator(read_tracking_record(path)[0], source=str(path))


def test_a_column_that_is_not_there_is_named(tmp_path):
    write(tmp_path / "t.csv", record(0, 40.0))
    with pytest.raises(InputError, match="name it with --hand"):
        read_tracking_record(tmp_path / "t.csv", {"hand": "stick"})
