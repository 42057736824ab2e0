"""No function takes more than ten arguments; what belongs together is a record."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "hydrotele"
MOST = 10
# Functions of `cli` have one argument per option of a command and are not looked at.
LONGER = {
    # Inlined into MuJoCo's callbacks, which cross these a million times a second with numbers that
    # lie in different structs of MuJoCo; the reduced model passes them from arrays of its own.
    "hydraulics/circuit.py:_flows_of_terms",
    "hydraulics/circuit.py:_delivery_of_terms",
    "hydraulics/circuit.py:step_circuit",
    "hydraulics/circuit.py:add_to_commands",
    "simulate/native.py:_state",
    "simulate/native.py:_advance_with_memory",
    # Filter and smoother of one run: the arguments of `track`, of which it is the second half.
    "estimate/track.py:_cross",
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
