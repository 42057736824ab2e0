"""One rule for logs: all commands accept or refuse the same files, with the same notes."""

import json
from pathlib import Path

import numpy as np
import pytest

from hydrotele.calibrate.calibrator_logs import read_calibration_logs
from hydrotele.cli import input_logs
from hydrotele.cli.replay_command import replay_logs
from hydrotele.cli.review_command import ReviewOutputs, review_logs
from hydrotele.cli.validate_command import LogMachine, validate_files
from hydrotele.core.errors import InputError
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine_file import load_machine

RIG = load_machine("rig")


def rig_rows(rows: int = 300) -> np.ndarray:
    time = 0.01 * np.arange(rows)
    wave = np.sin(2.0 * np.pi * time)
    return np.column_stack([time, 0.02 * wave, 0.25 - 0.001 * wave])


def write(path: Path, rows: np.ndarray, header="time,command.slide,position.slide") -> Path:
    text = ["" if np.isnan(v) else f"{v:.16g}" for v in rows.ravel()]
    lines = [",".join(text[k : k + 3]) for k in range(0, len(text), 3)]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def changed(row, column, value):
    rows = rig_rows()
    rows[row, column] = value
    return rows


def jittered():
    rows = rig_rows()
    rows[:, 0] = np.cumsum(0.01 + np.random.default_rng(0).uniform(0.0, 0.002, len(rows)))
    return rows


def set_back():
    rows = rig_rows()
    rows[150:, 0] -= 0.1
    return rows


ACCEPTED = {
    "plain": rig_rows(),
    "empty reading": changed(40, 2, np.nan),
    "empty first reading": changed(0, 2, np.nan),
    "empty command": changed(40, 1, np.nan),
    "lost rows": np.delete(rig_rows(), slice(40, 50), axis=0),
    "a pause": np.delete(rig_rows(), slice(100, 205), axis=0),
    "no common clock": jittered(),
    "epoch": rig_rows() + [1.7e9, 0.0, 0.0],
    "clock set back": set_back(),
    "repeated stamp": changed(40, 0, 0.39),
}
REFUSED = {
    "empty time": (changed(40, 0, np.nan), "column 'time', row 40 (line 42): is nan: remove the row or enter a value"),
    "beyond the stroke": (rig_rows() * [1.0, 1.0, 30.0], "column 'position.slide'"),
    "command in volts": (rig_rows() * [1.0, 500.0, 1.0], "looks like percent, counts or volts"),
    "no clock": (np.column_stack([np.cumsum(np.random.default_rng(1).exponential(0.01, 300)), rig_rows()[:, 1:]]),
                 "the time stamps follow no clock"),
}  # fmt: skip


def validated(path, capsys) -> list[str]:
    validate_files([path], True, LogMachine("rig"))
    return json.loads(capsys.readouterr().out)[0]["notes"]


@pytest.mark.parametrize("case", ACCEPTED)
def test_a_log_is_accepted_with_the_same_notes(case, tmp_path, capsys):
    path = write(tmp_path / "run.csv", ACCEPTED[case])
    notes = validated(path, capsys)
    replay_logs([path], "rig", None, 1e-3, None, as_json=True)
    printed = capsys.readouterr()
    replays = json.loads(printed.out)
    for replay in replays if isinstance(replays, list) else [replays]:
        assert replay["channels"]["position.slide"]["rms"] < 0.1
    (tmp_path / "logs").mkdir()
    second = write(tmp_path / "logs" / "other.csv", rig_rows())
    dataset = load_dataset([path, second], RIG)
    opened = input_logs.open_logs([path], "rig")
    shared = [note for note in notes if not note.startswith("gap, identify and compare")]
    assert (shared == []) == (case == "plain")
    assert set(opened.notes) <= set(shared) <= set(dataset.notes)
    assert all(note in printed.err.replace("\n", "") for note in opened.notes)
    assert set(read_calibration_logs(path, RIG)[1]) == set(opened.notes)
    review_logs(path, None, "rig", None, ReviewOutputs(plot=tmp_path / "plot.png"))
    assert all(note in capsys.readouterr().err.replace("\n", "") or not opened.notes for note in opened.notes[:1])


@pytest.mark.parametrize("case", REFUSED)
def test_a_log_is_refused_with_the_same_reason(case, tmp_path):
    rows, reason = REFUSED[case]
    path = write(tmp_path / "run.csv", rows)
    messages = []
    for command in (
        lambda: validate_files([path], True, LogMachine("rig")),
        lambda: replay_logs([path], "rig", None, 1e-3, None, as_json=True),
        lambda: review_logs(path, None, "rig", None, ReviewOutputs(plot=tmp_path / "plot.png")),
        lambda: load_dataset(path, RIG),
    ):
        with pytest.raises(InputError) as caught:
            command()
        messages.append(str(caught.value))
    assert len(set(messages)) == 1 and reason in messages[0], messages


def test_a_command_that_is_missing_is_said_by_validate(tmp_path, capsys):
    path = write(tmp_path / "run.csv", rig_rows(), "time,velocity.slide,position.slide")
    (note,) = [n for n in validated(path, capsys) if n.startswith("gap, identify and compare need more")]
    assert "needs the column command.slide" in note


def test_folders_are_taken_everywhere(tmp_path, capsys):
    """A folder of logs, a run folder and a folder of run folders."""
    for run in "ab":
        (tmp_path / "runs" / run).mkdir(parents=True)
        write(tmp_path / "runs" / run / "measured.csv", rig_rows())
    (tmp_path / "logs").mkdir()
    write(tmp_path / "logs" / "only.csv", rig_rows())
    for folder, count in ((tmp_path / "runs", 2), (tmp_path / "runs" / "a", 1), (tmp_path / "logs", 1)):
        assert len(input_logs.open_logs([folder], "rig").logs) == count
        validate_files([folder], True, LogMachine("rig"))
        assert json.loads(capsys.readouterr().out)[0]["kind"] == "log"
        replay_logs([folder], "rig", None, 1e-3, None, as_json=True)
        assert isinstance(json.loads(capsys.readouterr().out), list) == (count == 2)
    review_logs(tmp_path / "logs", None, "rig", None, ReviewOutputs(plot=tmp_path / "plot.png"))
    with pytest.raises(InputError, match=r"runs: contains 2 logs; give one of them: .*a/measured\.csv"):
        review_logs(tmp_path / "runs", None, "rig", None, ReviewOutputs(plot=tmp_path / "plot.png"))


def test_recordings_and_gap_folders_open_in_review(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr("hydrotele.cli.review_command._show", lambda recording, *_, **__: shown.append(recording))
    recording = tmp_path / "gap_logs" / "recording.rrd"
    recording.parent.mkdir()
    recording.write_bytes(b"RRF2")
    for path in (recording.parent, recording):
        review_logs(path, None, None, None, ReviewOutputs())
    assert shown == [recording, recording]
    with pytest.raises(InputError, match=r"recording\.rrd: is a recording, not a log"):
        review_logs(recording, None, "rig", None, ReviewOutputs())
    with pytest.raises(InputError, match=r"no\.rrd: does not exist"):
        review_logs(tmp_path / "no.rrd", None, None, None, ReviewOutputs())
