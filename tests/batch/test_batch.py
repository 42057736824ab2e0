"""Batches of machines against the estimator's model, MuJoCo, numba's simulator of CUDA, and themselves."""

import os
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest

from hydrotele.batch import Batch
from hydrotele.batch.batch import Task
from hydrotele.batch.machine_step import restart_machine
from hydrotele.batch.measure import compare_with_log
from hydrotele.core.compiled import compile_without_allocation
from hydrotele.core.device import import_cuda
from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.estimate.reduced_model import model_space, predicted_channels, reduced_model, simulate_rows
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, Slot
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import Sensor, SensorError, SensorSet
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.terms.term import Term

PERIOD, STEPS = 0.02, 20


@pytest.fixture(scope="module")
def cat215():
    return load_machine("cat215", "none")


def random_commands(rows, axes, seed=0):
    return np.random.default_rng(seed).uniform(-0.5, 0.5, (rows, axes))


def machine_with_all_states():
    """A machine with a transmission, bristles, a slow pump and a term."""
    machine = load_machine("cat215", "none")
    for name, location in (("presliding", "boom"), ("backlash", "swing"), ("pump_lag", "supply")):
        found = EFFECTS[name].parameters(machine, location)
        values = {k: v.start_values[0] if v.start_values else v.nominal + v.prior_std for k, v in found.items()}
        machine = apply_effect(machine, name, location, values)
    drag = Term(name="drag", axis="boom", balance="force", law="quadratic_drag", parameters={"coefficient": 2e5})
    return machine.model_copy(update={"terms": (drag,)})


MACHINES = {
    "open chain": lambda: load_machine("cat215", "none"), "four-bar linkage": lambda: load_machine("cat215", "bucket"),
    "pump drive": lambda: load_machine("eha"), "no cylinder": lambda: load_machine("emps"),
    "all states": machine_with_all_states,
}  # fmt: skip


@pytest.mark.parametrize("name", MACHINES)
def test_every_machine_has_the_bits_of_the_reduced_model(name):
    """The traced code of eight machines at once rounds as the estimator's functions for one machine."""
    machine = MACHINES[name]()
    batch = Batch(machine, 10, threads=2)  # one full block and one of two machines
    model = reduced_model(machine, predicted_channels(machine))
    commands = random_commands(26, len(batch.axes))
    if model.delay.any():  # the estimator holds the first command before the first row, a batch holds 0
        commands[: 1 + int(np.ceil(model.delay.max() / PERIOD))] = 0.0
    readings, states = np.zeros((26, len(batch.channels))), np.zeros((26, len(batch.state_names)))
    start = batch.machines.start[0].copy()
    simulate_rows(model, model_space(model), start, commands, PERIOD, STEPS, readings, states)
    for row in range(25):
        shown = batch.step(commands[row])
        assert np.array_equal(batch.state, np.broadcast_to(states[row + 1], batch.state.shape))
        assert np.array_equal(shown, np.broadcast_to(readings[row + 1], shown.shape))


def test_ten_seconds_of_excitation_equal_the_mujoco_plant(cat215):
    """Nominal excitation: angles within 0.02 deg, pressures within 0.1 % of 28 MPa RMS (issue's limits)."""
    truth = run_scenario(load_scenario("excitation", {"duration": "10"})).truth
    for channel, (rms, largest) in compare_with_log(cat215, truth).items():
        if channel.startswith("angle"):
            assert largest < np.deg2rad(0.02)
        elif channel.startswith("pressure"):
            assert rms < 0.001 * 28e6


def test_results_depend_neither_on_threads_nor_on_the_count(cat215):
    noisy = SensorSet(angle=Sensor(standard_deviation=1e-3, correlation_time=0.1), pressure=Sensor(accuracy=2e4))
    one, two = (Batch(cat215, n, threads=k, sensors=noisy, seed=3) for n, k in ((13, 1), (20, 2)))
    for command in random_commands(5, 3):
        few, many = one.step(command, periods=2), two.step(command, periods=2)
    assert np.array_equal(few, many[:13])
    assert np.array_equal(one.state, two.state[:13])


def test_random_errors_have_their_distribution(cat215):
    noisy = SensorSet(angle=Sensor(standard_deviation=1e-3), pressure=Sensor(accuracy=2e4))
    exact, noise = Batch(cat215, 500), Batch(cat215, 500, sensors=noisy, seed=1)
    errors = np.array([noise.step(np.zeros(3)) - exact.step(np.zeros(3)) for _ in range(10)])
    assert np.std(errors[..., 0]) == pytest.approx(1e-3, rel=0.03)  # 5000 samples: 1 % standard error
    pressure = errors[..., exact.channels.index("pressure_head.boom")]
    assert np.abs(pressure).max() < 2e4
    assert np.std(pressure) == pytest.approx(2e4 / np.sqrt(3.0), rel=0.03)
    assert abs(np.corrcoef(errors[3, :, 0], errors[4, :, 0])[0, 1]) < 0.15


def test_variants_are_machines_of_their_own(cat215):
    stick = cat215.links["stick"]
    links = {**cat215.links, "stick": stick.model_copy(update={"mass": stick.mass + 150.0})}
    heavy = cat215.model_copy(update={"links": links})
    both, alone = Batch([cat215, heavy], 4), Batch(heavy, 1)
    for command in random_commands(5, 3):
        both.step(command)
        alone.step(command)
    assert np.array_equal(both.state[1], alone.state[0])
    assert np.array_equal(both.state[3], alone.state[0])
    assert not np.array_equal(both.state[0], both.state[1])


