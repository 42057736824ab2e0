"""Implement `hydrotele compare`: open-loop predictions of machine models and black-box models.

Each model predicts held-out runs from the commands alone. The result is the RMS error of each
channel at each horizon, as a table, as JSON and as a plot.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
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
from hydrotele.cli.input_logs import load_machine_for_logs
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
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.dataset import Dataset, RunData, load_dataset
from hydrotele.machine.log_channels import default_channel_unit
from hydrotele.machine.machine import Machine
from hydrotele.machine.machine_file import MACHINE_FILE
from hydrotele.simulate.actuator_callbacks import stop_profiling_clock

_MACHINE_SUBFOLDERS = (
    "patched",
    "identified",
)  # subfolders in which `gap` and `identify` write the machine
_MAX_PLOT_SECONDS, _MAX_PLOTS = 120.0, 12  # duration [s] and number of channels in the plot
_ONE_STEP = "one row"


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
    """

    name: str
    kind: str
    runs: tuple[RunErrors, ...]
    plotted_prediction: np.ndarray
    lost: tuple[str, ...] = ()

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
    target: Path | None, as_json: bool, force: bool = False,
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
    dataset = load_dataset(
        list(data), next(iter(named.values())), sensors, heldout, force=force
    )  # fmt: skip
    for name, machine in named.items():
        _check_same_channels(name, machine, dataset)
    judged = [*dataset.fit, dataset.heldout] if include_fitted else [dataset.heldout]
    _check_horizons(horizons, judged)
    with show_stages("compare", as_json) as progress:
        compared = _evaluate_models(named, baselines, dataset, judged, horizons, progress)
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


def find_corrected_machine_folder(name: str) -> str:
    """Return the subfolder with the corrected machine of a result folder of `gap` or `identify`.

    Any other name or folder is returned unchanged.
    """
    for inside in _MACHINE_SUBFOLDERS:
        if (Path(name) / inside / MACHINE_FILE).is_file():
            return str(Path(name) / inside)
    return name


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
        runs = [
            {
                "run": errors.run,
                "one_step": map_channels_to_values(errors.one_step),
                "horizons": {
                    name: {
                        "seconds": h.seconds, "windows": h.windows, "diverged": h.diverged,
                        "rms": map_channels_to_values(h.rms), "final": map_channels_to_values(h.final),
                        "median": map_channels_to_values(h.median),
                    }
                    for name, h in errors.horizons.items()
                },
            }
            for errors in model.runs
        ]  # fmt: skip
        mean = {name: map_channels_to_values(model.mean_errors(name)) for name in printed_horizons}
        one_step = map_channels_to_values(model.mean_errors(_ONE_STEP))
        models.append(
            {"name": model.name, "kind": model.kind, "runs": runs,
             "mean": {"one_step": one_step, "horizons": mean}}
        )  # fmt: skip
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
    return [*dataset.notes, *(note for model in comparisons for note in model.lost)]


def _evaluate_models(
    machines: dict[str, Machine], baselines: Sequence[str], dataset: Dataset,
    evaluated_runs: Sequence[RunData], horizons: Sequence[float], progress: Callable | None,
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
        prepare, errors, lost, pictured = make(), [], [], np.empty(0)
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
        done += 1
        compared.append(ModelComparison(name, kind, tuple(errors), pictured, tuple(lost)))
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
    picture = draw_open_loop_predictions(
        time, begin.reading[:, some], {m.name: m.plotted_prediction[:, some] for m in comparisons}, channels,
        [default_channel_unit(channel) for channel in channels],
        f"{run.name}: open-loop predictions, restarted every {seconds:.3g} s",
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
    fitted = [m.name for m in comparisons if m.kind == "baseline"]
    if fitted:
        trained = ", ".join(run.name for run in dataset.fit)
        stdout_console.print(f"{', '.join(fitted)}: fitted on {trained}")
    for note in _list_notes(dataset, comparisons):
        stdout_console.print(f"[yellow]note[/] {note}")


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
