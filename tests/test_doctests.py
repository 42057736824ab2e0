"""Examples of the public names: each has one, and all examples run in one process.

pytest also collects the examples of all modules when it runs without arguments (`--doctest-modules`).
"""

import doctest
import importlib

import pytest

import hydrotele

ENTRY_POINTS = {
    "calibrate.arm_identification": ("identify_arm",),
    "calibrate.hybrid_calibration": ("calibrate_hybrid_robot",),
    "calibrate.imu_calibration": ("calibrate_imus",),
    "calibrate.linkage_identification": ("identify_linkage",),
    "calibrate.scara_calibration": ("calibrate_scara",),
    "calibrate.socket_measurement": ("simulate_sockets",),
    "effects.effect": ("Effect", "Parameter", "with_terms"),
    "envs.controllers.controller": ("Controller",),
    "envs.dm": ("load",),
    "envs.gymnasium_env": ("MachineEnv", "MachineVectorEnv"),
    "identify.record": ("build_records",),
    "identify.regressor_setup": ("machine_setup",),
}
"""Module -> names that documentation pages use without being in `hydrotele.__all__`."""

NAMES = {**vars(hydrotele)["_PUBLIC"], **ENTRY_POINTS}
NAMES["effects"] = ("", *(set(vars(hydrotele)["_PUBLIC"]["effects"]) - {"EFFECTS"}))  # a dict has no docstring


@pytest.fixture(scope="module")
def found():
    """Examples by `module.name`; the name is empty for a module."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    return {
        test.name.removeprefix("hydrotele."): test
        for module in NAMES
        for test in finder.find(importlib.import_module(f"hydrotele.{module}"))
    }


CASES = [".".join(filter(None, (module, name))) for module, names in NAMES.items() for name in sorted(names)]


@pytest.mark.parametrize("name", CASES)
def test_the_example_runs(name, found):
    assert name in found, f"{name} has no example in its docstring"
    assert not any(example.options.get(doctest.SKIP) for example in found[name].examples)
    assert "Example" in found[name].docstring
    report = []
    result = doctest.DocTestRunner().run(found[name], out=report.append)
    assert result.attempted and not result.failed, "".join(report)
