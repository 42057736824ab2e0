"""Break random lines of the package, one at a time, and count how many the tests find.

    python tools/validation/mutation_check.py                       # 40 lines, two at a time
    python tools/validation/mutation_check.py --list                # the lines and changes
    python tools/validation/mutation_check.py --suite ../old        # tests of another checkout

A random statement of five packages is changed in one place: an operator or a comparison is
replaced, a number or a condition changed, a sign removed. The tests of the package of that line
run first, then all others, until one fails. Each change is made in a copy of the package, with a
copy of the user's cache of compiled code. OUT/mutants.jsonl holds one line per change; a change
that is already there is not judged again.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("hydraulics", "estimate", "control", "kinematics", "identify")
TIMEOUT = 2400.0
"""Seconds after which a run of tests counts as one that found the change: it hangs."""

OPERATORS = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.Pow: ("**", "*"), ast.MatMult: ("@", "+"), ast.FloorDiv: ("//", "*"),
    ast.Lt: ("<", ">="), ast.LtE: ("<=", ">"), ast.Gt: (">", "<="), ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.And: ("and", "or"), ast.Or: ("or", "and"),
    ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}  # fmt: skip


class Mutant(NamedTuple):
    """One change of the source.

    Attributes:
        path: of the module, from the repository's root.
        line: its line, counted from 1.
        begin: first character of the change in the file.
        end: the one behind it.
        text: what stands there instead.
        before: the line as it is.
        after: the line as it becomes.
    """

    path: str
    line: int
    begin: int
    end: int
    text: str
    before: str
    after: str


def list_changes(path: Path) -> list[Mutant]:
    """List every possible change of a module, without those of docstrings and annotations."""
    source = path.read_text(encoding="utf-8")
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    data = source.encode()

    def place(line: int, column: int) -> int:
        return starts[line - 1] + column

    found: list[Mutant] = []

    def add(line: int, begin: int, end: int, text: str) -> None:
        first, last = starts[line - 1], starts[line]
        if end > last:
            return
        before = data[first:last].decode().strip()
        after = (data[first:begin] + text.encode() + data[end:last]).decode().strip()
        found.append(Mutant(path.relative_to(ROOT).as_posix(), line, begin, end, text, before, after))

    def replace_between(left: ast.AST, right: ast.AST, kind: type) -> None:
        if kind not in OPERATORS:
            return
        old, new = OPERATORS[kind]
        begin, end = (
            place(left.end_lineno, left.end_col_offset),
            place(right.lineno, right.col_offset),
        )
        at = data.find(old.encode(), begin, end)
        if at >= 0:
            add(data[:at].count(b"\n") + 1, at, at + len(old), new)

    def visit(node: ast.AST, body: bool) -> None:
        if isinstance(node, ast.FunctionDef):
            for child in node.body:
                visit(child, True)
            return
        if isinstance(node, ast.ClassDef):
            for child in node.body:
                if isinstance(child, ast.FunctionDef):
                    visit(child, True)
            return
        if isinstance(node, ast.AnnAssign):
            if node.value is not None:
                visit(node.value, body)
            return
        if isinstance(node, ast.Raise):  # the text of messages
            return
        if body:
            if isinstance(node, ast.BinOp):
                if not isinstance(node.left, ast.Constant | ast.JoinedStr) or not isinstance(
                    getattr(node.left, "value", 0), str
                ):
                    replace_between(node.left, node.right, type(node.op))
            elif isinstance(node, ast.BoolOp):
                replace_between(node.values[0], node.values[1], type(node.op))
            elif isinstance(node, ast.Compare):
                replace_between(node.left, node.comparators[0], type(node.ops[0]))
            elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
                at = place(node.lineno, node.col_offset)
                add(node.lineno, at, at + 1, "")
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                begin, end = (
                    place(node.lineno, node.col_offset),
                    place(node.end_lineno, node.end_col_offset),
                )
                add(
                    node.lineno,
                    begin,
                    end,
                    repr(node.value + 1 if node.value in (0, 1) else node.value * 2),
                )
            elif isinstance(node, ast.Constant) and type(node.value) is bool:
                begin, end = (
                    place(node.lineno, node.col_offset),
                    place(node.end_lineno, node.end_col_offset),
                )
                add(node.lineno, begin, end, repr(not node.value))
        for child in ast.iter_child_nodes(node):
            visit(child, body)

    visit(ast.parse(source), False)
    return sorted(set(found))


def draw_mutants(count: int, seed: int) -> list[Mutant]:
    """Draw lines without replacement, each with one of its changes."""
    lines: dict[tuple[str, int], list[Mutant]] = {}
    for package in PACKAGES:
        for path in sorted((ROOT / "hydrotele" / package).rglob("*.py")):
            for mutant in list_changes(path):
                lines.setdefault((mutant.path, mutant.line), []).append(mutant)
    rng = random.Random(seed)
    return [rng.choice(lines[key]) for key in rng.sample(sorted(lines), count)]


def judge_mutant(mutant: Mutant, suite: Path, only: list[str]) -> dict:
    """Run the tests on a copy of the package with one change until one of them fails."""
    with tempfile.TemporaryDirectory(prefix="mutant_") as name:
        folder = Path(name, "main")
        folder.mkdir()
        for part in ("hydrotele", "models", "scenarios", "pyproject.toml", "README.md", "docs",
                     "uv.lock", "LICENSE", "CHANGELOG.md", ".ci", ".gitignore"):  # fmt: skip
            source = ROOT / part
            if source.is_dir():
                shutil.copytree(source, folder / part)
            elif source.is_file():
                shutil.copy(source, folder / part)
        for part in ("tests", "tools"):
            shutil.copytree(suite / part, folder / part)
        if (ROOT.parent / "shared").exists():
            Path(name, "shared").symlink_to((ROOT.parent / "shared").resolve())
        (folder / ".venv").symlink_to(ROOT / ".venv")
        path = folder / mutant.path
        data = path.read_bytes()
        path.write_bytes(data[: mutant.begin] + mutant.text.encode() + data[mutant.end :])
        cache = Path(name, "cache", "hydrotele")
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        shutil.copytree(home / "hydrotele", cache)
        cache.chmod(0o700)
        environment = {**os.environ, "PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(cache.parent),
                       "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}  # fmt: skip
        own = f"tests/{Path(mutant.path).parts[1]}"
        rounds = [only] if only else [[own], ["tests", f"--ignore={own}"]]
        began, failed = time.monotonic(), ""
        for chosen in rounds:
            command = [str(ROOT / ".venv/bin/python"), "-m", "pytest", "-q", "-x", "-p",
                       "no:cacheprovider", *chosen]  # fmt: skip
            try:
                done = subprocess.run(
                    command, cwd=folder, env=environment, capture_output=True, text=True,
                    check=False, timeout=TIMEOUT,
                )  # fmt: skip
            except subprocess.TimeoutExpired:
                failed = "timeout"
                break
            if done.returncode not in (0, 5):
                lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
                failed = lines[0][:200] if lines else (done.stdout + done.stderr)[-300:]
                break
    return {
        **mutant._asdict(),
        "found": bool(failed),
        "by": failed,
        "seconds": time.monotonic() - began,
    }


def main() -> int:
    """Judge the mutants."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "mutation")
    parser.add_argument("--suite", type=Path, default=ROOT, help="checkout whose tests are run")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=58)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--survivors", type=Path, help="judge only what OUT/mutants.jsonl says survived")
    parser.add_argument("--list", action="store_true", help="print the changes, judge nothing")
    parser.add_argument("tests", nargs="*", help="pytest arguments instead of the whole suite")
    args = parser.parse_args()
    mutants = draw_mutants(args.count, args.seed)
    if args.survivors:
        judged = [json.loads(line) for line in args.survivors.read_text().splitlines()]
        left = {(j["path"], j["line"]) for j in judged if not j["found"]}
        mutants = [m for m in mutants if (m.path, m.line) in left]
    if args.list:
        for m in mutants:
            print(f"{m.path}:{m.line}\n    - {m.before}\n    + {m.after}")
        return 0
    args.out.mkdir(parents=True, exist_ok=True)
    record = args.out / "mutants.jsonl"
    done = [json.loads(line) for line in record.read_text().splitlines()] if record.is_file() else []
    seen = {(d["path"], d["line"], d["after"]) for d in done}
    todo = [m for m in mutants if (m.path, m.line, m.after) not in seen]
    with ThreadPoolExecutor(args.jobs) as pool, record.open("a") as out:
        for result in pool.map(lambda m: judge_mutant(m, args.suite, args.tests), todo):
            done.append(result)
            out.write(json.dumps(result) + "\n")
            out.flush()
            said = f"found by {result['by'][:90]}" if result["found"] else "NOT FOUND"
            print(
                f"{result['path']}:{result['line']}  {said}  ({result['seconds']:.0f} s)",
                flush=True,
            )
    found = sum(d["found"] for d in done)
    print(f"{found} of {len(done)} broken lines found")
    return 0


if __name__ == "__main__":
    sys.exit(main())
