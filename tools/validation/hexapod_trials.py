"""Run blind trials of `hydrotele gap` on the hexapod.

    python tools/validation/hexapod_trials.py --out runs/hexapod --single 20 --clean 10 --outside 6
    python tools/validation/hexapod_trials.py --out runs/hexapod            # continue after a kill
    python tools/validation/hexapod_trials.py --out runs/hexapod --score-only

One process makes the trials (`tools.validation.blind.hexapod`: MuJoCo, no regressor): it writes
four logs per trial, seals the key and ends. Another one, which sees nothing but copies of the logs
and the model as it is shipped, answers what `hydrotele gap --machine palida --data LOGS` answers.
Noise is drawn anew and not told; in three of four trials the numbers of the robot are off by 0.5, 1
or 2 % everywhere.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from hydrotele.core.errors import InputError
from tools.validation.blind.generate import key_hash
from tools.validation.blind.judge import DETECTABLE, Verdict, judge
from tools.validation.blind.run_trial import PASSED, ROOT
from tools.validation.blind.trials import Place, Series, begin_series, load_series, write_json

KINDS = ("single", "clean", "outside")
MODEL = ROOT / "models" / "palida"


def make(out: Path, places: Sequence[Place]) -> None:
    """Make the trials that are not there, in a process of its own, which then ends."""
    missing = [p.trial for p in places if not (p.data.is_dir() and p.seal.is_file())]
    if missing:
        words = [sys.executable, "-m", "tools.validation.blind.hexapod", str(out), *missing]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(out, f"no data: {done.stderr[-2000:]}")


def answer(places: Sequence[Place]) -> None:
    """Let a process that sees nothing but the model and copies of the logs answer all trials."""
    with tempfile.TemporaryDirectory(prefix="logs_") as folder:
        copies = []
        for number, place in enumerate(places):
            copies.append(Path(folder, f"{number}"))
            shutil.copytree(place.data, copies[-1])
        words = [
            sys.executable,
            str(ROOT / "tools" / "validation" / "blind" / "mechanism_workflow.py"),
            str(MODEL / "palida.xml"),
            str(MODEL / "columns.yaml"),
            *map(str, copies),
        ]
        environment = {name: os.environ[name] for name in PASSED if name in os.environ}
        environment["PYTHONPATH"] = str(ROOT)
        with subprocess.Popen(
            words, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            text=True,
        ) as process:  # fmt: skip
            assert process.stdout
            begin = time.perf_counter()
            for place, line in zip(places, process.stdout, strict=False):
                found = json.loads(line)
                error = found.get("error")
                write_json(place.result, {
                    "trial": place.trial, "answer": None if error else found, "error": error,
                    "wall_seconds": round(time.perf_counter() - begin, 2),
                })  # fmt: skip
                begin = time.perf_counter()
                print(f"{place.trial} answered", flush=True)
    if process.returncode:
        raise InputError("search", f"ended with status {process.returncode}")


def score(out: Path) -> str:
    """Judge all finished trials; the report."""
    verdicts, keys, answers = [], {}, {}
    for name in load_series(out).names():
        place = Place(out, name)
        if not place.result.is_file():
            continue
        if key_hash(place) != place.seal.read_text().strip():
            raise InputError(place.key, "is not the key that was sealed before the trial")
        keys[name] = json.loads(place.key.read_text())
        result = json.loads(place.result.read_text())
        answers[name] = result["answer"] or {}
        verdicts.append(judge(keys[name], result))
    if not verdicts:
        raise InputError(out, "no trial is finished yet")
    text = [*_summary(verdicts, answers), "", *_rows(verdicts, keys, answers)]
    (out / "summary.md").write_text("\n".join(text) + "\n")
    return "\n".join(text)


def _summary(verdicts: list[Verdict], answers) -> list[str]:
    rows = ["| trials | correct | fraction |", "| --- | --- | --- |"]
    for kind in KINDS:
        own = [v for v in verdicts if v.kind == kind]
        if own:
            right = sum(v.right for v in own)
            rows.append(f"| {kind} | {right} of {len(own)} | {100 * right / len(own):.0f} % |")
        faint = [v for v in own if v.weak and v.visible]  # a length's defect shows in no force
        if kind == "single" and faint:
            fine = sum(v.right or not answers[v.trial].get("effects") for v in faint)
            clear, right = len(own) - len(faint), sum(v.right for v in own if v not in faint)
            rows.append(f"| single, not faint | {right} of {clear} | {100 * right / clear:.0f} % |")
            rows.append(f"| faint: correct, or nothing named | {fine} of {len(faint)} | |")
    named = [v for v in verdicts if v.kind == "clean" and answers[v.trial].get("effects")]
    false = [v for v in verdicts if v.kind == "outside" and any(p > 0.5 for p, _ in v.beliefs)]
    covered = [low <= truth <= high for v in verdicts for _, _, low, high, truth in v.covered]
    rows += [
        "",
        f"Clean robots with an effect named: {len(named)}. Unmodelled effects with a known effect"
        f" above 50 %: {len(false)}. 95 % intervals that contain the truth: {sum(covered)} of"
        f" {len(covered)}.",
    ]
    rows.append(
        "Faint: the root of the summed squares of the force changes by the effect in the fitted"
        f" runs, in units of the noise, is below {DETECTABLE:g}."
    )
    loops = []
    for v in verdicts:
        loop = answers[v.trial].get("open_loop") or {}
        if v.kind == "single" and v.right and "after" in loop:
            before, after = (sum(x**2 for x in loop[k].values()) ** 0.5 for k in ("before", "after"))
            loops.append(after / before)
    if loops:
        loops.sort()
        rows.append(
            "Open loop of the patched MJCF, driven by the measured forces for 0.25 s: errors are"
            f" {loops[len(loops) // 2]:.2f} times those of the given one in the median"
            f" ({loops[0]:.2f} to {loops[-1]:.2f})."
        )
    return rows


def _rows(verdicts: list[Verdict], keys, answers) -> list[str]:
    rows = ["| trial | off | hidden | visibility | verdict | answer | errors / noise, both models |"
            " correct |", "| --- | --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    for v in verdicts:
        hidden = ", ".join(
            f"{e['name']} at {e['location']}: " + ", ".join(
                f"{k} {n['value']:.3g}" for k, n in e["parameters"].items() if k != "seed")
            for e in keys[v.trial]["effects"]
        ) or "nothing"  # fmt: skip
        told = ", ".join(
            f"{e['name']} at {e['location']}: " + ", ".join(
                f"{k} {n['value']:.3g}" for k, n in e["parameters"].items())
            for e in answers[v.trial].get("effects", [])
        ) or "-"  # fmt: skip
        size = f"{v.before:.2f}, {v.after:.2f}" if v.before and v.after else v.error or "-"
        seen = "" if v.visible is None else f"{v.visible:.3g}"
        rows.append(f"| {v.trial} | {100 * keys[v.trial]['off']:.1f} % | {hidden} | {seen} |"
                    f" {v.verdict} |"
                    f" {told} | {size} | {'yes' if v.right else 'no'} |")  # fmt: skip
    return rows


def main() -> int:
    """Parse the arguments, run what is missing, score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the series")
    for kind in KINDS:
        parser.add_argument(f"--{kind}", type=int, help=f"number of {kind} trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=12.0, help="of each run [s]")
    parser.add_argument("--score-only", action="store_true")
    args = parser.parse_args()
    try:
        counts = {kind: getattr(args, kind) for kind in KINDS}
        if any(counts.values()):
            args.out.mkdir(parents=True, exist_ok=True)
            counts = {kind: count or 0 for kind, count in counts.items()} | {"double": 0}
            begin_series(args.out, Series(args.seed, counts, "palida", args.duration))
        places = [Place(args.out.resolve(), n) for n in load_series(args.out).names()]
        left = [place for place in places if not place.result.is_file()]
        if left and not args.score_only:
            make(args.out.resolve(), left)
            answer(left)
        print(score(args.out))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
