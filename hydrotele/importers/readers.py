"""Read recordings from bags, MATLAB files, and CSV and Parquet files.

A group is a topic of a bag, a structure of a MATLAB file, or a table. Only the requested columns are kept in memory.
"""

import struct
from array import array
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.files import check_limit, get_limit
from hydrotele.importers.bag_files import Bag, Message, Topic, is_bag
from hydrotele.importers.matlab import read_matlab
from hydrotele.importers.message_layout import (
    Decoder,
    UndecodableTopic,
    find_stamp_paths,
    make_decoder,
    match_path,
    normalise_path,
)
from hydrotele.importers.plugin_importers import find_importer, list_plugin_suffixes, read_with_plugin
from hydrotele.importers.recordings import Group, Recording, convert_time, is_time_name
from hydrotele.logs.table import read_csv, read_table
from hydrotele.machine.log_columns import LogColumn

MATLAB_SUFFIX = ".mat"
TABLE_SUFFIXES = (".csv", ".txt", ".tsv", ".lvm", ".parquet")
_NO_STAMP = np.iinfo(np.int64).min  # stamp of a message that cannot be decoded
_BATCH_MESSAGES = 1024
_BATCH_BYTES = 4 * 2**20
_LISTED_MESSAGES = 20_000  # messages per topic that are read to propose a mapping
_MAX_LISTED_BYTES = 2**16  # longer messages, such as images, are not read to propose a mapping


def read_recording(path: Path, columns: Collection[str] | None, times: Mapping[str, LogColumn]) -> Recording:
    """Read columns of a recording.

    Args:
        path: bag, MATLAB file, CSV or Parquet file, or a file that a plug-in reads.
        columns: columns to read, such as `/joint_states.position[boom_joint]`; unknown ones are
            ignored. None reads a part of all columns, to propose a mapping.
        times: columns of a table or of a MATLAB file that are the time, with their conversion;
            without one, the time is found by its name.

    Raises:
        InputError: the file cannot be read; the message gives the reason.
    """
    if not path.exists():
        raise InputError(path, "does not exist: give logs of other programs to import")
    if is_bag(path):
        return _read_bag(path, columns)
    if path.suffix.lower() == MATLAB_SUFFIX:
        return read_matlab(path, columns, times)
    if path.suffix.lower() in TABLE_SUFFIXES:
        return _read_table(path, columns, times)
    if found := find_importer(path):
        return read_with_plugin(*found, path, columns)
    suffixes = ", ".join([*TABLE_SUFFIXES, *list_plugin_suffixes()])
    known = f".bag, .db3, .mcap, .mat, {suffixes}, or the folder of a ROS 2 bag"
    raise InputError(path, f"is not a log that can be imported; these are {known}")


def _read_table(path: Path, columns: Collection[str] | None, times: Mapping[str, LogColumn]) -> Recording:
    table = read_table(path, missing=True) if path.suffix.lower() == ".parquet" else read_csv(path, missing=True)
    names = list(table.names)
    time = [name for name in names if name in times] or [name for name in names if name == "time"]
    time = time or [name for name in names if is_time_name(name)] or names[:1]
    if not names or time[0] in table.faults:
        raise table.faults.get(time[0] if time else "", InputError(path, "has no columns"))
    place = names.index(time[0])
    seconds = convert_time(path, time[0], table.values[place], times.get(time[0]), table.units[place])
    kept = [name for name in names if name != time[0] and (columns is None or name in columns)]
    for name in kept:
        if name in table.faults and columns is not None:
            raise table.faults[name]
    kept = [name for name in kept if name not in table.faults]
    if twice := [name for name in kept if names.count(name) > 1]:
        raise InputError(table.location(twice[0]), f"occurs {names.count(twice[0])} times: keep one")
    values = {name: table.values[names.index(name)] for name in kept}
    units = {name: str(u) for name in kept if (u := table.units[names.index(name)])}
    known = np.isfinite(seconds)
    notes = []
    if not known.all():
        notes.append(f"{path}: {int((~known).sum())} rows without a time were removed.")
        seconds, values = seconds[known], {name: column[known] for name, column in values.items()}
    rows = len(seconds)
    ignored = {name: rows for name in names if name not in kept and name != time[0]}
    groups = [Group(str(path), "", seconds, None, values, units)] if kept else []
    return Recording(path, groups, ignored, notes, None, table.metadata)


