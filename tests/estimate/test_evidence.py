"""Evidence: errors of guesses at coarse steps, against the same at the full step."""

from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from hydrotele.effects import EFFECTS, Parameter, apply_effect, with_value
from hydrotele.estimate import evidence as evidence_module
from hydrotele.estimate.evidence import MIDDLE, Evidence, _beyond_dents, _move, _threads
from hydrotele.estimate.hypothesis import Guess, Hypothesis, hypotheses
from hydrotele.estimate.track import COARSE
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import SensorError
from tests.estimate.test_filter import machine_data


@pytest.fixture(scope="module")
def evidence():
    nominal = load_machine("cat215")
    data, _ = machine_data(nominal, apply_effect(nominal, "angle_offset", "boom", {"offset": 2e-3}))
    found = Evidence(data, data.fit, 1)
    found.set_base(Guess())
    yield found
    found.close()


def guess(evidence, name, *deviation):
    nominal = evidence.data.machine
    (part,) = [h for h in hypotheses(nominal, [name]) if h.location == "boom"]
    return Guess(((part, np.array(deviation)),))


def test_a_coarse_step_changes_nothing_for_the_base(evidence):
    own = evidence.errors(Guess())
    for step in (2e-3, 4e-3, 10e-3):
        np.testing.assert_allclose(evidence.errors(Guess(), step), own, atol=1e-9)  # rounding


@pytest.mark.parametrize(("name", "deviation"), [("angle_offset", (0.2,)), ("pin_offset", (0.1, 0.1))])
def test_the_gain_of_an_effect_does_not_depend_on_the_step(evidence, name, deviation):
    """At 10 ms the integrator's own errors would change the loss by more than the effect does."""
    effect = guess(evidence, name, *deviation)
    gains = []
    for step in (1e-3, 4e-3, 10e-3):
        before, after = evidence.errors(Guess(), step), evidence.errors(effect, step)
        gains.append(before @ before - after @ after)
    assert gains[1] == pytest.approx(gains[0], rel=0.02)
    assert gains[2] == pytest.approx(gains[0], rel=0.1)
    integrator = np.sum(evidence.step_effect(Guess(), 10e-3) ** 2)
    assert integrator > 0.5 * abs(gains[0])


@pytest.mark.nightly
def test_where_a_number_ends_the_others_move_as_is_best_with_it_there():
    """Three numbers that hardly differ in what they do, two with little room, by brute force."""
    rng = np.random.default_rng(3)
    slopes = rng.normal(size=(50, 1)) + 0.2 * rng.normal(size=(50, 3))
    errors = slopes @ np.array([4.0, -3.0, 1.0]) + 0.1 * rng.normal(size=50)
    rooms = ((-1.0, 1.0), (-0.5, 9.0), (-9.0, 9.0))
    table = {f"p{k}": Parameter("1", 0.0, *room, 1.0, 0.1) for k, room in enumerate(rooms)}
    here = Guess(((Hypothesis("made", "up", table), np.array([0.3, 0.0, 0.2])),))

    def loss(d: np.ndarray) -> np.ndarray:
        left = errors + (d - here.deviation) @ slopes.T
        return np.sum(left**2, axis=-1) + np.sum(d**2, axis=-1)

    found = here.at(here.deviation + _move(here, slopes, errors)).deviation
    grids = [np.linspace(*room, 121) for room in rooms]
    tried = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1).reshape(-1, 3)
    assert loss(found) <= loss(tried).min()
    assert found[0] == -1.0 and found[1] < 9.0
    free = here.deviation - np.linalg.solve(slopes.T @ slopes + np.eye(3), slopes.T @ errors + here.deviation)
    assert loss(found) < 0.9 * loss(here.at(free).deviation)  # each number cut off by itself


def test_a_guess_of_nothing_is_fitted_as_it_is(evidence):
    """A search may end with none of its effects left: the fit has no numbers then."""
    fit = evidence.fit(Guess(), 0.0)
    assert fit.guess == Guess() and fit.information.shape == (0, 0)


