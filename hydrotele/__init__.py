"""Simulation and teleoperation testbed for heavy hydraulic machines, built on MuJoCo.

The names in `__all__` are the public ones, each imported when it is first used; what is in the
modules below may move. `docs/api.md` lists them; `hydrotele/__init__.pyi` tells them to
type checkers.
"""

import contextlib
import os
from importlib import import_module

__version__ = "0.1.0"

_CONFIGURATION = {"numba": ".numba_config.yaml", "matplotlib": "matplotlibrc"}


def _ignore_configuration() -> None:
    """Keep libraries from taking their configuration from the working folder: it holds data.

    numba's may name a cache, which is code, and matplotlib's may name programs. Where such a file
    lies there, the library is imported from another folder, and does not look again.
    """
    for library, file in _CONFIGURATION.items():
        if os.path.lexists(file):
            with contextlib.chdir(os.path.dirname(__file__)):
                import_module(library)
            if library == "numba":  # it reads the file again for each function that it compiles
                vars(import_module("numba.core.config"))["_config_fname"] = os.devnull


_ignore_configuration()


_PUBLIC = {
    "control.endpoint_force": ("endpoint_force_of_log", "identify_gravity"),
    "core.errors": ("InputError",),
    "effects": ("EFFECTS", "apply_effect", "load_effects"),
    "gap.find": ("find_gap",),
    "gap.patched": ("write_patch",),
    "gap.result": ("Gap", "gap_document"),
    "identify.identification": ("identify_dynamics",),
    "logs.dataset": ("Dataset", "load_dataset"),
    "logs.log": ("Log", "load_log", "load_logs", "save_log"),
    "machine.machine": ("Machine",),
    "machine.machine_file": ("load_machine", "save_machine", "shipped_machines"),
    "run.replay": ("Replay", "replay_log"),
    "run.run": ("Run", "run_scenario"),
    "scenario.scenario": ("Scenario", "load_scenario", "shipped_scenarios"),
    "simulate.plant": ("Plant", "build_plant", "initial_state", "rest_state"),
    "envs.controllers.catalogue": ("make_controller",),
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
