"""Forms that a learned law can have: a table over one or two variables, linear in between.

It may see a variable through a play, or be switched by one, as a relay with hysteresis does.

Regression of prediction errors on the entries of a law's table, judged by parts of runs left out.

The errors are those of a track whose unknown inputs have taken up what they could; how they answer
to an addition is known to first order (`estimate.track`). So a reading counts as it does in the
likelihood, and a law that is faster than the unknown inputs is seen as it is, not as a smoother
blurs it. Entries that follow each other are taken to be alike (P-splines, Eilers and Marx 1996).
"""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.track import Track, error_responses
from hydrotele.terms.table import PLAY, SWITCH, update_hysteresis, window_factor
from hydrotele.terms.term import DRIVE_VARIABLES

THROUGH = "flow_through"
"""Balance of a flow from the head side to the rod side."""
_POINTS = 14  # of a table over one variable; what keeps them alike is in the regression
_PAIR_POINTS = 10  # over each of two
_TIMES = 10  # over time: what acts for a while begins and ends somewhere
_STEEP = 0.3  # precision of first differences, in units of the lack: beyond what the data tell a
# law goes on as it is there, not as steeply as it was
_SHRINK = 0.1  # precision of an entry, in units of the lack: what no data tells is nothing
OWN_VARIABLES = (
    "velocity", "position", "command", "force", "pressure_head", "pressure_rod", "spool",
    "pump_speed", "pressure_supply", "time",
)  # fmt: skip


PLAYED, AHEAD = "play_output", "play_difference"
"""What a law's play lets through of its variable, and by how much the variable is ahead of it."""


class Memory(NamedTuple):
    """How a law remembers a variable.

    Attributes:
        way: PLAY or SWITCH of `terms.table`.
        variable: as of a table [its unit].
        begin: 0 of a play; where a switch goes off.
        end: half width of a play; where a switch goes on.
    """

    way: int
    variable: str
    begin: float
    end: float

    def along(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n,) what is remembered along a run [1], see `terms.table.remembered`."""
        x = (np.asarray(values[self.variable], float) - self.begin) / (self.end - self.begin)
        return _along(self.way, x)

    def seen(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What a law sees of it along a run, (n,) each: `PLAYED` and `AHEAD` of a play."""
        if self.way != PLAY:
            return {}
        played = self.end * self.along(values)
        return {PLAYED: played, AHEAD: np.asarray(values[self.variable]) - played}

    @property
    def facts(self) -> dict[str, dict[str, Any]]:
        """Keys of a term."""
        plain = self.variable.partition(".")[0]
        if self.way == PLAY:
            return {"play": {"variable": plain, "half_width": self.end}}
        return {"switch": {"variable": plain, "on": self.end, "off": self.begin}}


@compiled
def _along(way, x):
    """What is remembered after each of (n,) values; what is not known changes nothing."""
    held, out = 0.0, np.empty(len(x))
    for k in range(len(x)):
        if np.isfinite(x[k]):
            held = update_hysteresis(way, held, x[k])
        out[k] = held
    return out


