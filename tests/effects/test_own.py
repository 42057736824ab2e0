"""Effects of one's own: files, plug-ins, refusals, and docs/effects.md as it is written."""

import importlib.metadata
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hydrotele
from hydrotele import effects as own
from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, apply_effect, load_effects
from hydrotele.effects.effect import Effect
from hydrotele.machine.machine_file import load_machine, save_machine
from hydrotele.run.run import run_scenario
from hydrotele.scenario.scenario import Scenario
from hydrotele.terms.drive_state import DriveState
from hydrotele.terms.law import LAWS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
FILE = re.search(r"```python\n(.*?)```", PAGE, re.S)[1]


@pytest.fixture
def alone(monkeypatch):
    """Libraries that are as before after the test."""
    monkeypatch.setattr(own, "_loaded_effects", {})
    monkeypatch.setenv(own.ENVIRONMENT_VARIABLE, "")
    effects, laws = dict(EFFECTS), dict(LAWS)
    yield
    for library, before in ((EFFECTS, effects), (LAWS, laws)):
        library.clear()
        library.update(before)


@pytest.fixture
def gas_spring(tmp_path, alone):
    file = tmp_path / "gas_spring.py"
    file.write_text(FILE, encoding="utf-8")
    assert load_effects(file) == ("gas_spring",)
    return file


def steps(machine, **more):
    keys = {"duration": 1.0, "ground": False, "control_rate": 200, "log_rate": 200}
    pilot = {"kind": "constant", "commands": {"slide": 0.2}}
    return Scenario(name="t", machine=str(machine), pilot=pilot, **keys, **more)


def test_a_file_adds_an_effect_that_runs_and_can_be_handed_on(gas_spring, tmp_path):
    rig = load_machine("rig")
    assert LAWS["gas_spring_force"].source == str(gas_spring)
    assert os.environ[own.ENVIRONMENT_VARIABLE] == str(gas_spring), "child processes load it, too"
    patched = apply_effect(rig, "gas_spring", "slide", {"force": 400.0})
    folder = tmp_path / "patched"
    folder.mkdir()
    save_machine(patched, folder / "machine.yaml")
    assert (folder / "gas_spring.py").read_text(encoding="utf-8") == FILE
    loaded = load_machine(folder)
    assert [term.source for term in loaded.terms] == ["gas_spring.py"]
    assert load_effects(folder / "gas_spring.py") == ("gas_spring",), "a copy is the same file"
    planted = [{"name": "gas_spring", "location": "slide", "parameters": {"force": 400.0}}]
    ways = [
        run_scenario(steps("rig", effects=planted)).truth["position.slide"],
        run_scenario(steps(folder)).truth["position.slide"],
    ]
    assert np.array_equal(*ways)
    without = run_scenario(steps("rig")).truth["position.slide"]
    assert np.abs(ways[0] - without).max() > 1e-4
    del LAWS["gas_spring_force"]
    message = "machine.yaml:.*terms.0: .*defined by gas_spring.py, which is not loaded.*--effects"
    with pytest.raises(InputError, match=message):
        load_machine(folder)


def test_the_force_of_the_example_is_that_of_a_gas_spring(gas_spring):
    force = LAWS["gas_spring_force"].function
    closed = DriveState(*[0.0] * 12)
    assert force(closed, 400.0, 0.8) == -400.0
    assert force(closed._replace(position=0.4), 400.0, 0.8) == pytest.approx(-400.0 * 2**1.3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\nEFFECT = 3", "3 is not a hydrotele.effects.Effect"),
        ("x = 1", "defines neither EFFECT = Effect.* nor EFFECTS = .* nor a law"),
        ("import math\nx = 1 / 0", r"bad.py:2: cannot be run: ZeroDivisionError"),
        ("x = (", r"bad.py:1: cannot be run: SyntaxError"),
        ("raise SystemExit(0)", r"bad.py:1: cannot be run: SystemExit: 0\n  File .*bad.py., line 1"),
        ("EFFECTS = (1 / k for k in (1, 0))", r"bad.py:1: cannot be run: ZeroDivisionError"),
        (FILE.replace('"gas_spring", "a gas', '"payload", "a gas'), "'payload' exists already"),
        (FILE.replace("def gas_spring_force", "def pulse"), "law pulse: is already defined by hyd"),
        (FILE.replace("(s, force, length)", "(s, force: str)"), "is not float, Variable or Num"),
    ],
)
def test_a_wrong_file_is_refused_and_leaves_nothing(text, message, tmp_path, alone):
    effects, laws, file = dict(EFFECTS), dict(LAWS), tmp_path / "bad.py"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load_effects(file)
    assert (effects, laws) == (EFFECTS, LAWS)
    assert not os.environ[own.ENVIRONMENT_VARIABLE]


def test_a_missing_file_or_another_kind_is_refused(tmp_path, alone):
    with pytest.raises(InputError, match=r"none\.py: cannot be read: No such file"):
        load_effects(tmp_path / "none.py")
    (tmp_path / "effects.yaml").write_text("a: 1")
    with pytest.raises(InputError, match=r"define custom effects in a \.py file"):
        load_effects(tmp_path / "effects.yaml")


