"""A drive with a pump of its own in the filter: shut valve, stiff oil, friction that holds."""

import math

import numpy as np
import pytest

from hydrotele.effects.effect import with_value
from hydrotele.estimate.filter import Input, input_columns
from hydrotele.estimate.levels import rough_noise
from hydrotele.estimate.reduced_model import model_space, reduced_model, simulate_rows, state_names
from hydrotele.estimate.track import STEP, steps_per_row, track_run
from hydrotele.hydraulics.actuator_layout import max_pump_drive_time_step
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.log import Log
from hydrotele.logs.resampling import RunRows, average_rows
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.term import Term

CHANNELS = ("position.piston", "pressure_head.piston", "pressure_rod.piston")
NOISE = np.array([1.0e-5, 2.0e4, 5.0e4])
PERIOD, ROWS = 0.01, 500
STANDING, SLIDING, HOLDING = 20, 150, 240  # rows


def duty():
    """Rest, out, hold at a stall, shut, back, shut."""
    return np.repeat([0.0, 0.7, 0.25, 0.0, -0.5, 0.0], [50, 150, 50, 100, 100, 50])[:, None]


def simulated(machine, fine=40, command=None):
    """((n, 3) what the sensors would show, (n, nz) states), from rest at 5 bar."""
    command = duty() if command is None else command
    model, names = reduced_model(machine, CHANNELS), state_names(machine)
    state = np.array([5.0e5 if n.startswith(("pressure_h", "pressure_r")) else 0.0 for n in names])
    shown, states = np.empty((len(command), 3)), np.empty((len(command), len(names)))
    simulate_rows(model, model_space(model), state, command, PERIOD, fine, shown, states)
    return shown, states


def dataset(machine, shown, noise=NOISE, behind=None):
    """A dataset of one run that shows these readings."""
    run = RunData(
        "made", 0.0, PERIOD, duty(), np.ones(ROWS, bool), shown,
        Log(time=PERIOD * np.arange(ROWS), columns={}, units={}), readings_per_mean=behind,
    )  # fmt: skip
    return Dataset(machine, ("piston",), CHANNELS, noise, (run,), run, ())


@pytest.fixture(scope="module")
def machine():
    return load_machine("eha", "load_30_bar")


@pytest.fixture(scope="module")
def stiff(machine):
    """The same without compliance of its lines, without air, and with little friction."""
    for side in ("head", "rod"):
        machine = with_value(machine, f"axes.piston.pump.compliance_{side}", 0.0)
        machine = with_value(machine, f"axes.piston.pump.air_{side}", 0.0)
    return with_value(machine, "axes.piston.cylinder.friction.viscous", 1.0e3)


@pytest.mark.parametrize("kind", ["machine", "stiff"])
def test_the_filter_follows_its_own_machine(kind, request):
    """Errors over their predicted spread within 0.6 .. 1.5: a step of breakaway is no linear one.

    Stiff lines ring at some 200 Hz; a transition taken with steps of 4 ms is off by powers of ten.
    The readings come from the filter's own steps, as the integrator is not what is tried here.
    """
    made = request.getfixturevalue(kind)
    shown, _ = simulated(made, steps_per_row(made, PERIOD, STEP))
    noise = np.random.default_rng(5).normal(size=shown.shape) * NOISE
    track = track_run(made, dataset(made, shown + noise), dataset(made, shown + noise).heldout)
    size = np.sqrt(np.mean(track.whitened[STANDING:] ** 2, axis=0))
    assert np.all((size > 0.6) & (size < 1.5)), size


def test_a_shut_valve_keeps_pressures_known(machine):
    """With the valve shut nothing flows, whatever a reading says of the pump's speed.

    The spread of a prediction may then grow over that of a reading by the integrator's allowance
    alone; oil from the accumulator would add several bar.
    """
    shown, _ = simulated(machine)
    noise = np.random.default_rng(6).normal(size=shown.shape) * NOISE
    data = dataset(machine, shown + noise)
    track = track_run(machine, data, data.heldout)
    shut = slice(STANDING, 50)
    assert np.all(track.gains.spread[shut, 1:] < 2.0 * NOISE[1:])
    speed = track.states[:, state_names(machine).index("speed.piston")]
    assert np.all(speed[shut] == 0.0)
    assert np.all(speed[60:200] > 0.0) and np.all(speed[360:440] < 0.0)


