"""A learned law as numbers to show, and what is left unexplained: which balance, where, when."""

from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.gap.discover import Discovery, Learned
from hydrotele.gap.law_shapes import THROUGH
from hydrotele.gap.result import Lack, LearnedLaw, Prediction, Unknown
from hydrotele.gap.words import lack_words, learned_words
from hydrotele.machine import Machine
from hydrotele.prediction.inputs import Input, input_units

_POINTS = 41  # at which a learned law is shown
_WINDOW = 1.0  # s, of the windows in which a lack shows
_SHOWS, _MOST_WINDOWS = 0.4, 5
_MOST_LACKS = 3  # that are said
_ALIKE = 0.9  # share of a law's square that a simple form must have to be said to resemble it
_LAW_OF = {"force": "force", "flow_head": "flow", "flow_rod": "flow", THROUGH: "flow",
           "command": "valve"}  # fmt: skip
_UNITS = {"time": "s", "spool": "1", "pump_speed": "rad/s", "command": "1",
          "pressure_head": "Pa", "pressure_rod": "Pa", "pressure_supply": "Pa"}  # fmt: skip


def learned_laws(
    discovery: Discovery, machine: Machine, spread: np.ndarray,
    shares: Mapping[tuple[str, str], float],
) -> tuple[LearnedLaw, ...]:  # fmt: skip
    """The learned laws of a guess as curves, formulas and sentences.

    Args:
        discovery: the guess with its laws.
        machine: the given model.
        spread: (P,) standard deviations of the guess's deviations.
        shares: part of the guess -> share of the gap that it closes.

    Returns:
        The laws in the order of the guess.
    """
    found, first = [], 0
    laws = {law.hypothesis.key: law for law in discovery.laws}
    for hypothesis, deviation in discovery.judged.guess.parts:
        own = spread[first : first + hypothesis.size]
        first += hypothesis.size
        if hypothesis.key in laws:
            law, share = laws[hypothesis.key], shares[hypothesis.key]
            found.append(_learned_law(machine, law, deviation, own, share))
    return tuple(found)


def _learned_law(
    machine: Machine, law: Learned, deviation: np.ndarray, spread: np.ndarray, share: float
) -> LearnedLaw:
    """A law along its (first) variable, with the other variables at their medians.

    A law that goes with the sign of the motion is shown for positive motion, one in proportion to
    the speed per unit of speed.
    """
    shape = law.shape
    scales = np.array([p.scale for p in law.hypothesis.parameters.values()])
    coefficients = deviation * scales
    a, _, b = shape.variable.partition(" - ")
    x = law.seen[a] - law.seen[b] if b else law.seen[a]
    points = np.unique(np.quantile(x[np.isfinite(x)], np.linspace(0.01, 0.99, _POINTS)))
    probe = {name: np.full(len(points), float(np.median(v))) for name, v in law.seen.items()}
    probe[a] = points + probe[b] if b else points
    if shape.factor:
        fast = 1e3  # sign(velocity) is 1 there
        probe["velocity"] = np.full(len(points), 1.0 if shape.factor == "velocity" else fast)
    if shape.other:  # at the median of the second variable
        c, _, e = shape.other.partition(" - ")
        across = law.seen[c] - law.seen[e] if e else law.seen[c]
        probe[c] = np.full(len(points), float(np.median(across))) + (probe[e] if e else 0.0)
    columns = shape.columns(probe, law.smoothing)
    error = np.sqrt((columns**2) @ (spread * scales) ** 2)
    along = shape.columns(law.seen, law.smoothing) @ coefficients
    balance = "flow_head" if law.balance == THROUGH else law.balance
    (unit,) = input_units(machine, [Input(balance, law.axis)])
    formula = " + ".join(
        f"{c:.3g} {p}" if p != "1" else f"{c:.3g}"
        for p, c in zip(shape.products, coefficients, strict=True)
    ).replace("+ -", "- ")
    resembles = _resembles(law, along)
    length = "rad" if _turns(machine, law.axis) else "m"
    size = float(np.sqrt(np.mean(along**2)))
    return LearnedLaw(
        law.balance, law.axis, formula,
        learned_words(
            law.balance, law.axis, shape.variable, shape.factor, size, unit, resembles, shape.other
        ),
        resembles, shape.variable, tuple(points.tolist()), tuple((columns @ coefficients).tolist()),
        tuple(error.tolist()), _per_speed(unit, length) if shape.factor == "velocity" else unit,
        _unit_of(a, unit, length), share, shape.other,
    )  # fmt: skip


def _turns(machine: Machine, axis: str) -> bool:
    """Whether an axis' drive moves in rad."""
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


def _per_speed(unit: str, length: str) -> str:
    """Unit of a law's part that is multiplied by the speed.

    >>> _per_speed("N", "m"), _per_speed("m^3/s", "m"), _per_speed("m^3/s", "rad")
    ('N s/m', 'm^2', 'm^3/rad')
    """
    if unit == "m^3/s":
        return "m^2" if length == "m" else "m^3/rad"
    return f"{unit} s/{length}"


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
            "time" if part == "time" else f"{part}.{learned[0].axis}"
            for part in _variables(learned[0])
        )
        words += [one.description for one in learned]
    if not words:
        words = ["No balance of forces or flows explains it: look at this sensor, its mounting and"
                 " the geometry of the linkage."]  # fmt: skip
    return Unknown(law, channel, depends, " ".join(words), term, _windows(after[0], channel))


def _variables(law: LearnedLaw) -> list[str]:
    both = (law.variable, law.other) if law.other else (law.variable,)
    return [part for variable in both for part in variable.split(" - ")]


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
