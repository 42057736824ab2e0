"""Write the report of a sweep: varied keys, ranges of the results and influence of each key.

The figures show each result over each varied key, and maps of each result over two grid keys.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import hydrotele
from hydrotele.core.output import atomic_file
from hydrotele.show import report_html
from hydrotele.show.report_html import figure_to_png, open_report_figure

RUN_COLOUR, MEAN_COLOUR, FAILED_COLOUR = "#9db4c8", "#1769aa", "#b5281c"
_MAX_COLUMNS, _MAX_MAP_COLUMNS = 4, 3
_MAX_BINS, _MIN_RUNS_PER_BIN = 8, 5
_MIN_LOG_SCALE_RATIO = 30.0  # ratio of largest and smallest value from which an axis is logarithmic
_MAX_ANNOTATED_CELLS = 60  # maximum number of cells of a map with printed values


class Study(NamedTuple):
    """Data of a sweep report.

    Attributes:
        name: name of the sweep.
        description: purpose of the sweep.
        scenario: name of the base scenario.
        columns: columns of the result table, {name: values}.
        units: units of the columns, {name: unit}.
        grid: keys with given values.
        sampled: keys with random values.
        log_sampled: sampled keys that are distributed on a logarithmic scale.
        figures: names of the results to show.
        failed: failed runs as (run, reason).
    """

    name: str
    description: str
    scenario: str
    columns: Mapping[str, Sequence[Any]]
    units: Mapping[str, str]
    grid: tuple[str, ...]
    sampled: tuple[str, ...]
    log_sampled: tuple[str, ...]
    figures: tuple[str, ...]
    failed: Sequence[tuple[int, str]]

    @property
    def varied_keys(self) -> tuple[str, ...]:
        """Keys with more than one value, or the seed if there is no such key."""
        keys = [key for key in (*self.grid, *self.sampled) if len(distinct_values(self.columns[key])) > 1]
        return tuple(keys) or ("seed",)


class DisplayedResult(NamedTuple):
    """Result in display units: label with unit, and values (n,) with NaN for failed runs."""

    label: str
    values: np.ndarray


def distinct_values(values: Sequence[Any]) -> list[Any]:
    """Return the distinct values; numbers are sorted, other values keep the order of occurrence."""
    found = list({json.dumps(value): value for value in values}.values())
    return sorted(found) if are_numbers(found) else found


def are_numbers(values: Sequence[Any]) -> bool:
    """Return whether all values are numbers."""
    return all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)


def convert_result_for_display(study: Study, name: str) -> DisplayedResult:
    """Convert a result of all runs from SI to a readable unit.

    Lengths are converted to mm if all are below 2 m, angles to deg, and forces to kN if the largest is
    at least 2 kN. Other results keep their unit.
    """
    given = study.columns[name]
    values = np.array([math.nan if v is None else float(v) for v in given])
    unit = study.units.get(name, "1")
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    factor = 1.0
    if unit == "m" and largest < 2.0:
        unit, factor = "mm", 1e3
    elif unit == "rad":
        unit, factor = "deg", 180.0 / math.pi
    elif unit == "N" and largest >= 2e3:
        unit, factor = "kN", 1e-3
    stem = name.removesuffix(f"_{study.units.get(name)}").replace("_", " ").replace(".", " ")
    return DisplayedResult(f"{stem} [{unit}]" if unit != "1" else stem, factor * values)


def key_label(study: Study, key: str) -> str:
    """Return a varied key with its unit for an axis label, such as `duration [s]`."""
    return f"{key} [{study.units[key]}]" if key in study.units else key


def draw_main_effects(study: Study) -> bytes:
    """Draw each result of a sweep over each varied key: runs as dots, means as a line.

    Args:
        study: data of the sweep.

    Returns:
        A PNG.
    """
    keys, across = study.varied_keys, min(_MAX_COLUMNS, len(study.varied_keys))
    per_figure = math.ceil(len(keys) / across)
    rows = per_figure * len(study.figures)
    with open_report_figure(0.3 + 2.35 * rows) as figure:
        axes = figure.subplots(rows, across, squeeze=False)
        for number, name in enumerate(study.figures):
            one = convert_result_for_display(study, name)
            block = axes[number * per_figure : (number + 1) * per_figure].ravel()
            for place, key in zip(block, keys, strict=False):
                _draw_effect(place, study, key, one)
                place.sharey(block[0]) if place is not block[0] else None
            for place in block[len(keys) :]:
                place.set_visible(False)
            for row in axes[number * per_figure : (number + 1) * per_figure]:
                row[0].set_ylabel(_fold_label(one.label))
        return figure_to_png(figure)


def _draw_effect(place, study: Study, key: str, result: DisplayedResult) -> None:
    values = study.columns[key]
    steps = distinct_values(values)
    spots = _axis_positions(values, steps)
    known = np.isfinite(result.values)
    place.plot(spots[known], result.values[known], "o", color=RUN_COLOUR, ms=3.2, alpha=0.75, mew=0)
    x, mean = _mean_curve(key in study.sampled and are_numbers(steps), spots[known], result.values[known])
    place.plot(x, mean, "-o", color=MEAN_COLOUR, lw=1.6, ms=4.2)
    lost = spots[~known]
    if len(lost):
        place.plot(lost, np.full(len(lost), 0.03), "x", color=FAILED_COLOUR, ms=5, clip_on=False,
                   transform=place.get_xaxis_transform())  # fmt: skip
    if not are_numbers(steps):
        place.set_xticks(range(len(steps)), [_format_level(step) for step in steps])
        place.set_xlim(-0.5, len(steps) - 0.5)
    elif key in study.log_sampled or (len(steps) > 2 and _needs_log_scale(spots)):
        place.set_xscale("log")
    if _needs_log_scale(result.values[known]):
        place.set_yscale("log")
    place.set_xlabel(key_label(study, key))


def _axis_positions(values: Sequence[Any], steps: list[Any]) -> np.ndarray:
    """Return positions on a plot axis: numbers themselves, else the index of each value in `steps`."""
    if are_numbers(steps):
        return np.array([float(value) for value in values])
    texts = [json.dumps(step) for step in steps]
    return np.array([float(texts.index(json.dumps(value))) for value in values])


def _mean_curve(binned: bool, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve of mean results: at each x or, if `binned` and few runs share an x, over bins of x.

    Few runs means fewer than five per distinct x. Runs with the same x are in one bin, so that all
    values of the other keys contribute to it.

    Args:
        binned: whether x are random numbers, which may be averaged over bins.
        x: (n,) values of the varied key.
        y: (n,) results.

    Returns:
        x and y of the curve; empty if there are too few runs for two bins.
    """
    there = np.unique(x)
    if not binned or len(x) >= _MIN_RUNS_PER_BIN * len(there):
        return there, np.array([y[x == value].mean() for value in there])
    bins = min(_MAX_BINS, len(there) // 2, len(x) // _MIN_RUNS_PER_BIN)
    if bins < 2:
        return np.empty(0), np.empty(0)
    parts = [np.isin(x, part) for part in np.array_split(there, bins)]
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts])


