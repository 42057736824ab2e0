"""Parameters that differ between runs, forces that act in one run, and the held-out run compared with the others."""

import dataclasses
import math

import numpy as np
import pytest

from hydrotele.effects import apply_effect
from hydrotele.estimate.evidence import Fit, Judged
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.gap.find import find_gap
from hydrotele.gap.regression import NormalEquations, compare_groups, split_columns
from hydrotele.gap.result import gap_document
from hydrotele.gap.run_differences import (
    between_runs,
    common_value,
    has_common_value,
    list_quantities,
    rescale_between_runs,
)
from hydrotele.machine.machine_file import load_machine
from hydrotele.show.gap_report import write_report
from hydrotele.terms.term import Term
from tests.gap.test_regression import _log_density
from tests.small_machines import simulate_data

_VISCOUS = "viscous_friction.slide.viscous"


def _simulate(own, rows=500):
    """Runs of the rig at 200 Hz, one of each machine; the first is held out."""
    noise = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}
    channels = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
    model = load_machine("rig")
    return simulate_data(model, channels, noise, period=0.005, rows=rows, noise_stated=True, own=own)


def test_a_group_with_a_column_per_run_has_the_bayes_factor_of_the_dense_gaussian():
    rng = np.random.default_rng(3)
    parts = [(rng.normal(size=40), rng.normal(size=(40, 1)), rng.normal(size=(40, 2))) for _ in range(3)]
    by_run = [NormalEquations.of(y, [x], n) for y, x, n in parts]
    terms = split_columns(by_run, [0], [1])
    marginal = terms.marginalise(np.array([2.0, 0.5]))
    factors, _ = compare_groups(terms.edges, marginal.right, marginal.blocks)
    errors, nuisance = (np.concatenate([p[k] for p in parts]) for k in (0, 2))
    own = nuisance * [2.0, 0.5]
    none = _log_density(errors, own)
    for factor, columns in zip(factors, ([p[1] for p in parts], [p[2][:, 1:] for p in parts]), strict=True):
        split = np.zeros((len(errors), 3))
        for r, column in enumerate(columns):
            split[40 * r : 40 * (r + 1), r] = column[:, 0]
        # rounding of a 120 x 120 determinant
        assert factor == pytest.approx(2.0 * (_log_density(errors, own, split) - none), abs=1e-8)


def test_the_standard_deviation_between_runs_is_that_of_the_estimates_where_these_are_certain():
    rig = load_machine("rig")
    quantity = list_quantities(rig, hypotheses(rig))[_VISCOUS]
    data = _simulate([rig] * 4, 60)
    group = between_runs(quantity, ["run_1", "run_2", "run_3", "run_0"], 1.0)
    deviation = np.array([2.0, -1.0, 0.5, 0.0])
    guess = Guess(((group, deviation),))
    information = np.diag([1e6, 1e6, 1e6, 0.0]) + np.eye(4)
    judged, fit = rescale_between_runs(Judged(guess, (), 0.0), Fit(guess, 0.0, 0.0, 0.0, information), data.fit)
    ((h, moved),) = judged.guess.parts
    scale = h.parameters["run_1"].prior_std / group.parameters["run_1"].prior_std
    assert scale == pytest.approx(math.sqrt(np.mean(deviation[:3] ** 2)), rel=1e-3)  # variances of 1e-6 remain
    assert h.values(moved) == pytest.approx(group.values(deviation))
    assert fit.information[0, 0] == pytest.approx(1e6 * scale**2 + 1.0)


def test_a_machine_differs_only_in_the_run_of_the_parameter():
    rig = load_machine("rig")
    viscous = rig.axes["slide"].cylinder.friction.viscous
    group = between_runs(list_quantities(rig, hypotheses(rig))[_VISCOUS], ["a", "b"], 1.0)
    guess = Guess(((group, np.array([1.0, -1.0])),))
    size = group.parameters["a"].prior_std
    found = [guess.machine(rig, run).axes["slide"].cylinder.friction.viscous for run in ("", "a", "b", "other")]
    assert found == pytest.approx([viscous, viscous + size, viscous - size, viscous])
    assert guess.parameter_runs == [("a",), ("b",)]


@pytest.mark.parametrize(("values", "common"), [
    ([1.3, 1.3, 1.3], True),
    ([1.0, 1.3, 1.1], True),
    ([1.3, -1.2, 0.1], False),
    ([2.0, 0.1], False),  # two values: 95 % of Student's distribution are within 12.7 standard errors
    ([1.3], False),  # one run says nothing about the scatter
])  # fmt: skip
def test_values_have_a_common_one_if_their_mean_is_significantly_nonzero(values, common):
    assert has_common_value(np.array(values)) is common


