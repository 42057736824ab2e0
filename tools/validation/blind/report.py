"""Write the results of a series as a Markdown page and as lines for a terminal."""

from collections.abc import Sequence
from typing import Any

from tools.validation.blind.judge import DETECTABLE, Verdict

_PICTURES = (
    ("confusion.png", "Confusion matrix"),
    ("reliability.png", "Reliability"),
    ("closure.png", "Closure"),
)

_WEAK = (
    f"Weak: visibility below {DETECTABLE:g} (root of the summed squares of what the effect changes,"
    " in standard deviations of the noise, over all samples and channels of the fit runs). Not to"
    " name a weak one is no error; to name something else instead is. Singles by visibility, weak"
    " ones included:"
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


def markdown(
    series: Any, scores: dict[str, Any], control: dict[str, Any], verdicts: Sequence[Verdict]
) -> str:
    """The page."""
    lines = [
        "# Blind trials",
        "",
        f"Seed {series.seed}, machine {series.machine}, {scores['trials']} trials of four runs of"
        f" {series.duration:g} s. Right means name and location; an ambiguous set that holds the"
        " truth counts.",
        "",
        "| what | value | asked | reached |",
        "| --- | ---: | --- | --- |",
    ]
    for name, target in scores["targets"].items():
        value = "-" if target["value"] is None else f"{target['value']:.3f}"
        word = {None: "no trial tells", True: "yes", False: "no"}[target["reached"]]
        lines.append(f"| {name} | {value} | {target['asked']} | {word} |")
    lines += ["", "| class | right | without weak ones | verdicts |", "| --- | --- | --- | --- |"]
    for kind, part in scores["classes"].items():
        words = "; ".join(f"{count} {word}" for word, count in part["verdicts"].items())
        clear = _share(part.get("right_without_weak"))
        lines.append(f"| {kind} | {_share(part['right'])} | {clear} | {words} |")
    lines += ["", _WEAK, "", "| visibility | right |", "| --- | --- |"]
    lines += [f"| {bin_} | {_share(part)} |" for bin_, part in scores["by_visibility"].items()]
    crossed = ", ".join(f"{kind} {_share(part)}" for kind, part in control.items())
    lines += ["", f"With the keys swapped between trials (must collapse): {crossed}.", ""]
    for file, title in _PICTURES:
        lines.append(f"![{title}]({file})")
    lines += ["", "## Answers that were not right", "",
              "| trial | class | planted | visibility | answered | verdict |",
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
