"""Run the code cells of a MyST notebook in the current folder: python run_notebook.py NOTEBOOK [--small JSON].

Needs neither Jupyter nor IPython. Commands after `!` that begin with `hydrotele` run in this process,
others in a shell; their exit status must be 0. With `--small`, the cell tagged `parameters` is replaced
by the given values, and cells tagged `slow` or `learn` are left out. A cell tagged `raises-exception`
must fail.
"""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

CELL = re.compile(r"^```\{code-cell\}[^\n]*\n(.*?)^```$", re.M | re.S)
TAGS = re.compile(r"\A:tags: \[(.*)\]\n\n?")
COMMAND = re.compile(r"^( *)!(.+)$", re.M)


class Cell(NamedTuple):
    """Code of a cell and its tags."""

    code: str
    tags: tuple[str, ...]


def read_cells(path: Path) -> list[Cell]:
    """Return the code cells of a notebook."""
    cells = []
    for code in CELL.findall(path.read_text(encoding="utf-8")):
        tags = TAGS.match(code)
        cells.append(Cell(code[tags.end() :] if tags else code, tuple(tags[1].split(", ")) if tags else ()))
    return cells


def run_cell(code: str, names: dict) -> None:
    """Run the code of a cell with these global variables."""
    if code.startswith("%%writefile "):
        line, _, text = code.partition("\n")
        Path(line.split()[1]).write_text(text, encoding="utf-8")
        return
    code = code.replace("from IPython.display import Image\n", "")
    exec(COMMAND.sub(lambda match: f"{match[1]}_run_command({match[2]!r})", code), names)


def make_command_runner(names: dict):
    """Return the function that runs a command line, in which `{NAME}` stands for a variable."""

    def run_command(line: str) -> None:
        import shlex

        from typer.testing import CliRunner

        from hydrotele.cli.main import app

        line = re.sub(r"\{(\w+)\}", lambda match: str(names[match[1]]), line)
        if not line.startswith("hydrotele ") or set("|>") & set(line):
            subprocess.run(line.replace("hydrotele ", f"{sys.executable} -m hydrotele "), shell=True, check=True)
            return
        done = CliRunner().invoke(app, shlex.split(line)[1:])
        if done.exit_code:
            raise RuntimeError(f"{line}: status {done.exit_code}\n{done.output}") from done.exception

    return run_command


def run_notebook(path: Path, small: dict | None) -> None:
    """Run all cells of a notebook."""
    import matplotlib

    matplotlib.use("agg")
    names: dict = {"__name__": "notebook", "Image": lambda file, **options: Path(file).read_bytes()}
    names["_run_command"] = make_command_runner(names)
    for cell in read_cells(path):
        if small is not None and {"slow", "learn"} & set(cell.tags):
            continue
        if small is not None and "parameters" in cell.tags:
            names |= small
        elif "raises-exception" in cell.tags:
            try:
                run_cell(cell.code, names)
            except Exception as error:
                print(f"as stated, this cell fails: {error}")
            else:
                raise RuntimeError(f"this cell must fail:\n{cell.code}")
        else:
            run_cell(cell.code, names)


if __name__ == "__main__":
    run_notebook(Path(sys.argv[1]), json.loads(sys.argv[3]) if "--small" in sys.argv else None)