def test_values_of_runs_are_split_into_their_mean_and_the_differences_from_it():
    """The machine of every run stays the same."""
    rig, key = load_machine("rig"), ("viscous_friction", "slide")
    effect = next(h for h in hypotheses(rig) if h.key == key)
    group = between_runs(list_quantities(rig, [effect])[_VISCOUS], ["a", "b", "held_out"], 0.5)
    deviation, size = np.array([1.0, 2.0, 0.3]), group.parameters["a"].prior_std
    (own, start), (differing, moved) = common_value(effect, group, deviation)
    assert own is effect and differing is group
    assert effect.values(start)["viscous"] == pytest.approx(effect.parameters["viscous"].nominal + 1.5 * size)
    assert moved == pytest.approx([-0.5, 0.5, 0.3])
    before, after = Guess(((group, deviation),)), Guess(((own, start), (differing, moved)))
    for run in ("a", "b"):
        viscous = [g.machine(rig, run).axes["slide"].cylinder.friction.viscous for g in (before, after)]
        assert viscous[1] == pytest.approx(viscous[0])


def test_friction_that_differs_between_runs_is_found_and_transfers_to_another_run():
    """Viscous friction of the oil differs by up to 35 % from day to day; the held-out day is estimated, too."""
    rig = load_machine("rig")
    viscous = rig.axes["slide"].cylinder.friction.viscous
    ratios = {"run_0": 1.35, "run_1": 0.7, "run_2": 1.05, "run_3": 1.3}
    own = [rig.replace("axes.slide.cylinder.friction.viscous", viscous * k) for k in ratios.values()]
    gap = find_gap(_simulate(own, 350), effects=("viscous_friction",), jobs=1)
    assert gap.verdict == "no_gap"
    (difference,) = gap.differences
    assert difference.name == _VISCOUS
    for run, (size, width) in difference.runs.items():
        # four standard deviations of five estimates: a chance of 1 in 3000
        assert abs(size - viscous * (ratios[run] - 1.0)) < 4.0 * width
    assert gap.size.after < 1.05  # the white noise of 1050 readings: 2 %
    sampled = gap.posterior.samples[:, gap.posterior.names.index(_VISCOUS)]
    assert np.std(sampled) > 0.8 * difference.deviation  # samples hold for a new run; of 200, truncated at 0
    (document,) = gap_document(gap)["run_differences"]
    assert document["name"] == _VISCOUS


def test_an_effect_that_the_fitted_run_does_not_show_is_named_from_the_held_out_run():
    rig = load_machine("rig")
    rough = rig.replace("axes.slide.cylinder.friction.viscous", 1.5 * rig.axes["slide"].cylinder.friction.viscous)
    data = _simulate([rough, rough])
    data = dataclasses.replace(data, fit=(data.fit[0].select_rows(0, 30),))  # 0.15 s
    gap = find_gap(data, effects=("viscous_friction",), jobs=1)
    assert [(e.name, e.location) for e in gap.effects] == [("viscous_friction", "slide")]
    assert any("run_1 is held out in place of run_0" in note for note in gap.notes)


def test_a_pulse_in_one_run_is_named_and_one_in_the_held_out_run_is_reported(tmp_path):
    rig = load_machine("rig")
    pulsed = [
        apply_effect(rig, "force_pulse", "slide", {"size": size, "start": start, "duration": 0.6})
        for size, start in ((300.0, 1.2), (250.0, 0.8))
    ]
    data = _simulate([pulsed[0], rig, pulsed[1]])
    gap = find_gap(data, effects=("viscous_friction", "force_pulse"), jobs=1)
    (effect,) = gap.effects
    assert (effect.name, effect.location) == ("force_pulse", "slide.run_2")
    for key, value in (("size", 250.0), ("start", 0.8), ("duration", 0.6)):
        found = effect.parameters[key]
        width = (found.high - found.low) / 3.92
        assert abs(found.value - value) < 4.0 * width
    assert not gap.patched.terms  # what one run has is no property of the machine
    (difference,) = gap.differences
    assert difference.name == "force_pulse.slide" and list(difference.runs) == ["run_0"]
    assert difference.runs["run_0"][0] == pytest.approx(300.0, rel=0.05)  # five standard deviations
    write_report(gap, tmp_path / "report.html")
    assert "force pulse of the slide run 2" in (tmp_path / "report.html").read_text().lower()
    assert any("Run run_0 differs from the fitted runs: force_pulse.slide" in note for note in gap.notes)


@pytest.mark.nightly
def test_a_periodic_force_has_a_phase_of_its_own_in_every_run():
    rig, own = load_machine("rig"), []
    for phase in (0.3, 1.3, 2.9):
        waves = {"cos(time, 0.37)": 100.0 * math.cos(phase), "sin(time, 0.37)": 100.0 * math.sin(phase)}
        term = Term(name="wave", axis="slide", balance="force", law="formula", parameters=waves)
        own.append(rig.model_copy(update={"terms": (term,)}))
    gap = find_gap(_simulate(own, 800), effects=("force_pulse", "viscous_friction"), jobs=1)
    assert gap.verdict == "named"
    (effect,) = gap.effects
    assert (effect.name, effect.location) == ("periodic_force", "slide")
    period = effect.parameters["period"]
    assert period.low < 0.37 < period.high
    for run in ("run_1", "run_2"):
        size = math.hypot(*(effect.parameters[f"{run}: {part}"].value for part in ("cosine", "sine")))
        assert size == pytest.approx(100.0, rel=0.05)  # three standard deviations of 4 s
