"""Build wheels that contain the compiled functions, install them in empty environments and measure first use.

    python tools/release/build_wheel.py --out dist                                   # for the Python that runs this
    python tools/release/build_wheel.py --out dist --python python3.11 python3.12    # for others
    python tools/release/build_wheel.py --out dist --sdist           # also install the source distribution

For each Python the plain wheel is installed in an environment of its own. There `hydrotele compile` fills an
empty cache, which becomes the folder `hydrotele/compiled_code` of the wheel. The wheel is for one minor version
of Python; elsewhere pip installs the plain wheel.

Then `pip install` installs the wheel in another environment, and each task runs as a new user with an empty
cache. pip's output is kept in OUT/install_TAG.log, TAG being the wheel's name of the Python. The script prints a
table and ends with 1 if a command fails, a function is compiled or a task takes longer than its limit. Needs the
network.
"""

import argparse
import base64
import csv
import hashlib
import io
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
CODE_FOLDER = "hydrotele/compiled_code"
PLATFORM = "manylinux_2_17_x86_64"  # the code calls the C library's mathematical functions only
ZIP_TIME = (1980, 1, 1, 0, 0, 0)  # equal files give an equal wheel
MAKE = """
import gymnasium, hydrotele.envs
env = gymnasium.make("hydrotele/TrackTrajectory-v0")
env.reset(seed=0)
for _ in range(100):
    env.step(env.action_space.sample())
"""
GAP_RUNS = ("excitation", "excitation_fast", "excitation_stick", "excitation_boom")
GAP_EFFECT = "effects=[{name: valve_deadband, location: stick, parameters: {deadband: 0.055}}]"


class Task(NamedTuple):
    """A first use of the installed package.

    Attributes:
        name: what the table calls it.
        commands: arguments after the environment's `bin` folder.
        max_seconds: longest allowed time [s] on two free cores; None without limit.
    """

    name: str
    commands: list[list[str]]
    max_seconds: float | None


TASKS = (
    Task("gymnasium.make and 100 steps", [["python", "-c", MAKE]], 5.0),
    Task("hydrotele run dig", [["hydrotele", "run", "dig", "--out", "dig"]], 8.0),
    Task(
        "the README's gap example",
        [["hydrotele", "run", name, "--out", f"logs/{name}", "--set", GAP_EFFECT] for name in GAP_RUNS]
        + ["hydrotele gap --machine cat215 --data logs --heldout excitation_fast --out gap".split()],
        None,
    ),
)  # fmt: skip


class Measurement(NamedTuple):
    """Times of the commands of a task in one environment.

    Attributes:
        seconds: elapsed time [s].
        processor_seconds: processor time [s].
        compiled: number of functions that were compiled.
    """

    seconds: float
    processor_seconds: float
    compiled: int


def run(*command: str | Path, **options) -> str:
    """Run a command and return its output; end this script with the output if it fails."""
    done = subprocess.run(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}")
    return done.stdout


def make_environment(folder: Path, python: str, package: Path, log: Path) -> float:
    """Make an empty environment and install a wheel or source distribution there with pip.

    Args:
        folder: folder of the environment.
        python: interpreter.
        package: the wheel or source distribution.
        log: file to which pip's output is added.

    Returns:
        Elapsed time of `pip install` [s].
    """
    run(python, "-m", "venv", folder)
    start = time.monotonic()
    told = run(folder / "bin" / "python", "-m", "pip", "install", package, cwd=folder)
    seconds = time.monotonic() - start
    with log.open("a") as file:
        file.write(f"pip install {package.name}\n{told}{seconds:.0f} s\n\n")
    return seconds


def add_compiled_code(plain: Path, compiled: Path, python_tag: str, out: Path) -> Path:
    """Write a copy of a wheel that contains compiled code.

    Args:
        plain: wheel without compiled code.
        compiled: cache folder that `hydrotele compile` has filled.
        python_tag: tag of the Python version, such as "cp311".
        out: folder of the result.

    Returns:
        Path of the written wheel.
    """
    added = {
        f"{CODE_FOLDER}/{path.relative_to(compiled).as_posix()}": path.read_bytes()
        for path in sorted(compiled.rglob("*"))
        if path.suffix == ".code" or path.name.startswith("complete_")
    }
    tag = f"{python_tag}-none-{PLATFORM}"
    target = out / plain.name.replace("py3-none-any", tag)
    with zipfile.ZipFile(plain) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as wheel:
        files = {name: source.read(name) for name in source.namelist()} | added
        record = next(name for name in files if name.endswith(".dist-info/RECORD"))
        kind = record.replace("RECORD", "WHEEL")
        files[kind] = files[kind].replace(b"Tag: py3-none-any", f"Tag: {tag}".encode())
        table = io.StringIO()
        lines = csv.writer(table, lineterminator="\n")
        for name, content in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")
            lines.writerow([name, *(["", ""] if name == record else [f"sha256={digest}", len(content)])])
        files[record] = table.getvalue().encode()
        for name, content in files.items():
            entry = zipfile.ZipInfo(name, ZIP_TIME)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o100644 << 16
            wheel.writestr(entry, content)
    return target


