"""The independent machine of the trials, what each kind draws, and how answers are judged."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.estimate.reduced_model import model_space, reduced_model, simulate_rows
from hydrotele.hydraulics.laws import ATMOSPHERE
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import load_log, save_log
from hydrotele.machine.machine_file import load_machine
from tests.measured import TRUTH
from tools.validation.blind.forms import FORMS
from tools.validation.blind.open_loop import open_loop_error
from tools.validation.blind.spreads import SIZES, draw_library_effect, off_everywhere
from tools.validation.blind.trials import Place
from tools.validation.blind.world import PA, PB, STATES, Q, R, S, W, simulate
from tools.validation.blind.world_judge import closed, judge_world, score_world
from tools.validation.blind.world_machine import channels
from tools.validation.blind.world_runs import (
    Noise,
    nominal_world,
    record_run,
    references,
    visibility,
)
from tools.validation.blind.world_trials import (
    KINDS,
    Drawn,
    WorldSeries,
    draw_trial,
    make_trial,
    refuse_uncertain,
    true_parameters,
)

# The independent simulator serves tools/nightly only, and so do its tests.
pytestmark = pytest.mark.nightly

CAT, RIG = load_machine("cat215"), load_machine("rig")
SHORT = 4.0  # s
_STATES = {"angle": Q, "velocity": W, "spool": S, "spool_rate": R, "pressure_head": PA,
           "pressure_rod": PB}  # fmt: skip


def replay(facts, start, commands, period, steps):
    machine, n = nominal_world(facts), len(facts.axes)
    zeros = np.zeros_like(commands)
    states = np.zeros((len(commands), n, STATES))
    _, shown = simulate(
        machine, start, commands.copy(), False, zeros, zeros, zeros, np.ones((7, n)),
        np.zeros((len(commands), len(channels(facts)))), period, steps, 0, states,
    )  # fmt: skip
    return shown


@pytest.mark.parametrize("run", ["fit_2", "test_1"])
def test_the_nominal_machine_comes_out_of_other_equations(run):
    log = load_log(TRUTH / f"{run}.parquet")
    state = json.loads(log.metadata["initial_state"])
    start = np.zeros((3, STATES))
    for key, place in _STATES.items():
        start[:, place] = state[key]
    commands = np.column_stack([log[f"command.{axis}"] for axis in CAT.axes])
    shown = replay(CAT, start, commands, 0.02, 40)
    for k, name in enumerate(channels(CAT)):
        span = np.ptp(log[name])
        # 40 s open loop; both integrators are of fourth order, and at half of this step the worst
        # channel differs by 5e-7. A resolver's noise is 5e-3 of these ranges.
        assert np.abs(shown[:, k] - log[name]).max() < 3e-5 * span, name


@pytest.mark.parametrize(
    ("facts", "period", "steps", "pressures", "places"),
    [
        (RIG, 0.005, 50, [[4.0e6, 6.0e6]], [0.2]),
        (CAT, 0.02, 40, [[2.0e6, 2.0e6], [8.7e6, 2.6e6], [1.9e6, 3.8e6]], [0.1, 0.45, -1.4]),
    ],
)
def test_the_machines_agree_with_the_reduced_model(facts, period, steps, pressures, places):
    n, rows = len(facts.axes), 200
    time = period * np.arange(rows)
    commands = 0.3 * np.sin(2 * np.pi * np.outer(time, 0.7 + 0.2 * np.arange(n)))
    names = tuple(channels(facts))
    model = reduced_model(facts, names)
    z = np.concatenate([places, np.zeros(n), *([0.0, 0.0, *pair] for pair in pressures)])
    shown, states = np.zeros((rows, len(names))), np.zeros((rows, len(z)))
    simulate_rows(model, model_space(model), z.copy(), commands, period, steps, shown, states)
    start = np.zeros((n, STATES))
    start[:, Q], start[:, [PA, PB]] = places, pressures
    other = replay(facts, start, commands, period, steps)
    # second order in the step against fourth: the rig differs by 6e-6 of its pressures' range
    assert np.all(np.abs(other - shown).max(axis=0) <= 1e-3 * np.ptp(shown, axis=0))


def test_the_machines_agree_where_a_chamber_is_drawn_empty():
    """The swing coasts against its closed valve: air by a closed form here, by Newton there."""
    n, rows, period, names = 3, 100, 0.02, tuple(channels(CAT))
    model = reduced_model(CAT, names)
    pressures, places = [[2.0e6, 2.0e6], [8.7e6, 2.6e6], [1.9e6, 3.8e6]], [0.1, 0.45, -1.4]
    rates = [0.9, 0.0, 0.0]
    z = np.concatenate([places, rates, *([0.0, 0.0, *pair] for pair in pressures)])
    shown, states = np.zeros((rows, len(names))), np.zeros((rows, len(z)))
    commands = np.zeros((rows, n))
    simulate_rows(model, model_space(model), z, commands, period, 80, shown, states)
    start = np.zeros((n, STATES))
    start[:, Q], start[:, W], start[:, [PA, PB]] = places, rates, pressures
    other = replay(CAT, start, commands, period, 80)
    drawn = shown[:, names.index("pressure_head.swing")]
    assert -ATMOSPHERE < drawn.min() < -0.1 * ATMOSPHERE
    # as above; what opens and shuts in between makes the reduced model's step count more
    assert np.all(np.abs(other - shown).max(axis=0) <= 2e-3 * np.ptp(shown, axis=0))
    lack = names.index("pressure_head.swing")
    empty = drawn < -0.05 * ATMOSPHERE
    assert np.abs(other[empty, lack] - drawn[empty]).max() < 0.01 * ATMOSPHERE


def test_a_delay_is_not_rounded_to_the_integrators_steps():
    """What 0.2 ms more of delay do is 0.4 of what a step of 0.5 ms more does."""
    commands, ends = np.zeros((40, 3)), []
    commands[5:, 1] = 0.5
    start = np.zeros((3, STATES))
    start[:, Q], start[:, [PA, PB]] = (
        [0.1, 0.45, -1.4],
        [[2e6, 2e6], [8.7e6, 2.6e6], [1.9e6, 3.8e6]],
    )
    for delay in (0.0500, 0.0502, 0.0505):  # a step is 0.5 ms
        late = apply_effect(CAT, "command_delay", "boom", {"delay": delay})
        ends.append(replay(late, start, commands, 0.02, 40)[-1, 1])
    share = (ends[1] - ends[0]) / (ends[2] - ends[0])
    assert share == pytest.approx(0.4, abs=0.01)  # of a path that bends little over 0.5 ms


@pytest.fixture(scope="module")
def asked():
    return references(CAT, np.random.default_rng(4), SHORT)


@pytest.mark.parametrize("name", FORMS)
def test_every_form_runs_and_shows(asked, name):
    place = FORMS[name].places(CAT)[-1]
    plain, rng = nominal_world(CAT), np.random.default_rng(7)
    changed, numbers = FORMS[name].change(plain, CAT, place, rng)
    assert numbers and all(np.isfinite(list(numbers.values())))
    run = record_run(changed, CAT, asked[2], Noise({}), rng)
    assert visibility(plain, CAT, [run]) > 5.0  # the limit of a test that knows what to look for


@pytest.mark.parametrize("form", FORMS.values(), ids=list(FORMS))
def test_every_form_has_a_name_in_the_library_that_can_sit_there(form):
    for place in form.places(CAT):
        pairs = form.right(place)
        known = [(n, at) for n, at in pairs if n in EFFECTS]
        assert any(at in EFFECTS[n].locations(CAT) for n, at in known), (form.name, place)


def test_sizes_lie_in_the_library_and_reach_every_effect():
    rng, names = np.random.default_rng(1), set()
    for _ in range(400):
        name, place, values = draw_library_effect(CAT, rng)
        assert apply_effect(CAT, name, place, values) != CAT
        names.add(name)
    assert names == set(SIZES)


def test_numbers_are_off_within_their_bounds_and_the_truth_is_known():
    off, numbers = off_everywhere(CAT, np.random.default_rng(2))
    assert len(numbers) > 50
    ratios = np.array([true / model for model, true in numbers.values()])
    assert np.all(np.abs(ratios - 1.0) <= 0.1 + 1e-12) and np.all(ratios != 1.0)
    told = true_parameters(CAT, off)
    valve = off.axes["boom"].valve
    assert valve and told["valve_deadband(boom)"]["deadband"] == valve.deadband
    ratio = numbers["axes.stick.valve.rated_flow"]
    assert told["valve_gain(stick)"]["ratio"] == pytest.approx(ratio[1] / ratio[0])
    for label, values in true_parameters(CAT, CAT).items():
        name, _, place = label[:-1].partition("(")
        known = EFFECTS[name].parameters(CAT, place)
        assert values == pytest.approx({k: known[k].nominal for k in values}), label
    name, place, values = "base_tilt", "base", {"roll": 0.05, "pitch": -0.03}
    tilted = true_parameters(CAT, apply_effect(CAT, name, place, values))
    assert tilted["base_tilt(base)"] == pytest.approx(values)


def test_wrong_noise_has_the_size_it_says():
    rng = np.random.default_rng(3)
    for gaussian in (False, True):
        noise = Noise({"pressure": 2.0, "angle": 0.7}, gaussian).draw(CAT, 4000, rng)
        size = noise.std(axis=0) * np.sqrt(3.0)
        # 4000 draws know a standard deviation to about 1 %
        assert size[0] == pytest.approx(0.7 * np.radians(0.1), rel=0.05)
        assert size[-1] == pytest.approx(2.0 * 25 * 6894.757, rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_a_trial_of_each_kind_is_made_and_sealed(tmp_path, kind):
    series = WorldSeries(seed=11, counts={kind: 1}, seconds=SHORT)
    place = Place(tmp_path, "0000")
    place.key.parent.mkdir()
    make_trial(place, series)
    key = json.loads(place.key.read_text())
    assert key["kind"] == kind
    assert bool(key["planted"]) is (kind != "clean")
    assert all(part["visibility"] >= 10.0 for part in key["planted"])
    assert bool(key["numbers"]) is (kind == "off")
    logs = {path.stem: load_log(path) for path in place.data.iterdir()}
    assert logs.keys() == {"fit_1", "fit_2", "fit_3", "test_1"}
    for log in logs.values():
        assert set(log.metadata) == {"machine", "tool", "sample_rate_hz", "sensors", "run"}
        assert not [name for name in log.columns if name.startswith("truth")]
        assert len(log) == round(SHORT * 50)


def test_an_effect_within_what_numbers_may_be_off_by_is_drawn_anew():
    def drawn(name, place, **values):
        part = {"name": name, "location": place, "right": [[name, place]], "parameters": values}
        return Drawn(nominal_world(CAT), apply_effect(CAT, name, place, values), [part], [],
                     Noise({}), {})  # fmt: skip

    assert CAT.supply
    stated = CAT.supply.relief_pressure  # good to 3 %
    with pytest.raises(InputError, match="within what its numbers"):
        refuse_uncertain(CAT, drawn("relief_pressure", "supply", relief_pressure=0.95 * stated))
    refuse_uncertain(CAT, drawn("relief_pressure", "supply", relief_pressure=0.85 * stated))
    refuse_uncertain(CAT, drawn("payload", "tool", mass=20.0))  # no uncertain number


def test_the_rig_has_trials_too():
    rng = np.random.default_rng(5)
    drawn = draw_trial(RIG, "near", 0, rng)
    run = record_run(drawn.world, RIG, references(RIG, rng, 2.0)[1], drawn.noise, rng)
    assert np.ptp(run.log["position.slide"]) > 0.01  # m


def test_open_loop_errors_of_the_true_model_are_noise_and_of_a_wrong_one_are_not(tmp_path):
    rng = np.random.default_rng(6)
    for asked_for in references(CAT, rng, 10.0):
        run = record_run(nominal_world(CAT), CAT, asked_for, Noise({}), rng)
        save_log(run.log, tmp_path / f"{run.name}.parquet")
    data = load_dataset(tmp_path, CAT)
    true = open_loop_error(CAT, data, data.heldout)
    other = apply_effect(CAT, "valve_deadband", "boom", {"deadband": 0.1})
    wrong = open_loop_error(other, data, data.heldout)
    # 500 rows know a size to 3 %; what the start is off by adds to it
    assert all(0.8 < size < 1.6 for size in true.values()), true
    assert wrong["length.boom"] > 3.0 * true["length.boom"]


def effect(name, place, probability=0.95, low=0.5, high=1.5):
    return {"name": name, "location": place, "probability": probability, "alternatives": [],
            "parameters": {"mass": {"value": 1.0, "unit": "kg", "ci95": [low, high]}}}  # fmt: skip


def part(name="worn_pump", place="supply", right=(("pump_flow_limit", "supply"),)):
    pairs = [list(pair) for pair in right]
    return {"name": name, "location": place, "right": pairs, "parameters": {"mass": 1.0},
            "visibility": 80.0}  # fmt: skip


def key(kind, *planted, truth=None):
    return {"kind": kind, "planted": list(planted), "truth": truth or {}, "numbers": {}}


def answer(verdict, *effects, before=3.0, after=1.0, free=(5.0, 2.0)):
    gap = {"before": before, "after": after, "noise_floor": 1.0}
    return {"trial": "0000", "error": None, "answer": {
        "verdict": verdict, "effects": list(effects), "gap": gap, "seconds": 3.0,
        "open_loop": {"before": free[0], "after": free[1]}, "memory_bytes": 1e9,
    }}  # fmt: skip


PUMP, BOOM = effect("pump_flow_limit", "supply"), effect("valve_gain", "boom")
FAILED = {"trial": "0000", "error": "crashed", "answer": None}


@pytest.mark.parametrize(
    ("planted", "told", "right"),
    [
        (key("near", part()), answer("named", PUMP), True),
        (key("near", part()), answer("partly", PUMP), True),
        (key("near", part()), answer("unknown", PUMP), False),  # a verdict that names nothing
        (key("near", part()), answer("ambiguous", PUMP), False),
        (key("near", part()), answer("named", BOOM), False),
        (key("near", part()), answer("partly", effect("pump_flow_limit", "supply", 0.4)), False),
        (key("near", part(), part("x", "boom", [("hose_compliance", "boom")])),
         answer("named", PUMP), False),  # one of two
        (key("clean"), answer("no_gap"), True),
        (key("clean"), answer("unknown"), True),  # not right to a user, but names nothing
        (key("clean"), answer("named", BOOM), False),
        (key("clean"), answer("partly", BOOM), False),
        (key("noise"), answer("named", BOOM), False),
        (key("off"), answer("partly", BOOM), False),
        (key("outside", part(right=())), answer("unknown"), True),
        (key("outside", part(right=())), answer("partly", effect("payload", "tool", 0.3)), True),
        (key("outside", part(right=())), answer("partly", BOOM), False),
        (key("outside", part(right=())), answer("unknown", BOOM), False),  # in any verdict
        (key("near", part()), FAILED, False),
        (key("clean"), FAILED, False),
        (key("outside", part(right=())), FAILED, False),
    ],
)  # fmt: skip
def test_an_answer_is_right_or_not(planted, told, right):
    assert judge_world(planted, told).right is right


def test_extra_names_and_the_surest_name_count_apart():
    told = answer("named", effect("valve_gain", "boom", 0.99), PUMP)
    outcome = judge_world(key("near", part()), told)
    assert outcome.right and not outcome.led and outcome.false == 1


def test_intervals_count_against_the_true_numbers():
    planted = part("pump_flow_limit", "supply")
    truth = {"pump_flow_limit(supply)": {"mass": 1.6}, "valve_gain(boom)": {"mass": 1.0}}
    told = answer("named", PUMP, BOOM)
    assert judge_world(key("library", planted, truth=truth), told).covered == (False,)
    assert judge_world(key("off", planted, truth=truth), told).covered == (False, True)
    truth["pump_flow_limit(supply)"]["mass"] = 1.4
    assert judge_world(key("library", planted, truth=truth), told).covered == (True,)


def test_closure_is_a_share_of_the_mean_square_above_the_floor():
    assert closed(2.0, 1.0, 1.0) == 1.0
    assert closed(2.0, np.sqrt(2.5), 1.0) == pytest.approx(0.5)  # 3 above the floor, 1.5 remain
    assert closed(2.0, 5.0, 1.0) == -1.0 and closed(2.0, None, 1.0) == -1.0
    assert closed(1.001, 1.0, 1.0) is None and closed(2.0, 1.0, None) is None


def test_targets_are_missed_by_bad_answers_and_reached_by_good_ones():
    good = [judge_world(key("near", part()), answer("partly", PUMP)),
            judge_world(key("clean"), answer("no_gap")),
            judge_world(key("off"), answer("no_gap")),
            judge_world(key("outside", part(right=())), answer("unknown"))]  # fmt: skip
    poor = answer("named", BOOM, free=(5.0, 4.9))
    kinds = (key("near", part()), key("clean"), key("off"), key("outside", part(right=())))
    bad = [judge_world(one, poor) for one in kinds]
    told = [t["reached"] for t in score_world(good)["targets"].values() if t["value"] is not None]
    missed = [t["reached"] for t in score_world(bad)["targets"].values() if t["value"] is not None]
    assert len(told) == len(missed) == 5
    assert all(told) and not any(missed)


def test_an_outsider_without_an_answer_closes_nothing():
    outside = key("outside", part(right=()))
    assert judge_world(outside, FAILED).open_loop == 0.0
    assert judge_world(outside, answer("unknown")).open_loop > 0.6
    assert judge_world(key("near", part()), FAILED).open_loop is None


STUB = """
import json
print(json.dumps({"verdict": "no_gap", "effects": [], "seconds": 0.1, "memory_bytes": 1e8,
                  "gap": {"before": 1.0, "after": 1.0, "noise_floor": 1.0},
                  "open_loop": {"before": 1.0, "after": 1.0}}))
"""


def test_a_series_is_stamped_goes_on_and_is_summarised(tmp_path):
    stub, out = tmp_path / "stub.py", tmp_path / "series"
    stub.write_text(STUB)
    root = Path(__file__).parents[2]
    command = [
        sys.executable,
        str(root / "tools" / "validation" / "blind_world.py"),
        "--out",
        str(out),
    ]
    asked = ["--kinds", "clean:1,near:1", "--seconds", "4", "--workflow", sys.executable, str(stub)]
    done = subprocess.run(
        [*command, *asked], env={"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin"}, cwd=root,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    results = sorted(out.glob("trials/*/result.json"))
    assert len(results) == 2
    for path in results:
        stamp = json.loads(path.read_text())["commit"]
        assert len(stamp.partition("+")[0]) == 40
    page = (out / "summary.md").read_text()
    assert "Searched by commit" in page and "| clean | 1 |" in page
    again = subprocess.run(
        [*command, *asked[-3:]], env={"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin"}, cwd=root,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "2 trials, 0 to run" in again.stdout
