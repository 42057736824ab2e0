"""`hydrotele gap` writes its folder whole, says the verdict, and its patched machine runs."""

import json
import sys
import types

import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError
from hydrotele.gap.interim import Interim
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine

_ALWAYS = ["gap.json", "report.html", "summary.json"]


def invoke(*words):
    """Exit status, stdout and stderr; `main` turns an InputError into 2."""
    result = CliRunner().invoke(cli.app, [str(w) for w in words])
    if isinstance(result.exception, InputError):
        return 2, result.stdout, str(result.exception)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def site(tmp_path, monkeypatch, heldout):
    """A working folder with two runs of a machine in `site`."""
    (tmp_path / "site").mkdir()
    for name in ("fit_1", "test_1"):
        save_log(heldout.log, tmp_path / "site" / f"{name}.parquet")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def searching(monkeypatch, gap_of):
    """Put a search in place that yields a verdict; tells what it was asked.

    The report has tests of its own and takes seconds, so that it is drawn only where asked for.
    """

    def put(verdict, report=False):
        asked = {}
        if not report:
            written = "hydrotele.show.gap_report.write_report"
            monkeypatch.setattr(written, lambda gap, path: path.write_text("<html></html>"))

        def find_gap(dataset, progress=None, **chosen):
            asked.update(chosen, dataset=dataset)
            return gap_of(verdict)

        module = types.ModuleType("hydrotele.gap.find")
        module.__dict__["find_gap"] = find_gap
        monkeypatch.setitem(sys.modules, "hydrotele.gap.find", module)
        return asked

    return put


@pytest.mark.nightly
def test_the_folder_is_named_after_the_data_and_complete(site, searching):
    asked = searching("named", report=True)
    code, out, _ = invoke("gap", "--data", "site", "--no-recording")
    assert "Payload" in (site / "gap_site" / "report.html").read_text()
    assert code == 0 and names(site / "gap_site") == sorted([*_ALWAYS, "patched"])
    assert names(site / "gap_site" / "patched") == ["effects.yaml", "machine.xml", "machine.yaml"]
    said = " ".join(out.split())
    assert "Payload at the tool: mass 251.3 kg" in said and "which was not fitted" in said
    assert "247.9 .. 254.6" in said and "written to gap_site" in said
    assert asked["dataset"].machine.name == "cat215" and asked["dataset"].heldout.name == "test_1"
    assert asked["effects"] == () and asked["jobs"] == 2


@pytest.mark.nightly
def test_the_patched_machine_runs_and_is_replayed(site, searching):
    searching("named")
    assert invoke("gap", "--data", "site", "--no-recording")[0] == 0
    patched = "gap_site/patched/"
    short = ("--set", "duration=0.5", "--set", "tool=none", "--no-review", "--out", "again")
    code, _, err = invoke("run", "steps", "--machine", patched, *short)
    assert code == 0, err
    assert load_machine(site / "again").links["payload"].mass == 250.0
    code, out, err = invoke("replay", "again/measured.parquet", "--machine", patched, "--json", "--out", "replayed")
    assert code == 0, err
    assert "summary.json" in names(site / "replayed")
    channels = json.loads(out)["channels"]
    # the same machine, driven with the same commands; a start from noisy rows is off by their noise
    assert channels["angle.boom"]["rms"] < 0.01
    other = json.loads(invoke("replay", "again", "--machine", "cat215", "--json")[1])["channels"]
    assert other["pressure_head.boom"]["rms"] > 5 * channels["pressure_head.boom"]["rms"]


@pytest.mark.nightly
def test_a_machine_with_a_learned_law_runs_and_is_replayed(site, searching):
    searching("partly")
    code, out, _ = invoke("gap", "--data", "site", "--no-recording")
    assert code == 0 and "the remaining difference has no known cause" in " ".join(out.split())
    patched = "gap_site/patched/"
    assert load_machine(site / patched).terms[0].name == "learned_force"
    short = ("--set", "duration=0.5", "--set", "tool=none", "--no-review")
    code, _, err = invoke("run", "steps", "--machine", patched, *short, "--out", "again")
    assert code == 0, err
    code, out, err = invoke("replay", "again/measured.parquet", "--machine", patched, "--json")
    assert code == 0, err
    assert json.loads(out)["channels"]["angle.boom"]["rms"] < 0.01  # as without a law, see above


