"""Damage files of every kind and check that hydrotele refuses each in one sentence.

    python tools/validation/fuzz.py --count 10000 --seed 1 --jobs 2

A case is a shipped or made file with a few changes that keep most of its structure (numbers that
are huge, wrong types, keys that are deleted, doubled or nested, lines cut or exchanged, bytes
flipped), read by the command that is for it in a forked child with limits of time and memory. What
counts as a defect: a traceback, a signal, a time over 60 s, more than 4 GB, a message over 2 kB,
another exit status than 0, 2 and 3, or a processor time that grows with the square of the size of a
file (measured at n and 4 n). Defects are printed with their seed; `--only SEED` makes one
again and keeps its files.
"""

import argparse
import copy
import functools
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from hydrotele.core.files import models_folder, scenarios_folder
from hydrotele.logs.log import Log, load_log, save_log
from hydrotele.teleop.case_file import DEFAULT_CASE_FILE

SECONDS, MEMORY, LETTERS = 60.0, 4_000_000_000, 2048  # limits of a case
_FINE = (0, 2, 3)  # done, the user's mistake, a simulation that left the finite numbers
_STRANGE: tuple[Any, ...] = (
    None, True, "", "x", "é" * 300, "[/red]", "\x00", "1_000", "nan", -1, 0, 1e-320, 1e308, -1e308,
    2**70, float("nan"), float("inf"), [], {}, [[]], {"a": {"b": [1]}}, [1e9] * 3,
    "../../etc/passwd", "/dev/zero", "!!python/object:os.system", list(range(50)),
)  # fmt: skip
_MOVE = "name: move\nmachine: ./m\nduration: 0.2\npilot: {kind: constant}\n"


class Case(NamedTuple):
    """What is read: a command and the folder that it finds its files in."""

    kind: str
    arguments: tuple[str, ...]
    larger: tuple[str, ...] = ()
    """The same command for a file of four times the size; its processor time is compared."""
    program: tuple[str, ...] = ()
    """A program that is run in place of a command."""


class Verdict(NamedTuple):
    """How a case ended; `defect` is empty where it was right."""

    seed: int
    kind: str
    defect: str
    words: str
    seconds: float


def make_case(seed: int, folder: Path) -> Case:
    """Write the files of a case.

    Args:
        seed: of its random choices.
        folder: empty.

    Returns:
        The case.
    """
    dice = random.Random(seed)
    kind = dice.choice(sorted(_MAKERS))
    if kind in _LONG and dice.random() < 0.7:
        kind = dice.choice(sorted(_MAKERS.keys() - _LONG))
    made = _MAKERS[kind](dice, folder)
    return made if isinstance(made, Case) else Case(kind, tuple(made))


def judge(seed: int) -> Verdict:
    """Make a case, read it in a child of this process, and say how it ended."""
    folder = Path(tempfile.mkdtemp(prefix="hydrotele_fuzz_"))
    try:
        case = make_case(seed, folder)
        begin = time.monotonic()
        status, words, used = _in_child(case, folder)
        seconds = time.monotonic() - begin
        defect = _defect(status, words, seconds)
        if case.larger and not defect:
            status, words, more = _in_child(case._replace(arguments=case.larger), folder)
            seconds = time.monotonic() - begin
            defect = _defect(status, words, seconds) or _growth_defect(used, more)
        return Verdict(seed, case.kind, defect, words, seconds)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _growth_defect(used: float, more: float) -> str:
    """Whether the processor time at 4 n [s] exceeds that at n by more than a linear share.

    A time in proportion to n grows by 4, its square by 16; 10 is between, and 2 s exclude the noise
    of short times.
    """
    return f"square growth: {used:.1f} s, {more:.1f} s" if more > max(10.0 * used, 2.0) else ""


def _in_child(case: Case, folder: Path) -> tuple[int, str, float]:
    """Exit status (negative: a signal) of a case, what it said on stderr, and its processor time."""
    said = folder / "said.txt"
    child = os.fork()
    if child == 0:
        _read(case, folder, said)
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            seconds = used.ru_utime + used.ru_stime
            return os.waitstatus_to_exitcode(status), said.read_text(errors="replace"), seconds
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -signal.SIGKILL, said.read_text(errors="replace"), SECONDS