class Table(NamedTuple):
    """A form that a law can have: entries at points of one or two variables.

    Attributes:
        variables: one or two of a drive's state; those of another drive with its axis, such as
            `velocity.swing`; `PLAYED` and `AHEAD` of a play.
        points: rising points of each [its unit].
        window: times between which it acts [s]; empty for always.
        memory: what it remembers, if it does.
    """

    variables: tuple[str, ...]
    points: tuple[tuple[float, ...], ...]
    window: tuple[float, ...] = ()
    memory: Memory | None = None

    @property
    def kind(self) -> tuple[tuple[str, ...], bool, int]:
        """Variables, whether it acts for a while only, and in what way it remembers."""
        return self.variables, bool(self.window), self.memory.way if self.memory else 0

    @property
    def name(self) -> str:
        """On what it depends, such as `spool,time`."""
        text = ",".join(self.variables)
        if self.memory:
            m = self.memory
            text += f"@{m.variable}~{m.end:.4g}" + (f"/{m.begin:.4g}" if m.begin else "")
        return text + (f"@{self.window[0]:.4g}-{self.window[1]:.4g}" if self.window else "")

    @property
    def size(self) -> int:
        """Number of its entries K."""
        return int(np.prod([len(points) for points in self.points]))

    @property
    def of(self) -> dict[str, str]:
        """Variable -> the drive that it is of, where that is not the law's own."""
        named = (*self.variables, *([self.memory.variable] if self.memory else []))
        return dict(v.split(".") for v in named if "." in v)

    @property
    def is_clear(self) -> bool:
        """Whether no two of its variables are only told apart by their drives."""
        memory = [self.memory.variable] if self.memory else []
        named = {v for v in (*self.variables, *memory) if v not in (PLAYED, AHEAD)}
        return len({v.partition(".")[0] for v in named}) == len(named)

    def columns(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, K) shares of the entries along a run; row by row they add to 1 where the law acts."""
        entries, weights = self.weights(values)
        found = np.zeros((len(entries), self.size))
        np.put_along_axis(found, entries, weights, axis=1)
        return found

    def weights(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) or (n, 4) entries that have a share in a row of a run, and these shares."""
        held = self.memory.along(values) if self.memory else None
        if held is not None and self.memory and self.memory.way == PLAY:
            values = {**values, **self.memory.seen(values)}
        entries, weights = _weights(values[self.variables[0]], self.points[0])
        if len(self.variables) == 2:
            across, shares = _weights(values[self.variables[1]], self.points[1])
            entries = entries[:, :, None] * len(self.points[1]) + across[:, None]
            weights = weights[:, :, None] * shares[:, None]
            entries, weights = entries.reshape(len(across), -1), weights.reshape(len(across), -1)
        if held is not None and self.memory and self.memory.way == SWITCH:
            weights = weights * held[:, None]
        if self.window:
            weights = weights * window_factor(values["time"], *self.window)[:, None]
        return entries, weights

    def precision(self, smoothness: float) -> np.ndarray:
        """(K, K) prior precision of the entries: of their differences, and of each."""
        counts = tuple(map(len, self.points))
        bent, steep = (_differences(counts, order) for order in (2, 1))
        return smoothness * bent + _STEEP * steep + _SHRINK * np.eye(self.size)

    def law(self, entries: np.ndarray) -> dict[str, Any]:
        """Law, parameters, variables and window of a term with some entries (K,)."""
        plain, points = [v.partition(".")[0] for v in self.variables], self.points
        where = {"variables_from": self.of, "window": self.window or None}
        where |= self.memory.facts if self.memory else {}
        if len(plain) == 1:
            table = {"variable": plain[0], "points": points[0], "values": tuple(entries.tolist())}
            return {"law": "linear_table", "parameters": table, **where}
        rows = entries.reshape(len(points[0]), -1)
        table = {
            "row_variable": plain[0], "column_variable": plain[1], "row_points": points[0],
            "column_points": points[1], "values": tuple(tuple(row) for row in rows.tolist()),
        }  # fmt: skip
        return {"law": "bilinear_table", "parameters": table, **where}


@functools.cache
def _differences(counts: tuple[int, ...], order: int) -> np.ndarray:
    """(K, K) products of differences of entries with so many points of each variable.

    Args:
        counts: of points.
        order: of the differences.
    """
    found = np.zeros((1, 1))
    for count in counts:
        each = np.diff(np.eye(count), order, axis=0)
        own = np.kron(np.eye(len(found)), each.T @ each)
        found = np.kron(found, np.eye(count)) + own
    return found


