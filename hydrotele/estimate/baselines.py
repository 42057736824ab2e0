"""Black boxes to compare machines with: fitted on the same runs, they run freely in the same way.

All of them predict the mean rate of every channel over the next tenth of a second from the latest
readings and from the commands of the last half second, and integrate it row by row. So they need no
machine, and know nothing but the data: what a machine's physics is worth shows in the difference.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.estimate.free_run import Prepare, Runner
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.log_channels import parse_channel

AHEAD = 0.1  # s over which a rate is learned: a difference of two rows would be noise
_MEMORY = 0.5  # s of commands that a model sees; hydraulic delay and lag together are shorter
_PAST = 10  # values of each command in it
_PACE = 0.02  # s, least step in which the models are integrated
_NODES = 21  # of the table's commands, from end to end
_RIDGE = 1e-4  # of the linear models, against columns that repeat each other
_LAYERS, _EPOCHS, _MOST_ROWS = (32, 32), 40, 40_000  # of the network
_LEAST = 100  # samples of a fit
_TABULATED = ("angle", "position", "length")  # whose rate a table of the command tells


@dataclass(frozen=True)
class _Scales:
    """Means and sizes of readings (c,) and of commands (nu,), so that all features are near 1."""

    reading: np.ndarray
    size: np.ndarray
    command: np.ndarray
    height: np.ndarray


def fit_baseline(name: str, data: Dataset) -> Prepare:
    """Fit a black box to the fit runs of a dataset.

    Args:
        name: one out of `BASELINES`.
        data: the dataset; `heldout` is not seen.

    Returns:
        What prepares a run, as `free_run.machine_runner` does.

    Raises:
        InputError: there is no such baseline, too little data, or a package is not installed.
    """
    if name not in BASELINES:
        raise InputError(f"--baseline {name}", f"is not known; {suggest_valid_name(name, BASELINES)}")
    return BASELINES[name](data)


def fit_arx(data: Dataset) -> Prepare:
    """Linear model with inputs: rates from readings, their last rates and past commands.

    Args:
        data: the dataset.

    Returns:
        What prepares a run.

    Raises:
        InputError: too little data.

    Source: Ljung 1999, *System Identification*, 4.2 (ARX), least squares with a small ridge.
    """
    scales, features, targets = _samples(data)
    weights = _least_squares(np.column_stack([features, np.ones(len(features))]), targets)

    def rate(features: np.ndarray) -> np.ndarray:
        return features @ weights[:-1] + weights[-1]

    return _integrated(scales, rate)


def fit_mlp(data: Dataset) -> Prepare:
    """Multi-layer perceptron: rates from readings, their last rates and past commands.

    Args:
        data: the dataset.

    Returns:
        What prepares a run.

    Raises:
        InputError: too little data, or scikit-learn is not installed.

    Source: scikit-learn, `MLPRegressor` (Adam, early stopping on a tenth of the samples).
    """
    try:
        from sklearn.exceptions import ConvergenceWarning  # pyright: ignore - an extra
        from sklearn.neural_network import MLPRegressor  # pyright: ignore - an extra
    except ImportError:
        message = "needs scikit-learn: pip install 'hydrotele[baselines]'"
        raise InputError("--baseline mlp", message) from None
    import warnings

    scales, features, targets = _samples(data)
    every = max(1, len(features) // _MOST_ROWS)
    shown, told = features[::every], targets[::every]
    network = MLPRegressor(
        hidden_layer_sizes=_LAYERS, activation="tanh", early_stopping=True, max_iter=_EPOCHS,
        random_state=0, n_iter_no_change=5, batch_size=min(200, len(features)),  # pyright: ignore - its stub says str
    )  # fmt: skip
    with warnings.catch_warnings():  # the last epoch is no failure: the best one is kept
        warnings.simplefilter("ignore", ConvergenceWarning)
        network.fit(shown, told[:, 0] if told.shape[1] == 1 else told)
    layers = list(zip(network.coefs_, network.intercepts_, strict=True))

    def rate(features: np.ndarray) -> np.ndarray:
        for weight, bias in layers[:-1]:
            features = np.tanh(features @ weight + bias)
        return features @ layers[-1][0] + layers[-1][1]

    return _integrated(scales, rate)


def fit_table(data: Dataset) -> Prepare:
    """Delay and static table from command to speed per axis, the plainest model of a valve.

    The channel's own command counts; a channel without one takes the command that tells it best.
    What is no position (a pressure) has a table of its value itself.

    Args:
        data: the dataset.

    Returns:
        What prepares a run.

    Source: least squares over the delay (a grid up to half a second) and 21 nodes.
    """
    tables = []
    for column, channel in enumerate(data.channels):
        signal = parse_channel(channel)
        axes = [data.axes.index(signal.axis)] if signal.axis in data.axes else range(len(data.axes))
        moves = signal.kind in _TABULATED
        tried = [
            _tabulate(data.fit, column, axis, delay, moves) for axis in axes for delay in np.arange(0.0, _MEMORY, _PACE)
        ]
        tables.append(min(tried, key=lambda table: table.error))

    def prepare(run: RunData) -> Runner:
        filled = _filled(run.reading)
        told = np.column_stack([
            np.interp(_delayed(run.command[:, t.axis], t.delay, run.period), t.nodes, t.values)
            for t in tables
        ])  # fmt: skip
        travel = np.vstack([np.zeros(len(tables)), np.cumsum(told[:-1] * run.period, axis=0)])
        moves = np.array([t.moves for t in tables])

        def free(starts: np.ndarray, count: int) -> np.ndarray:
            rows = starts[:, None] + np.arange(1, count + 1)
            moved = filled[starts][:, None, :] + travel[rows] - travel[starts][:, None, :]
            return np.where(moves, moved, told[rows])

        return Runner(_one_step(free, filled), free)

    return prepare


BASELINES: dict[str, Callable[[Dataset], Prepare]] = {
    "table": fit_table,
    "arx": fit_arx,
    "mlp": fit_mlp,
}


class _Table(NamedTuple):
    """One channel's table of a delayed command: its rate where it `moves`, else its value."""

    error: float
    axis: int
    delay: float
    moves: bool
    nodes: np.ndarray
    values: np.ndarray


