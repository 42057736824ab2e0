"""The search by evidence: versions of an effect, residual inputs that are scaled, and one whole search."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from hydrotele.effects import EFFECTS, Effect, Parameter
from hydrotele.effects.effect import all_axes
from hydrotele.estimate.colour import Colour
from hydrotele.estimate.evidence import Evidence, Fit, Judged
from hydrotele.estimate.hypothesis import BETWEEN_RUNS, Guess, Hypothesis, hypotheses
from hydrotele.estimate.track import STEP
from hydrotele.gap.answer import Answer, Explanation
from hydrotele.gap.dictionary import list_versions
from hydrotele.gap.find import find_gap
from hydrotele.gap.machine_model import scale_residual_inputs
from hydrotele.gap.model_search import Model, compare_common_values, linear_factor
from hydrotele.gap.result import gap_document
from hydrotele.gap.run_differences import between_runs, list_quantities
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.dataset_reduction import select_exciting_segments
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.term import Term
from tests.gap.test_regression import _log_density
from tests.measured import MEASURED
from tests.small_machines import add_coloured_noise, simulate_data


def _effect(name, location):
    return next(h for h in hypotheses(load_machine("cat215")) if h.key == (name, location))


def test_versions_stay_inside_the_bounds():
    """Leakage from the cylinder to the tank cannot be negative, so it has no version on that side."""
    steps = [float(v.steps[0, 0]) for v in list_versions(_effect("tank_leakage", "boom"))]
    assert steps == [0.3, 2.0]
    relief = [float(v.steps[0, 0]) for v in list_versions(_effect("relief_pressure", "supply"))]
    assert relief == [0.3, 2.0, -2.0]
    for hypothesis in hypotheses(load_machine("cat215")):
        for version in list_versions(hypothesis):
            for step in version.steps.T:
                assert np.all(step >= hypothesis.low) and np.all(step <= hypothesis.high)


def test_the_answer_adds_up_and_names_the_deepest_sure_level():
    laws = (
        Explanation("coulomb_friction", "boom", 0.6),
        Explanation("viscous_friction", "boom", 0.38),
        Explanation("internal_leakage", "boom", 0.01),
    )
    answer = Answer(laws, 0.01)
    assert answer.places() == {"boom": pytest.approx(0.99)}
    assert answer.families("boom") == {"friction": pytest.approx(0.98), "leakage": pytest.approx(0.01)}
    assert answer.level == ("boom", "friction")
    assert sum(answer.places().values()) + answer.none == pytest.approx(1.0)


def test_the_factor_of_a_part_is_that_of_the_dense_gaussian():
    rng = np.random.default_rng(5)
    errors, sizes = 3.0 * rng.normal(size=40), (2, 1, 2)
    columns = [rng.normal(size=(40, size)) for size in sizes]
    every = np.hstack(columns)
    information = every.T @ every + np.eye(5)
    deviation = np.split(np.linalg.solve(information, every.T @ errors), np.cumsum(sizes)[:-1])
    table = {"a": Parameter("1", 0.0, -9.0, 9.0, 1.0, 0.0), "b": Parameter("1", 0.0, -9.0, 9.0, 1.0, 0.0)}
    parts = [
        (Hypothesis(f"part_{k}", "slide", dict(list(table.items())[:size])), d)
        for k, (size, d) in enumerate(zip(sizes, deviation, strict=True))
    ]
    fit = Fit(Guess(tuple(parts)), 0.0, 0.0, 0.0, information)
    for chosen in ([0], [1], [0, 2]):
        rest = [columns[k] for k in range(3) if k not in chosen]
        expected = 2.0 * (_log_density(errors, *columns) - _log_density(errors, *rest))
        assert linear_factor(fit, chosen) == pytest.approx(expected, abs=1e-9)  # rounding of a 40 x 40 determinant


class _ValuePerRun:
    """A model whose errors are how far the viscous friction of each run is from its true value."""

    def __init__(self, machine, true):
        self.machine, self.true, self.base = machine, true, None

    def judge(self, guess, same=False, reopened=False):
        found = [guess.machine(self.machine, run).axes["slide"].cylinder.friction.viscous for run in self.true]
        errors = 0.1 * (np.array(found) - list(self.true.values()))  # known to 10 N s/m
        tracks: Any = (_Uncoloured(),)
        return Judged(guess, tracks, float(errors @ errors) + guess.prior)

    def settle(self, judged, target):
        self.base = judged
        size = len(judged.guess.deviation)
        return judged, Fit(judged.guess, judged.loss, 0.0, 0.0, np.eye(size))

    def select_priors(self, guess):
        return guess

    def compact(self, judged):
        return judged

    def set_base(self, judged):
        self.base = judged
        return judged


class _Uncoloured:
    """A track without coloured noise."""

    levels = type("Levels", (), {"colours": ()})()


@pytest.mark.parametrize(("factors", "names"), [
    ((1.4, 1.4, 1.4), ["viscous_friction"]),  # one wrong value
    ((1.9, 2.5, 2.2), [BETWEEN_RUNS, "viscous_friction"]),
    ((1.4, 0.6, 1.0), [BETWEEN_RUNS]),
])  # fmt: skip
def test_a_parameter_that_is_wrong_in_all_runs_becomes_an_effect(factors, names):
    rig = load_machine("rig")
    nominal = rig.axes["slide"].cylinder.friction.viscous
    true = {f"run_{k}": nominal * factor for k, factor in enumerate(factors)}
    effect = next(h for h in hypotheses(rig) if h.key == ("viscous_friction", "slide"))
    quantity = list_quantities(rig, [effect])["viscous_friction.slide.viscous"]
    group = between_runs(quantity, [*true, "held_out"], 1.0)
    sizes = np.array([*true.values(), nominal]) - nominal
    guess = Guess(((group, sizes / group.parameters["run_0"].prior_std),))
    model: Any = _ValuePerRun(rig, true)
    found = compare_common_values(model, Model(model.judge(guess)), [effect])
    assert [h.name for h in found.guess.hypotheses] == names
    assert model.base is found.judged or names == [BETWEEN_RUNS]
    for run, value in true.items():
        assert found.guess.machine(rig, run).axes["slide"].cylinder.friction.viscous == pytest.approx(value)


def _set_ripple(machine, location, values):
    formula = {f"cos(position, {values['length']!r})": values["force"]}
    term = Term(name="ripple", axis=location, balance="force", law="formula", parameters=formula)
    return machine.model_copy(update={"terms": (*machine.terms, term)}) if values["force"] else machine


def test_a_custom_effect_is_found_whatever_its_start_value(monkeypatch):
    """The force is periodic in the position; its likelihood has a maximum at many lengths of the period."""

    def parameters(machine, location):
        return {
            "force": Parameter("N", 0.0, -500.0, 500.0, 50.0, 1.0, (20.0,)),
            "length": Parameter("m", 0.45, 0.02, 0.5, 0.1, 1e-3, (0.45,)),
        }

    effect = Effect("ripple", "a force that is periodic in the position", "force", all_axes, parameters, _set_ripple)
    monkeypatch.setitem(EFFECTS, "ripple", effect)
    rig = load_machine("rig")
    channels = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
    truth = _set_ripple(rig, "slide", {"force": 150.0, "length": 0.1})
    noise = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}
    data = simulate_data(truth, channels, noise, model=rig, period=0.005, rows=1000, noise_stated=True)
    gap = find_gap(data, effects=("ripple", "coulomb_friction"), jobs=1)
    (found,) = gap.effects
    assert found.name == "ripple"
    assert found.parameters["length"].low < 0.1 < found.parameters["length"].high


@pytest.fixture(scope="module")
def short_logs():
    """The logs with a larger dead band of the stick, 8 s of each run."""
    return select_exciting_segments(load_dataset([MEASURED / "open_05"], load_machine("cat215")), 24.0)


def test_a_filter_with_scaled_residual_inputs_is_the_linear_one(short_logs):
    """Nearly the same scale gives nearly the same innovations and likelihood."""
    evidence = Evidence(short_logs, short_logs.fit[:1], 1, STEP, lacking=True)
    try:
        (track,) = evidence.judged(Guess()).tracks
    finally:
        evidence.close()
    near = scale_residual_inputs(track, 1.0 + 1e-9)
    assert near.loss == pytest.approx(track.loss, rel=1e-4)  # the track's states are nonlinear, these are linear
    there = np.isfinite(track.whitened)
    assert np.abs(near.whitened - track.whitened)[there].max() < 0.1  # of a standard deviation
    smaller = scale_residual_inputs(track, 0.03)
    assert np.all(smaller.gains.spread[there] < track.gains.spread[there] * (1.0 + 1e-9))


def _rig_with_dead_band(rows):
    """Two runs of the rig at 200 Hz with a dead band that the model has 2 % of the full command smaller; its value."""
    rig = load_machine("rig")
    true = rig.axes["slide"].valve.deadband + 0.02
    noise = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}
    channels = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
    truth = rig.replace("axes.slide.valve.deadband", true)
    return simulate_data(truth, channels, noise, model=rig, period=0.005, rows=rows, noise_stated=True), true


def test_a_dead_band_of_the_rig_is_found_with_its_size():
    data, true = _rig_with_dead_band(800)
    gap = find_gap(data, effects=("valve_deadband", "command_delay", "payload"), jobs=1)
    assert gap.verdict == "named"
    assert [(e.name, e.location) for e in gap.effects] == [("valve_deadband", "slide")]
    found = gap.effects[0].parameters["deadband"]
    assert found.low < true < found.high
    sampled = np.quantile(gap.posterior.samples[:, 0], (0.025, 0.975))  # of 200: known to 0.2 standard deviations
    np.testing.assert_allclose(sampled, [found.low, found.high], atol=0.2 * (found.high - found.low))
    (answer,) = gap_document(gap)["answers"]
    assert answer["sure"][:1] == ["slide"]
    assert sum(answer["laws"].values()) + answer["none"] == pytest.approx(1.0)


@pytest.mark.nightly
def test_a_dead_band_is_found_with_its_size(short_logs):
    gap = find_gap(short_logs, effects=("valve_deadband", "command_delay", "payload"), jobs=2)
    assert [(e.name, e.location) for e in gap.effects] == [("valve_deadband", "stick")]
    # truth 0.085; a dead band is known to 0.001 even from half of the logs
    assert gap.effects[0].parameters["deadband"].value == pytest.approx(0.085, abs=0.003)
    (answer,) = gap_document(gap)["answers"]
    assert answer["sure"][:1] == ["stick"]
    assert sum(answer["laws"].values()) + answer["none"] == pytest.approx(1.0)


def test_a_machine_with_coloured_sensor_noise_has_no_gap():
    """All sensors of the rig resonate at 60 Hz with half of the stated variance: the noise is named, no effect is."""
    noise = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}
    channels = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
    data = simulate_data(load_machine("rig"), channels, noise, period=0.005, rows=1000, noise_stated=True)
    colours = {name: Colour(c, float(data.noise[c]), 0.04, 60.0) for c, name in enumerate(channels)}
    data = add_coloured_noise(dataclasses.replace(data, noise=np.sqrt(2.0) * data.noise), colours, seed=7)
    effects = ("coulomb_friction", "valve_deadband", "internal_leakage", "spool_lag", "pressure_lag")
    gap = find_gap(data, effects=effects, jobs=1)
    assert gap.verdict == "no_gap"
    assert not gap.effects
    notes = [note for note in gap.notes if "resonance" in note]
    assert [note.partition(" of ")[2].split()[4] for note in notes] == list(channels)
    for found, stated in gap.noise.values():
        assert found == pytest.approx(stated, rel=0.15)  # 1000 readings with a correlation time of 8 rows


@pytest.mark.nightly
@pytest.mark.parametrize(("memory", "frequency"), [(0.1, 0.0), (0.3, 0.0), (0.04, 30.0)])
def test_an_effect_and_coloured_noise_of_all_sensors_are_both_found(memory, frequency):
    """Half of the noise variance is coloured; the residual inputs must not stand for the rest."""
    data, true = _rig_with_dead_band(1600)
    colours = {name: Colour(c, float(data.noise[c]), memory, frequency) for c, name in enumerate(data.channels)}
    data = add_coloured_noise(dataclasses.replace(data, noise=np.sqrt(2.0) * data.noise), colours, seed=7)
    gap = find_gap(data, effects=("valve_deadband", "coulomb_friction", "command_delay"), jobs=1)
    assert gap.verdict == "named"
    assert [(e.name, e.location) for e in gap.effects] == [("valve_deadband", "slide")]
    found = gap.effects[0].parameters["deadband"]
    assert found.low < true < found.high
    assert sum("noise variance" in note for note in gap.notes) == 3
    for size, stated in gap.noise.values():
        assert size == pytest.approx(stated, rel=0.15)  # 27 to 80 independent coloured values of a run: 5 to 9 %


@pytest.mark.nightly
def test_friction_of_a_scored_bore_is_coulomb_friction_that_varies_with_position():
    """The hidden friction of open_02 acts within 0.05 m of 0.72 m of the stick's stroke."""
    data = select_exciting_segments(load_dataset([MEASURED / "open_02"], load_machine("cat215")), 45.0)
    gap = find_gap(data, effects=("coulomb_friction",), jobs=2)
    assert gap.verdict == "named"
    (effect,) = gap.effects
    assert (effect.name, effect.location) == ("coulomb_friction_by_position", "stick")
    points, values = effect.profile.points, effect.profile.values
    assert abs(points[int(np.argmax(values))] - 0.72) < 0.1