def _needs_log_scale(values: np.ndarray) -> bool:
    return len(values) > 0 and values.min() > 0.0 and values.max() > _MIN_LOG_SCALE_RATIO * values.min()


def find_heat_map_keys(study: Study) -> tuple[str, str] | None:
    """Return the two grid keys that span a heat map; None unless exactly two grid keys have several values."""
    keys = [key for key in study.grid if len(distinct_values(study.columns[key])) > 1]
    return (keys[0], keys[1]) if len(keys) == 2 else None


def draw_heat_maps(study: Study, keys: tuple[str, str]) -> bytes:
    """Draw a heat map of each result of a sweep over two varied keys; a cell is the mean of its runs.

    Args:
        study: data of the sweep.
        keys: keys along y and x.

    Returns:
        A PNG.
    """
    down, right = (distinct_values(study.columns[key]) for key in keys)
    rows, across = (
        math.ceil(len(study.figures) / _MAX_MAP_COLUMNS),
        min(_MAX_MAP_COLUMNS, len(study.figures)),
    )
    with open_report_figure(rows * min(max(2.6, 0.9 + 0.32 * len(down)), 6.0)) as figure:
        axes = figure.subplots(rows, across, squeeze=False)
        for place, name in zip(axes.ravel(), study.figures, strict=False):
            one = convert_result_for_display(study, name)
            cells = _average_into_cells(study, keys, one.values)
            place.grid(False)
            place.set_facecolor("0.85")
            scale = "log" if _needs_log_scale(cells[np.isfinite(cells)]) else "linear"
            image = place.imshow(cells, aspect="auto", origin="lower", cmap="viridis", norm=scale)
            figure.colorbar(image, ax=place, pad=0.02)
            place.set_title(_fold_label(one.label))
            place.set_xticks(range(len(right)), [_format_level(v) for v in right])
            place.set_yticks(range(len(down)), [_format_level(v) for v in down])
            place.set_xlabel(key_label(study, keys[1]))
            place.set_ylabel(key_label(study, keys[0]))
            if cells.size <= _MAX_ANNOTATED_CELLS:
                _print_cell_values(place, cells, image)
        for place in axes.ravel()[len(study.figures) :]:
            place.set_visible(False)
        return figure_to_png(figure)


def _average_into_cells(study: Study, keys: tuple[str, str], values: np.ndarray) -> np.ndarray:
    """Average the results of n runs over the cells that the values of two keys span.

    Args:
        study: data of the sweep.
        keys: names of the two keys.
        values: (n,) results, NaN for failed runs.

    Returns:
        (a, b) means for a distinct values of the first key and b of the second; NaN where no run
        succeeded.
    """
    texts = [[json.dumps(v) for v in distinct_values(study.columns[key])] for key in keys]
    cells = np.full((len(texts[0]), len(texts[1])), np.nan)
    places = [np.array([t.index(json.dumps(v)) for v in study.columns[key]])
              for t, key in zip(texts, keys, strict=True)]  # fmt: skip
    for i, j in np.ndindex(*cells.shape):
        here = values[(places[0] == i) & (places[1] == j)]
        here = here[np.isfinite(here)]
        cells[i, j] = here.mean() if len(here) else np.nan
    return cells