def _read(case: Case, folder: Path, said: Path) -> None:
    """What a child does: the command, and nothing that its parent would do."""
    status = 99
    try:
        handle = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = (open(n, "w", closefd=False) for n in (1, 2))
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.chdir(folder)
        if case.program:
            os.execv(case.program[0], case.program)
        sys.argv = ["hydrotele", *case.arguments]
        from hydrotele.cli.main import main

        main()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _defect(status: int, words: str, seconds: float) -> str:
    if status < 0:
        return "hang" if seconds >= SECONDS else signal.Signals(-status).name
    if "Traceback" in words:
        return "traceback"
    if status not in _FINE:
        return f"exit status {status}"
    return "long message" if len(words.encode()) > LETTERS else ""


def _yaml_file(dice: random.Random, source: Path, target: Path) -> None:
    """A damaged copy of a YAML file: as a structure, or as text."""
    text = source.read_text(encoding="utf-8")
    way = dice.random()
    if way < 0.4:
        data = yaml.safe_load(text)
        for _ in range(dice.randint(1, 3)):
            _change_number(dice, data)
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    elif way < 0.8:
        data = yaml.safe_load(text)
        for _ in range(dice.randint(1, 4)):
            data = _changed(dice, data)
        text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    else:
        text = _torn(dice, text)
    target.write_bytes(text.encode("utf-8", "surrogatepass"))


def _change_number(dice: random.Random, data: Any) -> None:
    """Change one number of a structure, such that it may still pass for one."""
    found: list[tuple[Any, Any]] = []

    def look(inside: Any) -> None:
        items = inside.items() if isinstance(inside, dict) else enumerate(inside)
        for key, value in items:
            if isinstance(value, dict | list):
                look(value)
            elif isinstance(value, int | float) and not isinstance(value, bool):
                found.append((inside, key))

    look(data)
    if found:
        inside, key = dice.choice(found)
        factor = dice.choice([-1.0, 0.0, 1e-6, 1e-3, 0.5, 0.9, 1.1, 2.0, 10.0, 1e3, 1e6])
        inside[key] = type(inside[key])(inside[key] * factor)


def _changed(dice: random.Random, data: Any) -> Any:
    """The same structure with one place in it changed."""
    if isinstance(data, dict) and data and dice.random() < 0.9:
        key = dice.choice(list(data))
        action = dice.random()
        if action < 0.08:
            return {k: v for k, v in data.items() if k != key}
        if action < 0.14:
            return {**data, dice.choice(["x", "", "é", key + "_mm", "9"]): data[key]}
        return {**data, key: _changed(dice, data[key])}
    if isinstance(data, list) and data and dice.random() < 0.9:
        place = dice.randrange(len(data))
        if dice.random() < 0.1:
            return data[:place] + data[place + 1 :]
        return [*data[:place], _changed(dice, data[place]), *data[place + 1 :]]
    if isinstance(data, float) and dice.random() < 0.5:
        return data * dice.choice([-1.0, 0.0, 1e-9, 1e-3, 1e3, 1e9, 1e30])
    return dice.choice(_STRANGE)


def _torn(dice: random.Random, text: str) -> str:
    """A text with lines or letters lost, doubled, exchanged or nested."""
    lines = text.split("\n")
    for _ in range(dice.randint(1, 5)):
        a, b = dice.randrange(len(lines)), dice.randrange(len(lines))
        match dice.randrange(7):
            case 0:
                lines[a] = lines[a][: dice.randint(0, max(0, len(lines[a])))]
            case 1:
                lines[a], lines[b] = lines[b], lines[a]
            case 2:
                lines.insert(a, lines[b])
            case 3:
                lines[a] += dice.choice(["[" * 3000, "{a: " * 500, "&x [*x]", "\t", "\x1b[31m", "': "])
            case 4:
                lines[a] = "".join(chr(dice.randint(1, 0x2FFF)) if dice.random() < 0.05 else c for c in lines[a])
            case 5:
                lines = lines[:a] or [""]
            case 6:
                lines[a] = " " * dice.randint(0, 9) + lines[a]
    return "\n".join(lines)


