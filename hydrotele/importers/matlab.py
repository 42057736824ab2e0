"""Read the numbers of MATLAB files: plain vectors with a time vector, and structures with their own time.

Files of versions 5 to 7 are read with SciPy, those of version 7.3, which are HDF5 files, with h5py; only the
requested columns are read from the latter. A column has the name of its variable, with fields and
elements behind it: `boom.angle`, `capture.Y[Boom Angle].Data`, `signals[0].values[1]` for the second
column of a matrix.
"""

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import check_limit, open_regular
from hydrotele.importers.bag_files import import_library
from hydrotele.importers.recordings import Group, Recording, convert_time, is_time_name
from hydrotele.machine.log_channels import MEASURED_KINDS
from hydrotele.machine.log_columns import LogColumn

_NAME_KEYS = ("Name", "name", "label", "Label")
_UNIT_KEYS = ("Unit", "unit", "Units", "units")
_TIME_KEYS = ("X.Data", "XData")  # time axis of dSPACE and of graphics, in addition to the names of a time
_MAX_MATRIX_COLUMNS = 1000  # of a matrix: more are an image or a table of another kind
_MIN_ROWS = 2


class _Vector(NamedTuple):
    """A vector of numbers in a file: its length, and the function that reads it."""

    length: int
    read: Callable[[], np.ndarray]


def read_matlab(path: Path, columns: Collection[str] | None, times: Mapping[str, LogColumn]) -> Recording:
    """Read columns of a MATLAB file; the arguments are those of `read_recording`.

    Raises:
        InputError: the file is damaged, or a library is missing.
    """
    with open_regular(path) as file:
        head = file.read(8)
        is_hdf5 = head == b"\x89HDF\r\n\x1a\n" or (head[:6] == b"MATLAB" and _has_hdf5_signature(file))
    if is_hdf5:
        h5py = import_library("h5py")
        try:
            with h5py.File(path, "r") as file:
                return _make_recording(path, _hdf5_to_tree(file, file), columns, times)
        except InputError:
            raise
        except Exception as error:  # a damaged file raises errors of many types
            reason = str(error)[:100]
            raise InputError(path, f"is a damaged MATLAB 7.3 file ({reason}): copy it again") from None
    tree, others = _read_version5(path, columns, times)
    recording = _make_recording(path, tree, columns, times)
    recording.ignored |= others
    return recording


def _has_hdf5_signature(file) -> bool:
    file.seek(512)
    return file.read(8) == b"\x89HDF\r\n\x1a\n"


def _read_version5(
    path: Path, columns: Collection[str] | None, times: Collection[str]
) -> tuple[dict[str, Any], dict[str, int]]:
    """Return the variables that are needed, and the names and lengths of the others."""
    from scipy.io import loadmat, whosmat

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = {n: max(shape) for n, shape, kind in whosmat(path) if kind not in ("char", "function", "opaque")}
            names = list(found)
            if columns is not None:
                roots = {column.partition(".")[0].partition("[")[0] for column in (*columns, *times)}
                names = [name for name in found if name in roots or is_time_name(name) or name in MEASURED_KINDS]
            read = loadmat(path, simplify_cells=True, variable_names=names) if names else {}
    except Exception as error:  # a damaged file raises errors of many types
        reason = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
        raise InputError(path, f"is not a readable MATLAB file, copy it again ({reason})") from None
    return {k: v for k, v in read.items() if k in names}, {k: n for k, n in found.items() if k not in names}


def _hdf5_to_tree(node, file) -> dict[str, Any]:
    """Return a group of an HDF5 file as nested dicts and lists whose leaves are texts and vectors."""
    h5py = import_library("h5py")
    if isinstance(node, h5py.Group):
        tree = {k: _hdf5_to_tree(v, file) for k, v in node.items() if not k.startswith("#")}
        counts = {len(v) for v in tree.values() if isinstance(v, list)}
        if tree and len(counts) == 1 and all(isinstance(v, list) for v in tree.values()):  # array of structures
            return [{k: v[i] for k, v in tree.items()} for i in range(counts.pop())]  # type: ignore[return-value]
        return tree
    if node.dtype == h5py.ref_dtype:
        references = np.asarray(node).ravel()
        return [_hdf5_to_tree(file[reference], file) for reference in references]  # type: ignore[return-value]
    kind = node.attrs.get("MATLAB_class", b"")
    if kind == b"char":
        return "".join(map(chr, np.asarray(node).ravel()[:1000]))  # type: ignore[return-value]
    if node.dtype.kind not in "fiub" or node.attrs.get("MATLAB_empty", 0):
        return {}
    shape = tuple(n for n in node.shape if n != 1)  # the dimensions of MATLAB are stored in reverse order
    if len(shape) == 1:
        return _Vector(shape[0], lambda: np.asarray(node).ravel())  # type: ignore[return-value]
    if len(shape) == 2 and len(node.shape) == 2 and shape[0] <= _MAX_MATRIX_COLUMNS:
        return [_Vector(shape[1], lambda k=k: np.asarray(node[k])) for k in range(shape[0])]  # type: ignore[return-value]
    return {}