def _print_cell_values(place, cells: np.ndarray, image) -> None:
    for (i, j), value in np.ndenumerate(cells):
        dark = np.isfinite(value) and image.norm(value) < 0.6
        text = f"{value:.3g}" if np.isfinite(value) else "failed"
        place.text(j, i, text, ha="center", va="center", fontsize=8,
                   color="white" if dark else "#1d232b")  # fmt: skip


def _format_level(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 18 else f"{text[:17]}..."


def _fold_label(label: str) -> str:
    """Break a label of more than 26 characters into two lines, at the space nearest to its middle."""
    if len(label) <= 26:
        return label
    gaps = [i for i, letter in enumerate(label) if letter == " "]
    middle = min(gaps, key=lambda i: abs(i - len(label) / 2))
    return f"{label[:middle]}\n{label[middle + 1 :]}"


__all__ = ["Study", "write_sweep_report"]

_MAX_LISTED_FAILURES = 200


def write_sweep_report(study: Study, folder: Path) -> None:
    """Write `report.html` of a sweep and its figures as PNG.

    Args:
        study: data of the sweep.
        folder: existing output folder.

    Raises:
        InputError: the folder cannot be written.
    """
    images = {}
    if any(np.isfinite(convert_result_for_display(study, name).values).any() for name in study.figures):
        images["main_effects.png"] = draw_main_effects(study)
        if keys := find_heat_map_keys(study):
            images["heat_map.png"] = draw_heat_maps(study, keys)
    for name in ("main_effects.png", "heat_map.png"):
        if name in images:
            with atomic_file(folder / name, ".png") as part:
                part.write_bytes(images[name])
        else:
            (folder / name).unlink(missing_ok=True)
    with atomic_file(folder / "report.html", ".html") as part:
        _write_page(study, images, part)


def _write_page(study: Study, images: dict[str, bytes], path: Path) -> None:
    runs, failed = len(study.columns["run"]), len(study.failed)
    report_html.write_template_report(
        "sweep", path, title=f"sweep {study.name}", heading=study.name.replace("_", " "),
        over=f"hydrotele {hydrotele.__version__} - sweep of {study.scenario}",
        description=study.description, varied=_key_rows(study), spreads=_range_rows(study),
        figures=[
            ("", runs, "runs"),
            ("after", runs - failed, "succeeded"),
            ("before" if failed else "", failed, "failed"),
            ("", len(study.varied_keys), "keys varied"),
        ],
        main_effects=images.get("main_effects.png"), heat_map=images.get("heat_map.png"),
        failures=_failures(study), unlisted=max(failed - _MAX_LISTED_FAILURES, 0),
    )  # fmt: skip


def _key_rows(study: Study) -> list[tuple[str, str]]:
    rows = []
    for key in (*study.grid, *study.sampled):
        steps = distinct_values(study.columns[key])
        if key in study.sampled and are_numbers(steps):
            values = f"{len(steps)} random values from {steps[0]:.4g} to {steps[-1]:.4g}"
        else:
            values = ", ".join(map(_format_value, steps[:12])) + (" ..." if len(steps) > 12 else "")
        rows.append((key_label(study, key), values))
    seeds = distinct_values(study.columns["seed"])
    rows.append(("seed", ", ".join(map(str, seeds[:12])) + (" ..." if len(seeds) > 12 else "")))
    return rows


def _format_value(value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _range_rows(study: Study) -> list[dict[str, Any]]:
    rows = []
    for name in study.figures:
        one = convert_result_for_display(study, name)
        known = np.flatnonzero(np.isfinite(one.values))
        if not len(known):
            continue
        values = one.values[known]
        ends = [int(known[np.argmin(values)]), int(known[np.argmax(values)])]
        smallest, largest = (_describe_run(study, one.values[row], row) for row in ends)
        median = f"{np.median(values):.4g}"
        rows.append({"label": one.label, "smallest": smallest, "median": median, "largest": largest})
    return rows


def _describe_run(study: Study, value: float, row: int) -> tuple[str, str]:
    """Format a result and, as a second text, its run with the first three varied keys of the run.

    Args:
        study: data of the sweep.
        value: the result, in display units.
        row: row of the run in the table.
    """
    keys = ", ".join(f"{key} {_format_value(study.columns[key][row])}" for key in study.varied_keys[:3])
    return f"{value:.4g}", f"run {study.columns['run'][row]}: {keys}"


def _failures(study: Study) -> list[tuple[int, str, str]]:
    rows = []
    for run, reason in study.failed[:_MAX_LISTED_FAILURES]:
        keys = ", ".join(f"{key} {_format_value(study.columns[key][run - 1])}" for key in study.varied_keys)
        rows.append((run, keys, reason))
    return rows
