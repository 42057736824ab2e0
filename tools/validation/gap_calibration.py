"""Residual tests and standard deviations of the gap search on simulated clean machines.

    python tools/validation/gap_calibration.py --out runs/clean --trials 100 --pulls 30
    python tools/validation/gap_calibration.py --out runs/clean            # continue after a kill

Makes the clean trials of a series (the motions, noise and sensors of the blind trials, no hidden effect), and notes of
each: the residual tests of the given model, and for some of them every effect's estimate over its stated standard
deviation, which a perfect model would leave at a standard deviation of 1. Writes `calibration.json` and
`calibration.md`.
"""

import argparse
import json
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, hypotheses
from hydrotele.gap.residuals import LIMITS, residual_tests
from hydrotele.logs.dataset import load_dataset
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.run_trial import ROOT
from tools.validation.blind.trials import Place, Series, begin_series, load_series, write_json

_SHARES = (0.5, 0.9, 0.98, 1.0)


def measure_trial(out: Path, trial: str, machine_name: str, pulls: bool) -> str:
    """Make a clean trial if it is not there, and note its figures."""
    place = Place(out, trial)
    if not place.data.is_dir():
        command = [sys.executable, "-m", "tools.validation.blind.generate", str(out), trial]
        subprocess.run(command, cwd=ROOT, check=True)
    data = load_dataset(place.data, load_machine(machine_name))
    evidence, nominal = Evidence(data, data.fit, 1, lacking=True), Guess()
    try:
        evidence.set_base(nominal)
        tracks = evidence.track(data.machine, (data.heldout, *data.fit))
        noted = {
            "tests": {k: t["value"] for k, t in residual_tests(tracks, data.channels).items()},
            "pulls": _pulls(evidence) if pulls else {},
        }
    finally:
        evidence.close()
    write_json(place.folder / "calibration.json", noted)
    return trial


def _pulls(evidence: Evidence) -> dict[str, list[float]]:
    """Estimate over spread of every effect that has a slope at nominal, fitted alone."""
    errors = evidence.base_errors
    found = {}
    for hypothesis in hypotheses(evidence.data.machine):
        if np.any(hypothesis.starts[0]):
            continue
        guess = Guess().plus(hypothesis, hypothesis.starts[0])
        slopes = evidence.slopes(guess, evidence.errors(guess))
        curvature = slopes.T @ slopes + np.eye(hypothesis.size)
        covariance = np.linalg.inv(curvature)
        pull = -covariance @ slopes.T @ errors / np.sqrt(np.diag(covariance))
        found[f"{hypothesis.name}({hypothesis.location})"] = [float(v) for v in pull]
    return found


def summary(noted: dict[str, dict]) -> tuple[dict, str]:
    """Quantiles over the trials, as a document and as Markdown."""
    rows = {
        f"worst channel, {test}": ([n["tests"][test] for n in noted.values()], limit) for test, limit in LIMITS.items()
    }
    lines = [
        f"The residual tests must not fail if nothing is hidden. {len(noted)} simulated unchanged machines are tested.",
        "",
        "- worst channel: the largest value over all channels of a [residual test](../gap.md#residual-tests) of the"
        " prediction errors: their mean square, the mean square of their means over 1 s, and their autocorrelation."
        " A test fails only above its threshold.",
        "",
        "Columns: the value that this fraction of the machines does not exceed. All must be below the threshold.",
        "",
        "| figure | " + " | ".join(f"{s:.0%} quantile" for s in _SHARES) + " | threshold |",
        "| --- |" + " --- |" * (len(_SHARES) + 1),
    ]  # fmt: skip
    document: dict = {"trials": len(noted), "quantiles": {}}
    for name, (values, limit) in rows.items():
        cuts = [float(np.quantile(values, s)) for s in _SHARES]
        document["quantiles"][name] = dict(zip(map(str, _SHARES), cuts, strict=True))
        lines.append(f"| {name} | " + " | ".join(f"{c:.3g}" for c in cuts) + f" | {limit:g} |")
    pulled = [n["pulls"] for n in noted.values() if n["pulls"]]
    if pulled:
        lines += ["", f"Second table: each effect is estimated on {len(pulled)} unchanged machines, so its true value"
                  " is the nominal one. The RMS of the estimate's error divided by its stated standard deviation should"
                  " be 1. Below 1 the stated uncertainty is too large, above 1 too small. 0 means that these logs do"
                  " not determine the effect, and the estimate stays at its nominal value.",
                  "", "| effect | RMS |", "| --- | --- |"]  # fmt: skip
        document["pulls"] = {}
        for key in pulled[0]:
            size = float(np.sqrt(np.mean([np.square(p[key]) for p in pulled])))
            document["pulls"][key] = size
            lines.append(f"| {key} | {size:.2f} |")
        every = [v for p in pulled for pull in p.values() for v in pull]
        beyond = float(np.mean(np.abs(every) > 1.96))
        size = float(np.sqrt(np.mean(np.square(every))))
        document |= {"pulls_rms": size, "beyond_1.96": beyond}
        lines += [
            "",
            f"All effects together: RMS {size:.2f}. A fraction of {beyond:.1%} of the errors exceeds 1.96"
            " standard deviations (ideal: 5 %).",
        ]
    return document, "\n".join(lines) + "\n"


def main() -> None:
    """Parse the arguments, measure what is missing, summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the series")
    parser.add_argument("--trials", type=int, help="of a new series (default 100)")
    parser.add_argument("--pulls", type=int, default=30, help="trials with every effect's pull")
    parser.add_argument("--seed", type=int, default=101, help="of a new series (default 101)")
    parser.add_argument("--jobs", type=int, default=2, help="trials at a time")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.trials or not (args.out / "settings.json").is_file():
        counts = {"single": 0, "double": 0, "clean": args.trials or 100, "outside": 0}
        begin_series(args.out, Series(args.seed, counts))
    series = load_series(args.out)
    missing = [n for n in series.names() if not _note(args.out, n).is_file()]
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        tasks = [pool.submit(measure_trial, args.out, n, series.machine, int(n) < args.pulls) for n in missing]
        for count, task in enumerate(tasks, 1):
            print(f"{task.result()} measured ({count}/{len(tasks)})", flush=True)
    noted = {n: json.loads(_note(args.out, n).read_text()) for n in series.names()}
    document, text = summary(noted)
    write_json(args.out / "calibration.json", document)
    (args.out / "calibration.md").write_text(text)
    print(text)


def _note(out: Path, trial: str) -> Path:
    return Place(out, trial).folder / "calibration.json"


if __name__ == "__main__":
    main()
