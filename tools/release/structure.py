"""Count packages, modules, lines and imports between packages; list the modules a command uses.

    python tools/release/structure.py            # packages, modules, lines, dependencies
    python tools/release/structure.py --arrows   # the same, and each dependency between packages
    python tools/release/structure.py -- run scenarios/dig.yaml --out runs/dig   # modules used

A dependency is a pair of packages below hydrotele of which one imports the other, anywhere in its
modules. A module is used by a command when one of its Python functions is called
while the command runs, other than by an import. Compiled functions call each other without Python
and are not counted.
"""

import argparse
import ast
import sys
import threading
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "hydrotele"


def room_of(path: Path) -> str:
    """Folder of a module below the package; the package itself for a module at its root."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else "hydrotele"


def imported_rooms(path: Path) -> set[str]:
    """Packages that a module imports, at its top or within functions."""
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        rooms |= {n.split(".")[1] for n in names if n.startswith("hydrotele.") and n.count(".")}
    return {room for room in rooms if (PACKAGE / room).is_dir()}


def passed_by(words: list[str]) -> tuple[Counter[str], int]:
    """Run a command of hydrotele; calls per module, and the command's exit status."""
    calls: Counter[str] = Counter()
    prefix, passed = f"{PACKAGE}/", set()

    def count(frame, event, _):
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(prefix) and name.endswith(".py"):
            caller = frame
            while caller and name not in passed:
                if caller.f_code.co_name == "<module>" and caller.f_code.co_filename != __file__:
                    return
                caller = caller.f_back
            passed.add(name)
            calls[name.removeprefix(prefix)] += 1

    from hydrotele.cli.main import main

    sys.argv = ["hydrotele", *words]
    threading.setprofile(count)
    sys.setprofile(count)
    try:
        status = main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
    return calls, int(status or 0)


def main() -> int:
    """Print the counts; the exit status is that of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arrows", action="store_true", help="list every dependency")
    parser.add_argument("command", nargs="*", help="command of hydrotele, after --")
    args = parser.parse_args()
    paths = sorted(PACKAGE.rglob("*.py"))
    modules, lines, arrows = Counter(), Counter(), set()
    for path in paths:
        room = room_of(path)
        modules[room] += 1
        lines[room] += len(path.read_text().splitlines())
        arrows |= {(room, other) for other in imported_rooms(path) if other != room}
    print(f"{'package':12} modules  lines  imports from")
    for room in sorted(modules):
        others = sorted(b for a, b in arrows if a == room)
        names = " ".join(others) if args.arrows else len(others)
        print(f"{room:12} {modules[room]:7} {lines[room]:6}  {names}")
    total = sum(modules.values()), sum(lines.values())
    print(f"{len(modules)} packages, {total[0]} modules, {total[1]} lines, {len(arrows)} dependencies")
    if not args.command:
        return 0
    calls, status = passed_by(args.command)
    for name, number in sorted(calls.items()):
        print(f"{number:9} calls  {name}")
    print(f"{len(calls)} modules used by: hydrotele {' '.join(args.command)}")
    return status


if __name__ == "__main__":
    raise SystemExit(main())
