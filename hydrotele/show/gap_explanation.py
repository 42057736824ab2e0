"""Two sections of the gap report: initial regressions, and why the verdict.

The module formats the tables and sentences and draws measured points with fitted and nominal lines, and the residual
inputs over time with what the accepted effects add.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from hydrotele.core.units import plot_axis_unit
from hydrotele.gap.description import effect_title, failed_tests, lack_title, probability_text, share_words
from hydrotele.gap.result import (
    SURE,
    Alternative,
    Comparison,
    Estimate,
    Gap,
    InputTrace,
    Regression,
    Rejection,
    amount,
    in_customary_units,
)
from hydrotele.machine.machine import Machine
from hydrotele.show.report_html import figure_to_png, open_report_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MEASURED_COLOUR, NOMINAL_COLOUR, FITTED_COLOUR = "#262b33", "#e07b00", "#1769aa"
_ROW_HEIGHT = 2.1  # inch of a row of plots
_LINE_POINTS = 200  # of a drawn line
_COEFFICIENTS = {
    "factor": "measured over model", "viscous": "viscous friction", "coulomb": "Coulomb friction",
    "per_position": "force per position", "constant": "constant",
}  # fmt: skip
_BALANCES = {"force": "force", "flow": "flow", "length": "cylinder length"}


# -- initial regressions ----------------------------------------------------------------------------------------------


def regression_content(gap: Gap) -> dict[str, Any] | None:
    """Return the content of the report section on the initial regressions; None if there are none.

    Returns:
        `errors`: description and probability of each gross error of the log or machine file.
        `rows`: table rows of the coefficients. `picture`: PNG of the force and flow regressions,
        None without them.
    """
    found = gap.initial
    if found is None or not (found.regressions or found.errors):
        return None
    shown = [r for r in found.regressions if r.balance != "length"]
    return {
        "errors": [(error.description, probability_text(error.probability)) for error in found.errors],
        "rows": [row for r in found.regressions for row in _regression_rows(r)],
        "picture": draw_regressions(shown, gap.machine) if shown else None,
    }


def _regression_rows(one: Regression) -> list[tuple[str, ...]]:
    """Return the table rows of one regression, one row per coefficient.

    A row contains, as texts, balance and drive, coefficient, value of the given machine, estimate,
    95 % interval, unit, and the variance that the given machine and the fit explain. Balance, drive
    and variances are stated in the first row only.
    """
    rows = []
    for name, estimate in one.coefficients.items():
        if name == "constant" and one.balance != "force":
            continue
        title = _COEFFICIENTS[name]
        if name == "factor" and not math.isfinite(estimate.nominal):
            title = "flow per command"
        s = _plain_texts(estimate)
        first = f"{_BALANCES[one.balance]} of the {one.axis}" if not rows else ""
        quality = (_variance_text(one.explained_nominal), _variance_text(one.explained)) if not rows else ("", "")
        rows.append((first, title, *s, *quality))
    return rows


def _plain_texts(estimate: Estimate) -> tuple[str, str, str, str]:
    """Return texts of given value, estimate, interval and unit of an estimate, in customary units.

    A number without unit is shown as a ratio, not in per cent, and its unit is "".
    """
    if estimate.unit == "1":
        given = f"{estimate.nominal:.3g}" if math.isfinite(estimate.nominal) else "-"
        return given, f"{estimate.value:.4g}", f"{estimate.low:.4g} to {estimate.high:.4g}", ""
    s = in_customary_units(estimate)
    return s.nominal, s.value, f"{s.low} to {s.high}", s.unit


def _variance_text(fraction: float) -> str:
    return f"{100.0 * max(fraction, 0.0):.1f} %" if math.isfinite(fraction) else "-"


def draw_regressions(regressions: list[Regression], machine: Machine) -> bytes:
    """Draw measured points and fitted lines of the initial regressions, with one row of plots per drive.

    The plots of a row show friction over velocity, force without load and friction over position,
    and measured flow over the valve flow of the model or, if that is unknown, over the command.

    Args:
        regressions: regressions of forces and flows.
        machine: the given machine.

    Returns:
        A PNG.
    """
    axes = list(dict.fromkeys(r.axis for r in regressions))
    table = {(r.axis, r.balance): r for r in regressions}
    titles = [
        t for t in ("friction", "position", "flow") if t == "flow" or any(r.balance == "force" for r in regressions)
    ]
    if not any(r.balance == "flow" for r in regressions):
        titles.remove("flow")
    with open_report_figure(_ROW_HEIGHT * len(axes) + 0.5) as figure:
        grid = figure.subplots(len(axes), len(titles), squeeze=False)
        for row, axis in zip(grid, axes, strict=True):
            for place, title in zip(row, titles, strict=True):
                one = table.get((axis, "flow" if title == "flow" else "force"))
                if one is None:
                    place.axis("off")
                    place.text(0.5, 0.5, f"{axis}: not measured", ha="center", va="center", color="0.5",
                               transform=place.transAxes)  # fmt: skip
                    continue
                (_draw_flow if title == "flow" else _draw_friction if title == "friction" else _draw_position)(
                    place, one, machine
                )
        handles, labels = next(p for p in grid.ravel() if p.get_legend_handles_labels()[0]).get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False, fontsize=8.5)
        return figure_to_png(figure)


def _parts(one: Regression, machine: Machine) -> tuple[np.ndarray, np.ndarray, float]:
    """Return three terms of a fitted force regression at its k points.

    Args:
        one: regression of the force of a drive.
        machine: the given machine, which states the smoothing velocity of the friction.

    Returns:
        Viscous and Coulomb friction (k,), position-dependent force (k,), which is 0 at the mean
        position, and the constant force; all in [N] or [N m].
    """
    c, smooth = one.coefficients, machine.axes[one.axis].drive.friction.smoothing_velocity
    speed, position = one.points["velocity"], one.points["position"]
    friction = c["viscous"].value * speed + c["coulomb"].value * np.tanh(speed / smooth)
    return friction, c["per_position"].value * (position - position.mean()), c["constant"].value


def _draw_friction(axes: "Axes", one: Regression, machine: Machine) -> None:
    """Draw the measured force minus the fitted load and position-dependent terms, over velocity.

    The lines are the friction of the given machine and the fitted friction plus constant. The load
    is the force that the model computes, times the fitted factor.
    """
    c, drive = one.coefficients, machine.axes[one.axis].drive.friction
    _, slope, _ = _parts(one, machine)
    force = one.points["measured"] - c["factor"].value * one.points["model"] - slope
    speed = one.points["velocity"]
    line = np.linspace(speed.min(), speed.max(), _LINE_POINTS)
    way = np.tanh(line / drive.smoothing_velocity)
    given = drive.viscous * line + drive.coulomb * way
    fitted = c["viscous"].value * line + c["coulomb"].value * way + c["constant"].value
    unit, factor = plot_axis_unit(one.unit)
    turns = one.unit == "N m"
    _draw(axes, speed, factor * force, line, factor * given, factor * fitted)
    axes.set_title(f"{one.axis}: friction")
    axes.set_xlabel(f"velocity [{'rad/s' if turns else 'm/s'}]")
    axes.set_ylabel(f"{'torque' if turns else 'force'} [{unit}]")


def _draw_position(axes: "Axes", one: Regression, machine: Machine) -> None:
    """Draw the measured force minus the fitted load and friction, over position.

    The lines are 0 (the given machine) and the fitted constant plus position-dependent force. The
    load is the force that the model computes, times the fitted factor.
    """
    friction, _, constant = _parts(one, machine)
    rest = one.points["measured"] - one.coefficients["factor"].value * one.points["model"] - friction
    position = one.points["position"]
    line = np.linspace(position.min(), position.max(), _LINE_POINTS)
    fitted = constant + one.coefficients["per_position"].value * (line - position.mean())
    unit, factor = plot_axis_unit(one.unit)
    turns = one.unit == "N m"
    _draw(axes, position, factor * rest, line, 0.0 * line, factor * fitted)
    axes.set_title(f"{one.axis}: {'torque' if turns else 'force'} without load and friction")
    axes.set_xlabel(f"position [{'rad' if turns else 'm'}]")
    axes.set_ylabel(f"{'torque' if turns else 'force'} [{unit}]")


def _draw_flow(axes: "Axes", one: Regression, machine: Machine) -> None:
    """Draw the measured flow over the valve flow of the model, with the lines of given and fitted model.

    If the given machine does not determine the valve flow, the measured flow is drawn over the
    command, without a line of the given model.
    """
    factor, constant = (one.coefficients[n].value for n in ("factor", "constant"))
    is_nominal = math.isfinite(one.coefficients["factor"].nominal)
    unit, scale = plot_axis_unit(one.unit)
    model = one.points["model"]
    line = np.linspace(model.min(), model.max(), _LINE_POINTS)
    along = scale if is_nominal else 1.0
    _draw(axes, along * model, scale * one.points["measured"], along * line,
          scale * line if is_nominal else None, scale * (factor * line + constant))  # fmt: skip
    axes.set_title(f"{one.axis}: flow")
    axes.set_xlabel(f"valve flow of the model [{unit}]" if is_nominal else "command [1]")
    axes.set_ylabel(f"velocity x area [{unit}]")


def _draw(axes: "Axes", x, measured, line, given, fitted) -> None:
    axes.plot(x, measured, ls="none", marker="o", ms=2.2, alpha=0.45, color=MEASURED_COLOUR, label="measured")
    if given is not None:
        axes.plot(line, given, color=NOMINAL_COLOUR, lw=1.8, label="given model")
    axes.plot(line, fitted, color=FITTED_COLOUR, lw=1.4, ls="--", label="fitted")
    low, high = np.quantile(measured, [0.02, 0.98])
    curves = [fitted] if given is None else [fitted, given]
    low, high = min(low, *(c.min() for c in curves)), max(high, *(c.max() for c in curves))
    room = 0.15 * (high - low) or 1.0
    axes.set_ylim(low - room, high + room)


# -- why this verdict -------------------------------------------------------------------------------------------------


def why_content(gap: Gap) -> dict[str, Any] | None:
    """Return sentences, tables and a picture that explain the verdict; None without an explanation.

    Returns:
        `reasons`: sentences. `candidates`, `levels`, `rejected`, `inputs`: table rows of the candidate
        effects, of location, family and law of each named effect, of the rejected effects and of the
        residual inputs. `run`: run of the residual inputs. `picture`: PNG of the residual inputs over
        time, None without them.
    """
    why = gap.explanation
    if why is None:
        return None
    return {
        "reasons": verdict_reasons(gap),
        "candidates": [row for c in why.comparisons for row in _candidate_rows(c)],
        "levels": _level_rows(gap),
        "rejected": [_rejection_row(r) for r in why.rejections],
        "run": why.traces[0].run if why.traces else "",
        "picture": draw_traces(why.traces) if why.traces else None,
        "inputs": [_trace_row(t) for t in why.traces],
    }


def verdict_reasons(gap: Gap) -> list[str]:
    """Return sentences that give the reasons of the verdict, each with its number.

    They state the Bayes factors of the named effects and of their best competitors, probabilities
    that are too low, residual tests that failed (or that all passed), and fractions of the gap that
    learned laws close. They also state if the prediction error of a perfect model is not known.
    """
    texts = []
    for comparison in gap.explanation.comparisons if gap.explanation else ():
        own = next(c for c in comparison.contenders if (c.name, c.location) == (comparison.name, comparison.location))
        others = [c for c in comparison.contenders if c is not own]
        text = f"Twice the log Bayes factor of {_title(own)} against no effect is {own.log_bayes_factor:,.0f}"
        if others:
            text += f"; that of the best other candidate, {_title(others[0])}, is {others[0].log_bayes_factor:,.0f}"
        texts.append(f"{text}.")
    for effect in gap.effects:
        if effect.mechanism_probability < SURE:
            texts.append(
                f"The probability of {effect_title(effect)}, summed over all its forms, is"
                f" {probability_text(effect.mechanism_probability)}; the verdict `named` requires {100 * SURE:.0f} %."
            )
    failed = failed_tests(gap)
    if gap.tests and not failed:
        texts.append(f"All {len(gap.tests)} residual tests of the patched model are passed.")
    for name in failed:
        test = gap.tests[name]
        texts.append(
            f"The residual test {name.replace('_', ' ')} failed: {test['value']:.3g}, limit {test['limit']:.3g}."
        )
    for law in gap.learned:
        if math.isfinite(law.share):
            texts.append(f"A learned law without a known cause closes {share_words(law.share)} of the gap.")
    if gap.size.noise_floor is None:
        texts.append(
            "The prediction error of a perfect model could not be computed; the verdict can therefore not be `no_gap`."
        )
    return texts


def _title(effect: Any) -> str:
    return effect_title(Alternative(effect.name, effect.location, 0.0))


def _candidate_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Return table rows of the candidate effects that compete for one part of the gap.

    A row has title, twice the log Bayes factor against no effect, probability, relative size of the
    factor (1 for the largest), and whether the candidate is the named effect. The last row has the
    probability that none of them is right.
    """
    best = max((c.log_bayes_factor for c in comparison.contenders), default=1.0)
    rows = [
        {
            "title": _title(c), "factor": f"{c.log_bayes_factor:,.0f}", "probability": probability_text(c.probability),
            "part": c.log_bayes_factor / best if best > 0.0 else 0.0,
            "named": (c.name, c.location) == (comparison.name, comparison.location),
        }
        for c in comparison.contenders
    ]  # fmt: skip
    none = max(0.0, 1.0 - sum(c.probability for c in comparison.contenders))
    return [*rows, {"title": "none of them", "factor": "0", "probability": probability_text(none), "part": 0.0,
                    "named": False}]  # fmt: skip


