"""Rooms import downwards only, files and signatures stay short, heavy libraries load late."""

import ast
import functools
import graphlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "hydrotele"

# Bottom first. A room is a folder directly under hydrotele; it sees every floor below its own.
# Rooms of one floor see each other, in one direction only, unless the floor is in WALLED.
FLOORS = (
    ("core",),
    ("terms", "machine", "effects"),
    ("kinematics", "hydraulics", "multibody", "soil"),
    ("logs",),
    ("scenario",),
    ("estimate",),
    ("identify",),
    ("simulate", "convert"),
    ("control", "batch"),
    ("teleop",),
    ("haptics",),
    ("run",),
    ("calibrate", "gap"),
    ("experiments",),
    ("importers",),
    ("show",),
    ("envs",),
    ("cli",),
    ("__main__",),  # a file: `python -m hydrotele`
)
WALLED = {"calibrate", "identify", "gap"}
_FACTS = set().union(*FLOORS[:6])
# Rooms that see less than all the floors below.
ONLY = {
    "kinematics": {"core", "machine"},
    "soil": {"core"},
    "simulate": _FACTS - {"logs", "estimate"},
    "identify": _FACTS,
    "calibrate": {*_FACTS, "identify"},
    "gap": {*_FACTS, "identify"},
}

HEAVY = {"rerun": {"show", "envs"}, "matplotlib": {"show", "envs"}, "gymnasium": {"show", "envs"}}
MAX_LINES = 1000
MAX_ARGUMENTS = 10  # what belongs together is a record
# Functions of `cli` have one argument per option of a command and are not looked at.
LONGER = {
    # Options of an optimiser by keyword, as SciPy's function of that name has them.
    "calibrate/estimation.py:least_squares",
}
STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)
UNFINISHED = re.compile(r"\b(?:TODO|FIXME|XXX|HACK)\b")
MACHINE_PATH = re.compile(r"(?<![\w.:/~$}-])/(?:work|home|root|Users|mnt|srv|tmp)/\w")


class Import(NamedTuple):
    """One imported module, seen in one line of a file."""

    module: str
    line: int
    at_top: bool


def floor_of(room: str) -> int | None:
    return next((level for level, rooms in enumerate(FLOORS) if room in rooms), None)


def may_import(room: str, other: str) -> bool:
    """Whether one placed room may import another placed room."""
    if room == other:
        return True
    if room in ONLY:
        return other in ONLY[room]
    here, there = FLOORS[floor_of(room)], FLOORS[floor_of(other)]
    if here == there:
        return room not in WALLED
    return FLOORS.index(there) < FLOORS.index(here)


def modules_of(root: Path) -> dict[str, Path]:
    """Every module of the package under `root`, by its dotted name."""
    modules = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


def room_of(module: str) -> str:
    """`hydrotele.simulate.plant` is in the room `simulate`; the package itself has no room."""
    return (module.split(".") + [""])[1]


def imports_of(path: Path, root: Path, module: str) -> Iterator[Import]:
    """Every import statement of a file, with relative names made absolute."""
    is_package, calls = path.name == "__init__.py", "import_module" in path.read_text(encoding="utf-8")
    for node, at_top in walk_imports(tree_of(path, root), calls):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(alias.name, node.lineno, at_top)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".") + ([""] if is_package else [])
                base = ".".join(parts[: -node.level] + ([base] if base else []))
            for alias in node.names:
                yield Import(f"{base}.{alias.name}", alias.lineno, at_top)
        else:  # a call of import_module
            if node.args and isinstance(node.args[0], ast.Constant):
                yield Import(str(node.args[0].value), node.lineno, at_top)


def walk_imports(tree: ast.AST, calls: bool) -> Iterator[tuple[Any, bool]]:
    """Import statements and, if asked, calls of `import_module`; whether importing the file executes them.

    Without calls only statements are visited, a tenth of the nodes.
    """
    nodes: list[tuple[Any, bool]] = [(tree, True)]
    while nodes:
        node, at_top = nodes.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, at_top
            continue
        if isinstance(node, ast.Call) and dotted_end(node.func).endswith("import_module"):
            yield node, at_top
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            at_top = False
        typing_only = isinstance(node, ast.If) and any(
            dotted_end(part) == "TYPE_CHECKING" for part in ast.walk(node.test)
        )
        executed = node.orelse if typing_only else ast.iter_child_nodes(node)
        if not calls:
            executed = [child for child in executed if isinstance(child, STATEMENTS)]
        children = [(child, at_top) for child in executed]
        children += [(child, False) for child in (node.body if typing_only else ())]
        nodes += reversed(children)


