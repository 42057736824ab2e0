"""Pictures of the signatures of effects: a run with and without the effect, with the same commands."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import yaml

from hydrotele.core.units import plot_axis_unit
from hydrotele.effects import EFFECTS
from hydrotele.effects.effect import Effect
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine
from hydrotele.run.run import load_nominal_machine, run_scenario
from hydrotele.scenario.pilots import TablePilot
from hydrotele.scenario.scenario import PlantedEffect, Scenario, load_scenario

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402

SETTINGS_FILE = Path(__file__).with_name("effects.yaml")
SETTINGS: dict[str, dict[str, Any]] = yaml.safe_load(SETTINGS_FILE.read_text(encoding="utf-8"))
SCENARIOS = {"excitation": 14.0, "eha_strokes": 8.0, "calibrate_boom": 40.0, "feller_excitation": 20.0}
"""Scenario -> simulated time [s]; the first whose machine can have an effect is used."""
PREFERRED_AXES = ("stick", "piston", "boom")
DEFAULT_CHANGE = 2.0  # standard deviations of the prior
MIN_SHOWN_CHANGE = 1.0e-3  # of the range of a signal


class Picture(NamedTuple):
    """Content of the picture of an effect: scenario, its changed values, location and parameters of the effect."""

    scenario: str
    overrides: tuple[tuple[str, str], ...]
    location: str
    values: Mapping[str, float]


@functools.cache
def load_open_loop_scenario(name: str, overrides: tuple[tuple[str, str], ...]) -> Scenario:
    """Return a shipped scenario without added effects whose pilot repeats the commands of its run."""
    common = {"sensors": "ideal", "effects": "[]"} | ({"duration": f"{SCENARIOS[name]:g}"} if name in SCENARIOS else {})
    scenario = load_scenario(name, common | dict(overrides))
    log = run_scenario(scenario).measured
    commands = {c.removeprefix("command."): log[c].tolist() for c in log.columns if c.startswith("command.")}
    pilot = TablePilot(kind="table", quantity="command", time=(log.time - log.time[0]).tolist(), columns=commands)
    return scenario.model_copy(update={"pilot": pilot})


@functools.cache
def load_scenario_machine(name: str) -> Machine:
    """Return the machine of a shipped scenario."""
    return load_nominal_machine(load_scenario(name))


def choose_picture(name: str) -> Picture:
    """Return scenario, location and size of an effect for its picture.

    The effect acts on the stick where it can. Its first parameter, or those of effects.yaml, differ from the nominal
    value by a number of standard deviations of the prior.
    """
    effect, setting = EFFECTS[name], SETTINGS[name]
    scenario = setting.get("scenario") or next(s for s in SCENARIOS if effect.locations(load_scenario_machine(s)))
    machine = load_scenario_machine(scenario)
    location = setting.get("location") or _choose_location(effect, machine)
    parameters = effect.parameters(machine, location)
    change = setting.get("change") or {next(iter(parameters)): DEFAULT_CHANGE}
    values = {
        key: float(np.clip(p.nominal + change.get(key, 0.0) * p.prior_std, p.lower_bound, p.upper_bound))
        for key, p in parameters.items()
        if not p.optional or key in change
    }
    return Picture(scenario, tuple(setting.get("set", {}).items()), location, values)


def _choose_location(effect: Effect, machine: Machine) -> str:
    places = effect.locations(machine)
    for axis in PREFERRED_AXES:
        for place in places:
            if place.split(".")[0] == axis:
                return place
    return places[0]


@functools.cache
def run_without_effect(scenario: str, overrides: tuple[tuple[str, str], ...]) -> Log:
    """Return the log of the sensors in the run without the effect."""
    return run_scenario(load_open_loop_scenario(scenario, overrides)).measured


def run_with_effect(name: str, picture: Picture) -> Log:
    """Return the log of the sensors in the run with the effect."""
    scenario = load_open_loop_scenario(picture.scenario, picture.overrides)
    planted = PlantedEffect(name=name, location=picture.location, parameters=dict(picture.values))
    return run_scenario(scenario.model_copy(update={"effects": (planted,)})).measured


def list_channels(name: str, picture: Picture, log: Log) -> list[list[str]]:
    """Return the channels of the two rows of a picture: pressures, and motion."""
    axis, _, side = picture.location.partition(".")
    joint = f"angle.{axis}"
    if joint in log.columns and f"pressure_head.{axis}" not in log.columns:  # an undriven joint of the calibrator
        return [[joint]]
    if axis not in {c.partition(".")[2] for c in log.columns if c.startswith("command.")}:
        axis = next(a for a in PREFERRED_AXES if f"pressure_head.{a}" in log.columns)
    pressures = [f"pressure_{s}.{axis}" for s in ("head", "rod") if side in ("", "head", "rod") or s == side]
    if EFFECTS[name].model_part == "supply":
        pressures = [c for c in log.columns if c.startswith("pressure_supply")]
    motion = [f"length.{axis}"] if name == "length_offset" else []
    motion = motion or [c for c in (f"angle.{axis}", f"position.{axis}", f"length.{axis}") if c in log.columns][:1]
    return [pressures, motion]


def _widen_limits(panel: Axes, span: float) -> None:
    """Make the vertical range of a panel at least as large as `span`, so that rounding errors are not enlarged."""
    low, high = panel.get_ylim()
    if high - low < span:
        middle = round(0.5 * (low + high) / span) * span
        panel.set_ylim(middle - span, middle + span)


def draw_picture(name: str, picture: Picture, file: Path) -> None:
    """Simulate an effect and draw its signature: signals with and without it, and their difference."""
    before, after = run_without_effect(picture.scenario, picture.overrides), run_with_effect(name, picture)
    rows = list_channels(name, picture, before)
    figure, axes = plt.subplots(len(rows), 2, figsize=(9.0, 2.3 * len(rows)), sharex=True, squeeze=False)
    for (left, right), channels in zip(axes, rows, strict=True):
        unit, factor = plot_axis_unit(before.units[channels[0]])
        for k, channel in enumerate(channels):
            colour = f"C{k}"
            left.plot(before.time, factor * before[channel], color=colour, alpha=0.45, linewidth=2.4)
            left.plot(after.time, factor * after[channel], color=colour, linewidth=1.0, label=channel)
            right.plot(after.time, factor * (after[channel] - before[channel]), color=colour, linewidth=1.0)
        spans = [float(np.ptp(factor * before[channel])) for channel in channels]
        _widen_limits(right, MIN_SHOWN_CHANGE * max(spans))
        left.set_ylabel(unit)
        left.legend(fontsize=7, loc="best")
    axes[0][0].set_title("without (wide, pale) and with the effect (thin)", fontsize=9)
    axes[0][1].set_title("change by the effect", fontsize=9)
    for panel in axes.flat:
        panel.grid(alpha=0.3)
        panel.tick_params(labelsize=8)
    for panel in axes[-1]:
        panel.set_xlabel("time [s]", fontsize=8)
    figure.tight_layout()
    figure.savefig(file, dpi=90)
    plt.close(figure)


def write_pictures(folder: Path) -> int:
    """Draw the pictures that are missing or older than their settings; return their number."""
    folder.mkdir(parents=True, exist_ok=True)
    count, newest = 0, max(SETTINGS_FILE.stat().st_mtime, Path(__file__).stat().st_mtime)
    for name in SETTINGS:
        file = folder / f"{name}.png"
        if file.is_file() and file.stat().st_mtime > newest:
            continue
        draw_picture(name, choose_picture(name), file)
        count += 1
    return count
