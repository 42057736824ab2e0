"""A learned law as numbers to show, and what is left unexplained: which balance, where, when."""

from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.estimate.inputs import SUPPLY, Input, input_units
from hydrotele.gap.discover import Discovery, Learned
from hydrotele.gap.law_tables import THROUGH
from hydrotele.gap.result import Lack, LearnedLaw, Prediction, Unknown
from hydrotele.gap.words import lack_words, learned_words
from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import OF_A_DRIVE

_POINTS = 41  # at which a learned law is shown
_WINDOW = 1.0  # s, of the windows in which a lack shows
_SHOWS, _MOST_WINDOWS = 0.4, 5
_MOST_LACKS = 3  # that are said
_ALIKE = 0.9  # share of a law's square that a simple form must have to be said to resemble it
_LAW_OF = {"force": "force", "flow_head": "flow", "flow_rod": "flow", THROUGH: "flow",
           "command": "valve", SUPPLY: "supply"}  # fmt: skip
_UNITS = {"time": "s", "spool": "1", "pump_speed": "rad/s", "command": "1",
          "pressure_head": "Pa", "pressure_rod": "Pa", "pressure_supply": "Pa"}  # fmt: skip


def learned_laws(
    discovery: Discovery, machine: Machine, shares: Mapping[tuple[str, str], float]
) -> tuple[LearnedLaw, ...]:
    """The learned laws of a guess as curves, formulas and sentences.

    Args:
        discovery: the guess with its laws.
        machine: the given model.
        shares: part of the guess -> share of the gap that it closes.

    Returns:
        The laws in the order of the guess.
    """
    laws = {law.hypothesis.key: law for law in discovery.laws}
    keys = [h.key for h in discovery.judged.guess.hypotheses if h.key in laws]
    return tuple(_learned_law(machine, laws[key], shares[key]) for key in keys)


def _learned_law(machine: Machine, law: Learned, share: float) -> LearnedLaw:
    """A law along its (first) variable, with the other variable at its median."""
    table = law.table
    variable, other = table.variables[0], table.variables[1] if len(table.variables) > 1 else ""
    points = np.unique(np.quantile(law.seen[variable], np.linspace(0.01, 0.99, _POINTS)))
    probe = {variable: points}
    if other:
        probe[other] = np.full(len(points), float(np.median(law.seen[other])))
    if table.window:
        probe["time"] = np.full(len(points), sum(table.window) / 2.0)
    columns = table.columns(probe)
    error = np.sqrt(np.maximum(np.einsum("pk,kl,pl->p", columns, law.covariance, columns), 0.0))
    along = table.columns(law.seen) @ law.entries
    balance = "flow_head" if law.balance == THROUGH else law.balance
    (unit,) = input_units(machine, [Input(balance, law.axis)])
    resembles = "" if table.of or table.window else _resembles(law, along)
    name, _, axis = variable.partition(".")
    length = "rad" if _turns(machine, axis or law.axis) else "m"
    size = float(np.sqrt(np.mean(along**2)))
    if law.balance == SUPPLY:
        variable, other = (_with_axis(v, law.axis) for v in (variable, other))
    return LearnedLaw(
        law.balance, law.axis, _formula(law),
        learned_words(
            law.balance, law.axis, variable, size, unit, resembles, other, table.window
        ),
        resembles, variable, tuple(points.tolist()), tuple((columns @ law.entries).tolist()),
        tuple(error.tolist()), unit, _unit_of(name, unit, length), share, other,
    )  # fmt: skip


def _with_axis(variable: str, axis: str) -> str:
    """A variable with its drive, where it is one of a drive."""
    return f"{variable}.{axis}" if variable in OF_A_DRIVE else variable


def _formula(law: Learned) -> str:
    """The law's table as the term of the patched machine has it, with its numbers if they are few.

    A law of one variable is told point by point.
    """
    table = law.table
    if len(table.variables) == 1:
        pairs = ", ".join(
            f"{x:.3g}: {y:.3g}" for x, y in zip(table.points[0], law.entries, strict=True)
        )
        text = f"linear_table({table.variables[0]}; {pairs})"
    else:
        ways = (f"{v}: {len(p)} points from {p[0]:.3g} to {p[-1]:.3g}"
                for v, p in zip(table.variables, table.points, strict=True))  # fmt: skip
        text = f"table2({'; '.join(ways)})"
    return text + (" from {:.4g} to {:.4g} s".format(*table.window) if table.window else "")