def dotted_end(node: ast.AST) -> str:
    """`import_module` of `importlib.import_module`; empty for what is no name."""
    return getattr(node, "attr", getattr(node, "id", ""))


def known_module(name: str, modules: Iterable[str]) -> str | None:
    """The module that an imported name is or lies in."""
    while name and name not in modules:
        name = name.rpartition(".")[0]
    return name or None


def tree_of(path: Path, root: Path) -> ast.Module:
    """Syntax tree of a file; of a file of this repository it is kept."""
    return kept_tree(path) if root == ROOT else ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def kept_tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def import_problems(root: Path) -> list[str]:
    """What is wrong with the imports of the package under `root`, one sentence each."""
    modules = modules_of(root)
    problems = [
        f"{PACKAGE}.{room} has no floor; place it in FLOORS of tests/test_architecture.py"
        for room in sorted({room_of(module) for module in modules} - {""})
        if floor_of(room) is None
    ]
    graph: dict[str, set[str]] = {module: set() for module in modules}
    for module, path in modules.items():
        room, where = room_of(module), path.relative_to(root).as_posix()
        for name, line, at_top in imports_of(path, root, module):
            library = name.partition(".")[0]
            if at_top and library in HEAVY and room not in HEAVY[library]:
                problems.append(f"{where}:{line} imports {library} at the top of the file")
            if library != PACKAGE:
                continue
            target = known_module(name, modules)
            if target is None or target == PACKAGE != name:
                problems.append(f"{where}:{line} imports {name}, which there is not")
                continue
            if target != module:
                graph[module].add(target)
            other = room_of(target)
            if room == "":
                problems.append(f"{where}:{line} imports {target}; the package imports no room")
            elif None not in (floor_of(room), floor_of(other)) and not may_import(room, other):
                problems.append(f"{where}:{line} {room} may not import {target}")
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        problems.append("import cycle: " + " <- ".join(error.args[1]))
    return list(dict.fromkeys(problems))


def test_no_room_reaches_up_or_sideways():
    assert import_problems(ROOT) == []


def test_every_room_has_one_floor():
    rooms = [room for floor in FLOORS for room in floor]
    assert len(rooms) == len(set(rooms))
    assert WALLED | set(ONLY) <= set(rooms)


@pytest.mark.parametrize(
    ("path", "text", "problem"),
    [
        ("kinematics/arm.py", "from hydrotele.simulate import plant", "may not import"),
        ("kinematics/arm.py", "from hydrotele import logs", "may not import"),
        ("kinematics/arm.py", "from ..logs.log import Log", "may not import"),
        ("kinematics/__init__.py", "from ..logs.log import Log", "may not import"),
        ("machine/late.py", "def late():\n    import hydrotele.run.interactive_run", "may not import"),
        ("simulate/late.py", "import hydrotele.control", "may not import"),
        ("gap/proof.py", "from hydrotele.simulate import plant", "may not import"),
        ("identify/proof.py", "from hydrotele.simulate import plant", "may not import"),
        ("gap/proof.py", "from hydrotele import run", "may not import"),
        ("core/signals.py", "from hydrotele.machine.machine import Machine", "may not import"),
        ("run/interactive_run.py", "import importlib\nimportlib.import_module('hydrotele.cli')", "may not"),
        ("__init__.py", "from hydrotele.machine.machine import Machine", "imports no room"),
        ("run/interactive_run.py", "from hydrotele.missing import thing", "which there is not"),
        ("plumbing.py", "import math", "has no floor"),
        ("core/errors.py", "from hydrotele.core.units import metre", "import cycle"),
        ("simulate/plant.py", "from hydrotele.simulate import native", "import cycle"),
        ("run/interactive_run.py", "import rerun as rr", "at the top"),
        (
            "run/interactive_run.py",
            "try:\n    from matplotlib import pyplot\nexcept ImportError:\n    pass",
            "at the top",
        ),
        ("simulate/plant.py", "class A:\n    import gymnasium", "at the top"),
    ],
)
def test_checker_finds_a_forged_violation(tmp_path, path, text, problem):
    forge(tmp_path)
    assert import_problems(tmp_path) == []
    target = tmp_path / PACKAGE / path
    target.parent.mkdir(exist_ok=True)
    target.write_text(text + "\n", encoding="utf-8")
    assert any(problem in found for found in import_problems(tmp_path))


