"""Implement `hydrotele compare`: open-loop predictions of machine models and black-box models.

Each model predicts held-out runs from the commands alone. The result is the RMS error of each
channel at each horizon, as a table, as JSON and as a plot.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

import hydrotele
from hydrotele.cli.console import (
    make_table,
    print_json,
    show_stages,
    stderr_console,
    stdout_console,
    to_json_types,
    write_json,
)
from hydrotele.cli.contact_command import ContactOption, load_dataset_without_contact
from hydrotele.cli.input_logs import find_corrected_machine_folder, load_machine_for_logs
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.output import atomic_folder, check_output_folder
from hydrotele.core.units import display_unit
from hydrotele.estimate.baselines import BASELINES, fit_baseline
from hydrotele.estimate.free_run import (
    TO_THE_END,
    Prepare,
    RunErrors,
    chained,
    free_run_errors,
    machine_runner,
)
from hydrotele.estimate.reduced_model import predicted_channels
from hydrotele.gap.bands import BandSummary, RunBands, band_document, compute_run_bands, noise_of, sample_machines
from hydrotele.gap.posterior import POSTERIOR_FILE, Posterior, read_posterior
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine import Machine
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock

_MAX_PLOT_SECONDS, _MAX_PLOTS = 120.0, 12  # duration [s] and number of channels in the plot
_ONE_STEP = "one row"
DEFAULT_BANDS = 20  # sampled machines per model with a posterior
_THREADS = 2


@dataclasses.dataclass(frozen=True)
class ModelComparison:
    """Prediction errors of one model on all evaluated runs.

    Attributes:
        name: name or folder that the user gave.
        kind: `machine`, or `baseline` for a black-box model.
        runs: prediction errors, one item per run.
        plotted_prediction: (n, c) open-loop predictions of n rows and c channels of the first run.
        lost: one sentence per run on which the one-step predictions of the model diverge, although
            the measurements correct them at every row.
        bands: prediction bands of the sampled machines, one item per run; empty without a posterior.
        samples: number of sampled machines.
    """

    name: str
    kind: str
    runs: tuple[RunErrors, ...]
    plotted_prediction: np.ndarray
    lost: tuple[str, ...] = ()
    bands: tuple[RunBands, ...] = ()
    samples: int = 0

    def mean_band(self, horizon: str) -> BandSummary | None:
        """Return the prediction band at a horizon, averaged over the runs; None without one."""
        found = [bands.horizons[horizon] for bands in self.bands if horizon in bands.horizons]
        if not found:
            return None
        widths, fractions = (np.array([getattr(b, name) for b in found]) for name in ("width", "inside"))
        known = np.isfinite(fractions)
        mean = np.where(known, fractions, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        inside = np.where(known.any(axis=0), mean, math.nan)
        return BandSummary(widths.mean(axis=0), inside, sum(b.diverged for b in found))

    def mean_errors(self, horizon: str) -> np.ndarray:
        """Return the RMS prediction errors of the c channels at a horizon, averaged over the runs.

        Args:
            horizon: name of a prediction horizon, or `one row` for one-step predictions.

        Returns:
            (c,) errors in SI units; NaN without measurements, infinite if a prediction diverged.
        """
        if horizon == _ONE_STEP:
            found = [errors.one_step for errors in self.runs]
        else:
            found = [e.horizons[horizon].rms for e in self.runs if horizon in e.horizons]
        columns = [column[~np.isnan(column)] for column in np.array(found).T]
        return np.array([column.mean() if len(column) else math.nan for column in columns])

    def count_diverged_predictions(self, horizon: str) -> tuple[int, int]:
        """Return how many predictions over a horizon diverged, and how many there are, over all runs."""
        found = [e.horizons[horizon] for e in self.runs if horizon in e.horizons]
        return sum(h.diverged for h in found), sum(h.windows for h in found)


def compare_models(
    machines: Sequence[str], data: Sequence[Path], tool: str | None, heldout: str | None,
    sensors: str | None, horizons: Sequence[float], baselines: Sequence[str], include_fitted: bool,
    target: Path | None, as_json: bool, force: bool = False, bands: int | None = None,
    contact: ContactOption = "mask",
) -> dict[str, Any]:  # fmt: skip
    """Compare open-loop predictions of several models on runs that were not used to fit them.

    Args:
        machines: names or folders of machines, or result folders of `gap` and `identify`. The
            first machine determines the compared channels.
        data: log files, folders of logs, run folders.
        tool: tool of the machines, None for that of the logs.
        heldout: name of the held-out run, None for `test*`, else the last run.
        sensors: name of the machines' sensor set, None for that named by the logs.
        horizons: prediction horizons [s].
        baselines: names of black-box models, which are fitted on the other runs.
        include_fitted: evaluate the models on the fitted runs as well.
        target: folder for compare.json and the plot, None to write nothing.
        as_json: print JSON instead of tables.
        force: accept logs whose metadata name another machine or tool.
        bands: number of machines sampled from the posterior of each result folder of `gap`, for prediction
            bands; 0 for none, None for 20 where a folder has a posterior.
        contact: `mask` to mask intervals of detected contact and loads, `ignore` to use all rows.

    Returns:
        The result in the form of `compare.json`.

    Raises:
        InputError: data, machines, horizons, baselines or target are not usable.
    """
    for name in baselines:
        if name not in BASELINES:
            raise InputError(f"--baseline {name}", f"is not known; {suggest_valid_name(name, BASELINES)}")
    if target is not None:
        check_output_folder(target, "compare")
    stop_profiling_clock()
    named = {name: load_machine_for_logs(data, find_corrected_machine_folder(name), tool) for name in machines}
    dataset = load_dataset_without_contact(data, next(iter(named.values())), sensors, heldout, force, contact)
    for name, machine in named.items():
        _check_same_channels(name, machine, dataset)
    posteriors = _read_posteriors(machines, bands)
    judged = [*dataset.fit, dataset.heldout] if include_fitted else [dataset.heldout]
    _check_horizons(horizons, judged)
    with show_stages("compare", as_json) as progress:
        compared = _evaluate_models(named, baselines, dataset, judged, horizons, progress, posteriors, bands)
    shown = _available_horizons(compared)
    document = build_comparison_document(compared, shown, dataset, data)
    if target is not None:
        with atomic_folder(target, "compare") as folder:
            _write(folder, document, compared, dataset, judged[0], _choose_plot_horizon(horizons, judged[0]))
    if as_json:
        print_json(document)
    else:
        _print(compared, shown, dataset, judged)
        if target is not None:
            stdout_console.print(f"written to [bold]{target}[/]")
    return document


def _read_posteriors(names: Sequence[str], bands: int | None) -> dict[str, Posterior]:
    """Return model name -> posterior of the models that have one; none with 0 bands.

    Raises:
        InputError: bands are requested, but no model has a posterior, or a posterior is damaged.
    """
    if bands == 0:
        return {}
    found = {name: read_posterior(name) for name in names if (Path(name) / POSTERIOR_FILE).is_file()}
    if bands and not found:
        message = f"needs a result folder of `hydrotele gap` that contains {POSTERIOR_FILE} among the models"
        raise InputError(f"--bands {bands}", message)
    return found


def build_comparison_document(
    comparisons: Sequence[ModelComparison],
    printed_horizons: Sequence[str],
    dataset: Dataset,
    data: Sequence[Path],
) -> dict[str, Any]:
    """Return the comparison as JSON data: RMS errors in SI units, None if a model diverged.

    Args:
        comparisons: prediction errors of each model.
        printed_horizons: names of the horizons at which errors are averaged over the runs.
        dataset: logs, channels and the first machine.
        data: paths of the logs.
    """

    def map_channels_to_values(values: np.ndarray) -> dict[str, float]:
        return dict(zip(dataset.channels, values.tolist(), strict=True))

    models = []
    for model in comparisons:
        bands = [run.horizons for run in model.bands] or [{}] * len(model.runs)
        runs = [
            {
                "run": errors.run,
                "one_step": map_channels_to_values(errors.one_step),
                "horizons": {
                    name: {
                        "seconds": h.seconds, "windows": h.windows, "diverged": h.diverged,
                        "rms": map_channels_to_values(h.rms), "final": map_channels_to_values(h.final),
                        "median": map_channels_to_values(h.median),
                        **({"band": band_document(own[name], dataset.channels)} if name in own else {}),
                    }
                    for name, h in errors.horizons.items()
                },
            }
            for errors, own in zip(model.runs, bands, strict=True)
        ]  # fmt: skip
        mean = {name: map_channels_to_values(model.mean_errors(name)) for name in printed_horizons}
        one_step = map_channels_to_values(model.mean_errors(_ONE_STEP))
        means: dict[str, Any] = {"one_step": one_step, "horizons": mean}
        if model.bands:
            found = {name: model.mean_band(name) for name in printed_horizons}
            means["bands"] = {name: band_document(b, dataset.channels) for name, b in found.items() if b}
        samples = {"samples": model.samples} if model.bands else {}
        models.append({"name": model.name, "kind": model.kind, **samples, "runs": runs, "mean": means})
    return to_json_types(
        {
            "machine": dataset.machine.name,
            "data": [str(path) for path in data],
            "fitted_runs": [run.name for run in dataset.fit],
            "evaluated_runs": [errors.run for errors in comparisons[0].runs],
            "units": {channel: default_channel_unit(channel) for channel in dataset.channels},
            "models": models,
            "notes": _list_notes(dataset, comparisons),
        }
    )


def _list_notes(dataset: Dataset, comparisons: Sequence[ModelComparison]) -> list[str]:
    diverged = {m.name: sum(b.diverged for run in m.bands for b in run.horizons.values()) for m in comparisons}
    return [
        *dataset.notes, *(note for model in comparisons for note in model.lost),
        *(f"{name}: {count} predictions of sampled machines diverged; the bands do not contain them"
          for name, count in diverged.items() if count),
    ]  # fmt: skip


def _evaluate_models(
    machines: dict[str, Machine], baselines: Sequence[str], dataset: Dataset,
    evaluated_runs: Sequence[RunData], horizons: Sequence[float], progress: Callable | None,
    posteriors: Mapping[str, Posterior], samples: int | None,
) -> list[ModelComparison]:  # fmt: skip
    say = progress or (lambda said, share: None)
    total = (len(machines) + len(baselines)) * (len(evaluated_runs) + 1)
    models: list[tuple[str, str, Callable[[], Prepare]]] = [
        (name, "machine", lambda machine=machine: machine_runner(machine, dataset))
        for name, machine in machines.items()
    ]
    models += [(n, "baseline", lambda n=n: fit_baseline(n, dataset)) for n in baselines]
    compared, done = [], 0
    for name, kind, make in models:
        say(name, done / total)
        prepare, errors, lost, pictured, bands = make(), [], [], np.empty(0), []
        sampled = []
        if posterior := posteriors.get(name):
            sampled = sample_machines(posterior, samples or min(DEFAULT_BANDS, len(posterior.samples)))
        for run in evaluated_runs:
            done += 1
            say(f"{name} on {run.name}", done / total)
            runner = prepare(run)
            errors.append(free_run_errors(runner, run, horizons))
            if runner.lost:
                lost.append(f"{name} on run {run.name}: {runner.lost}")
            if run is evaluated_runs[0]:
                begin = _truncate_run_for_plot(run)
                pictured = chained(runner, begin, _choose_plot_horizon(horizons, run))
            if sampled:
                say(f"{len(sampled)} machines sampled from {name} on {run.name}", done / total)
                noise, restart = noise_of(posteriors[name], dataset), _choose_plot_horizon(horizons, run)
                with ThreadPoolExecutor(_THREADS) as pool:
                    bands.append(compute_run_bands(sampled, dataset, run, noise, horizons, restart, pool.map))
        done += 1
        compared.append(ModelComparison(name, kind, tuple(errors), pictured, tuple(lost), tuple(bands), len(sampled)))
    return compared


def _check_same_channels(name: str, machine: Machine, dataset: Dataset) -> None:
    """Raise InputError if a machine has other axes than the first machine, or no prediction of a channel.

    Args:
        name: name of the machine, for the message.
        machine: the machine.
        dataset: logs with axes and compared channels, which are those of the first machine.
    """
    if tuple(actuator_order(machine)) != dataset.axes:
        raise InputError(
            f"machine {name}",
            f"has the axes {', '.join(actuator_order(machine))}; the first machine has"
            f" {', '.join(dataset.axes)}. Compare machines with the same axes",
        )
    lacking = [c for c in dataset.channels if c not in predicted_channels(machine)]
    if lacking:
        raise InputError(f"machine {name}", f"does not predict {', '.join(lacking)}")


def _check_horizons(horizons: Sequence[float], evaluated_runs: Sequence[RunData]) -> None:
    for seconds in horizons:
        rows = max(run.period for run in evaluated_runs)
        if not (math.isfinite(seconds) and seconds >= rows):
            raise InputError(f"--horizons {seconds:g}", f"must be at least {rows:g} s, the log's sample period")


def _available_horizons(comparisons: Sequence[ModelComparison]) -> list[str]:
    """Return the names of the prediction horizons that fit into at least one evaluated run, shortest first."""
    found = {name: h.seconds for m in comparisons for e in m.runs for name, h in e.horizons.items()}
    return sorted(found, key=lambda name: math.inf if name == TO_THE_END else found[name])


def _choose_plot_horizon(horizons: Sequence[float], run: RunData) -> float:
    """Return the time after which the plotted prediction restarts from the measurements [s].

    It is the longest horizon that fits three times into the plot, else a third of the plot. The
    plot shows the run, but at most 120 s of it.
    """
    seconds = min(_MAX_PLOT_SECONDS, len(run.reading) * run.period)
    return max([h for h in horizons if 3.0 * h <= seconds], default=seconds / 3.0)


def _truncate_run_for_plot(run: RunData) -> RunData:
    rows = slice(0, round(_MAX_PLOT_SECONDS / run.period))
    return dataclasses.replace(
        run, command=run.command[rows], command_known=run.command_known[rows],
        reading=run.reading[rows],
    )  # fmt: skip


def _write(
    folder: Path, document: dict[str, Any], comparisons: Sequence[ModelComparison], dataset: Dataset,
    run: RunData, seconds: float,
) -> None:  # fmt: skip
    from hydrotele.show.log_plots import draw_open_loop_predictions

    write_json(folder / "compare.json", document)
    stderr_console.print("drawing free_run.png ...", style="dim")
    begin, some = _truncate_run_for_plot(run), slice(0, _MAX_PLOTS)
    time = run.start + run.period * np.arange(len(begin.reading))
    channels = dataset.channels[some]
    shaded = "; shaded: 95 % band" if any(m.bands for m in comparisons) else ""
    picture = draw_open_loop_predictions(
        time, begin.reading[:, some], {m.name: m.plotted_prediction[:, some] for m in comparisons}, channels,
        [default_channel_unit(channel) for channel in channels],
        f"{run.name}: open-loop predictions, restarted every {seconds:.3g} s{shaded}",
        {
            m.name: (low[: len(time), some], high[: len(time), some])
            for m in comparisons for low, high in [bands.plotted for bands in m.bands[:1]]
        },
    )  # fmt: skip
    (folder / "free_run.png").write_bytes(picture)
    summary = {
        "kind": "compare",
        "machine": document["machine"],
        "data": document["data"],
        "models": [model.name for model in comparisons],
        "evaluated_runs": document["evaluated_runs"],
        "hydrotele": hydrotele.__version__,
    }
    write_json(folder / "summary.json", summary)


def _print(
    comparisons: Sequence[ModelComparison],
    printed_horizons: Sequence[str],
    dataset: Dataset,
    evaluated_runs: Sequence[RunData],
) -> None:
    runs = ", ".join(run.name for run in evaluated_runs)
    title = f"RMS prediction error on {runs} (lower is better; bold: best model)"
    rows = make_table(title, "channel", "horizon", *(m.name for m in comparisons), "unit")
    for c, channel in enumerate(dataset.channels):
        errors = {h: [m.mean_errors(h)[c] for m in comparisons] for h in (_ONE_STEP, *printed_horizons)}
        finite = [e for row in errors.values() for e in row if math.isfinite(e)]
        unit, factor = display_unit(default_channel_unit(channel), max(finite, default=math.nan))
        for horizon, row in errors.items():
            cells = [_format_error(m, horizon, e * factor) for m, e in zip(comparisons, row, strict=True)]
            best = min((e for e in row if math.isfinite(e)), default=math.nan)
            cells = [f"[bold]{cell}[/]" if e == best and len(row) > 1 else cell
                     for cell, e in zip(cells, row, strict=True)]  # fmt: skip
            first = channel if horizon == _ONE_STEP else ""
            rows.add_row(
                first,
                _format_horizon(horizon),
                *cells,
                unit,
                end_section=horizon == printed_horizons[-1],
            )
    stdout_console.print(rows)
    for model in comparisons:
        if model.bands:
            stdout_console.print(_make_band_table(model, printed_horizons, dataset.channels))
    fitted = [m.name for m in comparisons if m.kind == "baseline"]
    if fitted:
        trained = ", ".join(run.name for run in dataset.fit)
        stdout_console.print(f"{', '.join(fitted)}: fitted on {trained}")
    for note in _list_notes(dataset, comparisons):
        stdout_console.print(f"[yellow]note[/] {note}")


def _make_band_table(model: ModelComparison, horizons: Sequence[str], channels: Sequence[str]) -> Any:
    """Return the table of the prediction bands of a model."""
    title = (
        f"{model.name}: 95 % prediction bands of {model.samples} machines sampled from the posterior (parameter"
        " uncertainty and measurement noise, no missing laws)"
    )
    rows = make_table(title, "channel", "horizon", "band width, RMS", "unit", "measured inside band with noise")
    found = {h: band for h in horizons if (band := model.mean_band(h))}
    for c, channel in enumerate(channels):
        unit, factor = display_unit(
            default_channel_unit(channel), max((b.width[c] for b in found.values()), default=math.nan)
        )
        for number, (horizon, band) in enumerate(found.items()):
            inside = f"{100 * band.inside[c]:.1f} %" if math.isfinite(band.inside[c]) else "-"
            rows.add_row(
                "" if number else channel, _format_horizon(horizon), f"{band.width[c] * factor:.3g}", unit, inside,
                end_section=number == len(found) - 1,
            )  # fmt: skip
    return rows


def _format_horizon(horizon: str) -> str:
    if horizon in (_ONE_STEP, TO_THE_END):
        return {_ONE_STEP: _ONE_STEP, TO_THE_END: "whole run"}[horizon]
    return f"{horizon} s"


def _format_error(model: ModelComparison, horizon: str, error: float) -> str:
    """Format an error of a model; NaN gives `-`, infinity the number of diverged predictions."""
    if math.isnan(error):
        return "-"
    if math.isinf(error):
        gone, windows = model.count_diverged_predictions(horizon)
        return f"diverged in {gone} of {windows}" if windows else "diverged"
    return f"{error:.3g}"
