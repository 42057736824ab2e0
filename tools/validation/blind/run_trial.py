"""Run one trial: make its data if they are missing, run the workflow, keep the answer."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydrotele.core.errors import InputError
from tools.validation.blind.trials import Place, write_json

ROOT = Path(__file__).resolve().parents[3]
_SCRIPT = ROOT / "tools" / "validation" / "blind" / "workflow.py"
WORKFLOW = (sys.executable, str(_SCRIPT), "{data}", "{machine}", "{threads}")
PASSED = (  # all of the environment that the workflow sees
    "PATH", "HOME", "LANG", "LC_ALL", "TMPDIR", "NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "MPLCONFIGDIR",
)  # fmt: skip


def run_trial(
    place: Place,
    machine: str,
    workflow: Sequence[str] = WORKFLOW,
    limit: float = 1800.0,
    threads: int = 1,
) -> dict[str, Any]:
    """Run one trial anew, with the data that it has or with new ones.

    Args:
        place: where its files lie.
        machine: name of the nominal machine.
        workflow: command; `{data}`, `{machine}` and `{threads}` are filled in.
        limit: wall time after which the workflow counts as failed [s].
        threads: that the workflow may use.

    Returns:
        What the result file then holds: `answer` (a `gap.json` document, or None with the reason in
        `error`) and `wall_seconds`.

    Raises:
        InputError: the data could not be made.
    """
    if not (place.data.is_dir() and place.key.is_file() and place.seal.is_file()):
        shutil.rmtree(place.data, ignore_errors=True)
        _make_data(place)
    begin = time.perf_counter()
    filled = {"machine": machine, "threads": threads}
    answer, error = ask(place.data, [part.format(data="{data}", **filled) for part in workflow], limit)
    result = {"trial": place.trial, "answer": answer, "error": error,
              "wall_seconds": round(time.perf_counter() - begin, 2)}  # fmt: skip
    write_json(place.result, result)
    return result


def _make_data(place: Place) -> None:
    command = [sys.executable, "-m", "tools.validation.blind.generate", str(place.out), place.trial]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"trial {place.trial}", f"no data: {done.stderr[-2000:]}")


def ask(data: Path, workflow: Sequence[str], limit: float) -> tuple[dict[str, Any] | None, str | None]:
    """Let the workflow answer, from a read-only copy of the logs in an unnamed folder.

    That folder takes the place of `{data}` in the command. The workflow sees neither the key's nor
    the series' folder in its arguments, environment or working folder.

    Returns:
        (answer, None) or (None, what went wrong).
    """
    with tempfile.TemporaryDirectory(prefix="logs_") as folder:
        copy = Path(folder, "data")
        copy.mkdir()
        for log in sorted(data.glob("*.parquet")):
            target = copy / log.name
            target.write_bytes(log.read_bytes())
            target.chmod(0o444)
        command = [part.replace("{data}", str(copy)) for part in workflow]
        environment = {name: os.environ[name] for name in PASSED if name in os.environ}
        environment["PYTHONPATH"] = str(ROOT)  # the search is this checkout's, as its stamp says
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                capture_output=True, text=True, timeout=limit, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return None, f"no answer after {limit:g} s"
    if done.returncode:
        return None, f"exit status {done.returncode}: {done.stderr[-2000:]}"
    try:
        return json.loads(done.stdout[done.stdout.index("{") :]), None
    except ValueError:
        return None, f"no JSON: {done.stdout[-500:]!r}"