def _children(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield (suffix of the path, child) of a structure or list; columns of a matrix are its children."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield f".{key}", item
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1):
        for place, item in enumerate(value):
            label = str(place)
            if isinstance(item, dict):
                label = next((item[key] for key in _NAME_KEYS if isinstance(item.get(key), str)), label)
            yield f"[{label}]", item
    elif isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "fiub":
        if value.shape[1] <= _MAX_MATRIX_COLUMNS:
            for place in range(value.shape[1]):
                yield f"[{place}]", value[:, place]


def _as_vector(value: Any) -> _Vector | None:
    if isinstance(value, _Vector):
        return value
    if isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in "fiub":
        return _Vector(len(value), lambda: value)
    return None


def _find_times(tree: Mapping[str, Any], path: str, times: Collection[str]) -> list[tuple[str, _Vector]]:
    """Return (path, vector) of the time vectors that are direct fields of a structure; `times` are known times."""
    found = [
        (k, vector)
        for k, v in tree.items()
        if (is_time_name(k) or f"{path}.{k}".lstrip(".") in times) and (vector := _as_vector(v))
    ]
    for key in _TIME_KEYS:
        value: Any = tree
        for word in key.split("."):
            value = value.get(word) if isinstance(value, dict) else None
        if vector := _as_vector(value):
            found.append((key, vector))
    return found


def _list_columns(tree: Any, path: str, times: list, unit: str | None, known: Collection[str]) -> Iterator[tuple]:
    """Yield (path, vector, path of its time, time vector, unit) of all vectors that have a time of equal length.

    Args:
        tree: nested dicts and lists with vectors.
        path: path of the tree.
        times: (path, vector) of the times of the enclosing structures, the nearest first.
        unit: unit that the enclosing structure states.
        known: paths that the mapping states to be a time.
    """
    if isinstance(tree, dict):
        own = _find_times(tree, path, known)
        times = [(f"{path}.{name}".lstrip("."), vector) for name, vector in own] + times
        unit = next((tree[key] for key in _UNIT_KEYS if isinstance(tree.get(key), str) and tree[key]), unit)
    if (vector := _as_vector(tree)) is not None:
        own = next(((name, time) for name, time in times if time.length == vector.length), None)
        if vector.length >= _MIN_ROWS and own and path not in [name for name, _ in times]:
            yield path, vector, *own, unit
        return
    for suffix, child in _children(tree):
        yield from _list_columns(child, f"{path}{suffix}".lstrip("."), times, unit, known)


def _make_recording(
    path: Path, tree: dict[str, Any], columns: Collection[str] | None, times: Mapping[str, LogColumn]
) -> Recording:
    groups: dict[str, Group] = {}
    ignored, values = {}, 0
    for name, vector, time_name, time, unit in _list_columns(tree, "", [], None, times):
        if columns is not None and name not in columns:
            ignored[name] = vector.length
            continue
        values += 2 * vector.length
        check_limit(path, "LOG_VALUES", values)
        if time_name not in groups:
            stamps = np.asarray(time.read(), dtype=np.float64).ravel()
            stamps = convert_time(path, time_name, stamps, times.get(time_name), None)
            groups[time_name] = Group(time_name, "", stamps, None, {})
        groups[time_name].columns[name] = np.asarray(vector.read(), dtype=np.float64).ravel()
        if unit:
            groups[time_name].units[name] = unit
    notes = []
    if not groups and not ignored:
        notes.append(
            f"{path}: no vector of numbers has a time vector of the same length. Name the time `time`, or store it as"
            " the field `time` of the same structure. Objects such as timeseries must be stored as structures:"
            " s = struct('time', ts.Time, 'data', ts.Data)."
        )
    return Recording(path, list(groups.values()), ignored, notes)
