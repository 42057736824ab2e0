"""What every test shares: a renderer that needs no display, and hypothesis settings."""

import copy
import ctypes
import functools
import gc
import importlib.util
import os
import pickle
import sys
import time
from pathlib import Path

import hypothesis
import pytest
from matplotlib import layout_engine

# Their extra, `learn`, brings torch, 3 GB, so tools/setup --test leaves it out; the last lines of
# the suite say so, and tools/nightly has a check `learn`, which runs them with it.
_LEARN = (
    "envs/test_policy_training.py", "envs/test_stable_baselines.py", "run/test_learned_policy.py",
    "tools/test_learn.py",
)  # fmt: skip
collect_ignore = [] if importlib.util.find_spec("stable_baselines3") else [*_LEARN]

# Has to be settled before the first import of mujoco or dm_control.
if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
    for _name, _library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        try:
            ctypes.CDLL(_library)
        except OSError:
            continue
        os.environ["MUJOCO_GL"] = _name
        break

from hydrotele.core.files import models_folder  # noqa: E402
from hydrotele.machine import machine_file  # noqa: E402
from hydrotele.show import report_html  # noqa: E402
from hydrotele.simulate import mechanism  # noqa: E402


def _share_machines():
    """Let tests share what is read from the package's models: a machine is read and compiled once.

    Modules import these functions by name, so this has to be done before any other import.
    """
    read, compile_model = machine_file._read_machine, mechanism.compile_mechanism
    shipped = models_folder()
    read_once = functools.cache(read)

    def read_shared(path, tool):
        return (read_once if path.is_relative_to(shipped) else read)(path, tool)

    @functools.lru_cache(maxsize=50)  # models of 1 to 20 MB
    def compile_once(pickled):
        return compile_model(*pickle.loads(pickled))

    @functools.wraps(compile_model)
    def compile_shared(machine, timestep=1e-3, ground=True, visuals=True, surroundings=()):
        arguments = (machine, timestep, ground, visuals, surroundings)
        files = [Path(machine.folder, name) for name in (machine.mjcf or "", *machine.attached.values())]
        if not all(file.is_relative_to(shipped) for file in files):
            return compile_model(*arguments)
        return copy.copy(compile_once(pickle.dumps(arguments)))

    machine_file._read_machine, mechanism.compile_mechanism = read_shared, compile_shared


_share_machines()
gc.set_threshold(100_000, 50, 100)  # a full collection of all that the suite has imported takes seconds
report_html._DPI = 50  # pictures of reports are drawn in a third of the time
layout_engine.ConstrainedLayoutEngine.execute = lambda self, figure: None  # and without layout in half of that

# No deadline: the first example pays for numba's compilation. The same examples each time, so
# that a red run can be repeated. tools/nightly draws new ones, twenty times as many.
hypothesis.settings.register_profile("daily", deadline=None, derandomize=True, max_examples=25)
hypothesis.settings.register_profile("nightly", deadline=None, max_examples=500)
hypothesis.settings.load_profile("daily")


# Files that take three seconds or more, the longest first: two processes then end together. A file
# that is missing here costs at most its own length at the end.
LONG = (
    "cli/test_cli.py", "cli/test_drive_in_browser.py", "gap/test_run_differences.py",
    "gap/test_model_search.py", "gap/test_find.py",
    "gap/test_laws.py", "gap/test_mechanism.py", "scenario/test_scenario.py",
    "teleop/test_analyse_command.py", "identify/test_estimation.py", "test_architecture.py",
    "identify/test_identification.py", "show/test_pictures.py", "tools/test_check_english.py",
    "run/test_sweep.py", "estimate/test_filter.py", "calibrate/test_socket_calibration.py",
    "models/test_machines.py", "logs/test_load.py", "run/test_run.py", "estimate/test_robust.py",
    "teleop/test_operator_identification.py", "core/test_compiled.py", "effects/test_library.py",
    "core/test_linking.py", "teleop/test_teleoperation_system.py", "gap/test_explanation.py",
    "identify/test_estimators.py", "experiments/test_abdellatif2008.py",
    "control/test_gravity_model.py", "identify/test_hydraulic_identification.py",
    "identify/test_identify_command.py", "envs/test_render.py", "multibody/test_poses.py",
    "calibrate/test_arm_command.py", "gap/test_command.py", "hydraulics/test_circuit.py",
    "calibrate/test_hybrid_measurement.py", "cli/test_logs_alike.py", "gap/test_balances.py",
    "haptics/test_link.py", "kinematics/test_arm_dimensions.py", "gap/test_report.py",
    "teleop/test_linear_case.py", "envs/test_tip_controllers.py", "envs/test_grade.py",
    "experiments/test_wang2012.py", "experiments/test_zhu_theory.py",
    "calibrate/test_hybrid_calibration.py", "teleop/test_force_reflection.py", "test_packaging.py",
    "simulate/test_surroundings.py", "gap/test_jitter.py", "effects/test_forces.py",
    "estimate/test_reduced_against_plant.py", "identify/test_mechanism.py",
)  # fmt: skip


_REAL = Path(__file__).resolve().parents[2] / "shared" / "real"


@pytest.hookimpl(tryfirst=True)  # before pytest leaves out those that are marked as nightly
def pytest_collection_modifyitems(config, items):
    """Mark nightly cases, leave out what needs absent records, put files that take long first."""
    root = Path(__file__).parent
    mark_nightly_cases(items, whole=not any("::" in word for word in config.args))
    if not _REAL.is_dir():
        absent = [item for item in items if item.get_closest_marker("real")]
        config.hook.pytest_deselected(items=absent)
        items[:] = [item for item in items if item not in absent]
    if absent := [name for name in LONG if not (root / name).is_file()]:
        raise pytest.UsageError(f"LONG of tests/conftest.py names files that do not exist: {absent}")
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(_inside(item.path, root), len(LONG)))


def mark_nightly_cases(items, whole):
    """Mark the cases of a test that its marker `daily` does not name as nightly.

    Args:
        items: the tests.
        whole: whether all cases of each test are among them; a name that is none is then refused.
    """
    named = {}
    for item in items:
        if marker := item.get_closest_marker("daily"):
            left = named.setdefault(item.nodeid.partition("[")[0], set(marker.args))
            if item.callspec.id in marker.args:
                left.discard(item.callspec.id)
            else:
                item.add_marker("nightly")
    wrong = {test: left for test, left in named.items() if left and whole}
    if wrong:
        raise pytest.UsageError(f"cases that the marker `daily` names do not exist: {wrong}")


def _inside(path, root):
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else ""


def pytest_terminal_summary(terminalreporter):
    """Say what tools/test did beside pytest here, so that pytest has the last word."""
    if collect_ignore:
        terminalreporter.write_line(
            f"not run, for they need the extra `learn` (torch, 3 GB): {', '.join(collect_ignore)};"
            " tools/nightly --only learn runs them"
        )
    if not _REAL.is_dir():
        terminalreporter.write_line(f"not run: tests of real machines' records, not at {_REAL}")
    folder = os.environ.get("HYDROTELE_CHECKS")
    if folder and Path(folder, "output").exists():
        done = Path(folder, "done")
        while not done.exists():
            time.sleep(0.1)
        terminalreporter.write_line(Path(folder, "output").read_text().rstrip())
        if failed := done.read_text().strip():
            terminalreporter.write_line(f"FAILED beside pytest: {failed}", red=True)
    if started := os.environ.get("HYDROTELE_TEST_STARTED"):
        terminalreporter.write_line(f"tools/test took {time.time() - float(started):.0f} s in all")
