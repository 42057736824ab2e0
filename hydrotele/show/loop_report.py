"""Page and map of a teleoperated scenario's linear loop."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hydrotele.show.report_html import STYLE, drawing, page, picture, png, section, table, tag
from hydrotele.teleop.analysis import stability_map
from hydrotele.teleop.findings import said_size
from hydrotele.teleop.loop_findings import ScenarioFindings

_DELAYS, _FACTORS = 13, 25
_LONGEST = 0.3  # s each way
_SPAN = (0.05, 20.0)  # of the largest stable ratio


def draw_loop_map(found: ScenarioFindings) -> bytes:
    """Where the loop is stable, over delay and reflected force at the machine's force limit.

    Args:
        found: the findings.

    Returns:
        A PNG.
    """
    case, loop = found.case, found.loop
    margin = loop.gain_margin if np.isfinite(loop.gain_margin) and loop.gain_margin > 0.0 else 1.0
    delays = _LONGEST * np.linspace(0.0, 1.0, _DELAYS)
    factors = margin * np.geomspace(*_SPAN, _FACTORS)
    good = stability_map(case, loop.structure, delays, factors)
    with drawing(3.4) as figure:
        axes = figure.subplots()
        axes.pcolormesh(
            1e3 * delays, factors * case.ratio * case.force_limit, good, cmap="Blues", vmin=-0.3,
            vmax=1.6, shading="nearest",
        )  # fmt: skip
        now = 500.0 * (case.delay_forward + case.delay_back)
        axes.plot(now, case.ratio * case.force_limit, "o", color="#e07b00", ms=8, clip_on=False)
        axes.set_yscale("log")
        axes.set_xlabel("delay each way [ms]")
        axes.set_ylabel(f"hand force at {case.force_limit / 1e3:g} kN [N]")
        axes.set_title(f"{loop.structure}: blue is stable, the point is the scenario")
        return png(figure)


def write_loop_report(
    found: ScenarioFindings, said: Sequence[tuple[str, str, str]], map_: bytes, path: Path
) -> None:
    """Write a scenario's analysis as one self-contained HTML file.

    Args:
        found: the findings.
        said: (what, value, remark) of every finding.
        map_: a PNG.
        path: file to write.
    """
    rows = [(tag("b", what), value, remark) for what, value, remark in said]
    springs = [
        (tag("b", name), f"{one.damping:g}", f"{one.most:g}", said_size(one.margin),
         f"{one.enough_damping:.4g}", f"{one.growth:.3g}")
        for name, one in (("held", found.held), ("let go", found.free))
    ]  # fmt: skip
    head = ("joystick", "B", "K_max", "B² - 4 M K_max", "B that it asks for", "growth")
    verdict = "Stable" if found.loop.stable else "Unstable"
    sections = [
        tag("header", tag("p", f"TELEOPERATED SCENARIO  ·  {found.name}", class_="over"),
            tag("h1", f"{verdict}: {found.loop.structure}")),
        section("What was found", "The scenario's own numbers, linear about its contact pose.",
                table(("what", "value", ""), rows, numbers=" n")),
        section("Stability over delay and reflection", "Without dead bands, stops and limits.",
                tag("figure", picture(map_, "map"))),
        section("Stiffness feedback", "Stable whatever comes back if the margin is positive (Zhu"
                " 1994, 4.14). Growth of half a swing at the worst switching: stable below 1.",
                table(head, springs, numbers=" nnnnn")),
    ]  # fmt: skip
    Path(path).write_text(page(f"{found.name}: loop", STYLE, sections), encoding="utf-8")
