"""Kill commands, terminate them and fill their disk; check that reruns give the same output.

    python tools/validation/interruptions.py --kills 200 --terms 50 --full 50 --seed 0

Every command is first done undisturbed, and what agrees in two such runs is what later ones must
have. Then it gets SIGKILL or SIGTERM after a random part of the time that it takes, or writes into
a file system (tmpfs, which takes root to mount) with a random part of the room that it needs.
Wanted:

- where the output exists at all it is complete (a sweep's folder may be begun: it resumes);
- the same command afterwards ends well, with an output equal to that of the undisturbed ones;
- no child process outlives the command by 10 s;
- SIGTERM ends with status 143 and leaves nothing behind; a full disk ends with status 2 within 60 s
  and one message below 2 kB, without a traceback.
"""

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow.parquet as pq

ROOT = Path(__file__).resolve().parents[2]
SECONDS, LETTERS, ORPHANS = 60.0, 2048, 10.0
ENDED = (128 + signal.SIGTERM, -signal.SIGTERM)  # by its handler, or before that was there
_TOOK = re.compile(rb"(searched for|identified in) [0-9.]+ s")  # in reports, the machine's own
SWEEP = """scenario: rig_steps
set: {duration: 1.0}
grid: {seed: [1, 2, 3, 4]}
"""
COMMANDS = {
    "run": ("run zhu_up --set duration=1.0 --out OUT", "out"),
    "export": ("export cat215 --tool bucket --out OUT", "out.xml"),
    "review": ("review data/test_1 --out OUT", "out.rrd"),
    "sweep": ("sweep sweep.yaml --jobs 2 --out OUT", "out"),
    "identify": ("identify --data data --machine rig --out OUT", "out"),
    "gap": ("gap --data data --machine rig --effect coulomb_friction --jobs 1 --out OUT", "out"),
}
SHARES = {"run": 6, "export": 5, "review": 5, "sweep": 4, "identify": 3, "gap": 2}


