"""The log behind a run of a data set: without what only a simulator knows, cut as the run was."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from hydrotele.logs.files import RunFiles
from hydrotele.logs.log import Log
from hydrotele.logs.rows import Rows

_SECRET = ("initial_state",)  # metadata that only a simulator can know


def measured_only(run: RunFiles) -> RunFiles:
    """The run without truth, in columns and in metadata."""
    logs = [
        dataclasses.replace(
            log.without_truth(),
            metadata={k: v for k, v in log.metadata.items() if k not in _SECRET},
        )
        for log in run.logs
    ]
    return run._replace(logs=tuple(logs))


def piece_log(
    logs: Sequence[Log], name: str, rows: Rows, axes: Sequence[str], channels: Sequence[str],
    as_logged: bool = True,
) -> Log:  # fmt: skip
    """Log of a run or of a piece of it.

    Args:
        logs: the files of the run.
        name: name of the run or piece.
        rows: its rows.
        axes: the nu axes.
        channels: the c channels.
        as_logged: whether the rows stand for what was logged; False for means and masked rows.

    Returns:
        Of one file its rows as logged, with time stamps and all columns; else a log on the common
        clock, with commands and channels, NaN where missing.
    """
    first = logs[0]
    if len(logs) == 1 and as_logged:
        after = rows.start + rows.period * (len(rows.command) - 0.5)
        inside = (first.time > rows.start - 0.5 * rows.period) & (first.time < after)
        if inside.all():
            return first
        columns = {c: values[inside] for c, values in first.columns.items()}
        return dataclasses.replace(first, time=first.time[inside], columns=columns)
    columns = {f"command.{axis}": v for axis, v in zip(axes, rows.command.T, strict=True)}
    columns |= dict(zip(channels, rows.reading.T, strict=True))
    known = {channel: unit for log in logs for channel, unit in log.units.items()}
    columns = {channel: values for channel, values in columns.items() if channel in known}
    time = rows.start + rows.period * np.arange(len(rows.command))
    units = {channel: known[channel] for channel in columns}
    return Log(time, columns, units, first.metadata, name)
