"""Learned laws and profiles as columns of the regression, and the verdict that follows from a search."""

import itertools

import numpy as np
import pytest

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.filter import Input
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.estimate.levels import columns_of
from hydrotele.estimate.track import STEP, error_responses, track_run
from hydrotele.gap.find import find_gap
from hydrotele.gap.law_tables import THROUGH, Table
from hydrotele.gap.laws import LawForm, list_forms
from hydrotele.gap.machine_model import MachineModel
from hydrotele.gap.model_search import search_model
from hydrotele.gap.result import GapSize, LearnedLaw, NamedEffect
from hydrotele.gap.run_variables import Seen, see_run
from hydrotele.gap.verdict import HeldOut, count_unexplained, verdict_of
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.terms.term import Term
from tests.estimate.test_filter import machine_data
from tests.small_machines import simulate_data

_CHANNELS = ("position.slide", "pressure_head.slide", "pressure_rod.slide")
_NOISE = {"position": 2e-5, "pressure_head": 1e4, "pressure_rod": 1e4}


def _rig_with(rows, *terms):
    """Two runs of the rig at 200 Hz with terms that its model lacks."""
    rig = load_machine("rig")
    truth = rig.replace("terms", terms)
    return simulate_data(truth, _CHANNELS, _NOISE, model=rig, period=0.005, rows=rows, noise_stated=True)


@pytest.fixture(scope="module")
def rig_evidence():
    data = _rig_with(300, Term(name="x", axis="slide", balance="force", law="constant", parameters={"value": 200.0}))
    evidence = Evidence(data, data.fit, 1, STEP, lacking=True)
    evidence.set_base(Guess())
    yield evidence
    evidence.close()


def test_the_responses_of_a_law_are_those_of_its_term(rig_evidence):
    """The linearised filter predicts what simulating the term changes, for a force and a flow through the piston.

    A law that changes much with the velocity within a row, as friction does where the motion turns, is met less well.
    """
    machine, tracks = rig_evidence.data.machine, rig_evidence.tracks
    seen = [see_run(machine, rig_evidence.data, track) for track in tracks]
    forms = list_forms(rig_evidence, rig_evidence.judged(Guess()), seen, ("coulomb_friction",), True)
    single = next(f for f in forms if f.key == ("learned_force", "slide.position"))
    assert any(f.key == ("coulomb_friction_by_position", "slide") for f in forms)
    through = LawForm(THROUGH, "slide", single.table, 1e-6, single.smoothing)
    base = rig_evidence.errors(Guess())
    for form in (single, through):
        hypothesis = form.hypothesis(form.roots()[0])
        z = np.random.default_rng(0).normal(size=hypothesis.size)
        linear = rig_evidence.responses(hypothesis, tracks) @ z
        change = rig_evidence.errors(Guess().plus(hypothesis, z)) - base
        # the law is held over a row of 5 ms, and 0.1 % of the largest force is not quite linear
        assert np.linalg.norm(linear - change) < 0.15 * np.linalg.norm(change), form.key


def test_the_curve_of_a_valve_is_no_law_without_a_cause_if_its_gain_is_a_candidate(rig_evidence):
    """A command that depends on the command alone is a valve gain that varies with the command."""
    data, tracks = rig_evidence.data, rig_evidence.tracks
    seen = [see_run(data.machine, data, track) for track in tracks]
    judged = rig_evidence.judged(Guess())
    curve, gain = ("learned_command", "slide.command"), ("valve_gain_by_command", "slide")
    keys = {effects: [f.key for f in list_forms(rig_evidence, judged, seen, effects, True)]
            for effects in ((), ("valve_gain",))}  # fmt: skip
    assert curve in keys[()] and gain not in keys[()]
    assert gain in keys["valve_gain",] and curve not in keys["valve_gain",]
    assert ("learned_command", "slide.velocity") in keys["valve_gain",]


def test_several_laws_of_one_balance_have_names_of_their_own(tmp_path):
    """A machine that is searched again after a correction is still a machine."""
    patched = load_machine("rig")
    for variable, balance in itertools.product(("position", "velocity", "position"), ("flow_head", THROUGH)):
        form = LawForm(balance, "slide", Table((variable,), ((-0.1, 0.0, 0.1),)), 1e-5, 0.01)
        hypothesis = form.hypothesis(form.roots()[0])
        patched = hypothesis.machine(patched, np.ones(hypothesis.size))
    save_machine(patched, tmp_path / "machine.yaml")
    terms = load_machine(str(tmp_path / "machine.yaml")).terms
    assert len(terms) == 9  # a flow through the piston is on both sides
    assert terms == patched.terms


def test_the_responses_of_the_errors_are_those_of_a_simulated_term():
    """The linearised filter against the filter itself, with a small flow, row by row."""
    machine = load_machine("cat215")
    data, _ = machine_data(machine, machine)
    track = track_run(machine, data, data.heldout, linearise=True)
    flow, size = Input("flow_head", "boom"), 1.0e-7  # m^3/s
    term = Term(name="extra", axis="boom", balance="flow_head", law="constant", parameters={"value": size})
    changed = machine.model_copy(update={"terms": (term,)})
    with_it, without = (track_run(m, data, track.run, track).whitened for m in (changed, machine))
    column = columns_of(machine, track, [flow])[:, 0]
    linear = size * error_responses(track, column, np.ones((len(track.states), 1)))[..., 0]
    linear = linear[1:]  # the first row is not changed
    off = np.linalg.norm((with_it - without)[1:] - linear, axis=1) / np.linalg.norm(linear, axis=1)
    assert np.median(off) < 0.1  # where a check valve or friction switches within a row, the response is nonlinear


