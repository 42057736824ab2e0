"""Measure how near unchanged machines come to the thresholds of gap finding.

    python tools/validation/gap_calibration.py --out runs/clean --trials 100
    python tools/validation/gap_calibration.py --out runs/clean            # continue after a kill

Makes the clean trials of a series (the motions, noise and sensors of the blind trials, no hidden effect). Measured of
each are twice the largest log Bayes factor of an effect in the first round of the search, by the linear step and after
refinement, and the residual tests of the given model. Writes `calibration.json` and `calibration.md`.
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
from hydrotele.estimate.hypothesis import Guess, hypotheses, limit_to_domain
from hydrotele.estimate.track import STEP, track_run
from hydrotele.gap.disturbances import is_pulse
from hydrotele.gap.machine_model import MachineModel
from hydrotele.gap.model_search import (
    MIN_LOG_BAYES_FACTOR,
    Model,
    is_direct,
    propose,
    propose_disturbances,
    settle_noise,
)
from hydrotele.gap.residuals import LIMITS, residual_tests
from hydrotele.logs.dataset import Dataset, load_dataset
from hydrotele.machine.machine_file import load_machine
from tools.validation.blind.run_trial import ROOT
from tools.validation.blind.trials import Place, Series, begin_series, load_series, write_json

_REFINED = 4  # effects, the best by the linear step
_SHARES = (0.5, 0.9, 0.98, 1.0)


def measure_trial(out: Path, trial: str, machine_name: str) -> str:
    """Make a clean trial if it is not there, and write its figures."""
    place = Place(out, trial)
    if not place.data.is_dir():
        command = [sys.executable, "-m", "tools.validation.blind.generate", str(out), trial]
        subprocess.run(command, cwd=ROOT, check=True)
    data = load_dataset(place.data, load_machine(machine_name))
    tracks = [track_run(data.machine, data, run) for run in (data.heldout, *data.fit)]
    tests = {name: test["value"] for name, test in residual_tests(tracks, data.channels).items()}
    write_json(place.folder / "calibration.json", {**measure_first_round(data), "tests": tests})
    return trial


def measure_first_round(data: Dataset) -> dict[str, object]:
    """Return twice the largest log Bayes factor of an effect in the first round of the search.

    Returns:
        `linear` by the linear step, `refined` after refinement of the best effects, each with the `..._effect`. Effects
        that change their parameters by less than the smallest relevant change count 0 after refinement.
    """
    evidence = Evidence(data, data.fit, 1, STEP, lacking=True)
    try:
        model = MachineModel(evidence)
        given = Model(settle_noise(model, model.judge(Guess())))
        candidates = model.prepare(limit_to_domain(hypotheses(data.machine), data.machine)[0], given.judged)
        compared = [c for c in candidates if not is_pulse(c) and not is_direct(c)]
        proposals = [*propose(model, given, compared)[0], *propose_disturbances(model, given, candidates)]
        proposals = sorted((p for p in proposals if len(p.parts) == 1), key=lambda p: -p.factor)
        refined, best = 0.0, ""
        for proposal in proposals[:_REFINED]:
            found = model.refine(given.judged, Guess(proposal.parts), proposal.scale, False)
            if found is not None:
                factor = given.score - Model(*found, found[1].whole_penalty).score
                refined, best = max((refined, best), (factor, "{}({})".format(*proposal.key)))
    finally:
        evidence.close()
    first = proposals[0]
    return {"linear": first.factor, "linear_effect": "{}({})".format(*first.key), "refined": refined,
            "refined_effect": best}  # fmt: skip


def summary(measured: dict[str, dict]) -> tuple[dict, str]:
    """Return quantiles over the trials, as a document and as Markdown."""
    limit = MIN_LOG_BAYES_FACTOR
    rows = {
        "best effect, linear step": ([m["linear"] for m in measured.values()], limit),
        "best effect, refined": ([m["refined"] for m in measured.values()], limit),
    }
    for test, largest in LIMITS.items():
        rows[f"worst channel, {test}"] = ([m["tests"][test] for m in measured.values()], largest)
    lines = [
        f"Gap finding must not name an effect if nothing is hidden. {len(measured)} simulated unchanged machines are"
        " searched; motions and sensors are those of the [blind validation](blind_trials/summary.md).",
        "",
        "- best effect: twice the log [Bayes factor](../terms.md) of the best effect in the first round of the"
        " [search](../gap_method.md), by the linear step, and after the refinement of the best"
        f" {_REFINED}. Only effects above {limit:g} by the linear step are refined in a search, and an effect is added"
        f" to the model only above {limit:g} after the refinement.",
        "- worst channel: the largest value over all channels of a [residual test](../gap.md#residual-tests) of the"
        " prediction errors: their mean square, the mean square of their means over 1 s, and their autocorrelation."
        " A test fails only above its threshold.",
        "",
        "Columns: the value that this fraction of the machines does not exceed. All must be below the threshold, except"
        " in the first row.",
        "",
        "| figure | " + " | ".join(f"{s:.0%} quantile" for s in _SHARES) + " | threshold |",
        "| --- |" + " --- |" * (len(_SHARES) + 1),
    ]
    document: dict = {"trials": len(measured), "quantiles": {}}
    for name, (values, largest) in rows.items():
        cuts = [float(np.quantile(values, s)) for s in _SHARES]
        document["quantiles"][name] = dict(zip(map(str, _SHARES), cuts, strict=True))
        lines.append(f"| {name} | " + " | ".join(f"{c:.3g}" for c in cuts) + f" | {largest:g} |")
    over = [m["refined_effect"] for m in measured.values() if m["refined"] > limit]
    document["above the threshold"] = over
    count = f"{len(over)} {', '.join(over)}".rstrip()
    lines += ["", f"Number of machines on which an effect is above the threshold after refinement: {count}."]
    return document, "\n".join(lines) + "\n"


def main() -> None:
    """Parse the arguments, measure what is missing, summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the series")
    parser.add_argument("--trials", type=int, help="of a new series (default 100)")
    parser.add_argument("--seed", type=int, default=101, help="of a new series (default 101)")
    parser.add_argument("--jobs", type=int, default=2, help="trials at a time")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.trials or not (args.out / "settings.json").is_file():
        counts = {"single": 0, "double": 0, "clean": args.trials or 100, "outside": 0}
        begin_series(args.out, Series(args.seed, counts))
    series = load_series(args.out)
    missing = [n for n in series.names() if not _file(args.out, n).is_file()]
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        tasks = [pool.submit(measure_trial, args.out, n, series.machine) for n in missing]
        for count, task in enumerate(tasks, 1):
            print(f"{task.result()} measured ({count}/{len(tasks)})", flush=True)
    measured = {n: json.loads(_file(args.out, n).read_text()) for n in series.names()}
    document, text = summary(measured)
    write_json(args.out / "calibration.json", document)
    (args.out / "calibration.md").write_text(text)
    print(text)


def _file(out: Path, trial: str) -> Path:
    return Place(out, trial).folder / "calibration.json"


if __name__ == "__main__":
    main()
