"""Write the results of a series as a Markdown page and as lines for a terminal."""

from collections.abc import Sequence
from typing import Any

from tools.validation.blind.judge import DETECTABLE, Verdict

_PICTURES = (
    ("confusion.png", "Confusion matrix"),
    ("reliability.png", "Reliability"),
    ("closure.png", "Closure"),
)

_CRITERIA = {
    "single right, silence on weak ones set aside": "single effects correct, weak ones excluded",
    "single right, silence on weak ones counted as wrong": "single effects correct, all",
    "double right, silence on weak ones set aside": "pairs correct, weak ones excluded",
    "double right, silence on weak ones counted as wrong": "pairs correct, all",
    "clean falsely named": "unchanged machine, effect named",
    "outside called unknown": "unmodelled effect, reported as `unknown`",
    "outside surely named": "unmodelled effect, known effect named with probability above 0.9",
    "interval coverage": "95 % intervals that contain the truth",
    "interval coverage, not too wide": "95 % intervals that contain the truth, upper limit",
    "gap closed, median": "error reduction, median",
}

_WEAK = (
    "[Visibility](../../terms.md) measures how strongly an effect changes the readings, in standard deviations of the"
    f" noise. An effect is weak if its visibility is below {DETECTABLE:g}. To miss a weak effect is no error in the"
    " rows without weak ones; to name another effect instead is an error. Single effects by visibility,"
    " including weak ones:"
)


def summary_lines(scores: dict[str, Any], control: dict[str, Any]) -> list[str]:
    """The scores in a few lines."""
    lines = []
    for name, target in scores["targets"].items():
        if target["value"] is not None:
            mark = "ok  " if target["reached"] else "MISS"
            lines.append(f"{mark} {name}: {100 * target['value']:.1f} % (asked {target['asked']})")
    for kind, part in scores["classes"].items():
        lines.append(f"     {kind}: {_share(part['right'])} right")
    for kind in ("single", "double"):
        if part := scores["classes"].get(kind):
            lines.append(f"     {kind} without weak ones: {_share(part['right_without_weak'])}")
    if scores["seconds"]:
        lines.append("     seconds per search: mean {mean:.4g}, max {max:.4g}".format(
            **scores["seconds"]))  # fmt: skip
    if scores["failed"]:
        lines.append(f"     no answer: {', '.join(scores['failed'])}")
    part = ", ".join(f"{k} {_share(v)}" for k, v in control.items())
    return [*lines, f"     with the keys swapped (must collapse): {part}"]


def markdown(series: Any, scores: dict[str, Any], control: dict[str, Any], verdicts: Sequence[Verdict]) -> str:
    """The page."""
    lines = [
        "# Blind validation on the library's own simulation",
        "",
        f"Seed {series.seed}, machine {series.machine}, {scores['trials']} trials of four runs of"
        f" {series.duration:g} s. Correct means the right name and location; an ambiguous answer"
        " that contains the truth counts as correct.",
        "",
        "Values are fractions of the trials. Reached compares the value with the requirement of the project.",
        "",
        "| criterion | value | required | reached |",
        "| --- | ---: | --- | --- |",
    ]
    for name, target in scores["targets"].items():
        value = "-" if target["value"] is None else f"{target['value']:.3f}"
        word = {None: "no data", True: "yes", False: "no"}[target["reached"]]
        lines.append(f"| {_CRITERIA.get(name, name)} | {value} | {target['asked']} | {word} |")
    lines += [
        "",
        "Each row is a class: one effect of the library (single), two (double), none (clean), or an effect that the"
        " library does not contain (outside). Correct: fraction, number of trials, and its 95 % interval in per cent.",
        "",
        "| class | correct | without weak effects | verdicts |",
        "| --- | --- | --- | --- |",
    ]
    for kind, part in scores["classes"].items():
        words = "; ".join(f"{count} {word}" for word, count in part["verdicts"].items())
        clear = _share(part.get("right_without_weak"))
        lines.append(f"| {kind} | {_share(part['right'])} | {clear} | {words} |")
    lines += ["", _WEAK, "", "| visibility | correct |", "| --- | --- |"]
    lines += [f"| {bin_} | {_share(part)} |" for bin_, part in scores["by_visibility"].items()]
    crossed = ", ".join(f"{kind} {_share(part)}" for kind, part in control.items())
    lines += [
        "",
        "As a control of the scoring, every answer is compared with the hidden effect of another trial."
        f" The fraction of correct answers must then be close to 0: {crossed}.",
        "",
    ]
    for file, title in _PICTURES:
        lines.append(f"![{title}]({file})")
    lines += ["", "## Incorrect answers", "",
              "| trial | class | hidden | visibility | named | verdict |",
              "| --- | --- | --- | ---: | --- | --- |"]  # fmt: skip
    for v in verdicts:
        if not v.right:
            size = "" if v.visible is None else f"{v.visible:g}{' (weak)' if v.weak else ''}"
            truth = ", ".join(v.truth) or "nothing"
            answer = ", ".join(v.answer)
            lines.append(f"| {v.trial} | {v.kind} | {truth} | {size} | {answer} | {v.verdict} |")
    return "\n".join(lines) + "\n"


def _share(part: dict[str, Any] | None) -> str:
    if part is None:
        return "-"
    low, high = part["ci95"]
    return f"{100 * part['share']:.1f} % of {part['of']} ({100 * low:.0f}..{100 * high:.0f})"
