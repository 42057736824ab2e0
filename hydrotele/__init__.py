"""Simulation and teleoperation testbed for heavy hydraulic machines, built on MuJoCo."""

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