def test_expanded_parameters_act_on_their_machine(cat215):
    batch, same = Batch(cat215, 3), Batch(cat215, 1)
    viscous = batch.expand_parameters("user").reshape(3, -1, SLOT_COUNT)[:, :, int(Slot.VISCOUS)]
    viscous[1] *= 2.0
    for command in random_commands(5, 3):
        batch.step(command)
        same.step(command)
    assert np.array_equal(batch.state[0], same.state[0])
    assert np.array_equal(batch.state[2], same.state[0])
    assert not np.array_equal(batch.state[1], same.state[0])


def test_reset_restarts_the_chosen_machines(cat215):
    batch = Batch(cat215, 3)
    begun = batch.state.copy()
    batch.step([0.4, 0.2, 0.1], 5)
    moved = batch.state.copy()
    batch.reset(np.array([False, True, False]))
    assert np.array_equal(batch.state[1], begun[1])
    assert np.array_equal(batch.state[[0, 2]], moved[[0, 2]])
    assert batch.machines.period_count.tolist() == [5, 0, 5]


def test_commands_change_at_the_limited_rate(cat215):
    batch = Batch(cat215, 2, rate_limit=5.0)
    batch.step([1.0, -1.0, 0.05])
    assert batch.machines.history[0, -1].tolist() == pytest.approx([0.1, -0.1, 0.05])
    batch.step([1.0, -1.0, 0.05])
    assert batch.machines.history[1, -1].tolist() == pytest.approx([0.2, -0.2, 0.05])


class Counter(NamedTuple):
    """Arrays of a task that restarts a machine after three control periods."""

    angle: np.ndarray


@compile_without_allocation
def command_swing(task, model, sp, z, machines, i):
    machines.command[i, 0] = 0.3


@compile_without_allocation
def keep_angle(task, model, sp, z, machines, i):
    task.angle[i] = machines.reading[i, 0]
    if machines.period_count[i] == 3:
        restart_machine(model, sp, z, machines, i, 0)


def test_functions_of_a_task_run_in_the_step(cat215):
    arrays = Counter(np.zeros(9))
    batch, plain = Batch(cat215, 9, task=Task(command_swing, keep_angle, arrays)), Batch(cat215, 1)
    batch.step(None, 3)
    angle = plain.step([0.3, 0.0, 0.0], 3)[0, 0]
    assert np.array_equal(arrays.angle, np.full(9, angle))
    assert np.array_equal(batch.state, np.repeat(plain.machines.start, 9, axis=0))
    assert not batch.machines.period_count.any()


def test_options_and_sensors_that_do_not_exist_are_named(cat215):
    with pytest.raises(InputError, match="device must be cpu or cuda"):
        Batch(cat215, 1, device="tpu")
    with pytest.raises(InputError, match="multiple of the time step"):
        Batch(cat215, 1, period=0.0205)
    with pytest.raises(InputError, match="has no option thread"):
        Batch(cat215, 1, thread=1)
    if not import_cuda().is_available():
        with pytest.raises(InputError, match="no CUDA device"):
            Batch(cat215, 1, device="cuda")
    late = cat215.model_copy(update={"sensor_errors": {"angle.boom": SensorError(delay=0.01)}})
    with pytest.raises(InputError, match="delay of sensors angle.boom"):
        Batch(late, 1)


SIMULATED = """
import sys
import numpy as np
from hydrotele.batch import Batch
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.sensors import Sensor, SensorSet
noisy = SensorSet(angle=Sensor(standard_deviation=1e-3), pressure=Sensor(accuracy=2e4, bits=12, span=40e6))
from hydrotele.terms.term import Term
drag = Term(name="drag", axis="boom", balance="force", law="quadratic_drag", parameters={"coefficient": 2e5})
machine = load_machine("cat215", "bucket").model_copy(update={"terms": (drag,)})
cpu, cuda = (
    Batch(machine, 2, device=d, period=0.003, sensors=noisy, rate_limit=100.0, precision=sys.argv[1])
    for d in ("cpu", "cuda")
)
for command in np.random.default_rng(0).uniform(-0.5, 0.5, (2, 2, 4)):
    shown, same = cpu.step(command), cuda.step(command)
    assert np.array_equal(cpu.state, cuda.state.copy_to_host())
    assert np.array_equal(shown, same.copy_to_host())
cuda.reset(np.array([True, False]))
cpu.reset(np.array([True, False]))
cpu.step(command), cuda.step(command)
assert np.array_equal(cpu.state, cuda.state.copy_to_host())
print("equal")
"""


def test_mixed_precision_keeps_the_accuracy_required_of_the_batch(machine=("cat215", "bucket")):
    """Required are 0.02 deg and 28 kPa RMS over 10 s; the rounding of mass matrix and forces takes a thousandth."""
    double, mixed = (Batch(load_machine(*machine), 4, precision=p) for p in ("double", "mixed"))
    differences = []
    for command in np.repeat(random_commands(20, 4), 25, axis=0):
        double.step(command)
        mixed.step(command)
        differences.append(np.abs(mixed.state - double.state))
    names = np.array(double.state_names)
    worst, rms = np.max(differences, axis=(0, 1)), np.sqrt(np.mean(np.square(differences), axis=(0, 1)))
    assert 0.0 < worst[np.char.startswith(names, "position")].max() < np.radians(0.02) / 1000
    assert rms[np.char.startswith(names, "pressure")].max() < 28.0
    with pytest.raises(InputError, match="double or mixed"):
        Batch(load_machine(*machine), 1, precision="half")


@pytest.mark.parametrize("precision", ["double", "mixed"])
def test_the_cuda_kernel_has_the_bits_of_the_cpu_in_numbas_simulator(precision):
    """The Python code of the kernel and of the traced programs rounds as the CPU's machine code."""
    environment = {**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SIMULATED, precision], env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == "equal", done.stderr[-2000:]
