"""The electro-hydraulic actuator: both simulators, its loads, and what it refuses."""

import mujoco
import numpy as np
import pytest

from hydrotele.effects.effect import with_value
from hydrotele.estimate.reduced_model import model_space, reduced_model, simulate_rows, state_names
from hydrotele.logs.log import load_log
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import load_scenario
from hydrotele.simulate.plant import build_plant, rest_state

CHANNELS = ("position.piston", "pressure_head.piston", "pressure_rod.piston")


def ideal(tool: str) -> Machine:
    """The machine without delay and sensor errors, so that channels are states."""
    machine = with_value(load_machine("eha", tool), "axes.piston.command_delay", 0.0)
    return with_value(machine, "sensor_errors", {})


def in_mujoco(machine: Machine, duty: np.ndarray) -> np.ndarray:
    """(n, 3) position and pressures of the plant at every ms."""
    plant = build_plant(machine, 1.0e-3, ground=False)
    data = rest_state(plant)
    rows = np.empty((len(duty), 3))
    for row, value in enumerate(duty):
        rows[row] = data.qpos[plant.qpos[0]], data.act[2], data.act[3]
        data.ctrl[0] = value
        mujoco.mj_step(plant.model, data)
    return rows


def reduced(machine: Machine, duty: np.ndarray) -> np.ndarray:
    """The same of the reduced model."""
    model, names = reduced_model(machine, CHANNELS), state_names(machine)
    z = np.zeros(len(names))
    plant = build_plant(machine, 1.0e-3, ground=False)
    z[names.index("pressure_head.piston") :][:2] = rest_state(plant).act[2:]
    rows, states = np.empty((len(duty), 3)), np.empty((len(duty), len(z)))
    simulate_rows(model, model_space(model), z, duty[:, None].copy(), 1.0e-3, 1, rows, states)
    return rows


@pytest.mark.parametrize("tool", ["none", "load_40_bar"])
def test_both_simulators_agree(tool):
    """Out, hold and back: 0.1 mm and 0.3 bar, as half a step of timing differs between them.

    The pressure at the load's void and at reversals moves by several bar per ms.
    """
    duty = np.repeat([0.7, 0.3, -0.5, 0.0], 800)
    machine = ideal(tool)
    error = np.abs(in_mujoco(machine, duty) - reduced(machine, duty))
    assert error[:, 0].max() < 1.0e-4
    assert np.sqrt(np.mean(error[:, 1:] ** 2, axis=0)).max() < 0.3e5


def test_load_raises_the_head_pressure_by_its_relief():
    """Between two loads the mean pressures while extending differ as the loads and their friction.

    Same areas: `dp = dp_load (1 + friction)`, as far as the slower piston rubs less (2 bar).
    """
    duty = np.full(2500, 0.9)
    means = {}
    for tool in ("load_20_bar", "load_30_bar"):
        rows = in_mujoco(ideal(tool), duty)
        means[tool] = rows[2000:, 1].mean()
        assert 0.02 < rows[-1, 0] < 0.06  # on its way, short of the end at 0.065
    load = load_machine("eha", "load_30_bar").loads["piston"]
    expected = 10.0e5 * (1.0 + load.friction)
    assert means["load_30_bar"] - means["load_20_bar"] == pytest.approx(expected, abs=2.0e5)


def test_speed_drives_it_without_a_motor():
    """Steady travel per turn: displacement over the head area, less the leakage.

    Below 1 % is the compression while the pressures still settle.
    """
    machine = with_value(ideal("none"), "axes.piston.pump.motor", None)
    pump, cylinder = machine.axes["piston"].pump, machine.axes["piston"].cylinder
    assert pump and cylinder
    rows = in_mujoco(machine, np.full(3000, 0.5))
    speed = (rows[-1, 0] - rows[1500, 0]) / 1.499
    leak = pump.leakage * (rows[-1, 1] - rows[-1, 2])
    flow = 0.5 * pump.rated_speed * pump.displacement - leak
    assert speed == pytest.approx(flow / cylinder.area_head, rel=1.0e-2)


def test_stands_still_under_load_with_the_valve_shut():
    """Pressed 5 mm into the load and shut: the seals hold, nothing creeps (1 um in 2 s)."""
    duty = np.concatenate([np.full(900, 0.7), np.zeros(2500)])
    rows = in_mujoco(ideal("load_30_bar"), duty)
    assert rows[900, 0] > 3.0e-3
    assert abs(rows[-1, 0] - rows[1400, 0]) < 1.0e-6


def test_runs_as_a_scenario_and_its_chambers_balance():
    """A run logs pump speed and load pressure as truth; volumes balance to 1e-4 (7.7e-6 seen).

    Air makes the compliance a curve, which the audit's trapezia follow to second order only.
    """
    scenario = load_scenario("eha_strokes")
    run = run_scenario(scenario)
    assert run.summary["balance"]["flow_balance"] < 1.0e-4
    assert {"truth.speed.piston", "truth.pressure_load.piston"} <= set(run.truth.columns)
    assert "pressure_supply" not in run.measured
    assert run.truth["position.piston"].max() > 0.01


def test_reads_a_log_whose_duty_and_valve_stand_apart(tmp_path):
    """`command.pump * command.valve` of `log_columns` becomes the command."""
    file = tmp_path / "run.csv"
    lines = [f"{0.001 * k},{0.001 * k},0.5,{-1 if k > 50 else 1}" for k in range(100)]
    file.write_text("\n".join(["time,position,command.pump,command.valve", *lines]) + "\n")
    log = load_log(file, aliases=load_machine("eha").log_columns)
    assert set(np.unique(log["command.piston"])) == {-0.5, 0.5}


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("axes.piston.end_stop", None, "end_stop"),
        ("axes.piston.cylinder.hose_compliance", 1.0e-13, "compliance_head"),
        ("axes.piston.command_delay", 0.0, None),
    ],
)
def test_says_what_a_pump_needs(path, value, words):
    """A pump states its end stop and its own compliances."""
    data = load_machine("eha").model_dump(exclude_defaults=True)
    node = data
    *parents, last = path.split(".")
    for part in parents:
        node = node[part]
    node[last] = value
    if words is None:
        assert Machine.model_validate(data).axes["piston"].command_delay == value
        return
    with pytest.raises(ValueError, match=words):
        Machine.model_validate(data)
