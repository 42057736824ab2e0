"""Write the HTML reports of teleoperator analyses and draw their figures.

The figures of a case show hybrid matrix, transmitted impedance, scattering norm, Nyquist curves,
stability maps and stiffness feedback. The report of a scenario shows the properties and the
stability map of its linear loop.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.show import report_html
from hydrotele.show.report_html import figure_to_png, open_report_figure
from hydrotele.show.teleop_text import (
    describe_stability,
    format_delay,
    format_gain_margin,
    format_number,
    format_relative_error,
)
from hydrotele.teleop.case_analysis import TeleopFindings
from hydrotele.teleop.linear_analysis import stability_map
from hydrotele.teleop.scenario_analysis import ScenarioFindings
from hydrotele.teleop.stiffness_switching import StiffnessAxis, compute_switching_growth_map
from hydrotele.teleop.two_port import Impedance

_INK, _GREY_COLOUR = "#262b33", "#8a94a0"
_WORST_CASE_STABLE_COLOUR, _STABLE_COLOUR, _UNSTABLE_COLOUR = "#cfe3f4", "#7fb2dd", "#f6ddd3"
_LINE_STYLES = {
    "position_position": ("#1769aa", "-"), "rate_position": ("#1769aa", (0, (4, 1.6))),
    "position_force": ("#e07b00", "-"), "rate_force": ("#e07b00", (0, (4, 1.6))),
    "four_channel_position": ("#23794a", "-"), "four_channel_rate": ("#23794a", (0, (4, 1.6))),
}  # fmt: skip
_HYBRID_TITLES = (
    ("h11: impedance felt with a free slave [N s/m]", "h12: reflected force / task force [1]"),
    ("h21: slave velocity / hand velocity [1]", "h22: admittance of the slave [m/(N s)]"),
)
_NYQUIST_LIMITS = (-3.0, 1.5, -2.25, 2.25)


def display_name(structure: str) -> str:
    """Format the name of a teleoperation structure (kind of control and feedback) for display.

    >>> display_name("four_channel_rate")
    'four-channel rate'
    """
    return structure.replace("four_channel_", "four-channel ").replace("_", "-")


def draw_hybrid_matrix(found: TeleopFindings) -> bytes:
    """Draw the magnitudes of the elements of a teleoperator's hybrid matrix over frequency.

    There is one curve per structure. The hybrid matrix maps hand velocity and task force to hand force
    and slave velocity.

    Args:
        found: results of the analysis.

    Returns:
        A PNG.
    """
    with open_report_figure(6.2) as figure:
        axes = figure.subplots(2, 2, sharex=True)
        for row in range(2):
            for column in range(2):
                panel = axes[row, column]
                panel.set_title(_HYBRID_TITLES[row][column])
                if row != column:
                    panel.axhline(1.0, color=_GREY_COLOUR, lw=1.2, dashes=(1, 1.5))
                for one in found.analyses:
                    _plot_over_frequency(panel, one, np.abs(one.hybrid_matrices[:, row, column]))
                _set_log_axes(panel, 1e-4, 1e5)
        for panel in axes[1]:
            panel.set_xlabel("frequency [Hz]")
        _legend(figure, axes[0, 0])
        return figure_to_png(figure)


def draw_transmitted_impedance(found: TeleopFindings) -> bytes:
    """Draw the impedance that the operator feels over frequency, with that of the task, as PNG.

    The panels are magnitude and phase, with one curve per structure.
    """
    with open_report_figure(4.2) as figure:
        left, right = figure.subplots(1, 2, sharex=True)
        first = found.analyses[0]
        hertz = first.frequencies / (2.0 * np.pi)
        left.plot(hertz, np.abs(first.task_impedance), color=_INK, lw=4.0, alpha=0.25, label="task")
        right.plot(hertz, np.degrees(np.angle(first.task_impedance)), color=_INK, lw=4.0, alpha=0.25)
        for one in found.analyses:
            _plot_over_frequency(left, one, np.abs(one.transmitted_impedance))
            _plot_over_frequency(right, one, np.degrees(np.unwrap(np.angle(one.transmitted_impedance))))
        _set_log_axes(left, 1e-1, 1e7)
        left.set_title("magnitude of the felt impedance [N s/m]")
        right.set_title("phase of the felt impedance [deg]")
        right.set_ylim(-360.0, 180.0)
        right.set_yticks(range(-360, 181, 90))
        for panel in (left, right):
            panel.set_xlabel("frequency [Hz]")
        _legend(figure, left)
        return figure_to_png(figure)


def draw_scattering(found: TeleopFindings) -> bytes:
    """Draw the norm of a teleoperator's scattering matrix over frequency, per structure, as PNG.

    Above 1, the teleoperator is not passive: it can emit energy.
    """
    with open_report_figure(3.4) as figure:
        panel = figure.subplots()
        top = max(float(one.scattering_norms.max()) for one in found.analyses)
        panel.axhspan(1.0, 1.3 * top, color=_UNSTABLE_COLOUR, alpha=0.5, lw=0)
        panel.axhline(1.0, color=_INK, lw=1.0)
        for one in found.analyses:
            _plot_over_frequency(panel, one, one.scattering_norms)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_ylim(0.8, 1.3 * top)
        panel.set_xlabel("frequency [Hz]")
        panel.set_title("norm of the scattering matrix [1]; above 1 (red) it is not passive")
        _legend(figure, panel)
        return figure_to_png(figure)


def draw_nyquist(found: TeleopFindings) -> bytes:
    """Draw Nyquist curves of the force-reflection loop, with the task and in free motion, as PNG.

    There is one panel per structure.
    """
    with open_report_figure(3.1 * _count_panel_rows(found)) as figure:
        for panel, one in zip(_panels(figure, found), found.analyses, strict=False):
            colour = _LINE_STYLES[one.structure][0]
            for curve, look, name in (
                (one.loop_gains, {"color": colour, "lw": 1.4}, "with the task"),
                (one.loop_free, {"color": _GREY_COLOUR, "lw": 1.1}, "free motion"),
            ):
                panel.plot(np.real(curve), np.imag(curve), label=name, **look)
                panel.plot(np.real(curve), -np.imag(curve), **(look | {"alpha": 0.35}))
            panel.plot(-1.0, 0.0, "+", color="#b5281c", ms=10, mew=2)
            panel.axis(_NYQUIST_LIMITS)
            panel.set_aspect("equal")
            panel.set(xlabel="real part [1]", ylabel="imaginary part [1]")
            said = "stable" if one.is_stable_held else describe_stability(one).removeprefix("no, ")
            panel.set_title(f"{display_name(one.structure)}: {said}")
            panel.legend(loc="upper right", fontsize=8, frameon=False)
        return figure_to_png(figure)


def draw_stability_maps(found: TeleopFindings) -> bytes:
    """Draw where each structure is stable, over one-way delay and factor on the reflected signal, as PNG.

    There is one panel per structure. A point marks the case itself. Crosses mark cells in which a
    simulation disagrees.
    """
    with open_report_figure(2.9 * _count_panel_rows(found)) as figure:
        seen = {one.structure: one.simulated for one in found.agreements}
        for panel, (name, cells) in zip(_panels(figure, found), found.maps.items(), strict=False):
            _draw_cell_map(panel, 1e3 * found.delays, found.factors, cells, (_UNSTABLE_COLOUR, _STABLE_COLOUR))
            panel.set_yscale("log")
            _set_root_scale(panel, 1e3 * found.delays)
            panel.plot(1e3 * found.case.delay, 1.0, "o", color=_INK, ms=6, clip_on=False)
            if name in seen:
                row, column = np.nonzero(seen[name] != cells)
                panel.plot(1e3 * found.delays[column], found.factors[row], "x", color="#b5281c", ms=5)
            panel.set_title(display_name(name))
            panel.set_xlabel("one-way delay [ms]")
            panel.set_ylabel("factor on reflection [1]")
            panel.grid(False)
        _draw_map_legend(figure)
        return figure_to_png(figure)


def draw_stiffness_stability(spring: StiffnessAxis, held: StiffnessAxis) -> bytes:
    """Draw the stability of a joystick with force-dependent stiffness over damping and maximum stiffness.

    With damping B, mass M and maximum stiffness K_max, the joystick is stable for B^2 - 4 M K_max > 0. The
    left panel shows this margin. The right one shows where the joystick is stable by it, where only the
    computed motion under the worst switching of the stiffness decays, and where neither holds.

    Args:
        spring: joystick without a hand.
        held: joystick with the operator's hand; its mass and minimum stiffness are used.

    Returns:
        A PNG.
    """
    damping = np.linspace(0.0, 1.25 * max(held.stability_theorem_damping, held.damping), 91)
    stiffest = np.geomspace(held.min_stiffness or 1e-2 * held.max_stiffness, 4.0 * held.max_stiffness, 91)
    growth = compute_switching_growth_map(held.mass, held.min_stiffness, damping, stiffest)
    margin = damping[None, :] ** 2 - 4.0 * held.mass * stiffest[:, None]
    with open_report_figure(4.0) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _draw_margin(figure, left, damping, stiffest, margin)
        kinds = np.where(margin > 0.0, 2, np.where(growth < 1.0, 1, 0))
        _draw_cell_map(
            right,
            damping,
            stiffest,
            kinds,
            (_UNSTABLE_COLOUR, _WORST_CASE_STABLE_COLOUR, _STABLE_COLOUR),
        )
        right.set_title("stable by margin (dark), stable in worst case (light), unstable (red)")
        edge = 2.0 * np.sqrt(held.mass * stiffest)
        for panel in (left, right):
            panel.plot(edge, stiffest, color=_INK, lw=1.6)
            panel.plot(held.damping, held.max_stiffness, "o", color=_INK, ms=7)
            panel.annotate("this case,\nheld", (held.damping, held.max_stiffness), (9, -4),
                           textcoords="offset points", fontsize=8.5, va="top")  # fmt: skip
            panel.set(yscale="log", xlim=(0.0, damping[-1]), xlabel="damping B [N s/m]")
            panel.set_ylim(stiffest[0], stiffest[-1])
            panel.grid(False)
        left.set_ylabel("maximum stiffness K_max [N/m]")
        return figure_to_png(figure)


def _draw_margin(figure: Any, panel: Any, damping: np.ndarray, stiffest: np.ndarray, margin: np.ndarray):
    """Draw the stability margin over damping and stiffness, with a colour scale symmetric about 0.

    Args:
        figure: figure for the colour bar.
        panel: axes to draw in.
        damping: (n,) damping B [N s/m].
        stiffest: (m,) maximum stiffness K [N/m].
        margin: (m, n) values of B^2 - 4 M K [(N s/m)^2].
    """
    reach = float(np.percentile(np.abs(margin), 80.0)) / 1e3
    shown = panel.pcolormesh(damping, stiffest, margin / 1e3, cmap="RdBu", vmin=-reach, vmax=reach, shading="nearest")
    figure.colorbar(shown, ax=panel, extend="both", pad=0.02)
    panel.set_title("margin B² - 4 M K [1000 (N s/m)²]")


def _draw_cell_map(panel: Any, x: np.ndarray, y: np.ndarray, kinds: np.ndarray, colours: tuple) -> None:
    """Draw a map of cells over x (n,) and y (m,); the integer `kinds` (m, n) select the colours."""
    from matplotlib.colors import ListedColormap

    panel.pcolormesh(
        x, y, kinds.astype(int), cmap=ListedColormap(list(colours)), vmin=0,
        vmax=len(colours) - 1, shading="nearest", rasterized=True,
    )  # fmt: skip


def _set_root_scale(panel: Any, delays: np.ndarray) -> None:
    """Give the delay axis [ms] a square-root scale, which enlarges short delays."""
    panel.set_xscale("function", functions=(lambda x: np.sqrt(np.maximum(x, 0.0)), np.square))
    panel.set_xlim(0.0, delays[-1])
    ticks = [tick for tick in (0, 5, 20, 50, 100, 200, 500, 1000, 2000) if tick <= delays[-1]]
    panel.set_xticks(ticks, [str(tick) for tick in ticks])


def _plot_over_frequency(panel: Any, one: Any, values: np.ndarray) -> None:
    colour, style = _LINE_STYLES[one.structure]
    hertz = one.frequencies / (2.0 * np.pi)
    panel.plot(hertz, values, color=colour, ls=style, lw=1.4, label=display_name(one.structure))


def _set_log_axes(panel: Any, least: float, most: float) -> None:
    """Make both axes of a panel logarithmic, and restrict the y limits to the range from `least` to `most`.

    The range excludes rounding errors and unbounded resonances.
    """
    panel.set_xscale("log")
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    panel.set_ylim(max(low, least), min(high, most))


def _legend(figure: Any, panel: Any) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4, frameon=False, fontsize=8.5)


def _draw_map_legend(figure: Any) -> None:
    """Draw the legend of the stability maps: stable, unstable, this case."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    point = Line2D([], [], color=_INK, marker="o", ls="")
    figure.legend(
        [Patch(color=_STABLE_COLOUR), Patch(color=_UNSTABLE_COLOUR), point], ["stable", "unstable", "this case"],
        loc="outside upper left", ncols=3, frameon=False, fontsize=8.5,
    )  # fmt: skip