def _weights(x: np.ndarray, points: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) points and weights of linear interpolation, constant beyond the ends."""
    at = np.asarray(points)
    x = np.clip(np.nan_to_num(x), at[0], at[-1])
    low = np.clip(np.searchsorted(at, x) - 1, 0, len(at) - 2)
    part = (x - at[low]) / (at[low + 1] - at[low])
    return np.stack([low, low + 1], axis=1), np.stack([1.0 - part, part], axis=1)


def possible_tables(
    values: Sequence[Mapping[str, np.ndarray]], smoothing: float,
    window: tuple[float, ...] = (),
) -> list[Table]:  # fmt: skip
    """Every table over one variable that a law can have.

    Args:
        values: per run variable -> (n,) values of the drive, and of others (`velocity.swing`).
        smoothing: of the sign of the drive's velocity [m/s] or [rad/s]; friction has points there.
        window: in which they act.

    Returns:
        The tables.
    """
    points = {n: _points(n, values, _POINTS, smoothing, window) for n in _names(values)}
    return [Table((n,), (p,), window) for n, p in points.items() if p]


def paired_tables(
    values: Sequence[Mapping[str, np.ndarray]],
    smoothing: float,
    others: bool,
    window: tuple[float, ...] = (),
) -> list[Table]:
    """Every table over two variables that a law can have.

    Args:
        values: as of `possible_tables`.
        smoothing: as of `possible_tables`.
        others: whether variables of other drives are among them.
        window: in which they act.

    Returns:
        The tables; none has two variables that only their drives tell apart.
    """
    names = [n for n in _names(values) if others or "." not in n]
    points = {n: _points(n, values, _PAIR_POINTS, smoothing, window) for n in names}
    pairs = itertools.combinations([n for n in names if points[n]], 2)
    return [
        Table((a, b), (points[a], points[b]), window) for a, b in pairs
        if a.partition(".")[0] != b.partition(".")[0]
        and a.partition(".")[2] in ("", b.partition(".")[2] or a.partition(".")[2])
    ]  # fmt: skip


_WAYS = 3  # points over how far a variable is ahead of its play: both ways and between
_WIDTHS = (0.06, 0.15, 0.3)  # half widths of plays, of the variable's range
# quantiles at which a switch goes on and off: far apart, and nearly one
_THRESHOLDS = (
    (0.75, 0.25), (0.9, 0.5), (0.5, 0.1),
    (0.23, 0.17), (0.38, 0.32), (0.53, 0.47), (0.68, 0.62), (0.83, 0.77),
)  # fmt: skip


def remembering_tables(
    table: Table, values: Sequence[Mapping[str, np.ndarray]], variables: Sequence[str]
) -> list[Table]:
    """A table with every memory that is tried at first.

    Args:
        table: without a memory.
        values: as of `possible_tables`.
        variables: that may be remembered; of a play only those of the table.

    Returns:
        The tables; none whose variables only their drives tell apart.
    """
    found = []
    for name in variables:
        if name == "time":
            continue
        x = np.concatenate([v[name] for v in values])
        x = x[np.isfinite(x)]
        low, high = np.quantile(x, [0.01, 0.99]) if len(x) else (0.0, 0.0)
        if not high > low:
            continue
        for width in _WIDTHS if name in table.variables else ():
            play = Memory(PLAY, name, 0.0, float(width * (high - low)))
            through = tuple(PLAYED if v == name else v for v in table.variables)
            found.append(table._replace(variables=through, memory=play))
            if len(table.variables) == 1:
                ways = tuple((play.end * np.linspace(-1.0, 1.0, _WAYS)).tolist())
                found.append(Table((AHEAD,), (ways,), memory=play))
                found.append(Table((name, AHEAD), (*table.points, ways), memory=play))
        for on, off in _THRESHOLDS:
            upper, lower = np.quantile(x, [on, off])
            if upper > lower:
                for ends in ((lower, upper), (upper, lower)):
                    switch = Memory(SWITCH, name, *map(float, ends))
                    found.append(table._replace(memory=switch))
    return [table for table in found if table.is_clear]


def _over(table: Table, memory: Memory) -> Table:
    """A table with another memory; points over what is ahead go with its width."""
    assert table.memory
    ratio = memory.end / table.memory.end if memory.way == PLAY else 1.0
    points = tuple(
        tuple(ratio * x for x in own) if name == AHEAD else own
        for name, own in zip(table.variables, table.points, strict=True)
    )
    return table._replace(points=points, memory=memory)


def finer_memories(table: Table, step: float) -> list[Table]:
    """A table with a memory, and some whose memories are somewhat different."""
    m = table.memory
    assert m
    way = step * (m.end - m.begin)
    begins = (m.begin,) if m.way == PLAY else (m.begin - way, m.begin, m.begin + way)
    return [
        _over(table, m._replace(begin=a, end=b))
        for a in begins for b in (m.end - way, m.end, m.end + way) if a != b
    ]  # fmt: skip


def _names(values: Sequence[Mapping[str, np.ndarray]]) -> list[str]:
    others = [n for n in values[0] if "." in n and n.partition(".")[0] in DRIVE_VARIABLES]
    return [n for n in (*OWN_VARIABLES, *others) if n in values[0]]


def _points(
    name: str, values: Sequence[Mapping[str, np.ndarray]], count: int, smoothing: float,
    window: tuple[float, ...],
) -> tuple[float, ...]:  # fmt: skip
    """Points of a variable, half-way between evenly and by quantiles; none if it never moves.

    Those of the time lie evenly in the window, if there is one.
    """
    if name == "time" and window:
        begin, end = window
        return tuple(np.linspace(begin, end, _TIMES).tolist())
    x = np.concatenate([v[name] for v in values])
    x = x[np.isfinite(x)]
    if len(x) < 10 * count or np.ptp(x) == 0.0:
        return ()
    count = _TIMES if name == "time" else count
    low, high = np.quantile(x, [0.01, 0.99])
    found = np.quantile(x, np.linspace(0.01, 0.99, count)) + np.linspace(low, high, count)
    points = set((0.5 * found).tolist())
    if name == "velocity" and low < -2.0 * smoothing and high > 2.0 * smoothing:
        points = {p for p in points if abs(p) > 2.0 * smoothing} | {-smoothing, smoothing}
    rounded = sorted({float(f"{p:.6g}") for p in points})
    return tuple(rounded) if len(rounded) > 1 else ()


_PARTS = 4  # of a single run, left out one by one
_HALVES = 2  # of each of several: a law over what no two runs visit alike is told by neither
_GLANCED = 2000  # rows of a run that are looked at in blocks
_BLOCKS = 400  # of these at most
_HELD = 0.1  # s of a block
_MEMORY_ROWS = 15.0  # that a smoother's answer is alike
_SMOOTHNESS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of the entries, in units of the lack


def parts_left_out(runs: int) -> int:
    """Of how many parts of each of some runs one after the other is left out."""
    return _PARTS if runs == 1 else _HALVES


class Regression(NamedTuple):
    """A law's entries.

    Attributes:
        predicted: fall of -2 log likelihood in parts of runs that were left out, all together.
        entries: (K,) [unit of the addition].
        covariance: (K, K) of the entries [unit of the addition, squared].
        charge: what the entries cost: log determinant of what the data add to their precision.
        left: RMS of what the law does not take of the unknown input [unit of the addition].
    """

    predicted: float
    entries: np.ndarray
    covariance: np.ndarray
    charge: float
    left: float


def regression(
    table: Table, parts: Sequence[tuple[Track, np.ndarray, np.ndarray, np.ndarray]], size: float
) -> Regression:
    """Fit a table's entries to the errors of some tracks.

    Args:
        table: with K entries.
        parts: per run the track, its whitened errors (n c,), what a unit of the addition does
            (n, nz), and the entries' shares (n, K).
        size: standard deviation of the unknown input in whose place the law is put.

    Returns:
        The regression, with the smoothness that predicts best what was left out.
    """
    answers = []
    for track, errors, column, shares in parts:
        slope = error_responses(track, column, shares * size)
        answers.append((slope.reshape(-1, slope.shape[2]), errors))
    falls, x, covariance, charge = _entries(table, answers)
    along = np.concatenate([shares @ x for *_, shares in parts])
    left = size * float(np.sqrt(max(1.0 - np.mean(along**2), 0.0)))
    return Regression(falls, x * size, covariance * size**2, charge, left)


def lack_regression(
    table: Table, parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[Regression, float]:
    """Fit a table's entries to a lack that readings tell row by row.

    Args:
        table: with K entries.
        parts: per run the lack (n,), its standard deviation (n,) and the entries' shares (n, K).

    Returns:
        (The regression, the share of the lack's square in its standard deviations that it predicts
        where it was left out); rows over which smoothed readings hang together count as one.
    """
    lack = np.concatenate([told for told, _, _ in parts])
    size = float(np.sqrt(np.mean(lack**2)))
    answers = []
    for told, deviation, shares in parts:
        each = np.sqrt(_MEMORY_ROWS) * deviation
        answers.append((-size * shares / each[:, None], told / each))
    falls, x, covariance, charge = _entries(table, answers)
    along = np.concatenate([shares @ x for _, _, shares in parts])
    left = float(np.sqrt(np.mean((lack - size * along) ** 2)))
    share = falls / sum(float(errors @ errors) for _, errors in answers)
    return Regression(falls, x * size, covariance * size**2, charge, left), share


def _entries(
    table: Table, answers: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Fall of what is left out, entries, their covariance and charge, with the best smoothness.

    Args:
        table: with K entries.
        answers: per run the slopes of its errors with the entries (n, K), and the errors (n,).
    """
    parts = parts_left_out(len(answers))
    answers = [
        pair for whole in answers
        for pair in zip(*(np.array_split(part, parts) for part in whole), strict=True)
    ]  # fmt: skip
    curvature = np.array([s.T @ s for s, _ in answers])
    slope = np.array([s.T @ e for s, e in answers])
    falls = {smooth: float(_left_out(curvature, slope, table.precision(smooth)).sum()) for smooth in _SMOOTHNESS}
    smooth = max(falls, key=falls.__getitem__)
    prior = table.precision(smooth)
    whole = curvature.sum(axis=0) + prior
    x = -np.linalg.solve(whole, slope.sum(axis=0))
    charge = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(prior)[1]
    return falls[smooth], x, np.linalg.inv(whole), float(charge)


