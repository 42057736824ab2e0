"""What a user's file may ask for before it is refused, and before memory is used for it.

Each limit can be changed by an environment variable of its name, `HYDROTELE_MAX_LOG_VALUES=1e9`.
"""

import math
import os
from collections.abc import Mapping
from types import MappingProxyType

from hydrotele.core.errors import InputError

LIMITS: Mapping[str, tuple[float, str]] = MappingProxyType({
    "FILE_BYTES": (32e6, "bytes of a YAML, JSON or MJCF file"),
    "FILE_DEPTH": (100, "levels of lists, mappings or elements inside each other"),
    "FILE_VALUES": (2e6, "values of a YAML file, those that aliases repeat included"),
    "LOG_VALUES": (1e8, "values of a log, rows times columns"),
    "RUN_TICKS": (2e7, "ticks of the controller in a run"),
    "RUN_ROWS": (2e6, "rows that a run logs"),
    "MOVES": (1e4, "moves or waypoints of a pilot"),
    "HARMONICS": (1e3, "harmonics of a joint's reference"),
    "ASSET_BYTES": (256e6, "bytes of a mesh, texture or height field"),
})  # fmt: skip
"""Name -> (the most that is allowed, of what)."""


def limit(name: str) -> float:
    """The most that is allowed of a name in `LIMITS`.

    Raises:
        InputError: the environment variable is no positive number.
    """
    variable = f"HYDROTELE_MAX_{name}"
    stated = os.environ.get(variable)
    if stated is None:
        return LIMITS[name][0]
    try:
        value = float(stated)
    except ValueError:
        value = math.nan
    if not value > 0.0:
        raise InputError(variable, f"must be a positive number, not {stated[:40]!r}")
    return value


def beyond(name: str, amount: float) -> str | None:
    """What to say of an amount that is beyond its limit, None where it is within.

    >>> beyond("MOVES", 3)
    >>> beyond("MOVES", 20000)
    '20000 moves or waypoints of a pilot, at most 10000; HYDROTELE_MAX_MOVES=20000 allows them'
    """
    most = limit(name)
    if amount <= most:
        return None
    asked = f"{amount:.0f}" if amount < 1e7 else f"{amount:.4g}"
    return (
        f"{asked} {LIMITS[name][1]}, at most {most:g}; HYDROTELE_MAX_{name}={asked} allows them"
    ).replace("e+0", "e")


def check_limit(where: object, name: str, amount: float) -> None:
    """Refuse an amount beyond its limit.

    Raises:
        InputError: it is; says how to allow it.
    """
    if said := beyond(name, amount):
        raise InputError(where, f"has {said}")
