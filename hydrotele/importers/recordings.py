"""Recordings: the columns of a log of another program, in groups with a common time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.units import si_unit_and_factor
from hydrotele.logs.table import DATE_UNIT
from hydrotele.machine.log_channels import suggest_channel_names
from hydrotele.machine.log_columns import LogColumn


@dataclass
class Group:
    """Columns with a common time.

    Attributes:
        name: topic, structure or file.
        type: type of the messages, empty without one.
        received: (n,) time at which each row was received or recorded [s].
        stamped: (n,) time that the messages state for their measurement [s]; None without one.
        columns: name of the column, in the form of the mapping -> (n,) values, NaN where missing.
        units: name of the column -> unit; columns without a stated unit are absent.
    """

    name: str
    type: str
    received: np.ndarray
    stamped: np.ndarray | None
    columns: dict[str, np.ndarray]
    units: dict[str, str] = field(default_factory=dict)


@dataclass
class Recording:
    """Content of a log of another program: groups of columns, each with its own times.

    Attributes:
        path: file or folder.
        groups: the groups that have columns.
        ignored: topic or column that was not read -> number of its messages or rows.
        notes: one sentence per repair, damaged part or topic that cannot be decoded.
        origin: calendar time of time 0 [ns since 1970], None if unknown.
        metadata: metadata of the file.

    Examples:
        Topics of a bag have their own times, and become groups:

        >>> from pathlib import Path
        >>> import numpy as np
        >>> fast, slow = np.arange(100) / 100.0, np.arange(10) / 10.0
        >>> arm = Group("/arm", "JointState", fast, None, {"position": 0.1 * fast}, {"position": "rad"})
        >>> oil = Group("/oil", "Temperature", slow, None, {"temperature": 45.0 + slow}, {"temperature": "degC"})
        >>> recording = Recording(Path("field.mcap"), [arm, oil], ignored={"/camera": 30})
        >>> {group.name: len(group.received) for group in recording.groups}
        {'/arm': 100, '/oil': 10}
    """

    path: Path
    groups: list[Group]
    ignored: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    origin: int | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)


def is_time_name(name: str) -> bool:
    """Return whether a column is the time by its name, such as `Time`, `t_s` or `timestamp`."""
    return suggest_channel_names(name)[:1] == ["time"]


def convert_time(path: Path, name: str, values: np.ndarray, column: LogColumn | None, unit: str | None) -> np.ndarray:
    """Return the values (n,) of a time column in seconds.

    Args:
        path: file, for messages.
        name: name of the column, for messages.
        values: (n,) values.
        column: conversion that the mapping states, None without one.
        unit: unit that the file states, None without one.

    Raises:
        InputError: the unit is no unit of time.
    """
    stated = (column.unit if column else None) or unit
    if column:
        values = column.convert(values)
    if stated is None or stated == DATE_UNIT:
        return values
    si, factor = si_unit_and_factor(stated)
    if si != "s":
        raise InputError(f"{path}, column {name!r}", f"has the unit {stated!r}, which is no unit of time")
    return values if factor == 1.0 else values * factor