class Ground(NamedTuple):
    """How errors of a run answer to an addition that is held over blocks of rows.

    Attributes:
        rows: first row that is looked at, and the one after the last.
        width: rows of a block.
        curvature: (P, B, B) products of the answers to B blocks with each other, in each of P parts
            of the run, in units of the lack.
        slope: (P, B) products of the answers with the errors.
    """

    rows: tuple[int, int]
    width: int
    curvature: np.ndarray
    slope: np.ndarray

    def blocks(self, table: Table, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(B, K) means over the blocks of a table's shares along the run."""
        own = slice(*self.rows)
        entries, weights = table.weights(values)
        found = np.zeros((self.curvature.shape[1], table.size))
        _add_blocks(entries[own], weights[own], self.width, found)
        return found


@compiled
def _add_blocks(entries, weights, width, out):
    """Means (B, K) over blocks of rows of the shares (n, m) of entries (n, m)."""
    rows = len(entries)
    for row in range(rows):
        block = row // width
        count = min(width, rows - block * width)
        for k in range(entries.shape[1]):
            out[block, entries[row, k]] += weights[row, k] / count


@compiled
def _curved(curvature, held, out):
    """`held' curvature held` (K, K) of a symmetric curvature (B, B), where held has many zeros."""
    blocks, size = held.shape
    work = np.zeros((size, blocks))
    for b in range(blocks):
        for k in range(size):
            share = held[b, k]
            if share != 0.0:
                for a in range(blocks):
                    work[k, a] += share * curvature[b, a]
    for k in range(size):
        for b in range(blocks):
            part = work[k, b]
            if part != 0.0:
                for j in range(size):
                    out[k, j] += part * held[b, j]


def ground(
    track: Track, errors: np.ndarray, column: np.ndarray, told: np.ndarray, known: np.ndarray,
    parts: int,
) -> Ground:  # fmt: skip
    """What a glance at a law needs of a run.

    Args:
        track: linearised, with n rows and c channels.
        errors: (n c,) whitened.
        column: (n, nz) what a unit of the addition does, in units of the lack.
        told: (n,) what is lacking: of a long run its loudest stretch is looked at.
        known: (n,) rows in which a law may be sought.
        parts: that are left out one by one.
    """
    rows = len(told)
    squares = np.concatenate([[0.0], np.cumsum(np.nan_to_num(told) ** 2)])
    length = min(rows, _GLANCED)
    begin = int(np.argmax(squares[length:] - squares[: rows + 1 - length]))
    own = slice(begin, begin + length)
    width = max(1, round(_HELD / track.run.period), -(-length // _BLOCKS))
    held = np.eye(-(-length // width))[np.arange(length) // width] * known[own, None]
    answers = error_responses(track, column, held, own)
    whole = errors.reshape(rows, -1)[own]
    curvature, slope = [], []
    cuts = (np.array_split(all_rows, parts) for all_rows in (answers, whole))
    for s, e in zip(*cuts, strict=True):
        flat = s.reshape(-1, s.shape[2])
        curvature.append(flat.T @ flat)
        slope.append(flat.T @ e.ravel())
    return Ground((begin, begin + length), width, np.array(curvature), np.array(slope))


def at_a_glance(table: Table, runs: Sequence[tuple[Ground, Mapping[str, np.ndarray]]]) -> np.ndarray:
    """Falls of the loss that a table predicts in what is left out, seen block by block.

    Args:
        table: with K entries.
        runs: the ground of each, and variable -> (n,) values of the drive along it.

    Returns:
        (R P,) falls of -2 log likelihood of the P parts of R runs; what is faster than a block is
        missed.
    """
    curvature, slope = [], []
    for below, values in runs:
        held = below.blocks(table, values)
        for c in below.curvature:
            curvature.append(np.zeros((table.size, table.size)))
            _curved(c, held, curvature[-1])
        slope += [held.T @ s for s in below.slope]
    c, s = np.array(curvature), np.array(slope)
    return max((_left_out(c, s, table.precision(p)) for p in _SMOOTHNESS[1::2]), key=np.sum)


def predicted_by_choice(falls: Sequence[np.ndarray]) -> float:
    """Fall in runs left out, if the others choose among tables, too: each knows no more of it.

    Of hundreds of memories one fits the runs there are. What it predicts counts if the others would
    have chosen one that does.

    Args:
        falls: (R,) of each table, as of `at_a_glance`.
    """
    table = np.array(falls)
    others = table.sum(axis=1, keepdims=True) - table
    return float(table[np.argmax(others, axis=0), np.arange(table.shape[1])].sum())


def _left_out(curvature: np.ndarray, slope: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """(P,) falls of the loss of each part, with entries fitted to the others.

    Args:
        curvature: (P, K, K) of the parts.
        slope: (P, K) of the parts.
        prior: (K, K) precision of the entries.
    """
    others = curvature.sum(axis=0) - curvature + prior
    x = -np.linalg.solve(others, (slope.sum(axis=0) - slope)[:, :, None])[:, :, 0]
    return -np.sum(x * (2.0 * slope + (curvature @ x[:, :, None])[:, :, 0]), axis=1)
