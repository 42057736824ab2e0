"""The report of a sweep: what was varied, how far every number spreads, and what does it."""

from pathlib import Path

import numpy as np

import hydrotele
from hydrotele.core.output import replacing
from hydrotele.show.report_html import Cell, Markup, page, picture, section, table, tag
from hydrotele.show.report_style import STYLE
from hydrotele.show.sweep_figures import (
    Study,
    draw_heat_maps,
    draw_main_effects,
    key_label,
    levels,
    map_keys,
    numeric,
    shown,
)

__all__ = ["Study", "write_sweep_report"]

_LISTED = 200


def write_sweep_report(study: Study, folder: Path) -> None:
    """Write `report.html` and its pictures as PNG.

    Args:
        study: what to show.
        folder: where.

    Raises:
        InputError: the folder cannot be written.
    """
    images = {}
    if any(np.isfinite(shown(study, name).values).any() for name in study.figures):
        images["main_effects.png"] = draw_main_effects(study)
        if keys := map_keys(study):
            images["heat_map.png"] = draw_heat_maps(study, keys)
    for name in ("main_effects.png", "heat_map.png"):
        if name in images:
            with replacing(folder / name, ".png") as part:
                part.write_bytes(images[name])
        else:
            (folder / name).unlink(missing_ok=True)
    with replacing(folder / "report.html", ".html") as part:
        part.write_text(_page(study, images), encoding="utf-8")


def _page(study: Study, images: dict[str, bytes]) -> str:
    runs = len(study.columns["run"])
    parts = [_head(study, runs), section("What was varied", "", _varied(study))]
    if images:
        why = "Means over the runs that succeeded are in the pictures, single runs here."
        parts.append(section("How far the numbers spread", why, _spreads(study)))
        why = ("Dots are runs, the line is their mean at each value of the key while all other keys"
               " vary (of random values over bins of neighbours); red crosses are runs that"
               " failed.")  # fmt: skip
        image = picture(images["main_effects.png"], "main effects")
        parts.append(section("What each key does", why, tag("figure", image)))
    if "heat_map.png" in images:
        image = picture(images["heat_map.png"], "maps of two keys")
        why = "Mean of all runs of a cell; grey where all of them failed."
        parts.append(section("Both keys together", why, tag("figure", image)))
    if study.failed:
        parts.append(_failures(study))
    parts.append(tag("footer", "All runs with all numbers and their units: table.parquet."))
    return page(f"sweep {study.name}", STYLE, parts)


def _head(study: Study, runs: int) -> Markup:
    failed = len(study.failed)
    numbers = [
        (str(runs), "runs", ""),
        (str(runs - failed), "succeeded", "after"),
        (str(failed), "failed", "before" if failed else ""),
        (str(len(study.varied)), "keys varied", ""),
    ]
    boxes = [tag("div", tag("b", n), tag("span", what), class_=c) for n, what, c in numbers]
    return tag(
        "header",
        tag("p", f"hydrotele {hydrotele.__version__} - sweep of {study.scenario}", class_="over"),
        tag("h1", study.name.replace("_", " ")),
        tag("p", study.description),
        tag("div", *boxes, class_="figures"),
    )


def _varied(study: Study) -> Markup:
    rows = []
    for key in (*study.grid, *study.sampled):
        steps = levels(study.columns[key])
        if key in study.sampled and numeric(steps):
            said = f"{len(steps)} random values from {steps[0]:.4g} to {steps[-1]:.4g}"
        else:
            said = ", ".join(map(_text, steps[:12])) + (" ..." if len(steps) > 12 else "")
        rows.append((key_label(study, key), said))
    seeds = levels(study.columns["seed"])
    rows.append(("seed", ", ".join(map(str, seeds[:12])) + (" ..." if len(seeds) > 12 else "")))
    return table(("key", "values"), rows)


def _text(value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _spreads(study: Study) -> Markup:
    rows = []
    for name in study.figures:
        one = shown(study, name)
        known = np.flatnonzero(np.isfinite(one.values))
        if not len(known):
            continue
        values = one.values[known]
        ends = [int(known[np.argmin(values)]), int(known[np.argmax(values)])]
        cells = [_run(study, one.values[row], row) for row in ends]
        rows.append((one.label, cells[0], f"{np.median(values):.4g}", cells[1]))
    return table(("number", "smallest", "median", "largest"), rows, numbers="-nnn")


def _run(study: Study, value: float, row: int) -> Cell:
    keys = ", ".join(f"{key} {_text(study.columns[key][row])}" for key in study.varied[:3])
    said = f"run {study.columns['run'][row]}: {keys}"
    return Cell(Markup(f"{tag('b', f'{value:.4g}')}{tag('small', said)}"))


def _failures(study: Study) -> Markup:
    rows = []
    for run, reason in study.failed[:_LISTED]:
        keys = ", ".join(f"{key} {_text(study.columns[key][run - 1])}" for key in study.varied)
        rows.append((run, keys, Cell(reason, "no")))
    left = len(study.failed) - len(rows)
    why = f"{left} more stand in the table." if left else ""
    return section("Runs that failed", why, table(("run", "keys", "reason"), rows, numbers="n"))
