"""Something that no effect of the library is: not named as one, but learned, and simulated.

The machine is MuJoCo's, of the rig, with a term that the library has no effect for: an oil flow
into the head side that goes with the position in waves and with the square of the speed.
"""

import dataclasses

import numpy as np
import pytest

from hydrotele.dataset.load import load_dataset
from hydrotele.gap.discover import _better, _law, _Seen
from hydrotele.gap.find import find_gap
from hydrotele.gap.law_regression import Regression
from hydrotele.gap.law_shapes import Shape, possible_shapes
from hydrotele.log import save_log
from hydrotele.machine_file import load_machine, save_machine
from hydrotele.prediction.free_run import free_run_errors, machine_runner
from hydrotele.prediction.inputs import Input
from hydrotele.prediction.levels import columns_of
from hydrotele.prediction.responses import error_responses
from hydrotele.prediction.track import track_run
from hydrotele.run import run_scenario
from hydrotele.scenario import Scenario
from hydrotele.terms.facts import Term
from tests.prediction.test_filter import machine_data

PERIOD, SECONDS = 0.01, 10.0
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
            pilot={"kind": "table", "of": "command", "interpolate": "hold", "time": time.tolist(),
                   "columns": {"slide": np.where(time > 0.2, waves, 0.0).tolist()}},
        )  # fmt: skip
        save_log(run_scenario(scenario).measured, logs / f"run_{seed}.parquet")
    return load_dataset(logs, rig)


def test_an_outsider_is_not_named_but_learned(data):
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
    seen = _Seen({"slide": {"position": np.array([0.0, 0.4]), "velocity": np.array([-1.0, 1.0])}},
                 np.ones(2, bool))  # fmt: skip
    found = Regression(1.0, (1,), np.ones(1), np.ones(1), 0.1)
    patched = rig
    for variable in ("position", "velocity", "position"):
        shape = Shape(variable, "", (0.1,), "", ())
        for balance in ("flow_head", "flow_through"):
            law, start = _law(patched, (case, balance, shape), found, [seen])
            patched = law.hypothesis.machine(patched, start)
    save_machine(patched, tmp_path / "machine.yaml")
    assert len(load_machine(str(tmp_path / "machine.yaml")).terms) == 9  # through is on both sides


def test_products_of_two_variables_are_bilinear_between_their_kinks():
    shape = Shape("position", "", (0.3,), "pressure_head - pressure_rod", ())
    values = {
        "position": np.array([0.1, 0.5]), "pressure_head": np.array([3e6, 5e6]),
        "pressure_rod": np.array([1e6, 1e6]),
    }  # fmt: skip
    assert shape.products == [
        "1", "(pressure_head - pressure_rod)", "position",
        "position * (pressure_head - pressure_rod)", "above(position, 0.3)",
        "above(position, 0.3) * (pressure_head - pressure_rod)",
    ]  # fmt: skip
    expected = [[1, 2e6, 0.1, 2e5, 0, 0], [1, 4e6, 0.5, 2e6, 0.2, 8e5]]
    np.testing.assert_allclose(shape.columns(values, 0.01), expected)
    some = shape.with_products((1, 3))
    assert some.products == [shape.products[1], shape.products[3]]
    np.testing.assert_allclose(some.columns(values, 0.01), np.array(expected)[:, [1, 3]])
    Term(name="law", axis="slide", balance="force", law="formula",
         parameters=dict.fromkeys(shape.products, 1.0))  # fmt: skip


def test_a_variable_without_products_is_none_of_the_laws():
    shape = Shape("position", "", (0.3,), "velocity", (0.0,))
    assert shape.with_products((3, 6)) == Shape("position", "", (0.3,), chosen=(1, 2))
    assert shape.with_products((1, 2)) == Shape("velocity", "", (0.0,), chosen=(1, 2))
    assert shape.with_products((1, 4)).kind == ("position", "", "velocity")
    for chosen in ((3, 6), (1, 2), (1, 4)):
        expected = [shape.products[k] for k in chosen]
        assert shape.with_products(chosen).products == expected


def test_every_form_of_a_balance_can_be_written_as_a_term():
    rng = np.random.default_rng(0)
    names = ("time", "position", "velocity", "spool", "command", "force", "pressure_head",
             "pressure_rod", "pressure_supply")  # fmt: skip
    values = [{name: rng.normal(size=400) for name in names}]
    for balance in ("force", "flow_head", "flow_rod", "flow_through", "command"):
        shapes = possible_shapes(balance, values, 0.01)
        assert len({shape.kind for shape in shapes}) == len(shapes) > 10
        assert len({shape.name for shape in shapes}) == len(shapes)  # two laws of one place
        for shape in shapes:
            Term(name="law", axis="slide", balance="force", law="formula",
                 parameters=dict.fromkeys(shape.products, 1.0))  # fmt: skip
            assert shape.columns(values[0], 0.01).shape == (400, len(shape.products))


@pytest.mark.parametrize(
    ("now", "before", "kept"),
    [
        ((0.9, 1.9), (1.0, 2.0), True),
        ((0.9, 2.1), (1.0, 2.0), False),  # some windows got worse more than the others better
        ((0.9, np.inf), (1.0, 2.0), False),  # one diverged
        ((1.1, 1.9), (1.0, 2.0), False),
        ((np.nan, np.nan), (np.nan, np.nan), True),  # no run is long enough to tell
    ],
)
def test_a_law_is_kept_where_free_runs_get_better_and_none_is_lost(now, before, kept):
    assert _better(now, before) is kept
