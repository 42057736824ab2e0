"""Simulation and teleoperation testbed for heavy hydraulic machines, built on MuJoCo.

The public names are those in `__all__`; each is imported on first use. The submodules are private
and may change. `docs/api.md` documents the public names, and `hydrotele/__init__.pyi` declares
them for type checkers.
"""

import contextlib
import os
from importlib import import_module

__version__ = "0.1.0"

_CONFIGURATION = {"numba": ".numba_config.yaml", "matplotlib": "matplotlibrc"}


def _ignore_local_configuration_files() -> None:
    """Prevent numba and matplotlib from reading a configuration file in the working folder.

    The working folder holds data, which must not be able to run code. A numba file can name a
    folder of compiled code, and a matplotlib file can name programs. If such a file exists, the
    library is imported here while another folder is the working folder.
    """
    for library, file in _CONFIGURATION.items():
        if os.path.lexists(file):
            with contextlib.chdir(os.path.dirname(__file__)):
                import_module(library)
            if library == "numba":  # reads the file again for each function it compiles
                vars(import_module("numba.core.config"))["_config_fname"] = os.devnull


_ignore_local_configuration_files()


_PUBLIC = {
    "control.endpoint_force": ("endpoint_force_of_log",),
    "control.gravity_model": ("identify_gravity",),
    "core.compiled": ("compiled",),
    "core.errors": ("InputError",),
    "effects": ("EFFECTS", "apply_effect", "load_effects"),
    "estimate.linear_model": ("LinearModel", "linearise"),
    "gap.find": ("find_gap",),
    "gap.patched": ("write_patch",),
    "gap.result": ("Gap", "gap_document"),
    "identify.identification": ("identify_dynamics",),
    "logs.dataset": ("Dataset", "load_dataset"),
    "logs.log": ("Log", "load_log", "load_logs", "save_log"),
    "machine.machine": ("Machine",),
    "machine.machine_file": ("load_machine", "save_machine", "shipped_machines"),
    "run.policy": ("PilotState", "allow_policy"),
    "run.replay": ("Replay", "replay_log"),
    "run.run": ("Run", "run_scenario"),
    "scenario.scenario": ("Scenario", "load_scenario", "shipped_scenarios"),
    "simulate.plant": ("Plant", "build_plant", "initial_state", "rest_state"),
    "envs.controllers.catalogue": ("make_controller",),
    "envs.episode": ("draw_uniform", "draw_uniform_between"),
    "envs.observation": ("ObservationField",),
    "envs.python_task": ("PythonTask", "TaskState"),
    "importers.plugin_importers": ("Importer", "make_recording"),
    "importers.recordings": ("Recording",),
}
_MODULE = {name: module for module, names in _PUBLIC.items() for name in names}
__all__ = sorted(_MODULE)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str):
    if name not in _MODULE:
        raise AttributeError(f"module 'hydrotele' has no attribute {name!r}")
    found = getattr(import_module(f"hydrotele.{_MODULE[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
