"""Run blind trials: hide effects in the simulated machine, run the workflow, score its answers.

    python tools/validation/blind_trials.py --out runs/blind --single 100 --double 40 --clean 100
        --outside 40
    python tools/validation/blind_trials.py --out runs/blind              # continue after a kill
    python tools/validation/blind_trials.py --out runs/blind --only 0007  # repeat one trial
    python tools/validation/blind_trials.py --out runs/blind --score-only

Each trial is generated in a process of its own, which writes the logs, seals the key and ends;
another process gets a copy of the logs and answers. `summary.md`, `summary.json` and the pictures
appear in the folder of the series. Needs the project's own environment (`bash tools/setup`).
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from hydrotele.core.errors import InputError
from tools.validation.blind.generate import key_hash
from tools.validation.blind.judge import judge
from tools.validation.blind.pictures import draw_closure, draw_confusion, draw_reliability
from tools.validation.blind.report import markdown, summary_lines
from tools.validation.blind.run_trial import WORKFLOW, run_trial
from tools.validation.blind.score import score, share, swapped
from tools.validation.blind.trials import (
    CLASSES,
    Place,
    Series,
    begin_series,
    load_series,
    write_json,
)


def run_all(places: Sequence[Place], args: argparse.Namespace, series: Series) -> Iterator[str]:
    """Run trials here, `args.jobs` at a time, or on a cluster; yields each when it is finished.

    Raises:
        InputError: a trial's data could not be made, or there is no cluster at the address.
    """
    if args.dask:
        yield from _run_on_cluster(places, args)
        return
    workflow = shlex.split(args.workflow) if args.workflow else WORKFLOW
    with ThreadPoolExecutor(args.jobs) as pool:
        tasks = [pool.submit(run_trial, p, series.machine, workflow, args.limit, args.threads) for p in places]
        try:
            for task in as_completed(tasks):
                yield task.result()["trial"]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _run_on_cluster(places: Sequence[Place], args: argparse.Namespace) -> Iterator[str]:
    """Every worker starts this script for one trial; they must share the folder of the series."""
    try:
        from dask import distributed
    except ImportError:
        message = "needs dask.distributed: pip install 'hydrotele[cluster]'"
        raise InputError("--dask", message) from None
    options = ["--limit", str(args.limit), "--threads", str(args.threads)]
    options += ["--workflow", args.workflow] if args.workflow else []
    with distributed.Client(args.dask, timeout="30s") as client:
        tasks = {
            client.submit(
                subprocess.run,
                [sys.executable, str(Path(__file__).resolve()), "--out", str(p.out.resolve()),
                 "--only", p.trial, "--no-score", *options],
                capture_output=True, text=True, pure=False,
            ): p.trial
            for p in places
        }  # fmt: skip
        for task in distributed.as_completed(tasks):
            done = task.result()
            if done.returncode:
                raise InputError(f"trial {tasks[task]}", done.stderr[-2000:])
            yield tasks[task]


def score_series(out: Path) -> list[str]:
    """Score the finished trials and write summary and pictures.

    Raises:
        InputError: no trial is finished, or a key is not the one that was sealed.
    """
    series, keys, results = load_series(out), {}, {}
    for name in series.names():
        place = Place(out, name)
        if not place.result.is_file():
            continue
        if not place.key.is_file() or key_hash(place) != place.seal.read_text().strip():
            raise InputError(place.key, "is not the key that was sealed before the trial")
        keys[name] = json.loads(place.key.read_text())
        results[name] = json.loads(place.result.read_text())
    if not results:
        raise InputError(out, "no trial is finished yet")
    verdicts = [judge(keys[name], results[name]) for name in results]
    scores = score(verdicts)
    crossed = swapped(keys, results)
    control = {k: share([v.right for v in crossed if v.kind == k]) for k in CLASSES}
    control = {"all": share([v.right for v in crossed])} | {k: s for k, s in control.items() if s}
    rows = [
        {"trial": v.trial, "class": v.kind, "planted": v.truth, "answered": v.answer,
         "verdict": v.verdict, "right": v.right, "visibility": v.visible, "error": v.error}
        for v in verdicts
    ]  # fmt: skip
    write_json(out / "summary.json", {**scores, "keys_swapped": control, "answers": rows})
    (out / "summary.md").write_text(markdown(series, scores, control, verdicts))
    draw_confusion(verdicts, out / "confusion.png")
    draw_reliability(verdicts, out / "reliability.png")
    draw_closure(verdicts, out / "closure.png")
    return summary_lines(scores, control)


def main() -> int:
    """Parse the arguments, run what is missing, score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the series")
    for kind in CLASSES:
        parser.add_argument(f"--{kind}", type=int, help=f"number of {kind} trials")
    parser.add_argument("--seed", type=int, help="of a new series (default 0)")
    parser.add_argument("--machine", help="of a new series (default cat215)")
    parser.add_argument("--duration", type=float, help="of each run [s] (default 40)")
    parser.add_argument("--jobs", type=int, default=2, help="trials at a time")
    parser.add_argument("--threads", type=int, default=1, help="that one search may use")
    parser.add_argument("--only", nargs="+", metavar="ID", help="run these trials anew")
    parser.add_argument("--score-only", action="store_true")
    parser.add_argument("--no-score", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--limit", type=float, default=1800.0, help="per answer [s]")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster")
    parser.add_argument(
        "--workflow",
        help="another command that prints gap.json, with {data}, {machine}, {threads}",
    )
    args = parser.parse_args()
    try:
        return _run(args)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2


def _run(args: argparse.Namespace) -> int:
    asked = {kind: getattr(args, kind) for kind in CLASSES}
    given = [*asked.values(), args.seed, args.machine, args.duration]
    if any(value is not None for value in given):
        counts = {kind: count or 0 for kind, count in asked.items()}
        args.out.mkdir(parents=True, exist_ok=True)
        begin_series(args.out, Series(
            args.seed or 0, counts, args.machine or "cat215", args.duration or 40.0))  # fmt: skip
    series = load_series(args.out)
    names = series.names()
    if strange := [name for name in args.only or () if name not in names]:
        raise InputError(f"--only {strange[0]}", f"the trials are {names[0]} .. {names[-1]}")
    places = [Place(args.out, name) for name in args.only or names]
    if not args.only:
        places = [place for place in places if not place.result.is_file()]
    if not args.score_only:
        print(f"{len(names)} trials, {len(places)} to run", flush=True)
        for count, name in enumerate(run_all(places, args, series), 1):
            print(f"{name} answered ({count}/{len(places)})", flush=True)
    if not args.no_score:
        print("\n".join(score_series(args.out)))
        print(f"summary and pictures: {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