def forge(root: Path) -> None:
    """Write a small package that keeps every rule."""
    files = {
        "__init__.py": "import importlib.metadata",
        "core/errors.py": "",
        "core/units.py": "from hydrotele.core.errors import InputError",
        "machine/machine.py": "from hydrotele.core.errors import InputError",
        "logs/__init__.py": "",
        "logs/log.py": "from hydrotele.machine import machine",
        "kinematics/__init__.py": "",
        "kinematics/arm.py": "from hydrotele.core.errors import InputError",
        "simulate/__init__.py": "",
        "simulate/plant.py": "from hydrotele.kinematics.arm import reach",
        "simulate/native.py": "from .plant import Plant",
        "control/__init__.py": "from hydrotele.logs.log import Log",
        "identify/fit.py": "from hydrotele.kinematics import arm",
        "run/__init__.py": "",
        "run/interactive_run.py": "from .. import control\nfrom ..simulate.native import install",
        "show/__init__.py": "import rerun\nfrom hydrotele.simulate import plant",
        "cli/__init__.py": "",
        "cli/main.py": "def show():\n    import rerun\n    from hydrotele import run, show",
    }
    for name, text in files.items():
        path = root / PACKAGE / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")


def texts(*patterns: str) -> Iterator[tuple[str, list[str]]]:
    """Name and lines of every text file that a pattern finds under the repository root."""
    for pattern in patterns:
        for path in sorted(ROOT.glob(pattern)):
            if not path.is_file() or "__pycache__" in path.parts:
                continue
            try:
                yield path.relative_to(ROOT).as_posix(), path.read_text("utf-8").splitlines()
            except UnicodeDecodeError:
                continue  # a picture


def long_signatures() -> set[str]:
    """Functions with more than `MAX_ARGUMENTS` arguments, without `self`."""
    found, package = set(), ROOT / PACKAGE
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package).as_posix()
        for node in ast.walk(kept_tree(path)):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            a = node.args
            arguments = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            count = len(arguments) - (arguments[:1] in (["self"], ["cls"]))
            if count > MAX_ARGUMENTS and not name.startswith("cli/"):
                found.add(f"{name}:{node.name}")
    return found


def test_no_function_takes_more_than_ten_arguments():
    assert long_signatures() == LONGER


def test_files_are_short():
    lengths = {name: len(lines) for name, lines in texts(f"{PACKAGE}/**/*.py")}
    assert lengths
    assert {name: n for name, n in lengths.items() if n > MAX_LINES} == {}


def test_nothing_is_left_unfinished():
    found = [
        f"{name}:{number}"
        for name, lines in texts(f"{PACKAGE}/**/*", "models/**/*", "scenarios/**/*")
        for number, line in enumerate(lines, 1)
        if UNFINISHED.search(line)
    ]
    assert found == []


def test_no_file_names_a_path_of_one_machine():
    patterns = [f"{folder}/**/*" for folder in (PACKAGE, "models", "scenarios", "tests", "tools")]
    found = [
        f"{name}:{number}: {line.strip()}"
        for name, lines in texts(*patterns, "docs/**/*", ".ci/*", "*.md", "*.toml", "*.txt")
        for number, line in enumerate(lines, 1)
        if MACHINE_PATH.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("folder", ["work", "home", "root", "Users", "tmp"])
def test_machine_paths_are_recognised(folder):
    assert MACHINE_PATH.search(f'open("/{folder}/someone/log.parquet")')
    assert not MACHINE_PATH.search(f"https://example.org/{folder}/page")