def test_a_pipe_or_a_device_is_no_effects_file(tmp_path, alone):
    os.mkfifo(tmp_path / "pipe.py")
    (tmp_path / "zero.py").symlink_to("/dev/zero")
    for name in ("pipe.py", "zero.py"):
        with pytest.raises(InputError, match=f"{name}: is not a regular file but a pipe or device"):
            load_effects(tmp_path / name)


@pytest.mark.parametrize("line", ["1 / 0", "exit(0)", "open('missing.yaml')"])
def test_an_error_inside_a_file_of_effects_ends_a_command_with_the_traceback_of_that_file(
    line, tmp_path, alone, monkeypatch, capsys
):
    from hydrotele.cli import main

    file = tmp_path / "mine.py"
    file.write_text(
        "import dataclasses\nfrom hydrotele.effects import EFFECTS\n\n\ndef locate(machine):\n"
        f"    return {line}\n\n\nEFFECT = dataclasses.replace(EFFECTS['payload'], name='mine', locations=locate)\n"
    )
    monkeypatch.setattr(sys, "argv", ["hydrotele", "list", "effects", "--effects", str(file)])
    with pytest.raises(SystemExit, match="2"):
        main._run_app_and_report_errors()
    error = capsys.readouterr().err.splitlines()
    kind = {"1 / 0": "ZeroDivisionError", "exit(0)": "SystemExit"}.get(line, "FileNotFoundError")
    assert error[0].startswith(f"error {file}:6: {kind}: ")
    assert error[1] == f'  File "{file}", line 6, in locate' and error[2] == f"    return {line}"
    assert not any("hydrotele/" in text for text in error[1:]), "only of the user's file"


def test_a_law_that_numba_cannot_compile_is_named(tmp_path, alone):
    file = tmp_path / "odd.py"
    text = FILE.replace("return -force *", "return {}['a'] + -force *")
    file.write_text(text.replace("gas_spring", "odd_spring"), encoding="utf-8")
    load_effects(file)
    machine = apply_effect(load_machine("rig"), "odd_spring", "slide", {"force": 400.0})
    folder = tmp_path / "machine"
    folder.mkdir()
    save_machine(machine, folder / "machine.yaml")
    with pytest.raises(InputError, match=r"odd\.py: law odd_spring_force: cannot be compiled"):
        run_scenario(steps(folder))


def test_nobody_runs_a_file_that_was_not_named(tmp_path, alone):
    """A machine folder with a file of effects beside it; loading it must not run the file."""
    save_machine(load_machine("rig"), tmp_path / "machine.yaml")
    for name in ("effects.py", "gas_spring.py", "conftest.py"):
        (tmp_path / name).write_text("raise SystemExit('run')")
    assert load_machine(tmp_path).name == "rig"


def test_installed_packages_offer_effects_as_entry_points(monkeypatch, alone, tmp_path):
    (tmp_path / "rig_plugin.py").write_text(FILE, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    entries = [importlib.metadata.EntryPoint("springs", "rig_plugin", own.ENTRY_POINT_GROUP)]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: entries)
    library: dict[str, Effect] = {}
    own.add_plugin_effects(library)
    sys.modules.pop("rig_plugin")
    assert list(library) == ["gas_spring"]
    assert LAWS["gas_spring_force"].source == "plug-in springs of the package ?"
    entries[0] = importlib.metadata.EntryPoint("springs", "rig_plugin_2", own.ENTRY_POINT_GROUP)
    with pytest.raises(
        InputError, match="plug-in springs .*cannot be loaded: ModuleNotFoundError: No module.*uninstall"
    ):
        own.add_plugin_effects({})


@pytest.mark.nightly
def test_the_page_is_true_as_written(tmp_path):
    """Every command of docs/effects.md, in order, with the file as printed there."""
    (tmp_path / "gas_spring.py").write_text(FILE, encoding="utf-8")
    commands = re.search(r"```bash\n(.*?)```", PAGE, re.S)[1]
    program = f'hydrotele() {{ {shlex.quote(sys.executable)} -m hydrotele "$@"; }}\nset -e\n'
    paths = [str(Path(hydrotele.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    environment.pop(own.ENVIRONMENT_VARIABLE, None)
    done = subprocess.run(
        ["bash", "-c", program + commands], cwd=tmp_path, env=environment, capture_output=True,
        text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "gap_logs" / "gap.json").read_text())
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert (effect["name"], effect["location"]) == ("gas_spring", "slide")
    force = effect["parameters"]["force"]
    low, high = force["ci95"]
    assert low < 400.0 < high, force
    assert force["value"] == pytest.approx(400.0, rel=0.01)
    said = f"force {force['value']:.1f} N"
    assert said in PAGE, f"the page must say what was found: {said}"
    assert (tmp_path / "runs" / "patched" / "measured.parquet").is_file()
