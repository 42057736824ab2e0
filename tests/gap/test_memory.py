"""Effects whose laws remember, planted in MuJoCo's plant and looked for among their neighbours."""

import numpy as np
import pytest

from hydrotele.gap.find import find_gap
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import save_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario

RATE, SECONDS = 200, 6.0


def logs(folder, machine, sensors, planted, commands):
    """Two runs of a machine with a planted effect, driven by held commands."""
    time = np.arange(round(RATE * SECONDS)) / RATE
    for name, phase in (("fit_1", 0.0), ("test_1", 0.7)):
        column = commands(time, phase).tolist()
        scenario = Scenario(
            name=name, machine=machine, control_rate=RATE, log_rate=RATE, duration=SECONDS,
            ground=False, sensors=sensors, effects=[planted], seed=round(10 * phase),
            pilot={"kind": "table", "quantity": "command", "interpolate": "hold", "time": time.tolist(),
                   "columns": {"slide": column}},
        )  # fmt: skip
        save_log(run_scenario(scenario).measured, folder / f"{name}.parquet")
    return load_dataset(folder, load_machine(machine))


@pytest.mark.nightly
def test_bristles_of_the_emps_are_named(tmp_path):
    """50 um of way before it slides, under voltages that now hold and now break away."""

    def commands(time, phase):
        push = 24.0 * np.sin(2.0 * np.pi * 0.7 * time + phase)
        return (-3.165 + push + 12.0 * np.sin(2.0 * np.pi * 2.3 * time)) / 35.15

    planted = {"name": "presliding", "location": "slide", "parameters": {"compliance": 2.5e-6}}
    data = logs(tmp_path, "emps", "encoder", planted, commands)
    gap = find_gap(data, effects=("presliding", "coulomb_friction", "viscous_friction"))
    assert "presliding" in {e.name for e in gap.effects}
    found = next(e for e in gap.effects if e.name == "presliding")
    # the plant's own step and the search's differ by 2 % where it breaks away
    assert found.parameters["compliance"].value == pytest.approx(2.5e-6, rel=0.1)
    assert gap.size.after < 0.5 * gap.size.before


@pytest.mark.nightly
def test_a_slow_pump_of_the_rig_is_named(tmp_path):
    """100 ms, under steps of the valve that ask for most of what the pump gives."""

    def commands(time, phase):
        return 0.7 * np.sign(np.sin(2.0 * np.pi * 1.1 * time + phase)) * (time % 1.0 > 0.2)

    planted = {"name": "pump_lag", "location": "supply", "parameters": {"time_constant": 0.1}}
    data = logs(tmp_path, "rig", "laboratory", planted, commands)
    gap = find_gap(data, effects=("pump_lag", "pump_flow_limit", "spool_lag"))
    assert {(e.name, e.location) for e in gap.effects} >= {("pump_lag", "supply")}
    found = next(e for e in gap.effects if e.name == "pump_lag")
    # half a row of the log is 2.5 ms
    assert found.parameters["time_constant"].value == pytest.approx(0.1, abs=5e-3)
    assert gap.size.after < 0.5 * gap.size.before