def _tabulate(
    runs: Sequence[RunData], column: int, axis: int, delay: float, moves: bool
) -> _Table:  # fmt: skip
    """The table of one channel, command and delay, by least squares."""
    command = np.concatenate([_delayed(run.command[:, axis], delay, run.period) for run in runs])
    target = np.concatenate([_rates(run)[:, column] if moves else run.reading[:, column] for run in runs])
    low, high = float(command.min()), float(command.max())
    nodes = np.linspace(low, high if high > low else low + 1.0, _NODES)
    known = np.isfinite(target)
    place = np.interp(command[known], nodes, np.arange(_NODES))
    left = np.minimum(place.astype(int), _NODES - 2)
    rows, hats = np.arange(len(place)), np.zeros((len(place), _NODES))
    hats[rows, left], hats[rows, left + 1] = left + 1 - place, place - left
    values = _least_squares(hats, target[known])
    error = float(np.sum((hats @ values - target[known]) ** 2))
    return _Table(error, axis, float(delay), moves, nodes, values)


def _integrated(scales: _Scales, rate: Callable[[np.ndarray], np.ndarray]) -> Prepare:
    """Runs of a model whose scaled rates are integrated step by step, all windows at a time."""

    def prepare(run: RunData) -> Runner:
        filled = (_filled(run.reading) - scales.reading) / scales.size
        past = _past_commands(run, scales)
        pace, behind = _pace(run), _behind(run)
        step = pace * run.period

        def free(starts: np.ndarray, count: int) -> np.ndarray:
            steps = -(-count // pace)
            back = np.maximum(starts[:, None] - pace * np.arange(behind, -1, -1), 0)
            way = np.concatenate([filled[back], np.empty((len(starts), steps, filled.shape[1]))], axis=1)
            with np.errstate(over="ignore", invalid="ignore"):
                for k in range(steps):
                    now, before = way[:, behind + k], way[:, k]
                    seen = np.column_stack([now, (now - before) / (behind * step), past[starts + k * pace]])
                    way[:, behind + k + 1] = now + step * rate(seen)
                part = np.arange(1, count + 1) / pace
                low = np.minimum(part.astype(int), steps - 1)
                here, there = way[:, behind + low], way[:, behind + low + 1]
                between = here + (part - low)[:, None] * (there - here)
            return between * scales.size + scales.reading

        return Runner(_one_step(free, _filled(run.reading)), free)

    return prepare


def _samples(data: Dataset) -> tuple[_Scales, np.ndarray, np.ndarray]:
    """Scales, features (n, f) and scaled rates (n, c) of the fit runs, without gaps."""
    readings = np.concatenate([run.reading for run in data.fit])
    commands = np.concatenate([run.command for run in data.fit])
    size, height = np.nanstd(readings, axis=0), np.std(commands, axis=0)
    scales = _Scales(
        np.nanmean(readings, axis=0), np.where(size > 0.0, size, 1.0),
        np.mean(commands, axis=0), np.where(height > 0.0, height, 1.0),
    )  # fmt: skip
    features, targets = [], []
    for run in data.fit:
        reading = (run.reading - scales.reading) / scales.size
        pace, back = _pace(run), _pace(run) * _behind(run)
        ahead = _rates(run) / scales.size
        rows = np.arange(back, len(reading) - back, pace)
        last = (reading[rows] - reading[rows - back]) / (back * run.period)
        features.append(np.column_stack([reading[rows], last, _past_commands(run, scales)[rows]]))
        targets.append(ahead[rows])
    seen, told = np.concatenate(features), np.concatenate(targets)
    known = np.isfinite(seen).all(axis=1) & np.isfinite(told).all(axis=1)
    if known.sum() < _LEAST:
        raise InputError(
            "the baseline",
            f"has {known.sum()} samples with readings of all channels, {_LEAST} are needed:"
            " use more runs, or logs with fewer gaps",
        )
    return scales, seen[known], told[known]


def _pace(run: RunData) -> int:
    """Rows per step of the models."""
    return max(1, round(_PACE / run.period))


def _behind(run: RunData) -> int:
    """Steps over which rates are taken."""
    return max(1, round(AHEAD / (_pace(run) * run.period)))


def _rates(run: RunData) -> np.ndarray:
    """(n, c) mean rate of every channel over the next tenth of a second, NaN where not known."""
    ahead = _pace(run) * _behind(run)
    rates = np.full(run.reading.shape, np.nan)
    rates[:-ahead] = (run.reading[ahead:] - run.reading[:-ahead]) / (ahead * run.period)
    return rates


def _past_commands(run: RunData, scales: _Scales) -> np.ndarray:
    """(n, nu * past) scaled commands of the last half second."""
    scaled = (run.command - scales.command) / scales.height
    delays = np.linspace(0.0, _MEMORY, _PAST)
    return np.column_stack([_delayed(scaled, delay, run.period) for delay in delays])


def _delayed(command: np.ndarray, delay: float, period: float) -> np.ndarray:
    """A command, or all of them, some rows later; before its first row the first one is held."""
    return command[np.maximum(np.arange(len(command)) - round(delay / period), 0)]


def _filled(reading: np.ndarray) -> np.ndarray:
    """(n, c) readings, the last one kept where one is missing; before the first, the first."""
    filled = np.zeros_like(reading)
    for column, values in enumerate(reading.T):
        known = np.flatnonzero(np.isfinite(values))
        if len(known):
            last = np.searchsorted(known, np.arange(len(values)), side="right") - 1
            filled[:, column] = values[known[np.maximum(last, 0)]]
    return filled


def _one_step(free: Callable[[np.ndarray, int], np.ndarray], filled: np.ndarray) -> np.ndarray:
    """(n, c) predictions of every row from the one before; of the first, itself."""
    ahead = free(np.arange(len(filled) - 1), 1)[:, 0]
    return np.vstack([filled[:1], ahead])


def _least_squares(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Weights by ridge regression, the ridge a small share of the columns' mean square."""
    square = columns.T @ columns
    ridge = _RIDGE * np.trace(square) / len(square)
    return np.linalg.solve(square + ridge * np.eye(len(square)), columns.T @ target)
