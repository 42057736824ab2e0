"""No function takes more than ten arguments; what belongs together is a record."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "hydrotele"
MOST = 10
# Functions of `cli` have one argument per option of a command and are not looked at.
LONGER = {
    # Options of an optimiser by keyword, as SciPy's function of that name has them.
    "calibrate/estimation.py:least_squares",
}


def long_signatures() -> set[str]:
    found = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            a = node.args
            arguments = [one.arg for one in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
            count = len(arguments) - (arguments[:1] in (["self"], ["cls"]))
            if count > MOST and not name.startswith("cli/"):
                found.add(f"{name}:{node.name}")
    return found


def test_no_function_takes_more_than_ten_arguments():
    assert long_signatures() == LONGER