def test_json_is_gap_json_and_nothing_else(site, searching):
    searching("ambiguous")
    code, out, _ = invoke("gap", "--data", "site", "--no-recording", "--json", "--out", "here")
    assert code == 0 and json.loads(out) == json.loads((site / "here" / "gap.json").read_text())
    assert "patched" in names(site / "here") and "next_experiment.yaml" in names(site / "here")


@pytest.mark.daily("stop1")
@pytest.mark.parametrize("stop", [KeyboardInterrupt(), InputError("run fit_1", "the model cannot follow it")])
def test_an_interrupted_search_keeps_its_best_answer_and_says_where(site, searching, gap_of, monkeypatch, stop):
    searching("named")
    answer = Interim(gap_of("named").patched, {"interim": True, "effects": [{"name": "payload"}]})

    def stopped(dataset, progress=None, *, keep, **chosen):
        keep(answer)
        raise stop

    whole = sys.modules["hydrotele.gap.find"].__dict__["find_gap"]
    monkeypatch.setitem(sys.modules["hydrotele.gap.find"].__dict__, "find_gap", stopped)
    printed = []
    monkeypatch.setattr("hydrotele.cli.gap_command.stderr_console.print", lambda text, **_: printed.append(text))
    assert invoke("gap", "--data", "site", "--no-recording", "--out", "here")[0] != 0
    assert names(site) == ["here.interim", "site"], "the final folder appears whole or not at all"
    assert any("best answer so far is in here.interim" in text for text in printed)
    assert json.loads((site / "here.interim" / "interim.json").read_text()) == answer.document
    assert load_machine(site / "here.interim").links["payload"].mass == 250.0
    monkeypatch.setitem(sys.modules["hydrotele.gap.find"].__dict__, "find_gap", whole)
    with monkeypatch.context() as report:
        report.setattr("hydrotele.cli.gap_command.write_gap_files", lambda *_: (_ for _ in ()).throw(stop))
        assert invoke("gap", "--data", "site", "--no-recording", "--out", "here")[0] != 0
    assert json.loads((site / "here.interim" / "gap.json").read_text())["verdict"] == "named"
    assert invoke("gap", "--data", "site", "--no-recording", "--out", "here")[0] == 0
    assert names(site) == ["here", "site"], "a search that ends leaves no interim answer"


def test_without_a_gap_nothing_is_patched_and_nothing_old_stays(site, searching):
    for verdict in ("named", "no_gap"):
        searching(verdict)
        assert invoke("gap", "--data", "site", "--no-recording", "--out", "here")[0] == 0
    assert names(site / "here") == _ALWAYS


def test_a_recording_is_written(site, searching):
    searching("unknown")
    assert invoke("gap", "--data", "site/fit_1.parquet", "site/test_1.parquet")[0] == 0
    assert names(site / "gap_site") == sorted([*_ALWAYS, "recording.rrd"])


def test_choices_reach_the_search(site, searching):
    asked = searching("no_gap")
    words = ("--effect", "payload", "--effect", "pin_offset", "--jobs", "2", "--heldout", "fit_1")
    assert invoke("gap", "--data", "site", "--no-recording", *words)[0] == 0
    assert asked["effects"] == ("payload", "pin_offset") and asked["jobs"] == 2
    assert asked["dataset"].heldout.name == "fit_1"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--data", "site", "--effect", "paylod"], "did you mean 'payload'"),
        (["--data", "nowhere", "--machine", "cat215"], "nowhere"),
        (["--data", "site", "--machine", "cat216"], "did you mean 'cat215'"),
        (["--data", "site", "--heldout", "test_9"], "test_1"),
        (["--data", "site", "--sensors", "best"], "khoshzaban1992"),
        (["--data", "site", "--out", "site"], "was not written by a gap"),
    ],
)
def test_errors_of_the_user(site, searching, words, message):
    searching("named")
    code, _, err = invoke("gap", *words)
    assert code == 2 and message in err and names(site) == ["site"]


@pytest.mark.nightly
def test_notes_in_a_patched_folder_are_not_lost(site, searching):
    searching("named")
    assert invoke("gap", "--data", "site", "--no-recording")[0] == 0
    note = site / "gap_site" / "patched" / "notes.txt"
    note.write_text("measured by hand")
    code, _, err = invoke("gap", "--data", "site", "--no-recording")
    assert code == 2 and "patched/notes.txt, not written by a gap" in err
    assert note.read_text() == "measured by hand"
