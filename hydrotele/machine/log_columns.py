"""Mapping of the columns of foreign logs to channels (`log_columns` of a machine file, or a file in their folder).

An entry maps a column, or a field of a message, to a channel and states how its values are converted:

    value = sign * scale * (column - minus) + offset    [unit]

An entry may also be a text: `angle.boom`, `-command.boom` for the opposite sign, `angle.boom [deg]`
with the unit, or `none` to skip the column.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic

from hydrotele.core.datafile import Number, PositiveFloat, StrictModel, read_yaml, validate_data
from hydrotele.core.errors import InputError

SKIP_COLUMN = "none"  # channel of columns to skip
LOG_COLUMNS_FILE = "log_columns.yaml"
"""Name of the file in the folder of logs that maps their columns; it has precedence over the machine file."""

_SHORT_FORM = re.compile(r"(?P<minus>-?)\s*(?P<channel>.*?)\s*(\[(?P<unit>[^\[\]]*)\])?", re.DOTALL)


class LogColumn(StrictModel):
    """Channel of a column, and the conversion of its values: sign * scale * (column - minus) + offset [unit].

    `channel` is `none` for a column to skip. `unit` is the unit of the converted values; without it,
    that of the file, or else SI. `wrap` is the period of a column that jumps by it, such as 360 for
    an encoder that counts from 0 to 360; the jumps are removed first. `minus` is a second column
    that is subtracted, for a command that two one-sided pilot pressures state.
    """

    channel: str
    unit: str | None = None
    scale: Number = 1.0
    sign: Literal[1, -1] = 1
    offset: Number = 0.0
    wrap: PositiveFloat | None = None
    minus: str | None = None

    @pydantic.model_validator(mode="before")
    @classmethod
    def _read_minus(cls, data: Any) -> Any:
        """Accept a minus in front of the channel, as in the short form."""
        channel = data.get("channel") if isinstance(data, dict) else None
        if isinstance(channel, str) and channel.startswith("-") and "sign" not in data:
            return {**data, "channel": channel[1:].strip(), "sign": -1}
        return data

    def convert(self, values: np.ndarray, minus: np.ndarray | None = None) -> np.ndarray:
        """Return the converted values (n,) of a column (n,); `minus` (n,) is the column to subtract.

        >>> LogColumn(channel="-angle.boom", wrap=360).convert(np.array([350.0, 355.0, 2.0]))
        array([-350., -355., -362.])
        """
        if self.wrap is not None:
            known = np.isfinite(values)
            values = values.copy()
            values[known] = np.unwrap(values[known], period=self.wrap)
        if minus is not None:
            values = values - minus
        factor = self.sign * self.scale
        values = values if factor == 1.0 else -values if factor == -1.0 else factor * values
        return values if self.offset == 0.0 else values + self.offset


def _select_form(value: Any) -> str:
    return "text" if isinstance(value, str) else "mapping"


LogColumnEntry = Annotated[
    Annotated[str, pydantic.Tag("text")] | Annotated[LogColumn, pydantic.Tag("mapping")],
    pydantic.Discriminator(_select_form),
]
"""Type of an entry of `log_columns`: a text or a mapping with the keys of `LogColumn`."""


def parse_log_column(entry: str | LogColumn) -> LogColumn:
    """Return an entry of `log_columns`, which may be a text, as a `LogColumn`.

    >>> parse_log_column("-angle.boom [deg]")
    LogColumn(channel='angle.boom', unit='deg', scale=1.0, sign=-1, offset=0.0, wrap=None, minus=None)
    """
    if isinstance(entry, LogColumn):
        return entry
    match = _SHORT_FORM.fullmatch(entry.strip())
    assert match
    unit = (match["unit"] or "").strip() or None
    return LogColumn(channel=match["channel"], unit=unit, sign=-1 if match["minus"] else 1)


class _LogColumnsFile(StrictModel):
    log_columns: dict[str, LogColumnEntry]


def read_log_columns(path: str | Path) -> dict[str, str | LogColumn]:
    """Read a YAML file with the key `log_columns`; other files, such as a machine file, are refused.

    Raises:
        InputError: the file is not valid; the message gives file, line, key and reason.
    """
    data, lines = read_yaml(path)
    if "log_columns" not in data:
        raise InputError(path, "has no key log_columns: write `log_columns:` and one line `column: channel` per column")
    return validate_data(_LogColumnsFile, data, str(path), lines).log_columns


def log_columns_for(path: Path, columns: Mapping[str, str | LogColumn]) -> dict[str, LogColumn]:
    """Return `columns` and the entries of the file `log_columns.yaml` in the folder of a log, which have precedence."""
    beside = path.parent / LOG_COLUMNS_FILE
    merged = {**columns, **(read_log_columns(beside) if beside.is_file() else {})}
    return {name: parse_log_column(entry) for name, entry in merged.items()}