def measure(commands: list[list[str]], environment: Path, home: Path) -> Measurement:
    """Run commands of an environment as a user with an empty cache, and measure them.

    Args:
        commands: arguments of each command after the `bin` folder.
        environment: folder of the environment.
        home: folder for the cache and the results.
    """
    home.mkdir(exist_ok=True)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    variables = kept | {"XDG_CACHE_HOME": str(home / "cache")}
    cached = len([*home.rglob("*.code")])
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    for program, *arguments in commands:
        run(environment / "bin" / program, *arguments, cwd=home, env=variables)
    after, seconds = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - start
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Measurement(seconds, spent, len([*home.rglob("*.code")]) - cached)


def measure_tasks(environment: Path, homes: Path, label: str, is_compiled: bool) -> tuple[list[str], bool]:
    """Measure all tasks in an environment.

    Args:
        environment: folder of the environment.
        homes: new folder for the users' caches and results.
        label: text that is added to the names of the tasks.
        is_compiled: whether the environment has compiled functions. If so, every task has a user of its own and
            a time limit, and must not compile.

    Returns:
        (rows of the table, whether a task compiled a function or took too long).
    """
    homes.mkdir()
    rows, failed = [], False
    for k, task in enumerate(TASKS):
        home = homes / (str(k) if is_compiled else "one")
        found = measure(task.commands, environment, home)
        limit = task.max_seconds if is_compiled else None
        failed |= is_compiled and (found.compiled > 0 or found.seconds > (limit or found.seconds))
        rows.append(
            f"| {task.name}{label} | {found.seconds:.1f} | {limit or ''} | {found.processor_seconds:.1f} |"
            f" {found.compiled} |"
        )
    return rows, failed


def build_and_measure(python: str, plain: Path, source: Path | None, out: Path, work: Path) -> tuple[list[str], bool]:
    """Build the wheel for a Python, install it, and the source distribution if given, and measure the tasks.

    Args:
        python: interpreter.
        plain: wheel without compiled code.
        source: source distribution; None to leave it out.
        out: folder of the wheel and of pip's output.
        work: new folder for the environments.

    Returns:
        (lines of the report, whether a task compiled a function or took too long).
    """
    work.mkdir()
    tag = run(python, "-c", "import sys; print(f'cp{sys.version_info.major}{sys.version_info.minor}')").strip()
    log = out / f"install_{tag}.log"
    log.unlink(missing_ok=True)
    make_environment(work / "build", python, plain, log)
    filled = measure([["hydrotele", "compile"]], work / "build", work / "filled")
    wheel = add_compiled_code(plain, work / "filled" / "cache" / "hydrotele" / "compiled", tag, out)
    install_seconds = make_environment(work / "wheel", python, wheel, log)
    rows = [
        f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, installed in {install_seconds:.0f} s",
        f"compiling {filled.compiled} functions: {filled.processor_seconds:.0f} s of processor time,"
        f" {filled.seconds:.0f} s elapsed", "",
        "| from an empty cache | elapsed [s] | limit [s] | processor [s] | functions compiled |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]  # fmt: skip
    measured, failed = measure_tasks(work / "wheel", work / "homes", "", True)
    rows += measured
    if source is not None:
        make_environment(work / "sdist", python, source, log)
        rows += measure_tasks(work / "sdist", work / "sdist_homes", ", source distribution", False)[0]
    return [*rows, ""], failed


def main() -> int:
    """Build and measure; 1 if a task compiles a function or takes too long."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the wheels and of pip's output")
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters that wheels are for")
    parser.add_argument("--sdist", action="store_true", help="install the source distribution, too")
    args = parser.parse_args()
    if missing := [python for python in args.python if shutil.which(python) is None]:
        parser.error(f"not installed: {', '.join(missing)}")
    args.out.mkdir(parents=True, exist_ok=True)
    failed = False
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for kind in ("wheel", "sdist"):
            run(sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", work, cwd=ROOT)
        (plain,), (source,) = work.glob("*-py3-none-any.whl"), work.glob("*.tar.gz")
        print(f"plain wheel: {plain.stat().st_size / 1e6:.1f} MB\n")
        for k, python in enumerate(args.python):
            rows, is_bad = build_and_measure(
                python, plain, source if args.sdist else None, args.out.resolve(), work / str(k)
            )
            print("\n".join(rows), flush=True)
            failed |= is_bad
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