class _TopicReader:
    """Decodes the messages of one topic in batches."""

    def __init__(self, topic: Topic, rest: Sequence[str] | None) -> None:
        """Prepare to read the paths `rest` behind the name of the topic, None for all."""
        self.topic, self.rest = topic, rest
        self.decoder: Decoder | None = None
        self.paths: list[str] = []
        self.stamp: tuple[str, str] | None = None
        self.waiting: list[bytes] = []
        self.size = self.read = 0
        self.listed = False  # whether the paths are known
        self.received = array("q")
        self.stamped = array("q")
        self.columns: list[array[float]] = []

    def add(self, message: Message) -> None:
        """Add a message.

        Raises:
            UndecodableTopic: the type of the topic cannot be decoded.
        """
        if self.decoder is None:
            self.decoder = make_decoder(self.topic)
        if self.rest is None and (self.read >= _LISTED_MESSAGES or len(message.data) > _MAX_LISTED_BYTES):
            return
        self.read += 1
        self.received.append(message.received)
        self.waiting.append(message.data)
        self.size += len(message.data)
        if len(self.waiting) >= _BATCH_MESSAGES or self.size > _BATCH_BYTES:
            self.decode_batch()

    def decode_batch(self) -> None:
        """Decode the waiting messages; the first batch determines the paths."""
        if not self.waiting:
            return
        assert self.decoder
        if not self.listed:
            self.listed = True
            listed = dict.fromkeys(path for data in self._samples() for path in self._list_paths(data))
            self.stamp = find_stamp_paths(list(listed))
            hidden = ("header.", *(self.stamp or ()))
            every = [path for path in listed if not path.startswith(hidden)]
            self.paths = every if self.rest is None else [match_path(path, every) for path in self.rest]
            self.columns = [array("d") for _ in self.paths]
        found = self.decoder.decode(self.waiting, [*self.paths, *(self.stamp or ())])
        if self.stamp:
            readable = np.asarray(np.isfinite(found[:, -2:]).all(axis=1))  # False for a damaged message
            whole = np.nan_to_num(found[:, -2:]).astype(np.int64)
            stamps = np.where(readable, whole[:, 0] * 10**9 + whole[:, 1], _NO_STAMP)
            self.stamped.frombytes(stamps.tobytes())
        for column, values in zip(self.columns, found.T, strict=False):
            column.frombytes(values.tobytes())
        self.waiting, self.size = [], 0

    def _samples(self) -> list[bytes]:
        """Return messages of different sizes, whose joints or fields may differ."""
        return list({len(data): data for data in self.waiting}.values())

    def _list_paths(self, data: bytes) -> list[str]:
        assert self.decoder
        try:
            return self.decoder.list_paths(data)
        except (struct.error, ValueError, RecursionError):  # a damaged message
            return []

    def make_group(self, origin: int) -> Group:
        """Return the columns read; `origin` [ns] is the calendar time of time 0."""
        received = (np.frombuffer(self.received, np.int64) - origin) / 1e9
        stamped, readable = None, np.ones(len(received), dtype=bool)
        if self.stamped:
            whole = np.frombuffer(self.stamped, np.int64)
            readable = whole != _NO_STAMP
            stamped = (whole[readable] - origin) / 1e9
        names = self.paths if self.rest is None else list(self.rest)
        columns = {}
        for path, name, column in zip(self.paths, names, self.columns, strict=True):
            values = np.frombuffer(column, np.float64)
            values = values if bool(readable.all()) else values[readable]
            if np.isfinite(values).any():
                columns[f"{self.topic.name}.{path}" if self.rest is None else name] = values
        return Group(self.topic.name, self.topic.type, received[readable], stamped, columns)


def _read_bag(path: Path, columns: Collection[str] | None) -> Recording:
    bag, readers, unreadable = Bag(path), {}, {}
    wanted: dict[str, dict[str, str]] = {}

    def is_wanted(topic: Topic) -> bool:
        if columns is None:
            return True
        found = {c: c[len(topic.name) :] for c in columns if c.startswith((f"{topic.name}.", f"{topic.name}/"))}
        wanted[topic.name] = found
        return bool(found)

    first: int | None = None
    total, most = 0, get_limit("LOG_VALUES")
    for message in bag.messages(is_wanted):
        name = message.topic.name
        first = message.received if first is None else first
        if name in unreadable:
            continue
        if name not in readers:
            rest = None if columns is None else [normalise_path(r) for r in wanted[name].values()]
            readers[name] = _TopicReader(message.topic, rest)
        try:
            readers[name].add(message)
        except UndecodableTopic as error:
            unreadable[name] = str(error)
            del readers[name]
            continue
        total += max(len(readers[name].paths), 1)
        if total > most:
            check_limit(path, "LOG_VALUES", total)
    origin = first or 0
    groups = []
    for name, reader in readers.items():
        try:
            reader.decode_batch()
        except UndecodableTopic as error:
            unreadable[name] = str(error)
            continue
        if reader.listed:
            group = reader.make_group(origin)
            if columns is not None:
                keys = dict(zip((normalise_path(r) for r in wanted[name].values()), wanted[name], strict=True))
                group.columns = {keys[rest]: values for rest, values in group.columns.items()}
            groups.append(group)
    notes = [*bag.notes, *(f"{path}: topic {name} cannot be decoded: {why}." for name, why in unreadable.items())]
    read = {group.name for group in groups if group.columns}
    ignored = {name: bag.counts[name] for name in bag.topics if name not in read}
    return Recording(path, [g for g in groups if g.columns], ignored, notes, origin or None)