def _count_panel_rows(found: TeleopFindings) -> int:
    return -(-len(found.analyses) // 3)


def _panels(figure: Any, found: TeleopFindings) -> list:
    """Create one panel per structure, three per row; hide unused panels."""
    panels = list(figure.subplots(_count_panel_rows(found), 3, squeeze=False).flat)
    for panel in panels[len(found.analyses) :]:
        panel.set_axis_off()
    return panels[: len(found.analyses)]


_CHANNELS = {
    "position_position": "position control, reflects the slave position (coordinating force)",
    "position_force": "position control, reflects the task force (direct force)",
    "four_channel_position": "position control, all four channels; transparent without delay",
    "rate_position": "rate control, reflects the slave position (coordinating force)",
    "rate_force": "rate control, reflects the task force (direct force)",
    "four_channel_rate": "rate control, all four channels, without jerk",
}


def write_teleop_report(found: TeleopFindings, maps: bytes, path: str | Path) -> None:
    """Write the report of a teleoperator case as one self-contained HTML file.

    Args:
        found: results of the analysis.
        maps: PNG of the stability maps, from `draw_stability_maps`.
        path: file to write.
    """
    spring, case = found.spring, found.case
    good, many = [one for one in found.analyses if one.is_stable_held], len(found.analyses)
    gains, names = case.gains, ", ".join(display_name(one.structure) for one in good)
    report_html.write_template_report(
        "two_port", path, title=f"{found.name}: teleoperator",
        over=f"TELEOPERATOR ANALYSIS  ·  {found.name}  ·  delay {1e3 * case.delay_forward:g} ms"
        f" forward, {1e3 * case.delay_back:g} ms back",
        heading=f"Stable: {names}" if good else "No structure is stable",
        chip=("no_gap", "All stable") if len(good) == many
        else ("ambiguous", "Some unstable") if good else ("unknown", "Unstable"),
        figures=_key_figure_cards(found), verdicts=_verdicts(found), confirmed=_simulation_agreement_rows(found),
        pictures={
            "maps": maps, "nyquist": draw_nyquist(found), "felt": draw_transmitted_impedance(found),
            "scattering": draw_scattering(found), "hybrid": draw_hybrid_matrix(found),
        },
        stiffness=_stiffness_content(spring, spring.with_hand(case.hand)) if spring else None,
        gains=f"position {gains.position:g}, velocity {gains.velocity:g} 1/s, force"
        f" {gains.force:g}",
        impedances=_impedances(found), version=hydrotele.__version__,
    )  # fmt: skip


def _key_figure_cards(found: TeleopFindings) -> list[tuple[str, str, str]]:
    many, good = len(found.analyses), sum(one.is_stable_held for one in found.analyses)
    passive = sum(one.has_passive_port for one in found.analyses)
    cards = [
        ("after", f"{good} of {many}", "structures stable in contact and in free motion"),
        ("", f"{passive} of {many}", "passive two-ports: stable with any passive hand and task"),
    ]
    if found.agreements:
        worst = min(one.agreement_fraction for one in found.agreements)
        what = "of the map cells confirmed by simulation (lowest of all structures)"
        cards.append(("after", f"{100 * worst:.1f} %", what))
        errors = [s.max_relative_error for s in found.sweeps if s.max_relative_error is not None]
        if errors:
            what = "largest impedance error of a sine sweep"
            cards.append(("after", f"{100 * max(errors):.2f} %", what))
    return cards


def _verdicts(found: TeleopFindings) -> list[dict[str, Any]]:
    return [
        {
            "name": display_name(one.structure), "channels": _CHANNELS[one.structure],
            "stable": one.is_stable_held, "why": describe_stability(one), "passive": one.has_passive_port,
            "texts": (format_gain_margin(one.gain_margin), format_delay(one.max_delay),
                      f"{one.scattering_norms.max():.3g}"),
        }
        for one in found.analyses
    ]  # fmt: skip


def _simulation_agreement_rows(found: TeleopFindings) -> list[tuple[str, ...]]:
    rows = []
    for one in found.agreements:
        errors = [format_relative_error(s.max_relative_error) for s in found.sweeps if s.structure == one.structure]
        cells = f"{int((one.predicted == one.simulated).sum())} of {one.simulated.size}"
        rows.append((display_name(one.structure), *[*errors, "-"][:2], cells))
    return rows


def _stiffness_content(spring: StiffnessAxis, held: StiffnessAxis) -> dict[str, Any]:
    rows = [
        (name, f"{one.mass:.3g}", f"{one.damping:.4g}", f"{one.min_stiffness:g} to {one.max_stiffness:g}",
         format_number(one.stability_theorem_margin), f"{one.stability_theorem_damping:.4g}",
         f"{one.half_swing_growth:.3g}")
        for name, one in (("held", held), ("released", spring))
    ]  # fmt: skip
    safe = held.half_swing_growth < 1.0
    conclusion = (
        "The margin of the held joystick is positive: no change of the stiffness makes it unstable."
        if held.stability_theorem_margin > 0.0
        else "The margin of the held joystick is not positive, so that the theorem does not decide"
        " its stability. Under the worst-case switching of the stiffness, each half oscillation"
        f" {'shrinks' if safe else 'grows'} to {held.half_swing_growth:.3g} times the previous one: the"
        f" joystick is {'stable' if safe else 'unstable'}."
    )
    return {"rows": rows, "conclusion": conclusion, "picture": draw_stiffness_stability(spring, held)}


def _impedances(found: TeleopFindings) -> list[tuple[str, ...]]:
    case = found.case
    parts: list[tuple[str, Impedance]] = [
        ("master", case.master), ("controller of the master", case.master_control),
        ("hand", case.hand), ("slave", case.slave),
        ("controller of the slave", case.slave_control), ("task", case.task),
    ]  # fmt: skip
    return [(name, f"{z.mass:.4g}", f"{z.damping:.4g}", f"{z.stiffness:.6g}") for name, z in parts]


_N_DELAYS, _N_FACTORS = 13, 25
_MAX_DELAY = 0.3  # s, maximum one-way delay of the map
_RATIO_RANGE = (0.05, 20.0)  # range of the map, relative to the maximum stable ratio


def draw_loop_map(found: ScenarioFindings) -> bytes:
    """Draw where the force-reflection loop of a scenario is stable, over delay and reflected force.

    The horizontal axis is the one-way delay. The vertical axis is the hand force when the machine
    exerts its maximum force; it grows with the reflection ratio. A point marks the scenario.

    Args:
        found: results of the analysis.

    Returns:
        A PNG.
    """
    case, loop = found.case, found.loop
    margin = loop.gain_margin if np.isfinite(loop.gain_margin) and loop.gain_margin > 0.0 else 1.0
    delays = _MAX_DELAY * np.linspace(0.0, 1.0, _N_DELAYS)
    factors = margin * np.geomspace(*_RATIO_RANGE, _N_FACTORS)
    good = stability_map(case, loop.structure, delays, factors)
    with open_report_figure(3.4) as figure:
        axes = figure.subplots()
        axes.pcolormesh(
            1e3 * delays, factors * case.ratio * case.force_limit, good, cmap="Blues", vmin=-0.3,
            vmax=1.6, shading="nearest",
        )  # fmt: skip
        now = 500.0 * (case.delay_forward + case.delay_back)
        axes.plot(now, case.ratio * case.force_limit, "o", color="#e07b00", ms=8, clip_on=False)
        axes.set_yscale("log")
        axes.set_xlabel("one-way delay [ms]")
        axes.set_ylabel(f"hand force at {case.force_limit / 1e3:g} kN [N]")
        axes.set_title(f"{loop.structure}; blue: stable, point: scenario")
        return figure_to_png(figure)


def write_loop_report(
    found: ScenarioFindings,
    findings_rows: Sequence[tuple[str, str, str]],
    map_png: bytes,
    path: Path,
) -> None:
    """Write the report of a scenario analysis as one self-contained HTML file.

    Args:
        found: results of the analysis.
        findings_rows: results as text: (quantity, value, remark).
        map_png: PNG of the stability map, from `draw_loop_map`.
        path: file to write.
    """
    springs = [
        (name, f"{one.damping:g}", f"{one.max_stiffness:g}", format_number(one.stability_theorem_margin),
         f"{one.stability_theorem_damping:.4g}",
         f"{one.half_swing_growth:.3g}")
        for name, one in (("held", found.held_spring), ("released", found.released_spring))
    ]  # fmt: skip
    report_html.write_template_report(
        "loop", path, title=f"{found.name}: loop", over=f"TELEOPERATED SCENARIO  ·  {found.name}",
        heading=f"{'Stable' if found.loop.is_stable else 'Unstable'}: {found.loop.structure}",
        findings=findings_rows, map=map_png, springs=springs,
    )  # fmt: skip