def _level_rows(gap: Gap) -> list[tuple[str, str, str]]:
    """Return three table rows per named effect: its location, family and law.

    A row contains the title of the effect (in its first row only), the most probable name of the
    level and the probability of this name.
    """
    rows = []
    for effect, answer in zip(gap.effects, gap.answers or (), strict=bool(gap.answers)):
        place, chance = next(iter(answer["places"].items()))
        family, in_family = next(iter(answer["families"].items()))
        law, in_law = next(iter(answer["laws"].items()))
        levels = ((f"location: {place}", chance), (f"family: {family}", in_family),
                  (f"law: {law.split(' ')[0].replace('_', ' ')}", in_law))  # fmt: skip
        for k, (words, probability) in enumerate(levels):
            rows.append((effect_title(effect) if k == 0 else "", words, probability_text(probability)))
    return rows


def _rejection_row(rejection: Rejection) -> tuple[str, str, str, str]:
    """Return the table cells of a rejected effect: effect, failed test, value of the test, required value."""
    what = _title(rejection) if rejection.name else "all effects"
    value = f"{rejection.value:.3g}" if math.isfinite(rejection.value) else "-"
    limit = f"more than {rejection.limit:.3g}" if math.isfinite(rejection.limit) else "-"
    return what, rejection.test, value, limit


