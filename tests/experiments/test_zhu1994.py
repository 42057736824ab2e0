"""Zhu's experiments: what was seen on the machines is seen here, and a lack of it is told."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli import experimenting
from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.experiments import zhu1994 as felling
from hydrotele.experiments import zhu1994 as forces
from hydrotele.experiments import zhu1994 as motion
from hydrotele.experiments.finding import Finding, Panel


@pytest.mark.parametrize("way", ["up", "in"])
def test_lines_are_straight(way):
    found = motion.line(way)
    assert found.ok, found.simulated


def test_rate_control_is_smooth_and_position_control_is_not():
    found = motion.rate_against_position()
    assert found.ok, found.simulated


def test_direct_force_is_stable_only_while_it_is_small():
    for found in forces.direct_force():
        assert found.ok, found.simulated


def test_a_force_is_held_by_feel():
    found = forces.hold_by_feel()
    assert found.ok, found.simulated


def test_reflection_helps_to_track_a_force():
    operators = range(1, 4)  # one of them may guess right; the study has twenty
    found = forces.tracking(
        [forces.tracking_error("stiffness", seed) for seed in operators],
        [forces.tracking_error("none", seed) for seed in operators],
    )
    assert found.ok, found.simulated
    panels = (Panel("contact force [kN]", np.zeros(2), {}),)
    same = [(2e3, panels)]
    assert not forces.tracking(same, same).ok  # no better with it: not as published


@pytest.mark.nightly
def test_a_tree_is_felled():
    found = felling.tree()
    assert found.ok, found.simulated


def test_a_machine_does_not_tip():
    found = felling.tip_over()
    assert found.ok, found.simulated


@pytest.mark.nightly
def test_the_feller_buncher_steps_and_feels_little_in_the_air():
    for found in motion.feller_steps():
        assert found.ok, found.simulated


def test_json_is_a_list_of_rows(monkeypatch, tmp_path):
    time = np.linspace(0.0, 1.0, 20)
    panel = Panel("tip [m]", time, {"r": np.sin(time), "z": np.cos(time)})
    made = [Finding("a line", "Fig. 1", "straight", "1 mm", True, (panel,)),
            Finding("a force", "Fig. 2", "held", "12 % off", False)]  # fmt: skip
    monkeypatch.setitem(experimenting.SERIES, "zhu1994", (lambda *_: made, 1))
    result = CliRunner().invoke(app, ["experiments", "zhu1994", "--json"])
    assert result.exit_code == 0
    rows = json.loads(result.stdout)
    assert [set(row) for row in rows] == [{"name", "published", "simulated", "ok"}] * 2
    assert [row["ok"] for row in rows] == [True, False]
    folder = tmp_path / "zhu"
    result = CliRunner().invoke(app, ["experiments", "zhu1994", "--out", str(folder)])
    assert result.exit_code == 0 and "1 of 2 as published" in result.stdout
    report = (folder / "report.html").read_text()
    assert "12 % off" in report and "data:image/png" in report
    assert (folder / "table.md").read_text().count("\n") == 8


def test_another_series_is_refused():
    with pytest.raises(
        InputError, match="valid: abdellatif2008, khoshzaban1992, wang2012, zhu1994"
    ):
        experimenting.experiments_to_folder("parker1992", None, 1, 1, True)
