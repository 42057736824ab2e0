"""Zhu's experiments: quotations are verbatim, criteria can fail, a `no` is no success."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli import experimenting
from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.experiments import zhu_forces, zhu_motion
from hydrotele.experiments.finding import Finding, Panel, Sample, tally
from hydrotele.experiments.zhu1994 import EXPERIMENTS, broken_findings

CLAIMS = {claim.name: claim for one in EXPERIMENTS for claim in one.claims}
SEED = Path(__file__).parents[3] / "shared" / "seeds" / "zhu1994_teleoperation.txt"
COLUMNS = {"name", "published", "where", "ours_or_document", "simulated", "ok", "explanation"}
_HEAD = re.compile(r"Chapter\d:\d*MachineExperiments")
_UNREAD = {"6", "111"}  # pages whose numbers the scan does not have at their head


def bare(text: str) -> str:
    """Without white space, of which the scanned text has too much within words."""
    return re.sub(r"\s+", "", text)


@pytest.mark.parametrize("name", [n for n, one in CLAIMS.items() if one.basis == "document"])
def test_quotation_is_in_the_document_on_its_page(name):
    if not SEED.is_file():
        pytest.skip("the thesis is not beside the repository")
    claim = CLAIMS[name]
    text = bare(SEED.read_text(encoding="utf-8"))
    place = text.find(bare(claim.quote))
    assert place > 0, claim.quote
    page = re.match(r"p\. (\d+)", claim.where).group(1)  # pyright: ignore
    if page in _UNREAD:
        return
    head = list(_HEAD.finditer(text, 0, place))[-1]
    assert page in text[head.start() - 8 : head.end() + 8]


def test_claims_are_told_apart_and_can_be_broken():
    assert len(CLAIMS) == sum(len(one.claims) for one in EXPERIMENTS)
    assert {one.basis for one in CLAIMS.values()} == {"document", "ours"}
    for claim in CLAIMS.values():
        assert claim.broken and claim.broken_how, claim.name
        assert claim.where.startswith("beyond") == (claim.basis == "ours"), claim.name


def test_criteria_fail_on_a_broken_run():
    names = ("straight line up", "conventional centring force", "detents")
    found = broken_findings(names, jobs=1)
    assert [one.name for one in found] == list(names)
    assert not any(one.ok for one in found)


def test_centring_force_is_a_line_and_detents_are_not():
    for detent, name in (("false", "conventional centring force"), ("true", "detents")):
        found = CLAIMS[name].finding([zhu_motion.handle_ramp(detent, 1, {})])
        assert found.ok, found.simulated


def test_a_line_is_straight():
    found = CLAIMS["straight line in"].finding([zhu_motion.line("in", 1, {})])
    assert found.ok, found.simulated


def test_direct_force_is_unstable_when_large():
    claim = CLAIMS["direct feedback: unstable when large"]
    assert claim.finding([zhu_forces.direct(4.0e-4, 1, {})]).ok


def test_a_force_of_no_effect_is_no_improvement():
    values = {"stiffness_notch": 3e3, "none_notch": 9e3, "stiffness_plain": 3e3, "none_plain": 3e3}
    claim = CLAIMS["force tracking with and without reflection"]
    assert not claim.finding([Sample(values)]).ok
    assert claim.finding([Sample(values | {"none_plain": 9e3})]).ok


_CASES = ("calm", "fast", "slow_rate", "slow_position")
GOOD = {
    "rate against position control": {
        "rate_over": 0.03, "rate_swings": 0.0, "position_over": 0.4, "position_swings": 6.0,
        **{f"{case}_over": 0.4 for case in _CASES}, **{f"{case}_swings": 6.0 for case in _CASES},
    },
    "feller-buncher: joints follow their steps": {
        f"{joint}_{key}": value for joint in ("boom", "stick", "tilt")
        for key, value in (("over", 0.02), ("left", 0.01), ("ringing", 0.5))
    },
    "stiffness feedback: a force applied by feel":
        {"worst": 0.05, "truly": 0.05, "held_20": 2.0e4, "held_35": 3.5e4},
    "stiffness feedback: 20 and 35 kN":
        {"worst": 0.05, "truly": 0.05, "held_20": 2.0e4, "held_35": 3.5e4},
    "tip-over avoided by stiffness feedback alone":
        {"with_share": 0.5, "soil_share": 0.4, "without_share": 3.0},
    "tip-over: an added spring":
        {"protected_share": 0.7, "bare_share": 1.2, "protected_handle": 1.0e-3},
}  # fmt: skip


@pytest.mark.parametrize("name", GOOD)
def test_a_criterion_can_say_yes(name):
    assert CLAIMS[name].finding([Sample(GOOD[name])] * 2).ok


def test_one_bad_repetition_is_enough():
    claim = CLAIMS["direct feedback: held with 4.5 N"]
    good = {"ripple": 0.05, "place": 5e-4, "hand": -4.5, "held": 2.4e4, "ratio": 1.8e-4}
    assert claim.finding([Sample(good)] * 3).ok
    assert not claim.finding([Sample(good), Sample(good | {"ripple": 0.9})]).ok


def test_a_row_tells_whose_statement_it_is():
    ours = Finding("b", "beyond p. 1", "as ours", "so", False, basis="ours", explanation="why")
    found = [Finding("a", "p. 1", "as is", "so", True, basis="document"), ours]
    assert set(found[0].row()) == COLUMNS
    assert tally(found) == "1 of 1 as published; beyond the document 0 of 1 hold"
    lines = experimenting.markdown_table(found).splitlines()
    assert '"as is"' in lines[2] and "| ours | as ours | so | no | why |" in lines[3]


def test_a_no_is_no_success(monkeypatch, tmp_path):
    time = np.linspace(0.0, 1.0, 20)
    panel = Panel("tip [m]", time, {"r": np.sin(time), "z": np.cos(time)})
    made = [Finding("a line", "Fig. 1", "straight", "1 mm", True, (panel,)),
            Finding("a force", "Fig. 2", "held", "12 % off", False)]  # fmt: skip
    monkeypatch.setitem(experimenting.SERIES, "zhu1994", (lambda *_: made, 1))
    result = CliRunner().invoke(app, ["experiments", "zhu1994", "--json"])
    assert result.exit_code == 1
    rows = json.loads(result.stdout)
    assert [set(row) for row in rows] == [COLUMNS] * 2
    assert [row["ok"] for row in rows] == [True, False]
    folder = tmp_path / "zhu"
    result = CliRunner().invoke(app, ["experiments", "zhu1994", "--out", str(folder)])
    assert result.exit_code == 1 and "1 of 2 as published" in result.stdout
    report = (folder / "report.html").read_text()
    assert "12 % off" in report and "data:image/png" in report
    assert (folder / "table.md").read_text().count("\n") == 8
    monkeypatch.setitem(experimenting.SERIES, "zhu1994", (lambda *_: made[:1], 1))
    assert CliRunner().invoke(app, ["experiments", "zhu1994", "--json"]).exit_code == 0


def test_another_series_is_refused():
    with pytest.raises(
        InputError, match="valid: abdellatif2008, khoshzaban1992, wang2012, zhu1994"
    ):
        experimenting.experiments_to_folder("parker1992", None, 1, 1, True)
