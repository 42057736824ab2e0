"""Run blind trials on an independent simulator with other laws, wrong noise and wrong parameters.

    python tools/validation/blind_world.py --out runs/world --count 20
        --kinds near,noise,off,outside,clean
    python tools/validation/blind_world.py --out runs/world              # continue after a kill
    python tools/validation/blind_world.py --out runs/world --only 0007  # repeat one trial
    python tools/validation/blind_world.py --out runs/world --score-only

Kinds: `near` (a mechanism of the library in another form), `noise` (0.7 to 2 times the stated one,
every second with an effect), `off` (every number of the model wrong, every second with an effect),
`outside` (random laws), `clean`, `library` (one or two effects, sizes from the field), `coloured`
(half to all of the sensors' noise is correlated in time, every second with an effect), `drift` (the
oil has another viscosity in every run, every second with an effect).
A process of its own makes each trial and seals its key; another one gets a copy of the logs and the
nominal machine. Each answer is stamped with the commit of the search; `summary.md` and
`summary.json` appear in the folder. Needs the project's own environment (`bash tools/setup`).
"""

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from hydrotele.core.errors import InputError
from tools.validation.blind.generate import key_hash
from tools.validation.blind.run_trial import ROOT, WORKFLOW, ask
from tools.validation.blind.trials import Place, write_json
from tools.validation.blind.world_judge import judge_world, score_world, world_markdown
from tools.validation.blind.world_trials import (
    KINDS,
    WorldSeries,
    begin_world_series,
    load_world_series,
)


def commit() -> str:
    """Commit of the checkout that searches, with `+changed` if files differ from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    return git("rev-parse", "HEAD") + ("+changed" if git("status", "--porcelain", "-uno") else "")


def run_one(place: Place, series: WorldSeries, args: argparse.Namespace) -> None:
    """Make a trial's data if they are not there, let the workflow answer, keep the answer."""
    if not (place.data.is_dir() and place.key.is_file() and place.seal.is_file()):
        shutil.rmtree(place.data, ignore_errors=True)
        command = [
            sys.executable,
            "-m",
            "tools.validation.blind.world_trials",
            str(place.out),
            place.trial,
        ]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"trial {place.trial}", f"no data: {done.stderr[-2000:]}")
    if args.make_only:
        return
    filled = {"machine": series.machine, "threads": args.threads}
    workflow = [part.format(data="{data}", **filled) for part in args.workflow]
    stamp, begin = commit(), time.perf_counter()
    answer, error = ask(place.data, workflow, args.limit)
    write_json(place.result, {
        "trial": place.trial, "commit": stamp, "command": workflow, "answer": answer,
        "error": error, "wall_seconds": round(time.perf_counter() - begin, 2),
    })  # fmt: skip


def score_series(out: Path, series: WorldSeries) -> dict[str, Any]:
    """Score the finished trials and write the summary.

    Raises:
        InputError: none is finished, or a key is not the one that was sealed.
    """
    outcomes, commits = [], Counter()
    for name in series.names():
        place = Place(out, name)
        if not place.result.is_file():
            continue
        if not place.key.is_file() or key_hash(place) != place.seal.read_text().strip():
            raise InputError(place.key, "is not the key that was sealed before the trial")
        result = json.loads(place.result.read_text())
        commits[result["commit"]] += 1
        outcomes.append(judge_world(json.loads(place.key.read_text()), result))
    if not outcomes:
        raise InputError(out, "no trial is finished yet")
    scores = score_world(outcomes)
    counts = ",".join(f"{kind}:{count}" for kind, count in series.counts.items())
    head = [
        f"`python tools/validation/blind_world.py --out DIR --kinds {counts} --seed {series.seed}"
        f" --machine {series.machine} --seconds {series.seconds:g}`: {len(outcomes)} of"
        f" {len(series.names())} trials finished, each of four runs.",
        "Searched by commit " + ", ".join(f"{c} ({n} trials)" for c, n in commits.items()) + ".",
    ]
    write_json(out / "summary.json", {**scores, "commits": commits, "trials": [
        {"trial": o.trial, "kind": o.kind, "planted": o.planted, "answered": o.answer,
         "verdict": o.verdict, "right": o.right, "visibility": o.visible} for o in outcomes
    ]})  # fmt: skip
    (out / "summary.md").write_text(world_markdown(head, scores, outcomes))
    return scores


def read_counts(kinds: str, count: int) -> dict[str, int]:
    """Kind -> number of trials, from `near,off` and one count, or from `near:30,off:20`.

    Raises:
        InputError: a kind is not known, or a number is none.
    """
    counts = {}
    for part in kinds.split(","):
        kind, _, number = part.strip().partition(":")
        if kind not in KINDS:
            raise InputError(f"--kinds {kind}", f"is not known; the kinds are {', '.join(KINDS)}")
        if number and not number.isdigit():
            raise InputError(f"--kinds {part}", "give a whole number after the colon: near:30")
        counts[kind] = int(number) if number else count
    return counts


def main() -> int:
    """Parse the arguments, run what is missing, score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the series")
    parser.add_argument("--kinds", help="of a new series: near,noise or near:30,noise:20")
    parser.add_argument("--count", type=int, default=10, help="of each kind (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="of a new series")
    parser.add_argument("--machine", default="cat215", choices=["cat215", "rig"])
    parser.add_argument("--seconds", type=float, default=40.0, help="length of each run")
    parser.add_argument("--jobs", type=int, default=2, help="trials at a time")
    parser.add_argument("--threads", type=int, default=1, help="that one search may use")
    parser.add_argument("--only", nargs="+", metavar="ID", help="run these trials anew")
    parser.add_argument("--make-only", action="store_true", help="make and seal data, no search")
    parser.add_argument("--score-only", action="store_true")
    parser.add_argument("--limit", type=float, default=1800.0, help="per answer [s]")
    parser.add_argument("--workflow", nargs="+", default=list(WORKFLOW), help=argparse.SUPPRESS)
    args = parser.parse_args()
    try:
        return _run(args)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2


def _run(args: argparse.Namespace) -> int:
    if args.kinds:
        counts = read_counts(args.kinds, args.count)
        args.out.mkdir(parents=True, exist_ok=True)
        begin_world_series(args.out, WorldSeries(args.seed, counts, args.machine, args.seconds))
    series = load_world_series(args.out)
    names = series.names()
    if strange := [name for name in args.only or () if name not in names]:
        raise InputError(f"--only {strange[0]}", f"the trials are {names[0]} .. {names[-1]}")
    places = [Place(args.out, name) for name in args.only or names]
    if not args.only:
        places = [place for place in places if not place.result.is_file()]
    if not args.score_only:
        print(f"{len(names)} trials, {len(places)} to run", flush=True)
        with ThreadPoolExecutor(args.jobs) as pool:
            tasks = {pool.submit(run_one, place, series, args): place.trial for place in places}
            for count, task in enumerate(as_completed(tasks), 1):
                if (error := task.exception()) is not None:
                    pool.shutdown(cancel_futures=True)
                    raise error
                print(f"{tasks[task]} done ({count}/{len(places)})", flush=True)
    if args.make_only:
        return 0
    for name, target in score_series(args.out, series)["targets"].items():
        if target["value"] is not None:
            mark = "ok  " if target["reached"] else "MISS"
            print(f"{mark} {name}: {100 * target['value']:.1f} % (asked {target['asked']})")
    print(f"summary: {args.out / 'summary.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
