"""Train a policy for every control task from scratch and print its share of the reference controller's advantage.

Each task is trained with `hydrotele train` for the same time, one after the other. The share is
(policy - zero) / (reference - zero) of the mean returns on episodes that were not used in the
training; its 95 % interval is a bootstrap over these episodes. Needs the extra `learn`. A task whose
folder has scores already is not trained again.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hydrotele.envs import TASK_NAMES


def train_task(task: str, asked: argparse.Namespace) -> dict:
    """Train a task, unless its folder has scores, and return the scores."""
    folder = asked.out / task
    if not (folder / "scores.json").exists():
        budget = ["--steps", f"{asked.steps}"] if asked.steps else ["--minutes", f"{asked.minutes:g}"]
        resume = ["--resume"] if (folder / "training.json").exists() else [task, "--seed", f"{asked.seed}"]
        resume += [] if "--resume" in resume else ["--threads", f"{asked.threads}"]
        command = [sys.executable, "-m", "hydrotele", "train", *resume, *budget, "--out", f"{folder}"]
        subprocess.run([*command, "--episodes", f"{asked.episodes}", "--json"], check=True, stdout=subprocess.DEVNULL)
    return json.loads((folder / "scores.json").read_text(encoding="utf-8"))


def make_row(task: str, result: dict) -> str:
    scores = result["scores"]

    def cell(name: str) -> str:
        row = scores.get(name)
        return f"{row['return']:.1f} ± {row['standard_error']:.1f}" if row else "-"

    share = result.get("share_of_reference_advantage")
    shown = f"{share['value']:.2f} ({share['low']:.2f} to {share['high']:.2f})" if share else "-"
    success = scores["policy"]["success"]
    options = ", ".join(f"{key} {value}" for key, value in result["options"].items())
    cells = [task, options, f"{result['steps']:,}", f"{result['processor_seconds']:.0f}",
             f"{result['episodes']}", cell("policy"), cell("zero"), cell("reference"), shown,
             "-" if success is None else f"{success:.2f}"]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def draw_curves(results: dict[str, dict], asked: argparse.Namespace) -> None:
    """Draw the share of the advantage against the environment steps for every task."""
    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    for task, result in results.items():
        if "reference" not in result["scores"]:
            continue
        zero, reference = (result["scores"][name]["return"] for name in ("zero", "reference"))
        rows = np.genfromtxt(asked.out / task / "learning_curve.csv", delimiter=",", names=True)  # return -> return_
        axes.plot(rows["steps"] / 1e3, (rows["return_"] - zero) / (reference - zero), "o-", ms=3, label=task)
    axes.axhline(0.5, color="0.6", ls="--")
    axes.set(xlabel="environment steps [1000]", ylabel="share of the reference's advantage [1]", ylim=(-0.2, 1.1))
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(asked.out / "learning_curves.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--tasks", nargs="+", default=list(TASK_NAMES), metavar="TASK")
    parser.add_argument("--minutes", type=float, default=30.0, help="per task")
    parser.add_argument("--steps", type=int, help="environment steps per task, instead of --minutes")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=128, help="of the comparison")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    results = {}
    print("| task | environment options | steps | processor time [s] | episodes | policy return | zero | reference "
          "| share (95 % interval) | success |\n| " + "--- | " * 10)  # fmt: skip
    for task in asked.tasks:
        results[task] = train_task(task, asked)
        print(make_row(task, results[task]), flush=True)
    draw_curves(results, asked)


if __name__ == "__main__":
    main()
