"""Rows of Wang 2012: completeness, verdicts, broken runs, and the report's pictures."""

import re

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.experiments import wang_calibration, wang_identification, wang_models
from hydrotele.experiments.comparison import FAULT_REPETITIONS, Evaluation, Experiment, Sample
from hydrotele.experiments.wang2012 import SERIES
from hydrotele.show.experiment_report import write_experiment_report

# Repetitions of a right and of a broken run. Nightly 8: 95 % intervals of fractions of 1 then
# exclude one half. Daily fewer, so that fewer faults contradict a row, but broken runs still do.
DAILY, NIGHTLY = (4, 3), (8, FAULT_REPETITIONS)
ALL_ITEMS = {f"Table {k}" for k in range(1, 16)} | {f"Fig. {k}" for k in range(1, 31)}

FAST = (
    wang_models.KINEMATICS, wang_models.FIRST_ORDER, wang_models.PROPORTIONALITY,
    wang_calibration.REFINED_MODEL, wang_calibration.POE_MODEL,
    wang_calibration.WIRE_POSES, wang_calibration.WIRE_CALIBRATION, wang_identification.RANK_EXPERIMENT,
)  # fmt: skip
DIFFERS = {"54 parameters are refined to 36"}  # the rank of the 54 is 50, whatever the seed


def items_of(text: str) -> set[str]:
    """Tables and figures named in `Table 9, Figs 20 and 21 (p. 60)`; `3 to 5` is a range."""
    found = set()
    for word, numbers in re.findall(r"(Tables?|Figs?\.?) ((?:\d+(?:, | and | to )?)+)", text):
        values = [int(n) for n in re.findall(r"\d+", numbers)]
        if " to " in numbers:
            values = list(range(values[0], values[-1] + 1))
        found |= {f"{'Table' if word[0] == 'T' else 'Fig.'} {n}" for n in values}
    return found


def test_every_table_and_figure_is_a_row_or_a_drawing():
    rows = set().union(*(items_of(claim.item) for claim in SERIES.claims.values()))
    assert rows | set(SERIES.items_without_result) == ALL_ITEMS
    assert not rows & set(SERIES.items_without_result)


def test_names_are_unique_and_captions_have_no_checks():
    claims = [claim for one in SERIES.experiments for claim in one.claims]
    assert len(claims) == len(SERIES.claims)
    for claim in claims:
        assert (claim.fault is None) == (claim.kind == "caption")
        assert bool(claim.fault_description) == (claim.fault is not None)


def measure(one: Experiment, changes, count: int) -> list[Sample]:
    return [one.measure(seed, changes) for seed in range(1, one.repetitions(count) + 1)]


@pytest.mark.daily(
    "20 poses with wires-few",
    "POE model: 25 poses-few",
    "3-2-1 wires-few",
    "first-order error model-few",
    "independent parameters-few",
)
@pytest.mark.parametrize("counts", [DAILY, pytest.param(NIGHTLY, marks=pytest.mark.nightly)], ids=["few", "many"])
@pytest.mark.parametrize("one", FAST, ids=lambda one: one.name)
def test_rows_agree_and_their_broken_runs_differ(one: Experiment, counts):
    samples = measure(one, {}, counts[0])
    for claim in one.claims:
        row = claim.compare(samples)
        if claim.kind == "caption":
            assert row.verdict == "no verdict" and row.simulated
            continue
        # intervals of few repetitions may hold both verdicts, but must not contradict
        wrong = "agrees" if claim.name in DIFFERS else "differs"
        assert row.verdict != wrong, row.simulated
        assert claim.fault is not None
        broken = claim.compare(measure(one, claim.fault, counts[1]))
        assert broken.verdict == "differs", (claim.name, broken.simulated)


@pytest.mark.parametrize("one", SERIES.experiments, ids=lambda one: one.name)
def test_an_unknown_setting_is_refused(one: Experiment):
    with pytest.raises(InputError, match="valid: "):
        one.measure(1, {"magic": 1})


def judge(name: str, *values: dict[str, float]) -> Evaluation:
    return SERIES.claims[name].evaluate([Sample(one) for one in values])


def test_a_search_that_ends_too_high_differs():
    usual = {"excess": 0.02, "evaluations": 6e5, "least squares": 700.0, "generations": 2800.0}
    name = "DE does not depend on initial values"
    assert judge(name, usual, {**usual, "excess": 0.03}).verdict == "agrees"
    stopped = {**usual, "excess": 100.0}
    assert judge(name, stopped, {**stopped, "excess": 99.0}).verdict == "differs"


def test_posteriors_that_contradict_least_squares_differ():
    usual = {"shift": 0.04, "ratio": 1.01, "rhat": 1.05, "inside": 34.0}
    name = "MCMC and least squares agree on 36 parameters"
    assert judge(name, usual, usual).verdict == "agrees"
    for fault in ({"ratio": 2.0}, {"shift": 1.0}, {"rhat": 1.5}):
        assert judge(name, {**usual, **fault}, {**usual, **fault}).verdict == "differs"


def test_a_null_space_that_the_posterior_does_not_have_differs():
    usual = {"posterior over prior": 0.99, "posterior over theory": 1.0, "rhat": 1.08,
             "redundant": 4.0, "weak": 10.0}  # fmt: skip
    name = "redundancy by MCMC and by QR"
    assert judge(name, usual, usual).verdict == "agrees"
    assert judge(name, *[{**usual, "posterior over prior": 0.4}] * 2).verdict == "differs"


def test_forward_kinematics_that_miss_differ():
    usual = {"evolution": 1e-15, "mechanism": 1e-14, "inverse": 1e-16}
    name = "hexapod: forward kinematics by DE"
    assert judge(name, usual, {**usual, "evolution": 2e-15}).verdict == "agrees"
    missed = {**usual, "evolution": 0.1}
    assert judge(name, missed, {**missed, "evolution": 0.101}).verdict == "differs"


def test_every_posterior_figure_shows_the_parameters_of_its_caption(tmp_path):
    captions = wang_identification.FIGURE_CAPTIONS
    names = np.unique([name for _, shown, _ in captions.values() for name in shown])
    values = {f"{figure} {name}": 0.1 for figure, (_, shown, _) in
              captions.items() for name in shown[1:]}  # fmt: skip
    draws = np.random.default_rng(1).normal(size=(400, len(names)))
    arrays = {"draws": draws, "truth": np.zeros(len(names)), "names": names}
    rows = [
        claim.compare([Sample(values, arrays=arrays)])
        for claim in wang_identification.REDUNDANCY.claims
        if "posterior of" in claim.name
    ]
    drawn = [row.marginals.names for row in rows if row.marginals]
    assert drawn == [shown for _, shown, _ in captions.values()]
    write_experiment_report("wang2012", rows[:1], {}, tmp_path)
    assert len(list((tmp_path / "figures").glob("*.png"))) == 1


def test_curves_of_all_data_sets_are_drawn():
    history = np.geomspace(100.0, 0.01, 50)
    values = {"excess": 0.02, "evaluations": 6e5, "least squares": 700.0, "generations": 50.0}
    samples = [Sample(values, arrays={"history": history[: 50 - k]}) for k in range(5)]
    counts = {claim.item[:7]: len(claim.compare(samples).panels[0].curves)
              for claim in wang_identification.EVOLUTION_DH.claims
              if claim.kind == "caption"}  # fmt: skip
    assert counts == {"Fig. 10": 4, "Fig. 11": 5}
