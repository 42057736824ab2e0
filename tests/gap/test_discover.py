"""Something that no effect of the library is: not named as one, but learned, and simulated.

The machine is MuJoCo's, of the rig, with a term that the library has no effect for: an oil flow
into the head side that goes with the position in waves and with the square of the speed.
"""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.filter import Input
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.estimate.levels import columns_of, find_levels
from hydrotele.estimate.track import error_responses, track_run
from hydrotele.gap import discover
from hydrotele.gap.discover import Lacks, OpenLoop, Seen, better_ahead, learned_law, see
from hydrotele.gap.find import find_gap
from hydrotele.gap.law_tables import (
    Ground,
    Memory,
    Regression,
    Table,
    at_a_glance,
    finer_memories,
    lack_regression,
    paired_tables,
    possible_tables,
    predicted_by_choice,
    remembering_tables,
)
from hydrotele.gap.rivals import ENTER
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.terms.drive_state import Drives, DriveState
from hydrotele.terms.table import FORCE, PLAY, SWITCH, encode_terms_table, sum_terms, update_term_state
from hydrotele.terms.term import Term
from tests.estimate.test_filter import machine_data

PERIOD, SECONDS = 0.01, 7.0
HIDDEN = Term(
    name="hidden", axis="slide", balance="flow_head", law="formula",
    parameters={"sin(position, 0.24)": 2.0e-5, "velocity ** 2": -8.0e-4},
)  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two fit runs and one that is held out, of a rig that has the hidden flow."""
    folder = tmp_path_factory.mktemp("outside")
    rig = load_machine("rig")
    path = folder / "machine" / "machine.yaml"
    path.parent.mkdir()
    save_machine(rig.model_copy(update={"terms": (HIDDEN,)}), path)
    time = PERIOD * np.arange(round(SECONDS / PERIOD))
    logs = folder / "logs"
    logs.mkdir()
    for seed in range(3):
        waves = 0.35 * np.sin((1.1 + 0.2 * seed) * time) + 0.2 * np.sin((2.7 - 0.3 * seed) * time)
        scenario = Scenario(
            name=f"run_{seed}", machine=str(path), control_rate=100, log_rate=100, seed=seed,
            duration=SECONDS, sensors="laboratory", ground=False,
            pilot={"kind": "table", "quantity": "command", "interpolate": "hold", "time": time.tolist(),
                   "columns": {"slide": np.where(time > 0.2, waves, 0.0).tolist()}},
        )  # fmt: skip
        save_log(run_scenario(scenario).measured, logs / f"run_{seed}.parquet")
    return load_dataset(logs, rig)


@pytest.mark.nightly
@pytest.mark.parametrize("effects", [
    ("valve_gain", "internal_leakage"),
    pytest.param((), marks=pytest.mark.nightly, id="the whole library"),
])  # fmt: skip
def test_an_outsider_is_not_named_but_learned(effects, data, monkeypatch):
    """Daily with a small library: who names effects for `find_gap` to try gets no law learned."""

    def small(machine, names):
        return hypotheses(machine, effects)

    monkeypatch.setattr("hydrotele.gap.find.hypotheses", small)
    gap = find_gap(data)
    assert gap.verdict in ("unknown", "partly")
    assert all(effect.probability <= 0.5 for effect in gap.effects), gap.effects
    assert {law.balance for law in gap.learned} & {"flow_head", "flow_through"}
    errors = [
        free_run_errors(machine_runner(machine, data)(data.heldout), data.heldout, (5.0,), False)
        for machine in (gap.machine, gap.patched)
    ]
    column = data.channels.index("position.slide")
    before, after = (found.horizons["5"].rms[column] for found in errors)
    assert after < 0.5 * before  # a quarter of the mean square is left at most


def test_answers_of_the_errors_are_those_of_a_simulated_term():
    """First order against the filter itself, with a small flow, row by row."""
    machine = load_machine("cat215")
    made_up, _ = machine_data(machine, machine)
    data = dataclasses.replace(made_up, fit=(made_up.heldout,))
    track = track_run(machine, data, data.heldout, linearise=True)
    flow, size = Input("flow_head", "boom"), 1.0e-7  # m^3/s
    term = Term(name="extra", axis="boom", balance=flow.balance, law="constant",
                parameters={"value": size})  # fmt: skip
    changed = machine.model_copy(update={"terms": (term,)})
    with_it, without = (track_run(m, data, track.run, track).whitened for m in (changed, machine))
    column = columns_of(machine, track, [flow])[:, 0]
    told = size * error_responses(track, column, np.ones((len(track.states), 1)))[..., 0]
    told = told[1:]  # the first row is not changed
    off = np.linalg.norm((with_it - without)[1:] - told, axis=1) / np.linalg.norm(told, axis=1)
    # Where a check valve or friction switches within a row, the linear answer is another one.
    assert np.median(off) < 0.1


def test_two_laws_of_one_balance_are_written_and_read(tmp_path):
    """A machine that learned twice, or learns again after it was patched, is still a machine."""
    rig, case = load_machine("rig"), Input("flow_head", "slide")
    values = {"position": np.array([0.0, 0.4]), "velocity": np.array([-1.0, 1.0])}
    seen = Seen({"slide": values}, np.ones(2, bool), {})
    found = Regression(1.0, np.array([1.0, 2.0]) * 1e-5, np.eye(2), 1.0, 0.1)
    patched = rig
    for variable in ("position", "velocity", "position"):
        table = Table((variable,), ((-0.1, 0.1),), (1.0, 2.5) if variable == "velocity" else ())
        for balance in ("flow_head", "flow_through"):
            law = learned_law(patched, (case, balance, table), found, [seen])
            patched = law.hypothesis.machine(patched, np.zeros(0))
    save_machine(patched, tmp_path / "machine.yaml")
    terms = load_machine(str(tmp_path / "machine.yaml")).terms
    assert len(terms) == 9  # through is on both sides
    assert [t.window for t in terms] == 3 * [None] + 3 * [(1.0, 2.5)] + 3 * [None]


NAMES = (
    "time", "position", "velocity", "spool", "command", "force", "pressure_head", "pressure_rod",
    "pressure_supply", "velocity.swing", "spool.swing", "command.stick",
    "force.stick",
)  # fmt: skip


@pytest.fixture(scope="module")
def made_up():
    """Values of a boom's variables that have nothing to do with each other."""
    rng = np.random.default_rng(0)
    return {name: rng.normal(size=400) for name in NAMES} | {"time": np.linspace(0.0, 9.0, 400)}