def _machine(dice: random.Random, folder: Path) -> list[str]:
    name = dice.choice([path.parent.name for path in models_folder().glob("*/machine.yaml")])
    shutil.copytree(models_folder() / name, folder / "m")
    _yaml_file(dice, models_folder() / name / "machine.yaml", folder / "m/machine.yaml")
    if dice.random() < 0.3:
        (folder / "s.yaml").write_text(_MOVE)
        return ["run", "s.yaml", "--out", "out", "--no-review"]
    return dice.choice([["validate", "./m"], ["export", "./m", "--out", "scene.xml"]])


def _mjcf(dice: random.Random, folder: Path) -> list[str]:
    name = dice.choice([path.parent.name for path in models_folder().glob("*/machine.yaml")])
    shutil.copytree(models_folder() / name, folder / "m")
    files = [p for p in (folder / "m").glob("*.xml")]
    if not files:
        return ["validate", "./m"]
    file = dice.choice(sorted(files))
    tree = ElementTree.parse(file).getroot()
    if dice.random() < 0.7:
        for _ in range(dice.randint(1, 4)):
            _change_element(dice, tree)
        text = ElementTree.tostring(tree, encoding="unicode")
    else:
        text = _torn(dice, file.read_text())
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    return ["validate", "./m"]


def _change_element(dice: random.Random, tree: ElementTree.Element) -> None:
    element = dice.choice(list(tree.iter()))
    match dice.randrange(5):
        case 0 if element.attrib:
            name = dice.choice(list(element.attrib))
            element.set(name, str(dice.choice(_STRANGE))[:200].replace("\x00", "0"))
        case 1 if element.attrib:
            del element.attrib[dice.choice(list(element.attrib))]
        case 2:
            some = list(tree.iter(dice.choice(["geom", "body", "joint"]))) or [element]
            element.append(copy.deepcopy(dice.choice(some)))
        case 3:
            inner = element
            for _ in range(dice.choice([3, 300])):
                inner = ElementTree.SubElement(inner, "body")
        case _:
            element.tag = dice.choice(["body", "geom", "x", "mesh", "include", "default"])


def _scenario(dice: random.Random, folder: Path) -> list[str]:
    source = dice.choice(sorted(scenarios_folder().glob("*.yaml")))
    _yaml_file(dice, source, folder / "s.yaml")
    if dice.random() < 0.3:
        return ["run", "s.yaml", "--set", "duration=0.3", "--out", "out", "--no-review"]
    return ["validate", "s.yaml"]


def _sweep(dice: random.Random, folder: Path) -> list[str]:
    source = dice.choice(sorted(scenarios_folder().rglob("sweeps/*.yaml")))
    _yaml_file(dice, source, folder / "sweep.yaml")
    return ["validate", "sweep.yaml"]


def _joystick(dice: random.Random, folder: Path) -> list[str]:
    source = next(p.parent for p in models_folder().glob("*/joystick.yaml"))
    shutil.copytree(source, folder / "j")
    _yaml_file(dice, source / "joystick.yaml", folder / "j/joystick.yaml")
    return ["validate", "./j"]


def _teleop(dice: random.Random, folder: Path) -> list[str]:
    _yaml_file(dice, DEFAULT_CASE_FILE, folder / "case.yaml")
    return ["analyse", "teleop", "case.yaml", "--json"]


def _log(dice: random.Random) -> Log:
    rows = dice.choice([0, 1, 2, 50, 400])
    time_ = 0.02 * np.arange(rows)
    names = {"command.boom": "1", "angle.boom": "rad", "pressure_head.boom": "Pa"}
    columns = {name: np.sin(time_ + k) for k, name in enumerate(names)}
    known = {"order": ["swing", "boom", "stick"], "angle": [0, 0]}
    broken = '{"order": ["boom"], "angle": [NaN]}'
    state = dice.choice(["", "{", "[" * 100_000, '{"order": 5}', broken, json.dumps(known)])
    told = {
        "hydrotele": "1",
        "initial_state": state,
        "surroundings": dice.choice(["", "[]", "[[", "{"]),
    }
    return Log(time_, columns, names, told if dice.random() < 0.6 else {})