def test_a_law_over_two_variables_is_zero_at_the_prior_mean():
    table = Table(("position", "velocity"), ((0.0, 1.0), (-1.0, 1.0)))
    form = LawForm("force", "slide", table, 2.0, 0.01)
    seen = Seen({"slide": {"position": np.array([0.0, 1.0]), "velocity": np.array([1.0, 0.0])}}, np.ones(2, bool), {})
    np.testing.assert_allclose(form.shares(seen), [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.5, 0.5]])
    (term,) = form.terms(np.zeros(4), ())
    assert term.law == "bilinear_table"


def test_friction_that_peaks_at_a_position_is_named_with_its_profile():
    rig = load_machine("rig")
    numbers = {
        "coulomb": 300.0, "centre": 0.3, "width": 0.02,
        "smoothing_velocity": rig.axes["slide"].drive.friction.smoothing_velocity,
    }  # fmt: skip
    data = _rig_with(400, Term(name="x", axis="slide", balance="force", law="friction_bump", parameters=numbers))
    gap = find_gap(data, effects=("coulomb_friction",), jobs=1)
    assert gap.verdict == "named"
    (effect,) = gap.effects
    assert (effect.name, effect.location) == ("coulomb_friction_by_position", "slide")
    (term,) = gap.patched.terms
    assert (term.law, term.parameters["variable"]) == ("scaled_table", "position")
    nominal, points = rig.axes["slide"].drive.friction.coulomb, np.array(effect.profile.points)
    true = nominal + 300.0 * np.exp(-0.5 * ((points - 0.3) / 0.02) ** 2)
    deviation = (np.array(effect.profile.values) - true) / 300.0
    assert np.sqrt(np.mean(deviation**2)) < 0.1  # a smooth law of 2 s of motion


def test_a_force_without_a_cause_is_learned_in_competition_with_effects():
    force = Term(name="x", axis="slide", balance="force", law="formula", parameters={"sin(position, 0.2)": 400.0})
    data = _rig_with(300, force)
    candidates = [h for h in hypotheses(data.machine) if h.name in ("coulomb_friction", "payload")]
    evidence = Evidence(data, data.fit, 1, STEP, lacking=True)
    try:
        found = search_model(MachineModel(evidence), candidates, has_laws=True)
    finally:
        evidence.close()
    assert [h.key for h in found.guess.hypotheses] == [("learned_force", "slide.position")]
    (law,) = found.guess.machine(data.machine).terms
    points, values = np.array(law.parameters["points"]), np.array(law.parameters["values"])
    assert np.sqrt(np.mean((values - 400.0 * np.sin(2.0 * np.pi * points / 0.2)) ** 2)) < 20.0  # 5 % of 400 N


@pytest.mark.nightly
def test_an_oil_flow_of_a_form_that_the_library_does_not_have_is_learned_not_named():
    """It depends on the position in waves and on the square of the velocity; the errors of open loop halve."""
    laws = {"sin(position, 0.24)": 2.0e-5, "velocity ** 2": -8.0e-4}
    data = _rig_with(1400, Term(name="hidden", axis="slide", balance="flow_head", law="formula", parameters=laws))
    gap = find_gap(data, jobs=1)
    assert gap.verdict in ("unknown", "partly", "learned")
    assert all(effect.probability <= 0.5 for effect in gap.effects), gap.effects
    assert {law.balance for law in gap.learned} & {"flow_head", THROUGH}
    errors = [
        free_run_errors(machine_runner(machine, data)(data.heldout), data.heldout, (5.0,), False)
        for machine in (gap.machine, gap.patched)
    ]
    column = data.channels.index("position.slide")
    before, after = (found.horizons["5"].rms[column] for found in errors)
    assert after < 0.5 * before  # at most a quarter of the mean square remains


def _effect(probability, location="boom"):
    return NamedEffect("coulomb_friction", location, probability, {}, share=0.9)


def _law(share):
    return LearnedLaw("force", "boom", "", "", "", "position", (), (), (), "N", "m", share)


def test_the_verdict_follows_from_effects_laws_and_tests():
    closed, half = GapSize(5.0, 1.0, 1.0), GapSize(5.0, 3.0, 1.0)
    assert verdict_of([], [], False, closed) == "no_gap"
    assert verdict_of([], [], False, GapSize(1.0, 1.0, None)) == "unknown"
    assert verdict_of([], [], True, half) == "unknown"
    assert verdict_of([_effect(0.97)], [], False, closed) == "named"
    assert verdict_of([_effect(0.6)], [], False, closed) == "ambiguous"
    assert verdict_of([_effect(0.97)], [], True, half) == "partly"
    assert verdict_of([_effect(0.4)], [], True, half) == "unknown"
    assert verdict_of([_effect(0.97)], [_law(0.1)], False, closed) == "partly"
    assert verdict_of([], [_law(1.0)], False, closed) == "learned"
    assert verdict_of([], [_law(0.5)], True, half) == "unknown"


def test_what_remains_on_an_axis_counts_as_no_effect():
    left = {"": 0.1, "boom": 0.2, "stick": 0.0}
    named = count_unexplained([_effect(1.0), _effect(1.0, "stick")], [_law(0.3)], left, {"boom"})
    assert [e.probability for e in named] == pytest.approx([1.0, 0.5])
    assert count_unexplained([_effect(1.0)], [], left, set())[0].probability == 1.0


def test_a_held_out_run_rejects_what_predicts_it_worse():
    assert HeldOut(-30.0, -0.1, 0.02).is_worse
    assert HeldOut(100.0, 0.1, 0.02).is_worse
    assert not HeldOut(-3.0, 0.02, 0.02).is_worse
    assert not HeldOut(100.0, np.nan, np.nan).is_worse
    assert "0.90 times" in HeldOut(100.0, np.log(0.9), 0.02).words
