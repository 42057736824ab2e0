"""Verdicts follow from intervals, broken runs are judged, and reports hold every row."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hydrotele.cli import experiments_command
from hydrotele.cli.main import app
from hydrotele.core.errors import InputError
from hydrotele.experiments.comparison import (
    FAULT_REPETITIONS,
    Check,
    Claim,
    Comparison,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    Series,
    compare_by_repetition_count,
    run_series,
    run_with_faults,
    summarize_verdicts,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_fraction,
    check_mean,
    check_published_in_population,
    collect_values,
    format_values,
)


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(1.1, 1.9, "agrees"), (2.1, 2.5, "differs"), (0.2, 0.9, "differs"), (0.9, 1.2, "undecided"),
     (-np.inf, np.inf, "undecided")],
)  # fmt: skip
def test_verdict_follows_from_interval(low, high, verdict):
    assert Check("size", 1.5, low, high, (1.0, 2.0), "").verdict == verdict


def test_quantity_that_is_not_a_number_differs():
    assert Check("size", np.nan, np.nan, np.nan, (1.0, 2.0), "").verdict == "differs"


def test_judgement_needs_all_checks():
    good, bad = check_deterministic_value("a", 1.0, (0.0, 2.0), ""), check_deterministic_value("b", 3.0, (0.0, 2.0), "")
    open_ = check_mean("c", np.array([1.0]), (0.0, 2.0), "")
    assert Evaluation((good, good)).verdict == "agrees"
    assert Evaluation((good, bad, open_)).verdict == "differs"
    assert Evaluation((good, open_)).verdict == "undecided"
    assert Evaluation().verdict == "no verdict"
    assert Evaluation((good,), unavailable="the text ends").verdict == "cannot be computed"


def test_cells_number_the_quantities_and_name_those_outside():
    checks = tuple(check_deterministic_value(name, value, (0.0, 2.0), "two", unit="m")
                   for name, value in (("a", 1.0), ("b", 3.0), ("c", 4.0), ("d", 5.0)))  # fmt: skip
    row = Comparison("x", "p. 1", "", "document", Evaluation(checks, "wear", "more"))
    assert (
        row.format_simulated_cell() == "(1) a = 1 m<br>(2) b = 3 m<br>(3) c = 4 m<br>(4) d = 5 m<br>In addition: more"
    )
    assert row.format_criterion_cell() == "(1) to (4): 0 to 2 m (two)<br>Outside: (2) to (4)<br>Reason: wear"
    assert row.format_criterion_cell(only_ranges=True) == "(1) to (4): 0 to 2 m<br>Outside: (2) to (4)"
    single = row._replace(evaluation=Evaluation(checks[:1], "wear"))
    assert (single.format_simulated_cell(), single.format_criterion_cell()) == (
        "a = 1 m",
        "0 to 2 m (two)<br>Note: wear",
    )


@pytest.mark.nightly
def test_intervals_cover_the_truth():
    """Of 100 intervals 95 should: the binomial standard error is 2.2 %, and three are allowed.

    Of the 40 intervals of the bootstrap, whose standard error is 3.4 %, three are 10.2 %.

    The percentile bootstrap of the ratio covers less with 20 samples; 5 % are allowed for that.
    """
    rng, mean, ratio, fraction = np.random.default_rng(1), [], [], []
    for number in range(100):
        pair = rng.normal([2.0, 1.0], [0.5, 0.2], (20, 2))
        check = check_mean("", pair[:, 0], (0, 1), "")
        mean.append(check.low <= 2.0 <= check.high)
        if number < 40:
            check = check_bootstrapped_statistic("", pair, lambda x: x[:, 0].mean() / x[:, 1].mean(), (0, 1), "")
            ratio.append(check.low <= 2.0 <= check.high)
        check = check_fraction("", rng.random(20) < 0.7)
        fraction.append(check.low <= 0.7 <= check.high)
    assert np.mean(mean) > 0.95 - 0.066
    assert np.mean(ratio) > 0.95 - 0.102 - 0.05
    assert np.mean(fraction) > 0.95 - 0.066  # exact intervals are conservative


def test_published_figure_is_compared_with_the_population():
    sizes = np.exp(np.random.default_rng(2).normal(0.0, 0.3, 40))
    assert check_published_in_population("size", sizes, 1.1).verdict == "agrees"
    assert check_published_in_population("size", sizes, 11.0).verdict == "differs"


def test_failures_of_a_broken_run_are_decided():
    assert check_fraction("", [False] * FAULT_REPETITIONS).verdict == "differs"
    assert check_fraction("", [False] * (FAULT_REPETITIONS - 1)).verdict == "undecided"


def measure_length(seed, changes):
    length = 2.0 + changes.get("error", 0.0) + 0.1 * np.random.default_rng(seed).standard_normal()
    x = np.linspace(0.0, 1.0, 20)
    panel = Panel("length [m]", x, {"true": x + 2.0, "estimated": x + length}, errors={
        "estimated": 0.0 * x + length - 2.0}, error_label="error [mm]")  # fmt: skip
    points = Panel("length [m]", x, {"readings": x + length}, "pose [1]", discrete=True)
    return Sample({"length": length}, (panel, points))


def judge_length(samples):
    check = check_mean("length", collect_values(samples, "length"), (1.5, 2.5), "as printed", unit="m",
                       published=2.0)  # fmt: skip
    return Evaluation((check,), note=f"values {format_values(samples, 'length')}")


CLAIM = Claim("length", "2 m", "p. 1, Table 1", "document", judge_length, {"error": 3.0}, "3 m longer")
INPUT = Claim("mass", "3 kg", "p. 2, Table 2", "input",
              lambda samples: Evaluation((check_deterministic_value("mass", 3.0, (2.9, 3.1), "digits"),)),
              {"error": 1.0}, "")  # fmt: skip
SERIES = Series(
    "wang2012", "A. Author, 2000", 8,
    (Experiment("lengths", measure_length, (CLAIM, INPUT), max_repetitions=30),),
    (Comparison("force", "p. 3, Fig. 1", "5 N", "document", Evaluation(unavailable="no text")),),
    {"Fig. 2": "photograph"},
)  # fmt: skip


def test_series_is_judged_and_can_be_broken():
    rows = run_series(SERIES, 8, jobs=1)
    assert [row.verdict for row in rows] == ["agrees", "agrees", "cannot be computed"]
    assert summarize_verdicts(rows).startswith("of 2 published results 1 agree, 0 differ")
    ((claim, broken),) = run_with_faults(SERIES, ["length"], jobs=1)
    assert claim is CLAIM and broken.verdict == "differs"
    counts = compare_by_repetition_count(SERIES, (1, 8), jobs=1)
    assert [counts[n][0].verdict for n in (1, 8)] == ["undecided", "agrees"]
    assert counts[8][0] == rows[0]._replace(panels=counts[8][0].panels)


@pytest.mark.nightly
def test_processes_give_the_same_samples():
    alone, shared = (run_series(SERIES, 3, jobs)[0].evaluation for jobs in (1, 2))
    assert alone == shared


def test_command_writes_table_report_and_figures(monkeypatch, tmp_path):
    monkeypatch.setattr(experiments_command, "load_experiment_series", lambda name: SERIES)
    folder = tmp_path / "results"
    asked = ["experiments", "wang2012", "--jobs", "1", "--out", str(folder)]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 0 and "1 agree, 0 differ" in result.stdout
    table = (folder / "table.md").read_text()
    for words in ("2 m", "agrees", "cannot be computed | no text", "inputs of the model", "photograph"):
        assert words in table
    report = (folder / "report.html").read_text()
    assert "data:image/png" in report and "photograph" in report and "no text" in report
    files = {path.name for path in (folder / "figures").iterdir()}
    assert files == {"01-length.png", "01-length.svg", "02-mass.png", "02-mass.svg", "captions.md"}
    assert "error" in (folder / "figures" / "01-length.svg").read_text()
    assert "Length (p. 1, Table 1)" in (folder / "figures" / "captions.md").read_text()
    rows = json.loads((folder / "experiments.json").read_text())
    assert rows[0]["checks"][0]["published"] == 2.0
    assert CliRunner().invoke(app, asked).exit_code == 0  # an older folder is replaced


def test_a_difference_is_the_exit_status(monkeypatch):
    check = check_deterministic_value("length", 2.0, (2.9, 3.1), "")
    long = Claim("length", "3 m", "p. 1", "document", lambda samples: Evaluation((check,)))
    monkeypatch.setattr(experiments_command, "load_experiment_series", lambda name: Series(
        "wang2012", "", 1, (Experiment("lengths", measure_length, (long,)),)))  # fmt: skip
    result = CliRunner().invoke(app, ["experiments", "wang2012", "--json", "--jobs", "1"])
    assert result.exit_code == 1
    assert json.loads(result.stdout)[0]["verdict"] == "differs"


def test_unknown_document_is_refused():
    with pytest.raises(InputError, match="valid: abdellatif2008, khoshzaban1992, wang2012, zhu"):
        experiments_command.experiments_to_folder("parker1992", None, 1, 1, True)