def _parquet(dice: random.Random, folder: Path) -> list[str]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = folder / "log.parquet"
    if dice.random() < 0.3:
        column = dice.choice([pa.array([0.0]), pa.array(["x"]), pa.array([[1.0]]), pa.array([None])])
        values = pa.concat_arrays([column] * dice.choice([3, 1000]))
        table = pa.table({"time": values, dice.choice(["angle.boom", "", "é", "time"]): values})
        pq.write_table(table, file)
    else:
        log = _log(dice)
        if len(log):
            save_log(log, file)
        else:
            file.write_bytes(b"PAR1")
    content = bytearray(file.read_bytes())
    for _ in range(dice.choice([0, 1, 5, 50])):
        content[dice.randrange(len(content))] = dice.randrange(256)
    file.write_bytes(bytes(content[: dice.choice([len(content)] * 4 + [len(content) // 2])]))
    replay = ["replay", "log.parquet", "--machine", "cat215", "--json"]
    return dice.choice([["validate", "log.parquet"], replay])


def _csv(dice: random.Random, folder: Path) -> list[str]:
    log = _log(dice)
    head = ",".join(["time [s]", *(f"{n} [{u}]" for n, u in log.units.items())])
    rows = [",".join(map(str, row)) for row in zip(log.time, *log.columns.values(), strict=True)]
    text = _torn(dice, "\n".join([head, *rows]))
    (folder / "log.csv").write_bytes(text.encode(dice.choice(["utf-8", "utf-16", "latin-1"]), "replace"))
    return ["validate", "log.csv"]


_RIG = ["--machine", "rig", "--json"]
_FITTING = [
    ["compare", "rig", "--data", "data", "--json"], ["replay", "data/fit_2.parquet", *_RIG],
    ["review", "data/fit_2.parquet", "--out", "out.rrd"], ["validate", "data/fit_2.parquet"],
    ["identify", "--data", "data", *_RIG, "--out", "out"],
]  # fmt: skip


def _data_folder(dice: random.Random, folder: Path) -> list[str]:
    """Three runs of the rig, one of them damaged, for the commands that fit models to data."""
    (folder / "data").mkdir()
    for name, log in _rig_runs().items():
        if name == "fit_2":
            _write_unchecked(folder / f"data/{name}.parquet", *_damaged(dice, log))
        else:
            save_log(log, folder / f"data/{name}.parquet")
    return dice.choice(_FITTING)


def _write_unchecked(
    path: Path, time_: np.ndarray, columns: dict[str, np.ndarray], units: dict[str, str],
    told: dict[str, str],
) -> None:  # fmt: skip
    """What `save_log` writes, without its checks."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = {"time": time_, **columns}
    fields = [pa.field(n, pa.float64(), metadata={"unit": units.get(n, "s")}) for n in table]
    arrays = [pa.array(values) for values in table.values()]
    schema = pa.schema(fields, metadata=told)
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), path)


@functools.cache
def _rig_runs() -> dict[str, Log]:
    """Three short runs of the rig that the commands accept.

    They are made by other processes: a simulation here might hold locks that a forked child needs.
    """
    runs = {}
    with tempfile.TemporaryDirectory() as name:
        for k, run in enumerate(("fit_1", "fit_2", "test_1")):
            words = ["run", "rig_steps", "--set", f"seed={k}", "--set", "duration=4.0"]
            _command([*words, "--out", run, "--no-review"], name)
            runs[run] = load_log(Path(name) / run / "measured.parquet")
    return runs


def _command(words: list[str], folder: str) -> None:
    command = [sys.executable, "-m", "hydrotele", *words]
    subprocess.run(command, cwd=folder, check=False, capture_output=True)


def _damaged(dice: random.Random, log: Log) -> tuple[np.ndarray, dict, dict, dict]:
    """Time, columns, units and metadata of a log with something wrong in them."""
    time_, units, told = log.time.copy(), dict(log.units), dict(log.metadata)
    names = sorted(log.columns)
    columns = {name: values.copy() for name, values in log.columns.items()}
    for _ in range(dice.randint(1, 3)):
        name = dice.choice([n for n in names if n in columns])
        a, b = sorted(dice.sample(range(len(time_)), 2))
        match dice.randrange(10):
            case 0:
                columns[name] = columns[name] * dice.choice([0.0, -1.0, 1e-6, 1e3, 1e300])
            case 1:
                columns[name][a:b] = dice.choice([np.nan, np.inf, 0.0, 1e308])
            case 2:
                columns.pop(name)
                units.pop(name)
            case 3:
                units[name] = dice.choice(["", "deg", "bar", "m", "1", "furlong"])
            case 4:
                time_[a:b] += dice.choice([-1.0, 1e-9, 100.0, 1e12])
            case 5:
                time_[a:b] = time_[a]
            case 6:
                time_ = time_ * dice.choice([1e-6, 1e3, -1.0])
            case 7:
                other = dice.choice(["angle.nothing", "x" * 300, "truth.angle.slide", name + ".y"])
                columns[other], units[other] = columns.pop(name), units.pop(name)
            case 8:
                rows = dice.choice([1, 9, 12, len(time_) // 2])
                time_, columns = time_[:rows], {n: v[:rows] for n, v in columns.items()}
                return time_, columns, units, told
            case 9:
                told[dice.choice(sorted(told) or ["x"])] = dice.choice(["", "{", "null", "[1]"])
    return time_, columns, units, told


def _run_folder(dice: random.Random, folder: Path) -> list[str]:
    log = _log(random.Random(dice.random()))
    (folder / "run").mkdir()
    if len(log):
        save_log(log, folder / "run/measured.parquet")
    words = dice.choice(["{", "[" * 100_000, '{"kind": 5}', '{"kind": "run"}', "\x00", '"run"'])
    (folder / "run/summary.json").write_text(words)
    return dice.choice([["validate", "run"], ["replay", "run", "--json"],
                        ["run", "zhu_up", "--set", "duration=0.3", "--out", "run"]])  # fmt: skip


def _nested_mjcf(dice: random.Random, folder: Path) -> list[str]:
    """A machine whose MJCF includes or attaches documents: missing, cyclic, deep, or no files."""
    shutil.copytree(models_folder() / "rig", folder / "m")
    outer = folder / "m/rig.xml"
    names = [f"part{k}.xml" for k in range(dice.choice([1, 2, 5, 200]))]
    link = dice.choice(
        [
            '<include file="{}"/>',
            '<asset><model name="s" file="{}"/></asset>',
            '<asset><mesh name="z" file="{}"/></asset>',
            '<asset><texture type="2d" name="t" file="{}"/></asset>',
        ]
    )
    last = dice.choice([names[0], "rig.xml", "none.xml", "/dev/zero", "pipe", "."])
    for name, below in zip(names, [*names[1:], last], strict=True):
        (folder / "m" / name).write_text(f"<mujoco>{link.format(below)}</mujoco>")
    os.mkfifo(folder / "m/pipe")
    if dice.random() < 0.3:
        (folder / "m" / dice.choice(names)).write_text(_torn(dice, outer.read_text()))
    outer.write_text(outer.read_text().replace("<worldbody>", f"{link.format(names[0])}<worldbody>", 1))
    if dice.random() < 0.5:
        return ["validate", "./m"]
    (folder / "log.csv").write_text("time,slide\n" + "".join(f"{k / 100},0\n" for k in range(50)))
    return ["identify", "--mjcf", "m/rig.xml", "--data", "log.csv", "--json"]


_LAW = """
from hydrotele.core.compiled import callback, compiled

@compiled
def law(x):
    return 2.0 * x

@callback("float64(float64)")
def twice(x):
    return 2.0 * x

assert (law(1.0), law(1), twice.ctypes(2.0)) == (2.0, 2.0, 4.0)
"""


def _cache(dice: random.Random, folder: Path) -> Case:
    """Damaged files of compiled code of a small copy of the package."""
    import hydrotele

    shutil.copytree(Path(hydrotele.__file__).parent / "core", folder / "hydrotele/core")
    (folder / "hydrotele/__init__.py").write_text("")
    (folder / "hydrotele/law.py").write_text(_LAW)
    code = f"import os, sys; os.environ['XDG_CACHE_HOME'] = {str(folder)!r}; sys.path.insert(0, {str(folder)!r})"
    program = sys.executable, "-c", f"{code}; import hydrotele.law"
    subprocess.run(program, check=True, cwd=folder, capture_output=True)
    files = [path for path in (folder / "hydrotele/compiled").rglob("*") if path.is_file()]
    contents = {path: path.read_bytes() for path in files}
    for path in dice.sample(files, dice.randint(1, len(files))):
        content = bytearray(contents[path])
        match dice.randrange(6):
            case 0:
                path.write_bytes(content[: dice.randint(0, len(content))])
            case 1 if content:
                content[dice.randrange(len(content))] ^= 1 << dice.randrange(8)
                path.write_bytes(content)
            case 2:
                path.write_bytes(contents[dice.choice(files)])
            case 3:
                path.unlink()
            case 4:
                path.unlink()
                path.mkdir()
            case _:
                path.chmod(0)
    return Case("cache", (), program=program)


def _plain_log(dice: random.Random) -> list[list[str]]:
    """Header and rows of a log of the rig as text."""
    rows = dice.choice([12, 50, 400])
    columns = [0.01 * np.arange(rows), *(np.sin(0.05 * np.arange(rows) + k) for k in range(2))]
    return [
        ["time", "command.slide", "position.slide"],
        *([f"{x:.4f}" for x in row] for row in zip(*columns, strict=True)),
    ]


def _time_column(dice: random.Random, folder: Path) -> list[str]:
    """A log whose clock has another unit, origin, form or order, or holes."""
    table = _plain_log(dice)
    time_ = np.array([float(row[0]) for row in table[1:]])
    how = dice.randrange(9)
    a, b = sorted(dice.sample(range(len(time_)), 2))
    origin, factor = dice.choice([0.0, -5.0, 1.7e9, 1e15]), dice.choice([1.0, 1e3, 1e6, 1e9, -1.0, 0.0])
    texts = [repr(origin + factor * float(t)) for t in time_]
    if how == 1:
        texts = [f"2026-0{dice.choice([1, 9])}-01T12:{int(t) // 60 % 60:02d}:{t % 60:06.3f}Z" for t in time_]
    elif how == 2:
        texts[a] = dice.choice(["", "nan", "inf", "-", "2026-13-45", "1e999", "00:00:01", "0x10", "１"])
    elif how == 3:
        texts[a:b] = texts[a:b][::-1]
    elif how == 4:
        texts[b:] = [texts[a]] * len(texts[b:])
    elif how == 5:
        texts = texts[a:] + texts[:a]
    elif how == 6:
        table[0][0] = dice.choice(["", "Time [ms]", "t", "stamp", "time [furlong]", "time (s)", "TIME", "time.1"])
    elif how == 7:
        table[0][1] = table[0][0]
    for row, text in zip(table[1:], texts, strict=True):
        row[0] = text
    (folder / "log.csv").write_text("\n".join(",".join(row) for row in table), encoding="utf-8")
    return dice.choice([["validate", "log.csv"], ["replay", "log.csv", "--machine", "rig", "--json"]])


def _dialect(dice: random.Random, folder: Path) -> list[str]:
    """A log in another CSV dialect: separator, decimal comma, quotes, comments, line ends, encoding."""
    table = _plain_log(dice)
    separator, decimal = dice.choice(",;\t| :"), dice.choice("..,'")
    quote, end = dice.choice(["", "", '"', "'"]), dice.choice(["\n", "\r\n", "\r", "\n\n"])
    lines = [separator.join(f"{quote}{x.replace('.', decimal) if k else x}{quote}" for x in row)
             + dice.choice(["", "", separator]) for k, row in enumerate(table)]  # fmt: skip
    for _ in range(dice.choice([0, 0, 1, 3])):
        odd = ["# comment", "", "sep=;", "units;s;1;m", quote, "\ufeff", "Zähler; é", '"' * 3, ",".join("1" * 900)]
        lines.insert(dice.randrange(len(lines)), dice.choice(odd))
    encoding = dice.choice(["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252", "utf-32"])
    (folder / "log.csv").write_bytes(end.join(lines).encode(encoding, "replace"))
    return dice.choice([["validate", "log.csv"], ["replay", "log.csv", "--machine", "rig", "--json"]])


_BASES = {
    "identify": ["--data", "data", "--machine", "rig", "--json", "--out", "out"],
    "replay": ["data/fit_2.parquet", "--machine", "rig", "--json"],
    "compare": ["rig", "--data", "data", "--json"],
    "validate": ["data/fit_2.parquet"],
    "review": ["data/fit_2.parquet", "--out", "out.rrd"],
    "export": ["rig", "--out", "scene.xml"],
    "list": [],
    "run": ["rig_steps", "--set", "duration=0.3", "--no-review", "--out", "out"],
}
_LASTING = {"--serve", "--screenshot", "--video", "--version", "--effects"}
_OPTION_VALUES: dict[type, tuple[str, ...]] = {
    float: ("nan", "inf", "-inf", "-1", "0", "1e-320", "1e308", "1e999", "0.5", "x", ""),
    int: ("-1", "0", "1", "65535", "99999999999", "9" * 5000, "1.5", "x"),
    str: ("", "x", "nan", "1,5", "a=b", "seed=-1", "=", "é", "[/red]", "../..", "servo.lead=nan", "0" * 5000),
    Path: ("missing", ".", "/dev/null", "/dev/zero", "data", "loop", "/", "x" * 300, "out.png", ""),
}


def _options(dice: random.Random, folder: Path) -> list[str]:
    """A command with one to three options, with values of their declared types and others."""
    from hydrotele.cli.main import app

    (folder / "data").mkdir()
    for name, log in _rig_runs().items():
        save_log(log, folder / f"data/{name}.parquet")
    (folder / "loop").symlink_to("loop")
    command = dice.choice(sorted(_BASES))
    function = next(c.callback for c in app.registered_commands
                    if c.callback and (c.name or c.callback.__name__) == command)  # fmt: skip
    words = [command, *_BASES[command]]
    declared = []
    for name, hint in get_type_hints(function, include_extras=True).items():
        kind, *facts = get_args(hint) if get_origin(hint) is Annotated else (None,)
        option = next((f for f in facts if type(f).__name__ == "OptionInfo"), None)
        names = option and [
            d for d in option.param_decls or (f"--{name.strip('_').replace('_', '-')}",) if d.startswith("--")
        ]
        if names and names[0] not in _LASTING:
            kinds = {kind, *get_args(kind), *(k for part in get_args(kind) for k in get_args(part))}
            declared.append((names[0], next((t for t in _OPTION_VALUES if t in kinds), bool)))
    for name, kind in dice.sample(declared, min(len(declared), dice.randint(1, 3))):
        values = _OPTION_VALUES.get(kind, ()) if dice.random() < 0.9 else _OPTION_VALUES[str]
        words += [name, dice.choice(values)] if values else [name]
    return words


def _growth(dice: random.Random, folder: Path) -> Case:
    """A file of n and of 4 n entries."""
    form = dice.choice(sorted(_GROWING))
    names = [_GROWING[form](size, folder / f"{k}_{form}") for k, size in enumerate((1000, 4000))]
    return Case("growth", ("validate", names[0]), ("validate", names[1]))


def _growing_sweep(text: Callable[[int], str], size: int, path: Path) -> str:
    path.with_suffix(".yaml").write_text(f"scenario: rig_steps\n{text(size)}")
    return str(path.with_suffix(".yaml"))


def _growing_machine(text: Callable[[int], str], size: int, path: Path) -> str:
    shutil.copytree(models_folder() / "rig", path)
    with (path / "machine.yaml").open("a") as file:
        file.write(text(size))
    return str(path)


def _growing_log(size: int, path: Path) -> str:
    rows = "".join(f"{0.01 * k:.2f},{k % 7}\n" for k in range(20 * size))
    path.with_suffix(".csv").write_text("time,position.slide\n" + rows)
    return str(path.with_suffix(".csv"))


_GROWING: dict[str, Callable[[int, Path], str]] = {
    "grid values": functools.partial(
        _growing_sweep, lambda n: f"grid: {{servo.lead: {[k / 1e5 for k in range(n)]}}}\n"
    ),
    "grid keys": functools.partial(
        _growing_sweep, lambda n: "repeat: 2\nset:\n" + "".join(f"  servo.k{k}: 1\n" for k in range(n))
    ),
    "choices": functools.partial(
        _growing_sweep,
        lambda n: f"sample: {{count: {n}, keys: {{servo.lead: {{choice: {[k / 1e5 for k in range(n)]}}}}}}}\n",
    ),
    "terms": functools.partial(
        _growing_machine,
        lambda n: (
            "terms:\n"
            + "".join(
                f"- {{name: w{k}, axis: slide, balance: force, law: constant, parameters: {{value: 0.0}}}}\n"
                for k in range(n // 4)
            )
        ),
    ),
    "log rows": _growing_log,
}


_MAKERS: dict[str, Callable[[random.Random, Path], list[str] | Case]] = {
    "machine": _machine, "mjcf": _mjcf, "scenario": _scenario, "sweep": _sweep,
    "joystick": _joystick, "teleop case": _teleop, "parquet": _parquet, "csv": _csv,
    "run folder": _run_folder, "data folder": _data_folder, "nested mjcf": _nested_mjcf,
    "cache": _cache, "time column": _time_column, "dialect": _dialect, "options": _options,
    "growth": _growth,
}  # fmt: skip


_LONG = {"teleop case", "data folder", "cache", "options", "growth"}  # take seconds: fewer of them


def _ready() -> None:
    """Load what every case needs, so that the children need not."""
    from hydrotele.machine.machine_file import load_machine
    from hydrotele.simulate.plant import build_plant, rest_state

    rest_state(build_plant(load_machine("cat215")))
    _rig_runs()


def _compile_once() -> None:
    """What the commands compile when they first run is no part of a case's time."""
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "data").mkdir()
        for run, log in _rig_runs().items():
            save_log(log, Path(name) / f"data/{run}.parquet")
        teleop = ["analyse", "teleop", "--json"]
        runs = [
            ["run", file.stem, "--set", "duration=0.3", "--out", file.stem, "--no-review"]
            for file in sorted(scenarios_folder().glob("*.yaml"))
        ]
        for words in (*_FITTING, teleop, *runs):
            _command(words, name)


def main() -> None:
    """Judge cases, print the defects and how many there were of each kind."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; others count up")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, metavar="SEED", help="make this case, and keep its files")
    args = parser.parse_args()
    if args.only is not None:
        folder = Path(tempfile.mkdtemp(prefix="hydrotele_fuzz_"))
        print(folder, *make_case(args.only, folder).arguments)
        print(judge(args.only))
        return
    _compile_once()
    begin, found, kinds = time.monotonic(), Counter(), Counter()
    with ProcessPoolExecutor(args.jobs, get_context("spawn"), _ready) as pool:
        seeds = range(args.seed, args.seed + args.count)
        for verdict in pool.map(judge, seeds, chunksize=10):
            kinds[verdict.kind] += 1
            if kinds.total() % 500 == 0:
                print(f"{kinds.total()} of {args.count} cases", file=sys.stderr, flush=True)
            if verdict.defect:
                found[verdict.defect] += 1
                words = " ".join(verdict.words.split())[-300:]
                print(f"{verdict.seed} {verdict.kind}: {verdict.defect}, {words}", flush=True)
    seconds = time.monotonic() - begin
    print(f"{args.count} cases from seed {args.seed} in {seconds:.0f} s: {dict(kinds)}")
    print(f"defects: {dict(found) or 'none'}")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
