"""`report.html` and the picture of a calibrated serial robot."""

from collections.abc import Sequence
from typing import Any

import numpy as np

import hydrotele
from hydrotele.calibrate.mukca import LeftOut, SocketCalibration
from hydrotele.show.report_html import (
    STYLE,
    Markup,
    drawing,
    page,
    picture,
    png,
    section,
    table,
    tag,
)

NOMINAL, CALIBRATED = "#e07b00", "#1769aa"


def draw_sockets(found: SocketCalibration, left: Sequence[LeftOut]) -> bytes:
    """Distance of every row's ball from its socket's mean, and the distances of the sockets.

    Args:
        found: the calibration.
        left: places predicted without having been fitted; where there are none, the fit is shown.

    Returns:
        A PNG.
    """
    before, after, apart = {}, {}, {}
    for one in left:
        before |= one.nominal.rows
        after |= one.calibrated.rows
        apart |= one.calibrated.distances
    if not left:
        before, after, apart = found.before.rows, found.after.rows, found.after.distances
    names = list(after)
    with drawing(6.4) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=(1.7, 1.0))
        place = 0
        for k, name in enumerate(names):
            x = place + np.arange(len(after[name]))
            for rows, colour, label in (
                (before[name], NOMINAL, "nominal robot, ball fitted"),
                (after[name], CALIBRATED, "calibrated on the others" if left else "calibrated"),
            ):
                upper.plot(x, 1e3 * rows, ".", color=colour, ms=4, label="" if k else label)
                rms = 1e3 * float(np.sqrt(np.mean(rows**2)))
                upper.plot(x[[0, -1]], [rms, rms], color=colour, lw=1.6)
            if k % 2:
                upper.axvspan(place - 0.5, place + len(x) - 0.5, color="0.96", lw=0, zorder=0)
            place += len(x)
        middles = np.cumsum([0, *(len(after[n]) for n in names)])
        upper.set_xticks(0.5 * (middles[1:] + middles[:-1]))
        upper.set_xticklabels([n.replace("/", "\n").replace("hole_", "socket ") for n in names],
                              fontsize=7 if len(names) > 8 else 8.5)  # fmt: skip
        upper.tick_params(axis="x", length=0)
        upper.grid(axis="x", visible=False)
        upper.set_xlim(-0.5, place - 0.5)
        upper.set_yscale("log")
        upper.yaxis.set_major_formatter("{x:g}")
        upper.set_ylabel("ball from its socket's\nmean [mm]; lines: RMS")
        upper.set_title(f"{found.nominal.name}: consistency of the predicted ball")
        upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False,
                     fontsize=8.5, borderaxespad=0.1, markerscale=2.0)  # fmt: skip
        _draw_distances(lower, apart, found.options.distance)
        return png(figure)


def _draw_distances(plot: Any, apart: dict[str, float], given: float | None) -> None:
    if not apart:
        plot.set_axis_off()
        plot.text(0.0, 0.5, "no place has two sockets", transform=plot.transAxes)
        return
    values = 1e3 * np.array(list(apart.values()))
    x = np.arange(len(values))
    plot.plot(x, values, "o", color=CALIBRATED, ms=6)
    if given is not None:
        plot.axhspan(1e3 * given - 0.1, 1e3 * given + 0.1, color="0.5", alpha=0.15, lw=0)
        plot.axhline(1e3 * given, color="0.4", lw=1.0)
        reach = 1.25 * max(0.2, float(np.abs(values - 1e3 * given).max()))
        plot.set_ylim(1e3 * given - reach, 1e3 * given + reach)
    plot.set_xticks(x)
    plot.set_xticklabels(list(apart))
    plot.set_xlim(-0.6, len(values) - 0.4)
    plot.grid(axis="x", visible=False)
    plot.set_ylabel("sockets apart [mm]")
    plot.set_title("Distance of the sockets; grey: the tool's, +- 0.1 mm")