class Bench:
    """A folder with inputs, and what undisturbed commands leave."""

    def __init__(self, folder: Path) -> None:
        """Make the inputs and do every command twice."""
        self.folder = folder
        (folder / "sweep.yaml").write_text(SWEEP)
        for k, name in enumerate(("fit_1", "fit_2", "test_1")):
            words = f"run rig_steps --set seed={k + 1} --set duration=6.0 --out data/{name}"
            self._well([*words.split(), "--no-review"])
        self.seconds: dict[str, float] = {}
        self.size: dict[str, int] = {}
        self.wanted: dict[str, dict] = {}
        for name, (_, out) in COMMANDS.items():
            traces = []
            for _ in range(3):  # the first may have to compile
                target = folder / "undisturbed" / out
                shutil.rmtree(target.parent, ignore_errors=True)
                target.parent.mkdir()
                begin = time.monotonic()
                self._well(self.words(name, target))
                self.seconds[name] = time.monotonic() - begin
                traces.append(trace(target))
            same = {k: v for k, v in traces[1].items() if traces[2].get(k) == v}
            if set(traces[1]) != set(traces[2]):
                sys.exit(f"{name} does not write the same files twice")
            unstable = sorted({k.split("#")[0] for k in traces[1] if k not in same})
            self.wanted[name] = same
            files = [p for p in target.parent.rglob("*") if p.is_file()]
            self.size[name] = sum(p.stat().st_size for p in files)
            print(
                f"{name}: {self.seconds[name]:.1f} s, {self.size[name]} bytes, {len(same)} facts to"
                f" agree; differs from time to time: {unstable or 'nothing'}",
                flush=True,
            )

    def words(self, name: str, out: Path) -> list[str]:
        """Arguments of a command that writes to `out`."""
        return [str(out) if w == "OUT" else w for w in COMMANDS[name][0].split()]

    def start(self, words: list[str]) -> subprocess.Popen:
        """Start a command in a session of its own."""
        return subprocess.Popen(
            [sys.executable, "-m", "hydrotele", *words], cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip

    def _well(self, words: list[str]) -> None:
        process = self.start(words)
        said = process.communicate()[1]
        if process.returncode:
            sys.exit(f"{' '.join(words)}: {said}")

    def check(self, name: str, out: Path) -> str:
        """What is wrong with an output; empty where it is as it should be."""
        found = trace(out)
        wrong = [k for k, v in self.wanted[name].items() if found.get(k) != v]
        return f"{len(wrong)} facts of the output differ, {wrong[0]} first" if wrong else ""


def trace(out: Path) -> dict:
    """What is in a file or folder: hashes of files and tables, leaves of JSON, counts of rows."""
    facts = {}
    for file in sorted(out.rglob("*")) if out.is_dir() else [out]:
        if not file.is_file():
            continue
        place = str(file.relative_to(out)) if file != out else ""
        if file.suffix == ".json":
            facts |= {f"{place}#{k}": v for k, v in _leaves(json.loads(file.read_text()))}
        elif file.suffix == ".parquet":
            table = pq.read_table(file)
            for column in table.column_names:
                facts[f"{place}#{column}"] = _hash(str(table[column].to_pylist()).encode())
        elif file.suffix == ".rrd":
            facts |= {f"{place}#{k}": v for k, v in _recording(file).items()}
        else:
            facts[place] = _hash(_TOOK.sub(b"", file.read_bytes()))
    return facts


def _recording(file: Path) -> dict[str, str]:
    """Whether rerun finds a recording whole, and how many entities and rows it counts in it."""
    rerun = [str(Path(sys.executable).with_name("rerun")), "rrd"]
    whole = subprocess.run([*rerun, "verify", str(file)], capture_output=True)
    told = subprocess.run([*rerun, "stats", str(file)], capture_output=True, text=True).stdout
    counts = dict(line.split(" = ") for line in told.splitlines() if " = " in line)
    return {"status": str(whole.returncode), "entities": counts.get("num_entity_paths", ""),
            "rows": counts.get("num_rows", "")}  # fmt: skip


def _leaves(data, place: str = "") -> Iterator[tuple[str, object]]:
    if isinstance(data, dict):
        for key, value in data.items():
            yield from _leaves(value, f"{place}.{key}")
    elif isinstance(data, list):
        for k, value in enumerate(data):
            yield from _leaves(value, f"{place}[{k}]")
    else:
        yield place, data if data == data else "NaN"


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def _end(bench: Bench, name: str, out: Path, how: int, dice: random.Random) -> Iterator[str]:
    """Send a signal at a random moment; what is wrong afterwards."""
    process = bench.start(bench.words(name, out))
    try:
        process.wait(dice.uniform(0.0, 1.05) * bench.seconds[name])
    except subprocess.TimeoutExpired:
        process.send_signal(how)
    try:
        said = process.communicate(timeout=SECONDS)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        yield f"runs on for {SECONDS:.0f} s"
        return
    done = process.returncode == 0
    if how == signal.SIGTERM and not done:
        if process.returncode not in ENDED:
            yield f"status {process.returncode}: {said[-300:]}"
        if "Traceback" in said:
            yield f"traceback: {said[-300:]}"
    deadline = time.monotonic() + ORPHANS
    while _alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    if _alive(process.pid):
        os.killpg(process.pid, signal.SIGKILL)
        yield "leaves child processes"
    if out.exists() and (done or name != "sweep") and (wrong := bench.check(name, out)):
        yield f"partial: {wrong}"
    left = [p.name for p in out.parent.iterdir() if p != out]
    if left and how == signal.SIGTERM:
        yield f"leaves {left}"
    yield from _again(bench, name, out)


def _again(bench: Bench, name: str, out: Path) -> Iterator[str]:
    process = bench.start(bench.words(name, out))
    try:
        said = process.communicate(timeout=4 * bench.seconds[name] + SECONDS)[1]
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        yield "afterwards: it hangs"
        return
    if process.returncode:
        yield f"afterwards: status {process.returncode}: {said[-300:]}"
    elif wrong := bench.check(name, out):
        yield f"afterwards: {wrong}"


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of some bytes."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={max(4096, size)}", "tmpfs", str(folder)]
    subprocess.run(mount, check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
        folder.rmdir()


def _fill(bench: Bench, name: str, out: Path, dice: random.Random) -> Iterator[str]:
    """Write into too little room; what is wrong afterwards."""
    with small_disk(out.parent / "disk", int(dice.uniform(0.02, 0.95) * bench.size[name])):
        place = out.parent / "disk" / out.name
        process = bench.start(bench.words(name, place))
        begin, limit = time.monotonic(), bench.seconds[name] + SECONDS
        try:
            said = process.communicate(timeout=limit)[1]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            yield f"hangs for {time.monotonic() - begin:.0f} s"
            return
        if process.returncode != 2:
            yield f"status {process.returncode}: {said[-300:]}"
        if "Traceback" in said:
            yield f"traceback: {said[-300:]}"
        if len(said.encode()) > LETTERS:
            yield f"a message of {len(said.encode())} bytes"
        if place.exists() and name != "sweep":
            yield "partial output"
        room = f"remount,size={4 * bench.size[name] + 2**22}"
        subprocess.run(["mount", "-o", room, str(place.parent)], check=True)
        yield from _again(bench, name, place)


def main() -> None:
    """Disturb, print every defect and a table of how often what was done."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=25)
    parser.add_argument("--terms", type=int, default=0)
    parser.add_argument("--full", type=int, default=0)
    parser.add_argument("--only", choices=COMMANDS, help="this command alone")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    dice = random.Random(args.seed)
    names = [n for n in COMMANDS for _ in range(SHARES[n]) if args.only in (None, n)]
    work = Path(tempfile.mkdtemp(prefix="hydrotele_interruptions_"))
    done, defects = Counter(), 0
    try:
        bench = Bench(work)
        for kind, count in (("kill", args.kills), ("term", args.terms), ("full", args.full)):
            for k in range(count):
                name = names[k % len(names)]
                out = work / f"{kind}_{k}" / COMMANDS[name][1]
                out.parent.mkdir()
                if kind == "full":
                    wrong = list(_fill(bench, name, out, dice))
                else:
                    how = signal.SIGKILL if kind == "kill" else signal.SIGTERM
                    wrong = list(_end(bench, name, out, how, dice))
                done[kind, name] += 1
                defects += bool(wrong)
                for words in wrong:
                    print(f"{kind} {k} {name}: {words}", flush=True)
                shutil.rmtree(out.parent, ignore_errors=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    for kind in ("kill", "term", "full"):
        counts = {n: done[kind, n] for n in COMMANDS if done[kind, n]}
        if counts:
            print(f"{kind}: {sum(counts.values())} ({counts})")
    print(f"with defects: {defects}")
    sys.exit(1 if defects else 0)


if __name__ == "__main__":
    main()
