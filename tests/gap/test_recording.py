"""The recording of a gap holds readings, predictions, residuals and gap windows on one clock."""

import dataclasses

import numpy as np
import pytest

from hydrotele.show.gap_recording import write_gap_recording

_AXES = ("swing", "boom", "stick")


def _read(path):
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = {name: batch.column(name) for name in batch.schema.names}
        found.setdefault((chunk.entity_path, chunk.is_static), {}).update(columns)
    return found


def _floats(column) -> np.ndarray:
    while hasattr(column, "flatten") and hasattr(column.type, "value_type"):
        column = column.flatten()
    return np.asarray(column, dtype=float)


@pytest.fixture(scope="module")
def chunks(tmp_path_factory, gap_of, heldout):
    path = tmp_path_factory.mktemp("recording") / "gap.rrd"
    write_gap_recording(path, gap_of("named"), heldout, _AXES)
    return _read(path)


def test_readings_predictions_and_residuals_come_back(chunks, gap_of):
    before, after = gap_of("named").before[0], gap_of("named").after[0]
    column = before.channels.index("pressure_head.boom")
    for entity, values in {
        "/measured/pressure_head/boom": 1e-6 * before.measured[:, column],
        "/nominal/pressure_head/boom": 1e-6 * before.predicted[:, column],
        "/patched/pressure_head/boom": 1e-6 * after.predicted[:, column],
        "/residual/nominal/pressure_head/boom": before.whitened[:, column],
        "/residual/patched/pressure_head/boom": after.whitened[:, column],
    }.items():
        chunk = chunks[entity, False]
        assert _floats(chunk["Scalars:scalars"]) == pytest.approx(values, rel=1e-12)  # rounding
        assert len(np.unique(np.asarray(chunk["time"]).astype(np.int64))) == len(before.time)


def test_gap_windows_are_marked(chunks):
    texts = [t for row in chunks["/gap/text", False]["TextLog:text"].to_pylist() for t in row]
    assert texts and all("boom" in text and "x noise" in text for text in texts)
    levels = _floats(chunks["/gap/window", False]["Scalars:scalars"])
    assert len(levels) == 3 * len(texts) and np.isnan(levels[2::3]).all()


def test_the_machine_moves(chunks):
    assert ("/measured/machine/boom", False) in chunks and ("/command/boom", False) in chunks


@pytest.mark.nightly
def test_without_a_patch_there_is_none(tmp_path, gap_of, heldout):
    write_gap_recording(tmp_path / "gap.rrd", gap_of("no_gap"), heldout, _AXES)
    found = _read(tmp_path / "gap.rrd")
    assert not any(entity.startswith(("/patched", "/residual/patched")) for entity, _ in found)
    ((text,),) = found["/gap/text", False]["TextLog:text"].to_pylist()
    assert "the model has no significant errors" in text


@pytest.mark.nightly
def test_missing_readings_are_left_out(tmp_path, gap_of, heldout):
    gap = gap_of("no_gap")
    (before,) = gap.before
    measured = before.measured.copy()
    measured[10:20] = np.nan
    measured[:, 0] = np.nan  # the swing angle: the machine stands at home there
    holed = (dataclasses.replace(before, measured=measured),)
    gap = dataclasses.replace(gap, before=holed, after=holed)
    write_gap_recording(tmp_path / "gap.rrd", gap, heldout, _AXES)
    found = _read(tmp_path / "gap.rrd")
    assert ("/measured/angle/swing", False) not in found
    values = _floats(found["/measured/angle/boom", False]["Scalars:scalars"])
    assert len(values) == len(before.time) - 10