def _turns(machine: Machine, axis: str) -> bool:
    """Whether an axis' drive moves in rad."""
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


def _unit_of(variable: str, unit: str, length: str) -> str:
    if variable == "force":
        return "N m" if length == "rad" else "N"
    return _UNITS.get(variable) or (f"{length}/s" if variable == "velocity" else length)


def _resembles(law: Learned, along: np.ndarray) -> str:
    """The library's effect whose form has nearly all of the law's square, or empty."""
    s = law.seen
    v = s["velocity"]
    way = np.tanh(v / law.smoothing)
    forms: dict[str, np.ndarray] = {}
    if law.balance == "force":
        forms = {"coulomb_friction": way, "viscous_friction": v, "external_force": np.ones_like(v),
                 "speed_dependent_force": v * abs(v)}  # fmt: skip
        if "force" in s:
            forms["load_dependent_friction"] = abs(s["force"]) * way
    elif law.balance in (THROUGH, "flow_head", "flow_rod") and "pressure_head" in s:
        drop = s["pressure_head"] - s["pressure_rod"]
        forms = {"internal_leakage": drop, "orifice_leakage": np.sign(drop) * np.sqrt(abs(drop))}
    elif law.balance == "command":
        u = s["command"]
        forms = {"command_offset": np.ones_like(u), "valve_deadband": np.tanh(u / 0.02),
                 "valve_gain": u}  # fmt: skip
    whole = float(along @ along)
    best, most = "", _ALIKE
    for name, form in forms.items():
        share = float(along @ form) ** 2 / (float(form @ form) * whole + 1e-300)
        if share > most:
            best, most = name, share
    return best


def describe(
    lacks: Sequence[Lack], learned: Sequence[LearnedLaw], after: Sequence[Prediction]
) -> Unknown:
    """Describe what no effect of the library explains.

    Args:
        lacks: what the named effects leave, by balance, the largest first.
        learned: laws that were found for it.
        after: one-step predictions of the patched machine, the held-out run first.

    Returns:
        The law that fails, the channel that shows it most, and words.
    """
    channel = _worst_channel(after)
    law, depends, term = "sensor", (), None
    words = [lack_words(lack) for lack in lacks[:_MOST_LACKS]]
    if lacks:
        law = _LAW_OF[lacks[0].balance]
    if learned:
        law, term = _LAW_OF[learned[0].balance], learned[0].formula
        depends = tuple(
            part if part == "time" or "." in part else f"{part}.{learned[0].axis}"
            for part in _variables(learned[0])
        )
        words += [one.description for one in learned]
    if not words:
        words = ["No balance of forces or flows explains it: look at this sensor, its mounting and"
                 " the geometry of the linkage."]  # fmt: skip
    return Unknown(law, channel, depends, " ".join(words), term, _windows(after[0], channel))


def _variables(law: LearnedLaw) -> list[str]:
    return [law.variable, law.other] if law.other else [law.variable]


def _worst_channel(after: Sequence[Prediction]) -> str:
    size = np.nanmean(np.concatenate([p.whitened**2 for p in after]), axis=0)
    return after[0].channels[int(np.nanargmax(size))]


def _windows(prediction: Prediction, channel: str) -> tuple[tuple[float, float], ...]:
    """Up to five windows of a second or more in which a channel's errors are large."""
    loud = prediction.whitened[:, prediction.channels.index(channel)] ** 2
    period = float(np.median(np.diff(prediction.time)))
    length = max(1, round(_WINDOW / period))
    count = len(loud) // length
    if count < 2:
        return ()
    blocks = loud[: count * length].reshape(count, length)
    there = np.isfinite(blocks)
    level = np.where(there, blocks, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    level[0] = 0.0
    high = level > max(2.0, 1.0 + _SHOWS * (np.quantile(level, 0.95) - 1.0))
    edges = np.flatnonzero(np.diff(np.r_[0, high.astype(int), 0]))
    spans = [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    spans = sorted(spans, key=lambda s: -level[s[0] : s[1]].sum())[:_MOST_WINDOWS]
    start = float(prediction.time[0])
    times = [(start + a * _WINDOW, start + b * _WINDOW) for a, b in sorted(spans)]
    return tuple((round(a, 2), round(b, 2)) for a, b in times)
