"""Draw the figures of a series: confusion matrix, reliability diagram, closure of the gap."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from tools.validation.blind.judge import Verdict
from tools.validation.blind.score import closures, floor_scatter, share

matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402 # the backend must be chosen first


def draw_confusion(verdicts: Sequence[Verdict], path: Path) -> None:
    """What was planted against what was answered; doubles stand in `score.py`'s numbers only."""
    shown = [v for v in verdicts if v.kind != "double"]
    rows = sorted({_planted(v) for v in shown}, key=lambda n: (n[0] == "*", n == "clean", n))
    columns = sorted({_answered(v) for v in shown} | {r for r in rows if r[0] not in "*c"})
    words = ("no_gap", "unknown", "several", "failed")
    columns = [c for c in columns if c not in words] + [c for c in words if c in columns]
    counts = np.zeros((len(rows), len(columns)), int)
    for v in shown:
        counts[rows.index(_planted(v)), columns.index(_answered(v))] += 1
    part = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    size = (3.0 + 0.34 * len(columns), 2.0 + 0.28 * len(rows))
    figure, axes = pyplot.subplots(figsize=size, layout="constrained")
    axes.imshow(part, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for r, c in zip(*np.nonzero(counts), strict=True):
        colour = "white" if part[r, c] > 0.6 else "black"
        axes.text(c, r, str(counts[r, c]), ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=8)
    axes.set_yticks(range(len(rows)), rows, fontsize=8)
    axes.set_xlabel("answered")
    axes.set_ylabel("planted (* outside the library)")
    axes.set_title(f"{len(shown)} trials; right place not regarded")
    _save(figure, path)


def draw_reliability(verdicts: Sequence[Verdict], path: Path) -> None:
    """How often what is named with a probability was planted."""
    beliefs = np.array([b for v in verdicts for b in v.beliefs], float).reshape(-1, 2)
    figure, axes = pyplot.subplots(figsize=(5, 5), layout="constrained")
    axes.plot([0, 1], [0, 1], color="grey", lw=1, label="reliable")
    edges = np.array([0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 0.97, 0.995, 1.0 + 1e-9])
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        inside = beliefs[(low <= beliefs[:, 0]) & (beliefs[:, 0] < high)]
        if len(inside):
            x, y = inside.mean(axis=0)
            part = share(list(inside[:, 1] > 0.5))
            assert part
            ends = [[max(0.0, y - part["ci95"][0])], [max(0.0, part["ci95"][1] - y)]]
            axes.errorbar(x, y, ends, fmt="o", color="tab:blue", capsize=3)
            axes.annotate(f" {len(inside)}", (x, y), fontsize=8)
    axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="stated probability",
             ylabel="share that was planted there", aspect="equal")  # fmt: skip
    axes.set_title(f"{len(beliefs)} named effects")
    axes.legend(loc="upper left")
    _save(figure, path)


def draw_closure(verdicts: Sequence[Verdict], path: Path) -> None:
    """Gap above the floor on the held-out run, before and after."""
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    least = 1e-4  # smaller and negative ones stand there
    for kind, colour in (("single", "tab:blue"), ("double", "tab:orange"), ("outside", "tab:red"),
                         ("clean", "tab:grey")):  # fmt: skip
        pairs = [
            [max(x - (v.floor or 1.0), least) for x in (v.before, v.after)]
            for v in verdicts
            if v.kind == kind and v.before is not None and v.after is not None
        ]
        if pairs:
            x, y = np.array(pairs).T
            left.loglog(x, y, "o", ms=4, alpha=0.7, color=colour, label=f"{kind} ({len(pairs)})")
    ends = np.array(left.get_xlim())
    left.plot(ends, ends, color="grey", lw=1)
    left.plot(ends, 0.05 * ends, color="grey", lw=1, ls="--", label="95 % closed")
    left.axvline(10 * floor_scatter(verdicts), color="grey", lw=1, ls=":",
                 label="10 x scatter of the floor")  # fmt: skip
    left.set(
        xlabel="gap above the floor before [1], at least 1e-4",
        ylabel="gap above the floor after [1], at least 1e-4",
    )
    left.legend(fontsize=8)
    values = [value for _, value in closures(verdicts)]
    right.hist(np.clip(values, -0.2, 1.2), bins=np.linspace(-0.2, 1.2, 29), color="tab:blue")
    right.axvline(0.95, color="grey", ls="--", lw=1)
    right.set(xlabel="part of the gap that was closed [1]", ylabel="trials")
    right.set_title("gaps clear of the floor: " + str(len(values)))
    _save(figure, path)


def _planted(v: Verdict) -> str:
    if v.kind == "clean":
        return "clean"
    name = v.truth[0].partition("(")[0]
    return f"*{name}" if v.kind == "outside" else name


def _answered(v: Verdict) -> str:
    if v.kind == "single" and v.right:
        return _planted(v)  # an ambiguous set that holds the truth counts as it
    if v.answer == (v.verdict,) or v.verdict == "unknown":
        return v.verdict
    return v.answer[0].partition("(")[0] if len(v.answer) == 1 else "several"


def _save(figure, path: Path) -> None:
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
