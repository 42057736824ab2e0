"""The reduced model in time: order of its steps, rest, delays and sensors, each exactly."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.effects.effect import with_value
from hydrotele.estimate.reduced_model import (
    accelerate,
    advance,
    arriving,
    place,
    predicted_channels,
    read_channels,
    simulate_rows,
    state_names,
    supply_of,
    write_trail,
)
from hydrotele.hydraulics.circuit import SLOT_COUNT, Slot, actuator_friction
from hydrotele.logs.log import load_log
from hydrotele.machine.sensors import SensorError
from hydrotele.multibody.reduced_dynamics import BIAS, ORIGIN, RATE, ROTATION, compute_mass_and_bias
from hydrotele.multibody.reduced_mechanism import COM, DAMPING, MASS
from tests.measured import TRUTH

PERIOD, RELIEF = 0.02, 28.0e6


def free_run(model, space, z, command, steps):
    out = np.zeros((len(command), len(model.kind)))
    states = np.zeros((len(command), len(z)))
    simulate_rows(model, space, z.copy(), command, PERIOD, steps, out, states)
    return out, states


@pytest.fixture(scope="module")
def truth(machine_of, reduced_of):
    """(model, space, start, commands, readings) of a run of an independent simulator."""
    machine, log = machine_of("cat215/none"), load_log(TRUTH / "test_1.parquet")
    channels = predicted_channels(machine)
    model, space, z = reduced_of(machine, channels)
    begin = json.loads(log.metadata["initial_state"])
    keys = {"position": "angle", "rate": "velocity"}
    joints = {machine.axes[axis].joint: axis for axis in machine.axes}
    for s, name in enumerate(state_names(machine)):
        kind, _, where = name.partition(".")
        axis = joints.get(where, where)
        z[s] = begin[keys.get(kind, kind)][begin["order"].index(axis)]
    command = np.column_stack([log[f"command.{axis}"] for axis in machine.axes])
    return model, space, z, command, np.column_stack([log[c] for c in channels])


def test_free_run_stays_with_the_independent_simulator(truth):
    model, space, z, command, expected = truth
    errors = []
    for steps in (5, 10, 20):
        found, _ = free_run(model, space, z, command, steps)
        errors.append(np.sqrt(np.mean((found - expected) ** 2, axis=0)))
    # a tenth of what the sensors of these machines resolve: 0.1 deg, 2 mm, 25 psi
    assert errors[1][:3].max() < np.radians(0.01)
    assert errors[1][3:5].max() < 0.2e-3
    assert errors[1][5:].max() < 0.1 * 25 * 6894.757
    assert min(errors[1]) > 0, "a replay that reads the log back would prove nothing"
    sizes = [np.linalg.norm(e[:3]) for e in errors]
    ratios = np.array(sizes[1:]) / sizes[:-1]
    # second order: a fourth per halving; valves that open within a step cost some of it
    assert np.all((ratios > 0.15) & (ratios < 0.4)), sizes


@pytest.mark.parametrize("name", ["cat215/none", "cat215/bucket", "ec20"])
def test_rest_is_rest(name, machine_of, reduced_of):
    """With closed valves and pressures that carry the load nothing accelerates."""
    machine = machine_of(name)
    model, space, z = reduced_of(machine)
    place(model, space, z)
    compute_mass_and_bias(model.mech, space.motion)
    load = space.motion.basis.T @ space.motion.joint[BIAS]
    forces, first = np.linalg.solve(space.row.T, load), 2 * len(load)
    for i, axis in enumerate(machine.hydraulic_axes.values()):
        area_head, area_rod = axis.hydraulic_drive.effective_areas
        z[first + 4 * i + 2] = (forces[i] + area_rod * z[first + 4 * i + 3]) / area_head
    place(model, space, z)  # which takes up the pressures
    accelerate(model, space, z, 0.0)
    # forces of 1e5 N that cancel, over masses of 1e3 kg and more
    assert np.abs(space.force).max() < 1e-10
    z[first + 2] *= 1.01
    place(model, space, z)
    accelerate(model, space, z, 0.0)
    assert np.abs(space.force).max() > 1e-3


def energy(model, space, z):
    """Kinetic and potential energy [J], and the power of drives and dampers [W]."""
    place(model, space, z)
    compute_mass_and_bias(model.mech, space.motion)
    mech, m = model.mech, space.motion
    n, rates, total = len(mech.independent), m.joint[RATE], 0.5 * m.joint[RATE] @ m.mass @ m.joint[RATE]
    for i in range(1, mech.body_count):
        turn, com = m.frame[i, ROTATION : ROTATION + 9].reshape(3, 3), mech.shape[i, COM : COM + 3]
        place_of_mass = m.frame[i, ORIGIN : ORIGIN + 3] + turn @ com
        total -= mech.shape[i, MASS] * mech.gravity @ place_of_mass
    power = -np.sum(mech.joint[DAMPING] * rates**2)
    for i, velocity in enumerate(space.row @ z[n : 2 * n]):
        u, a = i * SLOT_COUNT, 2 * n + 4 * i
        force = model.user[u + Slot.AREA_HEAD] * z[a + 2] - model.user[u + Slot.AREA_ROD] * z[a + 3]
        power += velocity * (force - actuator_friction(model.user, u, velocity))
    return total, power


@pytest.mark.parametrize("name", ["cat215/none", "cat215/bucket"])
def test_energy_comes_from_the_drives_and_goes_into_dampers(name, machine_of, reduced_of):
    model, space, z = reduced_of(machine_of(name))
    command, errors = np.full((1, len(model.gear)), 0.5), []
    nothing, gained = np.zeros((0, 0)), 0.0
    for period in (1e-3, 5e-4):
        state, books = z.copy(), []
        for _ in range(round(0.4 / period)):
            books.append(energy(model, space, state))
            advance(model, space, state, command, 0, period, 1, nothing)
        total, power = np.array(books).T
        work = np.concatenate([[0.0], np.cumsum(0.5 * period * (power[1:] + power[:-1]))])
        errors.append(np.abs(total - total[0] - work).max())
        gained = np.ptp(total)
    # trapezoids and steps are of second order, but for the friction that starts within 5 mm/s
    assert errors[1] < 1e-4 * gained
    assert errors[1] < 0.5 * errors[0]


@given(
    st.lists(st.floats(-1, 1), min_size=2, max_size=12),
    st.floats(0.0, 0.3),
    st.integers(0, 11),
    st.integers(1, 7),
)
def test_arriving_command_is_the_mean_of_the_delayed_one(held, delay, row, steps):
    command, row = np.array(held), row % len(held)
    edges = PERIOD * np.arange(-40, len(held) + 1)
    area = np.concatenate([[0.0], np.cumsum(PERIOD * np.concatenate([[held[0]] * 40, held]))])
    for step in range(steps):
        begin, end = step * PERIOD / steps, (step + 1) * PERIOD / steps
        ends = np.interp(row * PERIOD + np.array([begin, end]) - delay, edges, area)
        found = arriving(command, row, begin, end, PERIOD, delay)
        # parts below 1e-9 of a row count as rounding: 1e-9 of 1/7 row, twice
        assert found == pytest.approx((ends[1] - ends[0]) / (end - begin), abs=3e-8)


def test_late_scaled_and_shifted_channels(machine_of, reduced_of):
    """Every reading is `scale * value(t - lag) + offset`, straight between the steps."""
    errors = {
        "angle.boom": SensorError(scale=1.02, offset=0.01, delay=0.0333),
        "length.stick": SensorError(offset=-0.02),
        "pressure_head.stick": SensorError(delay=0.02),
        "pressure_rod.boom": SensorError(scale=0.9, delay=0.0007),
        "pressure_supply": SensorError(scale=1.1, delay=0.004),
    }
    plain = machine_of("cat215/none")
    machine, channels = with_value(plain, "sensor_errors", errors), predicted_channels(plain)
    (model, space, z), (ideal, room, _) = (reduced_of(m, channels) for m in (machine, plain))
    rng, steps, rows = np.random.default_rng(5), 10, 8
    h, command = PERIOD / steps, rng.uniform(-0.5, 0.5, (rows, 3))
    trail, nothing = np.zeros((rows * steps + 1, len(channels))), np.zeros((0, len(channels)))
    out, now = np.zeros(len(channels)), np.zeros(len(channels))
    place(model, space, z)
    write_trail(model, space, z, trail[0])
    for row in range(rows):
        read_channels(model, space, z, row, steps, h, trail, out)
        read_channels(ideal, room, z, row, steps, h, nothing, now)
        for c, name in enumerate(channels):
            error, value = errors.get(name, SensorError()), now[c]
            if error.delay:
                assert trail[row * steps, c] == now[c], "the trail is what an ideal sensor shows"
                back = row * steps - error.delay / h
                value = np.interp(back, np.arange(len(trail)), trail[:, c])
            # rounding of a straight line between two steps
            assert out[c] == pytest.approx(error.scale * value + error.offset, rel=1e-12)
        advance(model, space, z, command, row, PERIOD, steps, trail[row * steps :])
    assert supply_of(ideal, room, z, 0) > 0


def test_keeping_a_trail_changes_nothing(machine_of, reduced_of):
    error = {"angle.boom": SensorError(delay=0.01)}
    machine = with_value(machine_of("cat215/none"), "sensor_errors", error)
    model, space, z = reduced_of(machine, ("angle.boom",))
    other, command = z.copy(), np.full((1, 3), 0.3)
    advance(model, space, z, command, 0, PERIOD, 10, np.zeros((11, 1)))
    advance(model, space, other, command, 0, PERIOD, 10, np.zeros((0, 1)))
    assert np.array_equal(z, other)


def test_threads_with_spaces_of_their_own_do_not_disturb_each_other(machine_of, reduced_of):
    """Compiled code runs without Python's lock; whatever it writes belongs to its Space."""
    machine = machine_of("cat215/bucket")
    channels, rng = predicted_channels(machine), np.random.default_rng(2)
    commands = [np.repeat(rng.uniform(-0.5, 0.5, (10, 4)), 20, axis=0) for _ in range(4)]

    def run(command):
        model, space, z = reduced_of(machine, channels)
        return free_run(model, space, z, command, 20)[1]

    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(run, commands))
    for command, states in zip(commands, together, strict=True):
        assert np.array_equal(run(command), states)