def robot_report(document: dict[str, Any], png_: bytes) -> str:
    """One page that needs nothing else.

    Args:
        document: `calibration.json`.
        png_: the picture.

    Returns:
        HTML.
    """
    parts = [
        _head(document),
        tag("figure", picture(png_, "distances of the ball from its sockets")),
    ]
    if document["heldout"]:
        rows = [
            (name, f"{one['nominal_rms_mm']:.3f}", f"{one['rms_mm']:.3f}",
             f"{one['rms_without_outliers_mm']:.3f}", one["model"])
            for name, one in document["heldout"]["parts"].items()
        ]  # fmt: skip
        parts.append(section(
            "Places that were not fitted", "Root mean square distance of the ball from its"
            " socket's mean, predicted by a calibration on all others.",
            table(("place", "nominal mm", "calibrated mm", "without outliers mm", "joints"), rows,
                  numbers="-nnn"),
        ))  # fmt: skip
    parts.append(_parameters(document))
    parts.append(_told(document))
    said = [*(f"{o['socket']}, row {o['row']}: {o['distance_mm']:.2f} mm from its socket, not"
              " fitted" for o in document["outliers"]), *document["notes"]]  # fmt: skip
    if said:
        parts.append(section("Notes", "What was left out, and what to know.",
                             tag("ul", *(tag("li", note) for note in said))))  # fmt: skip
    parts.append(tag("footer", f"hydrotele {hydrotele.__version__}, data {document['data']}"))
    return page(f"{document['robot']} calibrated", STYLE, parts)


def _head(document: dict[str, Any]) -> Markup:
    judged, fitted = document["heldout"], document["fitted"]
    figures = [
        ("before", fitted["nominal_rms_mm"], "nominal robot, RMS mm"),
        ("after", fitted["rms_mm"], "calibrated, on the fitted rows, RMS mm"),
    ]
    if judged:
        figures.append(("after", judged["rms_mm"], "calibrated, not fitted, RMS mm"))
    boxes = [
        tag("div", tag("b", f"{value:.3f}"), tag("span", what), class_=kind)
        for kind, value, what in figures
    ]
    return tag(
        "header", tag("p", "Closed-chain calibration from joint angles", class_="over"),
        tag("h1", f"{document['robot']}: {len(document['places'])} places,"
            f" {sum(document['rows'].values())} postures"),
        tag("p", f"Joints: {document['model']}. Noise of a coordinate {document['noise_mm']:.3f}"
            f" mm. Search: {document['status']}."),
        tag("div", *boxes, class_="figures"),
    )  # fmt: skip


def _parameters(document: dict[str, Any]) -> Markup:
    rows = []
    for one in document["parameters"]:
        unit, factor = _customary(one["unit"])
        reach = "" if one["std"] is None else f"{0.5 * factor * (one['high'] - one['low']):.2g}"
        told = {"full": "by itself", "combination": "with others"}.get(one["told"], "no")
        rows.append((one["name"], f"{factor * one['value']:.4g}", reach, unit, told))
    return section(
        "Parameters", "t and r: displacement along and rotation about the axes of a joint's frame,"
        " z being the joint's axis; rz is the offset of its angle. sag: yielding of a joint under"
        " a weight at a place beyond. sine and cosine: error of an encoder once per turn.",
        table(("parameter", "value", "95 % +-", "unit", "told"), rows, numbers="-nn"),
    )  # fmt: skip


def _told(document: dict[str, Any]) -> Markup:
    units = {one["name"]: one["unit"] for one in document["parameters"]}
    rows = []
    for one in document["told"]:
        unit, factor = _customary(units[one["text"].split()[0]])
        reach = f"{0.5 * factor * (one['high'] - one['low']):.2g}"
        rows.append((one["text"], f"{factor * one['value']:.4g}", reach, unit))
    return section(
        "What the data tell", "A parameter or combination is told if its uncertainty is below half"
        " of its expected size in the noise that there is. How a combination is split between its"
        " parameters follows from their expected sizes, not from the data.",
        table(("parameter or combination", "value", "95 % +-", "unit"), rows, numbers="-nn"),
        tag("p", tag("b", "not told at all: "), ", ".join(document["unknown"]) or "none"),
    )  # fmt: skip


def _customary(unit: str) -> tuple[str, float]:
    return {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}.get(unit, (unit, 1.0))
