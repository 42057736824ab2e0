"""The sections "Why this verdict" and "Initial regressions" say the numbers of the result, and nothing else."""

import dataclasses
import io
import json

import numpy as np
import pytest

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.estimate.track import STEP
from hydrotele.gap.answer import answer_document
from hydrotele.gap.explanation import trace_inputs
from hydrotele.gap.find import best_words
from hydrotele.gap.result import (
    Comparison,
    Contender,
    Estimate,
    GrossError,
    InitialRegressions,
    InputTrace,
    Regression,
    Rejection,
    VerdictExplanation,
    gap_document,
)
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine_file import load_machine
from hydrotele.show.gap_explanation import draw_traces, regression_content, verdict_reasons, why_content
from hydrotele.show.gap_report import write_report
from tests.measured import MEASURED

_TIME = np.linspace(0.0, 8.0, 200)
_FORCE = 2e3 * np.sin(_TIME)
_TRACES = (
    InputTrace("fit_1", "force", "boom", "N", _TIME, _FORCE, 0.1 * _FORCE, 0.9 * _FORCE),
    InputTrace("fit_1", "command", "stick", "1", _TIME, 0.01 * np.cos(_TIME), 0.0 * _TIME, None),
)
_WHY = VerdictExplanation(
    (Comparison("length_offset", "boom", (
        Contender("length_offset", "boom", 512.0, 0.62), Contender("pin_offset", "boom", 510.5, 0.37),
    )),),
    (Rejection("viscous_friction", "boom", "fraction of the gap closed", 0.004, 0.02),),
    _TRACES,
)  # fmt: skip


def _regression() -> Regression:
    speed = np.linspace(-0.2, 0.2, 60)
    load = 1e4 * np.cos(np.arange(60.0))
    points = {"measured": 1.1 * load + 7e3 * speed + 3e3 * np.sign(speed), "model": load, "velocity": speed,
              "position": 0.5 + speed, "drive": load}  # fmt: skip
    table = {
        "factor": Estimate(1.1, "1", 1.08, 1.12, 1.0), "viscous": Estimate(7e3, "N s/m", 6e3, 8e3, 6e3),
        "coulomb": Estimate(3e3, "N", 2.8e3, 3.2e3, 2e3), "constant": Estimate(10.0, "N", -50.0, 70.0, 0.0),
        "per_position": Estimate(0.0, "N/m", -100.0, 100.0, 0.0),
    }  # fmt: skip
    return Regression("force", "boom", "N", table, 0.99, 0.9, 60, points)


_ERROR = GrossError(
    "wrong sign", ("command.stick",), 0.999, 0.98, -1.2,
    "If the sign of command.stick is reversed, the model explains 98 % of the variance of the flow of the stick drive;"
    " as logged, it explains nothing.",
)  # fmt: skip


@pytest.fixture
def gap(gap_of):
    found = gap_of("ambiguous")
    return dataclasses.replace(
        found, explanation=_WHY, initial=InitialRegressions((_regression(),), (_ERROR,)),
        answers=tuple(answer_document(found.effects)),
    )  # fmt: skip


def test_every_reason_has_its_number(gap):
    texts = verdict_reasons(gap)
    assert texts[0] == (
        "Twice the log Bayes factor of length offset of the boom against no effect is 512; that of the best other"
        " candidate, pin offset of the boom, is 510."
    )
    assert any("62 %" in t and "95 %" in t for t in texts)
    assert all(any(c.isdigit() for c in t) for t in texts)
    failed = dataclasses.replace(gap, tests={"mean_square": {"value": 1.3, "limit": 1.1, "passed": False}})
    assert "The residual test mean square failed: 1.3, limit 1.1." in verdict_reasons(failed)


def test_candidates_levels_and_rejections_are_tables(gap):
    content = why_content(gap)
    assert content is not None
    assert [(r["title"], r["probability"]) for r in content["candidates"]] == [
        ("length offset of the boom", "62 %"), ("pin offset of the boom", "37 %"), ("none of them", "1 %"),
    ]  # fmt: skip
    assert content["levels"][0][1:] == ("location: boom", "99 %")
    assert content["levels"][2][1:] == ("law: length offset", "62 %")
    assert content["rejected"] == [
        ("viscous friction of the boom", "fraction of the gap closed", "0.004", "more than 0.02")
    ]
    assert content["inputs"][0][0] == "Force on the boom drive" and content["inputs"][0][3] == "99 %"


def test_the_report_has_both_sections(gap, tmp_path):
    write_report(gap, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    for piece in ("Why this verdict", "Initial regressions", "command.stick is reversed", "measured over model", "512"):
        assert piece in text, piece


def test_without_explanation_the_sections_are_absent(gap_of):
    assert why_content(gap_of("named")) is None and regression_content(gap_of("named")) is None


def test_the_document_is_strict_json(gap):
    document = json.loads(json.dumps(gap_document(gap), allow_nan=False))
    assert document["explanation"]["candidates"][0]["contenders"][0]["log_bayes_factor"] == 512.0
    assert document["explanation"]["residual_inputs"][1]["added"] is None
    assert document["initial_regressions"]["errors"][0]["channels"] == ["command.stick"]


def test_the_picture_of_residual_inputs_is_not_empty():
    from PIL import Image

    with Image.open(io.BytesIO(draw_traces(_TRACES))) as image:
        assert np.asarray(image.convert("RGB"), float).std() > 10


def test_progress_names_the_best_explanation():
    machine = load_machine("cat215")
    leak = next(h for h in hypotheses(machine, ("internal_leakage",)) if h.location == "boom")
    assert best_words(Guess().plus(leak, np.zeros(leak.size))) == "internal leakage of the boom"
    assert best_words(Guess()) == ""


def test_the_accepted_effect_covers_the_missing_flow():
    """The hidden leakage of open_08 is 1.6e-11 m^3/(s Pa); the flow that it adds is that which was missing."""
    data = load_dataset([MEASURED / "open_08"], load_machine("cat215"))
    data = dataclasses.replace(data, fit=(data.fit[0].select_rows(0, 400),))
    evidence = Evidence(data, data.fit, 1, STEP, lacking=True)
    try:
        given = evidence.set_base(Guess())
        leak = next(h for h in hypotheses(data.machine, ("internal_leakage",)) if h.location == "boom")
        (parameter,) = leak.parameters.values()
        size = np.array([(1.6e-11 - parameter.nominal) / parameter.prior_std])
        traces = trace_inputs(data, given, evidence.judged(Guess().plus(leak, size)))
    finally:
        evidence.close()
    flow = next(t for t in traces if (t.balance, t.axis) == ("flow_head", "boom"))
    assert flow.added is not None
    known = np.isfinite(flow.given + flow.added + flow.remaining)
    given_flow, added = flow.given[known], flow.added[known]
    assert np.corrcoef(given_flow, added)[0, 1] > 0.8
    assert np.std(flow.remaining[known]) < 0.2 * np.std(given_flow)
