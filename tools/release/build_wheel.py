"""Build a wheel that contains the compiled functions, install it in an empty environment and measure first use.

    python tools/release/build_wheel.py --out dist                       # for the Python that runs this
    python tools/release/build_wheel.py --out dist --python python3.12   # for another one
    python tools/release/build_wheel.py --out dist --sdist               # also install the source distribution

The wheel is built without compiled code and installed in an environment of its own. There
`hydrotele compile` fills an empty cache, which becomes the folder `hydrotele/compiled_code` of the wheel.
The wheel is for one minor version of Python; pip installs the plain wheel elsewhere.

Then the wheel is installed in another environment, and each command runs as a new user with an
empty cache. The script prints a table and ends with 1 if a command fails, compiles a function or takes
longer than its limit. Needs `uv` and the network.
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


def run(*command: str | Path, **options) -> None:
    """Run a command; end this script with the command's output if it fails."""
    done = subprocess.run(
        [*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}")


def find_uv() -> str:
    """Return the path of uv: the user's or that of tools/setup."""
    found = shutil.which("uv") or shutil.which(ROOT / ".venv" / "bin" / "uv")
    return found or shutil.which("uv", path=Path(sys.executable).parent) or sys.exit("uv is missing")


def make_environment(folder: Path, python: str, package: Path) -> None:
    """Make an empty environment and install a wheel or source distribution with its dependencies there."""
    run(find_uv(), "venv", "--python", python, folder)
    # pip, unlike uv, compiles Python's bytecode by default.
    run(find_uv(), "pip", "install", "--compile-bytecode", "--python", folder / "bin" / "python", package)


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
        home: new folder for the cache and the results.
    """
    home.mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    variables = kept | {"XDG_CACHE_HOME": str(home / "cache")}
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    for program, *arguments in commands:
        run(environment / "bin" / program, *arguments, cwd=home, env=variables)
    after, seconds = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - start
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Measurement(seconds, spent, len([*home.rglob("*.code")]))


def main() -> int:
    """Build and measure; 1 if a task compiles a function or takes too long."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the wheels")
    parser.add_argument("--python", default=sys.executable, help="interpreter that the wheel is for")
    parser.add_argument("--compiled", type=Path, help="cache folder that is filled already, for these sources")
    parser.add_argument("--sdist", action="store_true", help="install the source distribution, too")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for kind in ("wheel", "sdist"):
            run(sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", work, cwd=ROOT)
        (plain,), (source,) = work.glob("*-py3-none-any.whl"), work.glob("*.tar.gz")
        rows = [f"plain wheel: {plain.stat().st_size / 1e6:.1f} MB"]
        if args.compiled is None:
            make_environment(work / "build", args.python, plain)
            filled = measure([["hydrotele", "compile"]], work / "build", work / "filled")
            rows.append(
                f"compiling {filled.compiled} functions: {filled.processor_seconds:.0f} s of processor time,"
                f" {filled.seconds:.0f} s elapsed"
            )
            args.compiled = work / "filled" / "cache" / "hydrotele" / "compiled"
        version = "import sys; print(f'cp{sys.version_info.major}{sys.version_info.minor}')"
        tag = subprocess.run([args.python, "-c", version], capture_output=True, text=True, check=True).stdout.strip()
        wheel = add_compiled_code(plain, args.compiled, tag, args.out)
        rows.append(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB")
        rows += ["", "| from an empty cache | elapsed [s] | limit [s] | processor [s] | functions compiled |",
                 "| --- | ---: | ---: | ---: | ---: |"]  # fmt: skip
        make_environment(work / "wheel", args.python, wheel)
        failed = False
        for k, task in enumerate(TASKS):
            found = measure(task.commands, work / "wheel", work / f"home{k}")
            failed |= found.compiled > 0 or found.seconds > (task.max_seconds or found.seconds)
            rows.append(
                f"| {task.name} | {found.seconds:.1f} | {task.max_seconds or ''} | {found.processor_seconds:.1f} |"
                f" {found.compiled} |"
            )
        if args.sdist:
            make_environment(work / "sdist", args.python, source)
            found = measure(TASKS[0].commands, work / "sdist", work / "home_sdist")
            rows.append(
                f"| {TASKS[0].name}, from the source distribution | {found.seconds:.1f} | |"
                f" {found.processor_seconds:.1f} | {found.compiled} |"
            )
    print("\n".join(rows))
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
