"""Unknown inputs: what the filter takes a force or a flow for is what a machine with it does."""

import numpy as np
import pytest

from hydrotele.estimate.filter import SUPPLY, Input, input_columns, possible_inputs
from hydrotele.estimate.reduced_model import advance, model_space, reduced_model, state_names
from hydrotele.estimate.track import track_run
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.term import Term
from tests.estimate.test_filter import PERIOD, machine_data

_STEPS = 20


@pytest.fixture(scope="module")
def track():
    machine = load_machine("cat215")
    data, _ = machine_data(machine, machine)
    return track_run(machine, data, data.heldout, linearise=True)


def row_later(machine, track, row):
    model = reduced_model(machine, ())
    z = track.states[row].copy()
    trail = np.zeros((0, 0))
    advance(model, model_space(model), z, track.run.command, row, PERIOD, _STEPS, trail)
    return z


def test_a_constant_flow_of_the_pump_moves_what_the_pump_is_set_to():
    """Its state follows by the exact exponential, which the column holds to rounding."""
    nominal = load_machine("cat215")

    def with_flow(size):
        term = Term(name="extra", axis="boom", balance=SUPPLY, law="constant",
                    parameters={"value": size})  # fmt: skip
        return nominal.model_copy(update={"terms": (term,)})

    machine, size = with_flow(0.0), 1.0e-4
    data, _ = machine_data(nominal, machine)
    track = track_run(machine, data, data.heldout, linearise=True)
    (own,) = (i for i in possible_inputs(machine) if i.balance == SUPPLY)
    assert all(i.balance != SUPPLY for i in possible_inputs(nominal))
    columns = input_columns(machine, track.states, track.flow, PERIOD, [own], track.run.command)
    at = state_names(machine).index("added_delivery.supply")
    for row in (100, 250, 400):
        later = row_later(with_flow(size), track, row) - row_later(machine, track, row)
        assert columns[row, 0, at] == pytest.approx(later[at] / size, rel=1e-3)  # slopes of `flow`


@pytest.mark.parametrize(
    ("balance", "size", "kind"),
    [("force", 2.0e3, "rate"), ("flow_head", 1.0e-5, "pressure_head")],
)
def test_a_constant_input_moves_the_state_as_a_constant_term_does(track, balance, size, kind):
    """Half of an input is carried through the row, half is not.

    The boom's oil swings at 5 to 10 Hz, a third of a period within a row, where the trapezoidal
    rule is off by up to a quarter. Inputs locate and weigh; laws are fitted inside the machine.
    """
    machine = load_machine("cat215")
    term = Term(name="extra", axis="boom", balance=balance, law="constant",
                parameters={"value": size})  # fmt: skip
    changed = machine.model_copy(update={"terms": (term,)})
    columns = input_columns(machine, track.states, track.flow, PERIOD, [Input(balance, "boom")], track.run.command)
    own = [s for s, name in enumerate(state_names(machine)) if name.startswith(f"{kind}.")]
    for row in (100, 250, 400):
        moved = (row_later(changed, track, row) - row_later(machine, track, row))[own] / size
        expected = columns[row, 0, own]
        assert np.linalg.norm(moved - expected) < 0.3 * np.linalg.norm(moved)
