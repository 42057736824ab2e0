"""The patched folder is a machine like any other, and says what was changed."""

import dataclasses

import pytest
import yaml

from hydrotele.gap.patched import has_patch, write_patch
from hydrotele.machine.machine_file import load_machine


@pytest.fixture
def patched(tmp_path, gap_of):
    write_patch(gap_of("named"), tmp_path)
    return tmp_path


def test_the_machine_comes_back_with_its_effects(patched, gap_of):
    found = load_machine(patched)
    kept = {"folder", "mjcf", "tools"}  # where it and its tree lie, and what else there was
    expected = gap_of("named").patched.model_dump(exclude=kept)
    assert found.model_dump(exclude=kept) == expected
    assert found.links["payload"].mass == 250.0
    assert found.axes["boom"].command_delay == 0.06
    assert found.sensor_errors["length.boom"].offset == -0.006


def test_its_head_says_what_was_changed(patched):
    head = [t for t in (patched / "machine.yaml").read_text().splitlines() if t.startswith("#")]
    assert any("payload at the tool" in line for line in head)
    assert any("mass: 251.3 kg (95 %: 247.9 .. 254.6), was 0" in line for line in head)


def test_effects_for_programs(patched):
    record = yaml.safe_load((patched / "effects.yaml").read_text())
    assert record["machine"] == "cat215" and record["verdict"] == "named"
    (effect,) = record["effects"]
    mass = {"value": 251.3, "unit": "kg", "ci95": [247.9, 254.6], "nominal": 0.0}
    assert effect["name"] == "payload" and effect["parameters"] == {"mass": mass}


def test_only_what_was_named_is_patched(gap_of):
    wanted = {
        "named": True, "ambiguous": True, "partly": True, "no_gap": False, "unknown": False,
    }  # fmt: skip
    assert {verdict: has_patch(gap_of(verdict)) for verdict in wanted} == wanted
    for part in ("effects", "calibration", "learned"):
        assert has_patch(dataclasses.replace(gap_of("unknown"), **{part: getattr(gap_of("partly"), part)}))


def test_calibrated_numbers_and_learned_laws_come_back(tmp_path, gap_of):
    gap = gap_of("partly")
    write_patch(gap, tmp_path)
    found = load_machine(tmp_path)
    assert found.terms == gap.patched.terms and len(found.terms) == 1
    assert found.axes["boom"].valve == gap.patched.axes["boom"].valve
    assert found.axes["boom"].valve != gap.machine.axes["boom"].valve
    head = [t for t in (tmp_path / "machine.yaml").read_text().splitlines() if t.startswith("#")]
    assert any("calibrated valve gain of the boom" in line and "104.0" in line for line in head)
    assert any("learned Force on the boom drive over position" in line for line in head)
    record = yaml.safe_load((tmp_path / "effects.yaml").read_text())
    assert record["calibration"]["mass.stick"]["nominal"] == 610.0
    assert record["learned"][0]["formula"] == "-3e+05 above(position, 0.55)"


def test_jitter_of_the_logger_is_said(tmp_path, gap_of):
    write_patch(dataclasses.replace(gap_of("named"), jitter=(0.003, 0.0)), tmp_path)
    assert "# - jitter of the sensors: 3 ms, was 0 ms" in (tmp_path / "machine.yaml").read_text()
    record = yaml.safe_load((tmp_path / "effects.yaml").read_text())
    assert record["jitter"] == {"found": 0.003, "stated": 0.0}