def test_every_table_is_a_term_that_adds_what_its_columns_say(made_up):
    rng = np.random.default_rng(1)
    tables = possible_tables([made_up], 0.01)
    tables += possible_tables([made_up], 0.01, (2.0, 5.0))
    tables += paired_tables([made_up], 0.01, others=True)
    tables += paired_tables([made_up], 0.01, others=True, window=(2.0, 5.0))
    assert len({table.kind for table in tables}) == len(tables) > 20
    assert len({table.name for table in tables}) == len(tables)  # two laws of one place
    order = ["swing", "boom", "stick"]
    for table in rng.permutation(np.array(tables, object))[:90]:
        table = Table(*table)
        entries = rng.normal(size=table.size)
        term = Term(name="law", axis="boom", balance="force", **table.law(entries))
        written = encode_terms_table([term], order, areas={"stick": (1.0, 0.5)})
        columns = table.columns(made_up)
        assert columns.shape == (400, table.size)
        for row in rng.integers(400, size=20):
            own = {name: made_up[name][row] for name in NAMES if "." not in name}
            swing, stick = made_up["velocity.swing"][row], made_up["command.stick"][row]
            act = np.zeros(12)
            act[0] = made_up["spool.swing"][row]
            act[10:] = made_up["force.stick"][row] * np.array([2.0, 2.0])
            drives = Drives(3, act, np.zeros(3), np.array([swing, 0, 0]), np.array([0, 0, stick]))
            got = sum_terms(
                written, FORCE, 1, DriveState(**own, spool_rate=0.0, play_output=0.0, play_difference=0.0), drives
            )
            assert got == pytest.approx(columns[row] @ entries, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("smoothness", [0.1, 1.0, 10.0])
def test_a_law_does_not_rise_beyond_what_the_data_tell(smoothness):
    """Told on half of its points, where it rises by 2 per metre; straight on would be 2 at last."""
    table = Table(("position",), (tuple(np.linspace(0.0, 1.0, 11)),))
    place = np.linspace(0.0, 0.5, 400)
    shares = 10.0 * table.columns({"position": place})
    told = shares.T @ (10.0 * 2.0 * place)
    entries = np.linalg.solve(shares.T @ shares + table.precision(smoothness), told)
    assert entries[:6] == pytest.approx(2.0 * np.array(table.points[0][:6]), abs=0.01)  # its prior
    assert 0.0 < entries[-1] < 1.0 and entries.max() < 1.1


_OF_MEMORIES = ("velocity", "command.stick")


def test_every_table_with_a_memory_is_such_a_term():
    """Row by row the term, whose memory follows as it does in every simulator."""
    rng = np.random.default_rng(3)
    values = {name: np.cumsum(rng.normal(size=400)) / 10 for name in NAMES if name != "force"}
    first = [t for t in possible_tables([values], 0.01) if t.variables[0] == "velocity"]
    second = [
        t
        for t in paired_tables([values], 0.01, others=True)
        if t.variables in (("velocity", "spool.swing"), ("velocity", "velocity.swing"))
    ]
    tables = [t for table in first + second for t in remembering_tables(table, [values], list(_OF_MEMORIES))]
    ways = {(t.memory.way, t.memory.variable, len(t.variables)) for t in tables}
    assert ways >= {(PLAY, "velocity", 1), (PLAY, "velocity", 2), (SWITCH, "command.stick", 1),
                    (SWITCH, "velocity", 2)}  # fmt: skip
    assert any(t.variables == ("velocity", "play_difference") for t in tables)
    order = ["swing", "boom", "stick"]
    for table in [t for k, t in enumerate(tables) if k % 3 == 0]:
        entries = rng.normal(size=table.size)
        term = Term(name="law", axis="boom", balance="force", **table.law(entries))
        written, held = encode_terms_table([term], order, 12), 0.0
        columns, told = table.columns(values), []
        for row in range(400):
            now = {name: column[row] for name, column in values.items()}
            held = update_term_state(written, 0, now[table.memory.variable], held)
            act = np.append(np.zeros(12), held)
            act[0] = now["spool.swing"]
            drives = Drives(3, act, np.zeros(3), np.array([now["velocity.swing"], 0, 0]),
                            np.array([0, 0, now["command.stick"]]))  # fmt: skip
            own = {name: now[name] for name in now if "." not in name}
            state = DriveState(**own, spool_rate=0.0, force=0.0, play_output=0.0, play_difference=0.0)
            told.append(sum_terms(written, FORCE, 1, state, drives))
        assert told == pytest.approx(columns @ entries, rel=1e-9, abs=1e-9)
        assert np.ptp(told) > 0.0


CUT = slice(0, 3000), slice(3000, 6000)


def readings(told):
    """The ground of a run whose rows (n,) each tell an addition by itself, in units of noise."""
    return Ground((0, len(told)), 1, np.eye(len(told))[None], -told[None])


def cut(told, values):
    """The same in parts, with what is seen along each."""
    return [(readings(told[c]), {name: x[c] for name, x in values.items()}) for c in CUT]


def test_thresholds_of_a_relay_are_found():
    """A constant that a pressure switches, in noise as large: to a tenth of the range."""
    rng = np.random.default_rng(4)
    t = np.arange(6000) / 50.0
    values = {"velocity": np.sin(t), "pressure_rod": np.sin(0.7 * t) + 0.4 * np.sin(2.9 * t)}
    truth = Memory(SWITCH, "pressure_rod", -0.5, 0.6)
    parts = cut(truth.along(values) + rng.normal(size=6000), values)

    def share(table):
        return at_a_glance(table, parts).sum()

    (table,) = (t for t in possible_tables([values], 0.01) if t.variables == ("velocity",))
    best = max(remembering_tables(table, [values], values), key=share)
    for step in (0.4, 0.2, 0.1):
        best = max(finer_memories(best, step), key=share)
    assert best.memory.way == SWITCH and best.memory.variable == "pressure_rod"
    assert [best.memory.begin, best.memory.end] == pytest.approx([-0.5, 0.6], abs=0.28)
    assert share(best) > 1.3 * share(table), "the same table without a memory"


@pytest.mark.daily("0.4")
@pytest.mark.parametrize("level", [0.25, 0.4, 0.6, 0.8])
def test_a_relay_with_hardly_any_hysteresis_is_found(level):
    """A constant that a pressure switches at nearly one value, in noise as large."""
    rng = np.random.default_rng(6)
    t = np.arange(6000) / 50.0
    values = {"velocity": np.sin(t), "pressure_rod": np.sin(0.7 * t) + 0.4 * np.sin(2.9 * t)}
    off, on = np.quantile(values["pressure_rod"], [level - 0.01, level + 0.01])
    truth = Memory(SWITCH, "pressure_rod", float(off), float(on))
    parts = cut(truth.along(values) + rng.normal(size=6000), values)

    def share(table):
        return at_a_glance(table, parts).sum()

    (table,) = (t for t in possible_tables([values], 0.01) if t.variables == ("velocity",))
    best = max(remembering_tables(table, [values], values), key=share)
    for step in (0.8, 0.4, 0.2, 0.1):
        best = max(finer_memories(best, step), key=share)
    agree = np.mean(best.memory.along(values) == truth.along(values))
    assert best.memory.way == SWITCH and agree > 0.95


def test_a_law_over_what_no_two_runs_visit_alike_is_told():
    """Each run at positions of its own, all of them in either half: other runs tell nothing."""
    rng = np.random.default_rng(5)
    t = np.arange(2000) / 50.0
    places = [k + 0.5 * np.sin(t) for k in range(3)]
    values = [{"position": x} for x in places]
    (table,) = possible_tables(values, 0.01)
    lacks = [np.sin(4.0 * x) + 0.1 * rng.normal(size=2000) for x in places]
    deviation = np.full(2000, 0.1)
    parts = [(lack, deviation, table.columns(v)) for lack, v in zip(lacks, values, strict=True)]
    assert lack_regression(table, parts)[1] > 0.9


def test_blocks_see_what_their_rows_do_on_average(made_up):
    """A glance at blocks of rows is the regression on means of the rows' columns."""
    rng = np.random.default_rng(8)
    width, rows = 7, 400  # the last block is shorter
    blocks = -(-rows // width)
    half = rng.normal(size=(blocks, blocks))
    below = Ground((0, rows), width, np.array([half @ half.T] * 2), rng.normal(size=(2, blocks)))
    mean = np.equal.outer(np.arange(blocks), np.arange(rows) // width).astype(float)
    mean /= mean.sum(axis=1, keepdims=True)
    for table in paired_tables([made_up], 0.01, others=False)[:5]:
        held = mean @ table.columns(made_up)
        assert below.blocks(table, made_up) == pytest.approx(held, abs=1e-12)
        falls = []
        for smooth in (0.3, 3.0, 30.0):
            whole = held.T @ half @ half.T @ held + table.precision(smooth)
            x = [-np.linalg.solve(whole, held.T @ s) for s in below.slope[::-1]]
            falls.append([-2.0 * s @ held @ e - np.square(half.T @ held @ e).sum()
                          for s, e in zip(below.slope, x, strict=True)])  # fmt: skip
        told = at_a_glance(table, [(below, made_up)])
        assert told == pytest.approx(max(falls, key=sum), rel=1e-6)


def test_pairs_are_never_of_variables_that_only_their_drives_tell_apart(made_up):
    pairs = [t.variables for t in paired_tables([made_up], 0.01, others=True)]
    assert ("velocity", "spool.swing") in pairs or ("spool.swing", "velocity") in pairs
    assert ("velocity.swing", "spool.swing") in pairs
    assert not any({"velocity", "velocity.swing"} == set(pair) for pair in pairs)
    assert not any({"velocity.swing", "command.stick"} == set(pair) for pair in pairs)
    alone = paired_tables([made_up], 0.01, others=False)
    assert not any("." in variable for table in alone for variable in table.variables)


@pytest.mark.nightly
def test_a_smooth_surface_is_found_among_other_tables():
    rng = np.random.default_rng(2)
    values = {name: rng.normal(size=6000) for name in NAMES}
    x, y = values["velocity"], values["pressure_rod"]
    told = np.cos(1.5 * x + y) + rng.normal(size=6000)
    parts = cut(told, values)
    shares = {table.variables: at_a_glance(table, parts).sum() for table in paired_tables([values], 0.01, others=True)}
    assert max(shares, key=shares.__getitem__) in (
        ("velocity", "pressure_rod"), ("pressure_rod", "velocity")
    )  # fmt: skip
    strange = [s for pair, s in shares.items() if not {"velocity", "pressure_rod"} & set(pair)]
    assert len(strange) > 10 and max(strange) < 0.2 * max(shares.values())


@pytest.mark.parametrize(
    ("now", "before", "kept"),
    [
        ((0.9, 1.9, 4.0), (1.0, 2.0, 5.0), True),
        ((0.9, 2.1, 4.0), (1.0, 2.0, 5.0), False),  # some got worse more than the others better
        ((0.9, np.inf, 4.0), (1.0, 2.0, 5.0), False),  # one diverged
        ((1.1, 1.9, 4.0), (1.0, 2.0, 5.0), False),
        ((0.9, 1.9, 5.1), (1.0, 2.0, 5.0), False),  # better at first, worse later
        ((0.9, 1.9, np.nan), (1.0, 2.0, np.nan), True),  # no run is long enough for long ones
        ((np.nan,) * 3, (np.nan,) * 3, True),  # nor for short ones
    ],
)
def test_a_law_is_kept_where_free_runs_get_better_and_none_is_lost(now, before, kept):
    assert better_ahead(OpenLoop(*now), OpenLoop(*before)) is kept


def test_one_lost_window_says_little_and_what_is_below_noise_nothing(monkeypatch):
    """Nine windows at half the noise and one lost: 1000^(1/10); the mean square tells the loss."""
    each = np.full((10, 2), 0.5)
    each[3] = np.inf
    near = SimpleNamespace(each=each, rms=np.array([np.inf, 2.0]))
    found = SimpleNamespace(horizons={"1": near})
    monkeypatch.setattr(discover, "machine_runner", lambda *_: lambda run: None)
    monkeypatch.setattr(discover, "free_run_errors", lambda *_, to_end: found)
    evidence: Any = SimpleNamespace(data=SimpleNamespace(machine=None), map=lambda f, x: [*map(f, x)])
    judged: Any = SimpleNamespace(guess=SimpleNamespace(machine=lambda machine, run: machine))
    run: Any = SimpleNamespace(name="run")
    ahead = discover.open_loop(evidence, [run], judged, np.ones(2))
    assert ahead.usual == pytest.approx(1000.0**0.1) and ahead.rms == np.inf
    assert np.isnan(ahead.far)


def test_a_law_is_fitted_again_where_nothing_unknown_is_needed_any_more():
    """Its entries were 30 % too small; readings tell them where no unknown flow takes the rest."""
    machine, true = load_machine("cat215"), 3.0e-5  # m^3/s
    table = Table(("position",), ((0.0, 1.0),))
    term = Term.model_validate({
        "name": "t", "axis": "boom", "balance": "flow_head", **table.law(np.full(2, true)),
    })  # fmt: skip
    data, _ = machine_data(machine, machine.model_copy(update={"terms": (term,)}))
    small = np.full(2, 0.7 * true)
    begun = Regression(100.0, small, (0.3 * true) ** 2 * np.eye(2), 0.0, 0.0)
    evidence = Evidence(data, (data.heldout,), 1, lacking=True)
    try:
        judged = evidence.set_base(Guess())
        seen = [see(data, judged, track) for track in judged.tracks]
        law = learned_law(machine, (Input("flow_head", "boom"), "flow_head", table), begun, seen)
        guess = Guess().plus(law.hypothesis, np.zeros(0))
        (track,) = judged.tracks
        levels = dataclasses.replace(track.levels, inputs=(), sizes=np.zeros(0))
        without = dataclasses.replace(track, levels=levels)
        tracks = find_levels(data, guess.machine(machine), (without,))
        again = discover._refitted(evidence, Judged(guess, tracks, 0.0), law)
        assert again is not None
        guess = Guess().plus(again.hypothesis, np.zeros(0))
        tracks = find_levels(data, guess.machine(machine), (without,))
        lacks, place = Lacks.of(evidence, Judged(guess, tracks, 0.0)), (law.balance, law.axis)
        at = Input(*place), law.balance
        assert at[0] not in lacks.sizes
        told = lacks.without(again)
        switched = table._replace(memory=Memory(SWITCH, "velocity", -0.02, 0.02))
        own, other = (told.regressed((*at, form)) for form in (table, switched))
    finally:
        evidence.close()
    # what would be lacking without it is this law, and no other one says as much
    assert own.entries[1] == pytest.approx(again.entries[1], rel=0.1)
    assert other.predicted < own.predicted - 10.0 * ENTER
    off = again.entries - true
    # three standard deviations in two dimensions; the entry that these positions tell is nearer
    assert off @ np.linalg.solve(again.covariance, off) < 11.8
    assert abs(off[1]) < 0.5 * abs(small[1] - true)


def test_a_choice_that_only_the_own_run_would_make_predicts_nothing():
    """Of two tables that fit one run each the other runs choose the wrong one; a third fits all."""
    chance = [np.array([90.0, -10.0, -10.0]), np.array([-20.0, 70.0, -10.0])]
    assert predicted_by_choice(chance) < 0.0 < max(falls.sum() for falls in chance)
    true = np.array([50.0, 50.0, 50.0])
    assert predicted_by_choice([*chance, true]) == pytest.approx(150.0)


@pytest.mark.parametrize(("errors", "good"), [
    ((9.0, 5.0, 3.0), 2),  # both help
    ((9.0, 5.0, 12.0), 1),  # the second one spoils what the first brought
    ((9.0, 10.0, 11.0), 0),
])  # fmt: skip
def test_as_many_laws_are_kept_as_help_the_held_out_run(monkeypatch, errors, good):
    monkeypatch.setattr(discover, "open_loop", lambda e, runs, stage, noise: OpenLoop(*3 * [stage]))
    evidence: Any = SimpleNamespace(data=SimpleNamespace(heldout=None))
    stages: Any = errors
    kept, last, first = discover._held_out(evidence, stages, np.ones(1))
    assert (kept, last.far, first.far) == (good, errors[good], 9.0)
