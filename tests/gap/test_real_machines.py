"""The workflow on public records of real machines.

`tools/validation/real_machines.py` is the full run.
"""

import dataclasses
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli.main import app
from hydrotele.estimate.baselines import fit_baseline
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import hypotheses
from hydrotele.gap import find
from hydrotele.gap.calibrating import calibrate_freely
from hydrotele.gap.find import find_gap
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine_file import load_machine
from tests.measured import REAL, needs_real
from tools.validation.real_machines import (
    FIRST_THREE_QUARTERS,
    PUSH,
    ec20_splits,
    force_error,
    pushed,
)

pytestmark = needs_real


@pytest.mark.nightly
@pytest.mark.parametrize("effects", [
    ("friction_asymmetry", "viscous_friction", "coulomb_friction", "command_offset"),
    pytest.param((), marks=pytest.mark.nightly, id="the whole library"),
])  # fmt: skip
def test_emps_names_friction_that_depends_on_the_direction(effects, monkeypatch):
    """Daily with a small library, patched: named effects would switch learning off."""
    monkeypatch.setattr(find, "hypotheses", lambda machine, names: hypotheses(machine, effects))
    machine = load_machine("emps")
    data = load_dataset(REAL / "emps" / "main.parquet", machine)
    gap = find_gap(data)
    (effect,) = gap.effects
    assert effect.name == "friction_asymmetry" and effect.probability > 0.95
    assert gap.verdict in ("named", "partly")  # a ripple of the drive remains
    # published: 166.7 and 240.4 N s/m, which differ by 0.181 of their mean
    found = effect.parameters["viscous_asymmetry"]
    assert found.low < (166.7 - 240.4) / (166.7 + 240.4) < found.high
    # nearly half of the mean square: a learned law that closed more made free runs worse
    assert gap.size.after**2 < 0.6 * gap.size.before**2
    # published 4.08 % before and 3.11 % after, all samples fitted; here none of these was
    assert force_error(machine, data.heldout, 20.0) > 3.5
    assert force_error(gap.patched, data.heldout, 20.0) < 3.2


@pytest.mark.nightly
def test_the_command_reads_a_record_whose_columns_only_the_machine_can_name(tmp_path):
    """The record calls its columns `position` and `drive_voltage`; there is no noise floor."""
    out = tmp_path / "gap"
    words = ["--machine", "emps", "--data", str(REAL / "emps" / "main.parquet"), "--no-recording"]
    done = CliRunner().invoke(app, ["gap", *words, "--out", str(out)])
    assert done.exit_code == 0, done.output
    document = json.loads((out / "gap.json").read_text())
    assert document["verdict"] in ("named", "partly")
    assert [e["name"] for e in document["effects"]] == ["friction_asymmetry"]
    assert document["noise"]["position.slide"]["stated"] is None


@pytest.mark.nightly
def test_emps_locates_a_hidden_push_in_time_and_size():
    data = pushed(load_dataset(REAL / "emps" / "main.parquet", load_machine("emps")), *PUSH)
    found = {e.name: e for e in find_gap(data).effects}
    push = found["force_pulse"]
    assert push.probability > 0.95
    size, start, duration = PUSH
    # the friction of one direction that the model lacks, too, is 3 % of the push
    assert push.parameters["size"].value == pytest.approx(size, rel=0.03)
    assert push.parameters["start"].value == pytest.approx(start, abs=0.01)  # a row
    assert push.parameters["duration"].value == pytest.approx(duration, abs=0.02)


@pytest.mark.nightly
def test_a_minute_of_the_ec20_is_worth_more_than_a_table_of_all():
    """Delay and table of command to speed are fitted to all but the last quarter, which judges.

    No tolerance: being ahead is the claim, over 10 s and 30 s and for both axes.
    """
    data = load_dataset(REAL / "volvo_ec20" / "long.parquet", load_machine("ec20"))
    splits = ec20_splits(data)
    minute, whole = (splits[name] for name in ("busiest 60 s -> last 25 %", FIRST_THREE_QUARTERS))
    opened = calibrate_freely(minute, 2)
    assert opened  # stretches left out are predicted better than by the machine as shipped
    assert all(e.low <= e.value <= e.high for e in opened.numbers.values())
    assert {"timing.boom.delay", "linkage.stick.base"} <= opened.numbers.keys()
    found = {
        name: free_run_errors(prepare(whole.heldout), whole.heldout, (10.0, 30.0), to_end=False)
        for name, prepare in {
            "machine": machine_runner(opened.machine, minute, step=0.01),
            "table": fit_baseline("table", whole),
        }.items()
    }
    for seconds, horizon in found["machine"].horizons.items():
        assert np.all(horizon.rms < found["table"].horizons[seconds].rms)


@pytest.mark.nightly
def test_a_machine_that_states_no_open_numbers_is_not_fitted_to_free_runs():
    data = load_dataset(REAL / "volvo_ec20" / "long.parquet", load_machine("ec20"))
    sure = data.machine.model_copy(update={"uncertainty": {"mass": 0.05}})
    assert calibrate_freely(dataclasses.replace(data, machine=sure), 1) is None


@pytest.mark.nightly
def test_long_records_are_cut_to_where_the_commands_change():
    data = load_dataset(REAL / "emps" / "main.parquet", load_machine("emps"))
    short = select_exciting_segments(data, 6.0)
    (run,), (whole,) = short.fit, data.fit
    assert len(run.command) == 6000 and short.heldout is data.heldout
    first = round((run.start - whole.start) / run.period)
    assert np.array_equal(run.reading, whole.reading[first : first + 6000])
    assert any("only the interval from" in note for note in short.notes)
    assert select_exciting_segments(data, 60.0) is data