def moved(machine, term, row, states):
    """What a constant term adds to the state over a row."""
    ends = []
    for one in (machine, machine.model_copy(update={"terms": (term,)})):
        model = reduced_model(one, ())
        command = np.tile(duty()[row], (2, 1))
        out, later = np.empty((2, 0)), np.empty((2, states.shape[1]))
        # the row before already had this command, so that its delay changes nothing
        simulate_rows(model, model_space(model), states[row].copy(), command, PERIOD, 20, out, later)
        ends.append(later[1])
    return ends[1] - ends[0]


@pytest.mark.parametrize(("balance", "size"), [("force", 50.0), ("flow_head", 5.0e-7)])
def test_an_input_moves_a_sliding_piston_as_a_term_does(machine, balance, size):
    """Steps of 4 ms against 0.5 ms: within 30 %, as inputs locate and weigh."""
    _, states = simulated(machine)
    term = Term(name="extra", axis="piston", balance=balance, law="constant",
                parameters={"value": size})  # fmt: skip
    flow = np.tile(np.eye(states.shape[1]), (ROWS, 1, 1))
    columns = input_columns(machine, states, flow, PERIOD, [Input(balance, "piston")], duty())
    expected = moved(machine, term, SLIDING, states) / size
    place = [0] if balance == "force" else [0, 4]
    for s in place:
        assert columns[SLIDING, 0, s] == pytest.approx(expected[s], rel=0.3)


def test_friction_that_holds_resists_a_term(machine):
    """A force below the breakaway moves nothing; the filter's input counts as on a slider."""
    _, states = simulated(machine)
    term = Term(name="extra", axis="piston", balance="force", law="constant",
                parameters={"value": 50.0})  # fmt: skip
    assert states[STANDING, 1] == 0.0
    assert moved(machine, term, STANDING, states)[0] == 0.0
    flow = np.tile(np.eye(states.shape[1]), (ROWS, 1, 1))
    column = input_columns(machine, states, flow, PERIOD, [Input("force", "piston")], duty())
    viscous = machine.axes["piston"].drive.friction.viscous
    slid = PERIOD / viscous  # what a newton moves against viscous friction alone
    assert 0.3 * slid < column[STANDING, 0, 0] < slid


def test_longest_step_halves_until_the_oil_is_followed(machine, stiff):
    """`h = 1 / omega` with little friction; at that step a free run stays with a fine one."""
    h = max_pump_drive_time_step(stiff, "piston")
    assert math.log2(h / 1.0e-3) == round(math.log2(h / 1.0e-3))
    area_head, area_rod = stiff.axes["piston"].cylinder.effective_areas
    volume, stroke = 30.0e-6, 0.075
    oil = 1.0e9 * (area_head**2 / volume + area_rod**2 / (volume + area_rod * stroke))
    omega = math.sqrt((oil + 3.0e7) / 50.0)
    assert 0.4 / omega < h <= 1.05 / omega  # friction allows a little more than 1 / omega
    assert h < max_pump_drive_time_step(machine, "piston")
    coarse, fine = (simulated(stiff, round(PERIOD / step))[0] for step in (h, h / 8))
    assert np.abs(coarse - fine)[:, 0].max() < 2.0e-4  # m, over 5 s


def test_readings_that_repeat_count_once():
    """Ten equal readings of an encoder at rest say no more than one; ten noisy ones do."""
    still = np.zeros(1000)
    noisy = np.random.default_rng(0).normal(size=1000)
    rows = RunRows(0.0, 1e-3, np.zeros((1000, 1)), np.ones(1000, bool),
                np.column_stack([still, noisy]), np.ones(1000, bool))  # fmt: skip
    _, behind, count = average_rows(rows, 100.0)
    assert count == 10
    assert behind[0] == 1.0
    assert behind[1] == pytest.approx(10.5, rel=0.01)  # half weights at the ends


def test_noise_is_that_of_a_logged_reading(machine):
    """Rows that are means of n readings scatter sqrt(n) less; 500 rows tell noise to some 5 %."""
    noise = np.array([3.0e-5, 2.0e4, 5.0e4])
    scatter = np.random.default_rng(1).normal(size=(ROWS, 3)) * noise / np.sqrt([1.0, 9.0, 9.0])
    found = rough_noise(dataset(machine, scatter, noise, np.array([1.0, 9.0, 9.0])))
    assert found == pytest.approx(noise, rel=0.2)
