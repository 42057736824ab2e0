"""Importers of other packages: plug-ins of the group `hydrotele.importers`, which read further file formats.

A plug-in is an `Importer`, such as

    IMPORTER = Importer(suffixes=(".acme",), read=read_acme)

where `read_acme(path)` returns a `Recording`, for example from `make_recording`. Mapping, units, common
rows and repairs are those of every import.
"""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.plugins import describe_exception, find_plugins
from hydrotele.importers.recordings import Group, Recording

PLUGIN_GROUP = "hydrotele.importers"


class Importer(NamedTuple):
    r"""Reader of a file format.

    Attributes:
        suffixes: ends of the names of its files, in lower case, such as `.acme`.
        read: function of the path that returns a `Recording` with all columns. It raises InputError with file and
            reason if the file cannot be read.

    Examples:
        An importer of a text format with semicolons and decimal commas. A package offers it as an entry point of
        the group `hydrotele.importers`.

        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> def read_bench(path):
        ...     head, *rows = path.read_text().splitlines()
        ...     table = np.array([[float(word.replace(",", ".")) for word in row.split(";")] for row in rows])
        ...     names = head.split(";")
        ...     return ht.make_recording(path, table[:, 0], dict(zip(names[1:], table.T[1:])), {"pA": "bar"})
        >>> bench = ht.Importer(suffixes=(".bench",), read=read_bench)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "run.bench")
        ...     _ = path.write_text("t;pA\n0,00;20,1\n0,01;20,4\n")
        ...     recording = bench.read(path)
        >>> recording.groups[0].columns["pA"]
        array([20.1, 20.4])
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path], Recording]


def make_recording(
    path: Path, time: np.ndarray, columns: Mapping[str, np.ndarray], units: Mapping[str, str] | None = None
) -> Recording:
    """Return a recording of columns with a common time.

    Args:
        path: the file.
        time: (n,) time of every row [s].
        columns: name -> (n,) values, NaN where missing.
        units: name -> unit of a column, such as `deg` or `bar`; others are in SI units.

    Examples:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> import hydrotele as ht
        >>> time = np.arange(5) / 100.0
        >>> recording = ht.make_recording(Path("a.bench"), time, {"pA": 20.0 + time}, {"pA": "bar"})
        >>> recording.groups[0].columns["pA"], recording.groups[0].units
        (array([20.  , 20.01, 20.02, 20.03, 20.04]), {'pA': 'bar'})
    """
    values = {name: np.asarray(column, float) for name, column in columns.items()}
    return Recording(path, [Group(str(path), "", np.asarray(time, float), None, values, dict(units or {}))])


def find_importer(path: Path) -> tuple[str, Importer] | None:
    """Return source (for messages) and importer of the plug-in that reads files of a name, None without one.

    Raises:
        InputError: a plug-in cannot be loaded, or is not an `Importer`.
    """
    for plugin in find_plugins(PLUGIN_GROUP).values():
        content = plugin.load()
        if not isinstance(content, Importer):
            raise InputError(
                plugin.source, f"is not a hydrotele.Importer but {content!r}; update or uninstall the package"
            )
        if path.name.lower().endswith(tuple(content.suffixes)):
            return plugin.source, content
    return None


def list_plugin_suffixes() -> list[str]:
    """Return the sorted suffixes that plug-ins read."""
    contents = [plugin.load() for plugin in find_plugins(PLUGIN_GROUP).values()]
    return sorted(suffix for content in contents for suffix in getattr(content, "suffixes", ()))


def read_with_plugin(source: str, importer: Importer, path: Path, columns: Collection[str] | None) -> Recording:
    """Read a file with a plug-in and keep the requested columns (None: all).

    Raises:
        InputError: the plug-in raised an exception, or its result is not a valid recording.
    """
    try:
        recording = importer.read(path)
    except InputError:
        raise
    except Exception as error:  # any error of the package's code
        raise InputError(path, f"{source} cannot read it: {describe_exception(error)}") from error
    if not isinstance(recording, Recording):
        raise InputError(source, f"read() returned {type(recording).__name__}; a Recording is needed")
    groups, ignored = [], dict(recording.ignored)
    for group in recording.groups:
        rows = len(group.received)
        for name, values in group.columns.items():
            if np.shape(values) != (rows,):
                message = f"read() returned {np.shape(values)} values of {name} for {rows} times"
                raise InputError(source, message)
            if columns is not None and name not in columns:
                ignored[name] = rows
        kept = {name: values for name, values in group.columns.items() if columns is None or name in columns}
        if kept:
            units = {name: unit for name, unit in group.units.items() if name in kept}
            groups.append(Group(group.name, group.type, group.received, group.stamped, kept, units))
    return Recording(path, groups, ignored, list(recording.notes), recording.origin, recording.metadata)
