"""`hydrotele analyse teleop`: what it writes, prints and refuses."""

import json
import re

import pytest
from typer.testing import CliRunner

from hydrotele.cli import main as cli
from hydrotele.core.errors import InputError
from hydrotele.teleop.case_file import DEFAULT_CASE_FILE, load_teleop_case
from hydrotele.teleop.two_port import STRUCTURES

SMALL = "map: {points: 3}\n"  # nine cells


def invoke(*words):
    """Exit status, stdout, and stderr or the user's error."""
    result = CliRunner().invoke(cli.app, ["analyse", "teleop", *map(str, words)])
    if isinstance(result.exception, InputError):
        return 2, result.stdout, str(result.exception)
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def case(tmp_path):
    """A copy of the shipped case with a small map."""
    path = tmp_path / "case.yaml"
    path.write_text(DEFAULT_CASE_FILE.read_text("utf-8") + SMALL, "utf-8")
    return path


def test_help_has_an_example_and_every_structure():
    code, out, _ = invoke("--help")
    said = "".join(out.split())  # a terminal wraps
    assert code == 0 and "hydroteleanalyseteleop" in said
    assert all(option in said for option in ("--delay", "--confirm", "--json", "--out"))


@pytest.mark.parametrize("options", [(), pytest.param(("--confirm",), marks=pytest.mark.nightly)])
def test_it_writes_report_and_json(case, tmp_path, options):
    target = tmp_path / "out"
    code, out, _ = invoke(case, "--out", target, *options, "--structure", "rate_force")
    assert " any " not in out  # limits are numbers
    assert code == 0 and "rate_force" in out and ("confirmed in simulation" in out) == bool(options)
    assert {p.name for p in target.iterdir()} == {
        "analysis.json", "report.html", "stability.png", "summary.json",
    }  # fmt: skip
    document = json.loads((target / "analysis.json").read_text())
    assert set(document["structures"]) == {"rate_force"}
    if options:
        assert min(document["confirmed"]["agreement"].values()) >= 0.95  # what was asked for
        assert all(s["error"] < 0.03 for s in document["confirmed"]["sweeps"])  # the same
    page = (target / "report.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == 6
    assert 'src="http' not in page and "href=" not in page  # it needs nothing else
    code, _, err = invoke(case, "--out", case.parent)
    assert code == 2 and "not written by a two-port analysis" in err


def test_json_is_all_that_is_printed_and_nothing_is_written(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = invoke(case, "--json", "--structure", "rate_force", "--delay", "0.3")
    document = json.loads(out)
    assert code == 0 and list(document["structures"]) == ["rate_force"]
    assert document["delay"] == {"forward": 0.3, "back": 0.3}
    found = document["structures"]["rate_force"]
    assert not found["stable"] and found["unstable_poles"] > 0 and found["gain_margin"] < 1.0
    assert 0.1 < found["max_delay"] < 0.15  # 123 ms
    assert [p.name for p in tmp_path.iterdir()] == ["case.yaml"]


@pytest.mark.parametrize(
    ("line", "new", "message"),
    [
        ("master: {mass: 0.85}", "master: {mass: -1}", r"master\.mass.*greater than 0"),
        ("slave: {mass: 15.7}", "slave: {}", r"slave\.mass.*required"),
        ("task: {damping: 451,", "task: {dampling: 451,", "did you mean 'damping'"),
        ("velocity: 1,", "velocity: 0,", r"gains\.velocity.*greater than 0"),
        ("force: 1}", "force: -2}", r"gains\.force.*greater than or equal to 0"),
        ("forward: 0.02", "forward: 99", r"delays\.forward.*less than or equal to 10"),
        ("min_stiffness: 300", "min_stiffness: 700", "nominal_stiffness <= max_stiffness: 700, 600, 4000"),
        ("name: cat215_axis", "structures: [rate_farce]\nname: x", "did you mean 'rate_force'"),
        ("master_control: {damping", "master_control: {mass: 1, damping", "unknown key 'mass'"),
    ],
)
def test_a_case_that_makes_no_sense(case, line, new, message):
    text = case.read_text("utf-8")
    assert line in text
    case.write_text(text.replace(line, new), "utf-8")
    code, out, err = invoke(case, "--json")
    assert code == 2 and out == "" and re.search(message, err) and "case.yaml:" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.yaml"], "none.yaml: cannot be read"),
        (["--structure", "rate_farce"], "--structure: no structure .*did you mean 'rate_force'"),
        (["--delay", "-1"], "'--delay': Input should be greater than or equal to 0"),
        (["--delay", "nan"], "'--delay': Input should be greater than or equal to 0"),
    ],
)
def test_wrong_words(words, message):
    code, out, err = invoke(*words, "--json")
    assert code == 2 and out == "" and re.search(message, err)


def test_the_shipped_case_has_its_joystick_from_the_thesis():
    facts = load_teleop_case()
    assert facts.stiffness and facts.master_control.stiffness == facts.stiffness.nominal_stiffness
    assert facts.structures == STRUCTURES
    assert facts.stiffness.mass == facts.master.mass


def test_robust_has_waves_and_passivity_control(case, tmp_path):
    """A trace of delays with jitter; the joystick's released handle with rate_position."""
    trace = tmp_path / "delays.csv"
    rows = "".join(f"0.0{1 + n % 3},0.02\n" for n in range(300))
    trace.write_text("forward,back\n" + rows, "utf-8")
    code, out, _ = invoke(
        case, "--json", "--robust", "--delays", trace, "--operators", 2, "--period", 0.005,
        "--structure", "rate_position", "--structure", "passivity_control",
    )  # fmt: skip
    document = json.loads(out)
    assert code == 0 and set(document["structures"]) == {"rate_position"}
    assert not document["structures"]["rate_position"]["stable_released"]
    assert document["structures"]["rate_position"]["unstable_poles_released"] == 2
    robust = document["robust"]["structures"]
    assert set(robust) == {"rate_position", "passivity_control"}
    assert robust["rate_position"]["released_master"]["unstable_poles"] == 2
    assert not robust["rate_position"]["sampled"]["released_task"]["stable"]
    assert robust["passivity_control"]["sampled"]["released_task"]["stable"]
    assert document["stiffness_feedback"]["held"]["stable_by"] == "switching bound"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--structure", "wave_variables"], "--structure: no structure 'wave_variables'"),
        (["--robust", "--period", "9"], "--period: must be from 0.0001 to 0.1 s"),
        (["--robust", "--operators", "0"], "'--operators': Input should be greater than or equal to 1"),
        (["--robust", "--delays", "none.csv"], "none.csv: cannot be read"),
    ],
)
def test_wrong_words_of_robust(case, words, message):
    code, out, err = invoke(case, *words, "--json", "--structure", "rate_force")
    assert code == 2 and out == "" and re.search(message, err)
