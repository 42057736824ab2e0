"""Logged oil temperature: the dataset has the machine at the median temperature of its runs."""

import numpy as np
import pytest

from hydrotele.logs.dataset import make_dataset
from hydrotele.logs.log import Log
from hydrotele.logs.run_files import RunFiles
from hydrotele.machine.machine_file import load_machine
from hydrotele.machine.oil import Oil, kinematic_viscosity


def test_machine_of_a_dataset_has_the_logged_oil_temperature():
    machine = load_machine("cat215").replace("oil", Oil(temperature=40.0))
    rng = np.random.default_rng(1)
    files = []
    for name, temperature in (("cold", 50.0), ("warm", 70.0)):
        time = np.arange(0.0, 20.0, 0.02)
        columns = {f"command.{a}": np.sin(time) for a in machine.axes}
        columns |= {f"angle.{a}": 0.1 * np.sin(time) + 1e-3 * rng.normal(size=len(time)) for a in ("swing", "boom")}
        units = {c: "1" if c.startswith("command") else "rad" for c in columns}
        columns["oil_temperature"], units["oil_temperature"] = np.full(len(time), temperature), "degC"
        files.append(RunFiles(name, (Log(time, columns, units, {}, name),)))
    data = make_dataset(files, machine)
    ratio = kinematic_viscosity(Oil(), 60.0) / kinematic_viscosity(Oil(), 40.0)
    assert data.machine.axes["boom"].hydraulic_drive.friction.viscous == pytest.approx(6000.0 * ratio)
    assert any("50.0 degC in cold and 70.0 degC in warm" in note for note in data.notes)