@pytest.mark.parametrize(
    ("jobs", "processors", "runs", "threads"),
    [(2, 2, 3, 3), (2, 2, 1, 2), (2, 2, 20, 4), (1, 2, 3, 1), (1, 1, 3, 1), (2, 8, 3, 2)],
)
def test_runs_take_turns_where_the_jobs_are_all_processors(monkeypatch, jobs, processors, runs, threads):
    """Three runs on two processors take 1.5 times as long as one, not twice; no job more else."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(processors)), raising=False)
    assert _threads(jobs, runs) == threads


def test_a_rare_size_costs_little_and_pulls_little_where_no_drawing_tells(evidence):
    """The t distribution of 4 degrees, of the unit normal's width; a sensor's fault is normal."""
    inertia, offset = (guess(evidence, name, 0.0) for name in ("inertia_error", "angle_offset"))
    for d in (0.1, 1.0, 42.5):  # the last is 9.5 times the model's inertia
        far = inertia.at(np.array([d]))
        assert far.prior == pytest.approx(4.0 * np.log(1.0 + d**2 / 4.0))
        pull = (inertia.at(np.array([d + 1e-6])).prior - far.prior) / 1e-6
        assert far.prior_weight == pytest.approx([pull / (2.0 * d)], rel=1e-4)  # of a difference
    assert inertia.at(np.array([0.1])).prior == pytest.approx(0.01, rel=0.01)
    assert offset.at(np.array([7.0])).prior == 49.0


def test_a_number_among_dents_is_told_no_better_than_they_are_deep(evidence, monkeypatch):
    """A loss that rises by 1 at one spread, with dents 100 deep that repeat every third of it."""
    nominal, alone = evidence.data.machine, np.array([0.01])
    gap = EFFECTS["backlash"].parameters(nominal, "swing")["gap"]
    teeth = Hypothesis("backlash", "swing", {"gap": gap})
    guess = Guess(((teeth, np.array([0.5])),))

    def track_run(depth):
        def run(machine, *_, **__):
            value = machine.axes["swing"].transmission.backlash
            z = ((value - gap.nominal) / gap.prior_std - 0.5) / alone[0]
            loss = z**2 + 0.5 * depth * (1.0 - np.cos(19.0 * z))
            return SimpleNamespace(loss=loss / len(evidence.tracks))

        return run

    found = {}
    for depth in (0.0, 100.0):
        monkeypatch.setattr(evidence_module, "track_run", track_run(depth))
        (found[depth],) = _beyond_dents(evidence, guess, alone)
    assert found[0.0] == 1.0
    # dents of 100 hide a rise of as much, at 10 spreads: half the interval, 2 standard deviations
    assert 0.5 * 10.0 < 2.0 * found[100.0] < 2.0 * 10.0


class _Errors(Evidence):
    """Errors of a formula instead of runs."""

    def __init__(self, formula):
        """Take (guess, step) -> (E,) errors."""
        names = {f"n{k}": Parameter("1", 0.0, -3.0, 3.0, 1.0, 0.0) for k in range(12)}
        many = Hypothesis("many", "all", names)
        self._base = Guess(((many, np.zeros(many.size)),))
        self._smooth, self._formula = {}, formula

    def errors(self, guess, step=None, tracks=None, parallel=False):
        return self._formula(guess.deviation, step)


@pytest.mark.parametrize("curve, expected", [
    (lambda x: np.sin(3.0 * x), COARSE),
    (lambda x: 20.0 * x + 30.0 * x**2, COARSE),
    (lambda x: np.sin(1e7 * x), MIDDLE),  # another last digit, another error
    (lambda x: np.floor(300.0 * x + 0.3), MIDDLE),  # sticks or slips
])  # fmt: skip
def test_slopes_are_taken_at_a_step_at_which_errors_are_smooth(curve, expected):
    def errors(deviation, step):
        return np.tile(curve(deviation) if step > MIDDLE else deviation, 20)

    assert _Errors(errors).slope_step == expected


def test_leakage_to_tank_is_recovered_and_not_mistaken_for_leakage_across_the_piston():
    """Oil lost by both chambers against oil that one loses to the other, on 12 s of motion."""
    nominal, leak = load_machine("cat215"), 1e-12
    data, _ = machine_data(nominal, apply_effect(nominal, "tank_leakage", "boom",
                                                 {"leakage": leak}))  # fmt: skip
    with closing(Evidence(data, data.fit, 1, 4e-3)) as found:
        found.set_base(Guess())
        fits = {}
        for name in ("tank_leakage", "internal_leakage"):
            first = guess(found, name, 0.0)
            fits[name] = found.fit(first, 0.0)
        spread = float(np.linalg.inv(fits["tank_leakage"].information)[0, 0]) ** 0.5
        ((part, deviation),) = fits["tank_leakage"].guess.parts
        scale = part.parameters["leakage"].prior_std
        # four standard deviations of the fit, and the known value is as far from none as 100
        assert deviation[0] * scale == pytest.approx(leak, abs=4.0 * spread * scale)
        assert leak > 20.0 * spread * scale
        losses = {k: float(np.sum(found.errors(f.guess, 4e-3) ** 2)) for k, f in fits.items()}
        nothing = float(np.sum(found.errors(Guess(), 4e-3) ** 2))
    gained = nothing - losses["tank_leakage"]
    assert nothing - losses["internal_leakage"] < 0.5 * gained


def test_a_drift_is_recovered_and_not_mistaken_for_an_offset():
    """A sensor that warms up within the 12 s, its time constant known, as in a search."""
    slow = {"angle.boom": SensorError(drift_time_constant=5.0)}
    nominal = with_value(load_machine("cat215"), "sensor_errors", slow)
    data, _ = machine_data(nominal, apply_effect(nominal, "angle_drift", "boom", {"drift": 0.02}))
    losses, best = {}, {}
    with closing(Evidence(data, data.fit, 1, 4e-3)) as found:
        found.set_base(Guess())
        for name in ("angle_drift", "angle_offset"):
            best[name] = found.fit(guess(found, name, 0.0), 0.0)
            losses[name] = float(np.sum(found.errors(best[name].guess, 4e-3) ** 2))
        losses[""] = float(np.sum(found.errors(Guess(), 4e-3) ** 2))
    ((part, deviation),) = best["angle_drift"].guess.parts
    scale = part.parameters["drift"].prior_std
    spread = float(np.linalg.inv(best["angle_drift"].information)[0, 0]) ** 0.5
    # four standard deviations of the fit
    assert deviation[0] * scale == pytest.approx(0.02, abs=4.0 * spread * scale)
    assert 20.0 * spread * scale < 0.02
    assert losses["angle_drift"] < losses["angle_offset"] - 100.0  # exp(50) times as likely
    assert losses["angle_offset"] < losses[""]