def _rms(values: np.ndarray | None) -> float:
    return math.nan if values is None else float(np.sqrt(np.nanmean(values**2)))


def _trace_row(trace: InputTrace) -> tuple[str, str, str, str]:
    """Return the table cells of a residual input (force, flow or command that a model misses) over one run.

    The cells are its name, its RMS with the given and with the patched model, and the fraction of
    its mean square that the patched model removes.
    """
    given, left = _rms(trace.given), _rms(trace.remaining)
    explained = f"{100.0 * max(0.0, 1.0 - (left / given) ** 2):.0f} %" if given > 0.0 else "-"
    return lack_title(trace.balance, trace.axis), amount(given, trace.unit), amount(left, trace.unit), explained


def draw_traces(traces: tuple[InputTrace, ...]) -> bytes:
    """Draw residual inputs (forces, flows and commands that the models miss) over time, one plot each.

    The lines are the residual input of the given model, what the accepted effects add in the
    patched model, if known, and the residual input of the patched model.

    Args:
        traces: residual inputs of one run.

    Returns:
        A PNG.
    """
    with open_report_figure(1.6 * len(traces) + 0.6) as figure:
        rows = figure.subplots(len(traces), 1, sharex=True, squeeze=False)[:, 0]
        for axes, trace in zip(rows, traces, strict=True):
            unit, factor = plot_axis_unit(trace.unit)
            axes.axhline(0.0, color="0.6", lw=0.8)
            axes.plot(trace.time, factor * trace.given, color=NOMINAL_COLOUR, lw=1.8, alpha=0.75,
                      label="missing in the given model")  # fmt: skip
            if trace.added is not None:
                axes.plot(trace.time, factor * trace.added, color=FITTED_COLOUR, lw=1.0,
                          label="added by the patched model")  # fmt: skip
            axes.plot(trace.time, factor * trace.remaining, color=MEASURED_COLOUR, lw=0.8,
                      label="missing in the patched model")  # fmt: skip
            everything = np.concatenate([v for v in (trace.given, trace.added, trace.remaining) if v is not None])
            reach = 1.3 * factor * float(np.nanquantile(np.abs(everything), 0.995)) or 1.0
            axes.set_ylim(-reach, reach)
            axes.set_title(lack_title(trace.balance, trace.axis))
            axes.set_ylabel(f"[{unit}]")
        rows[-1].set_xlabel("time [s]")
        handles: Mapping[str, Any] = {}
        for axes in rows:
            handles = {**dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True)), **handles}
        figure.legend(handles.values(), handles.keys(), loc="outside upper right", ncols=3, frameon=False, fontsize=8.5)
        return figure_to_png(figure)
