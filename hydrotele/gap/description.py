"""A learned law as numbers to show, and what is left unexplained: which balance, where, when.

The verdict in plain words, as the console, the report and the README say it.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.estimate.filter import SUPPLY, Input, input_units
from hydrotele.gap.answer import base_effect
from hydrotele.gap.law_tables import THROUGH, Learned
from hydrotele.gap.result import (
    LIKELY,
    SURE,
    Alternative,
    Candidate,
    Estimate,
    Gap,
    GapSize,
    Lack,
    LearnedLaw,
    NamedEffect,
    Prediction,
    Unknown,
    amount,
    in_customary_units,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import DRIVE_VARIABLES

_PLACES = {"tool": "at the tool", "base": "of the base", "all": "of all axes"}
_SIDES = {"head": "head side", "rod": "rod side"}
_COUNTS = ("no place", "one place", "two places", "three places", "four places")
_QUANTITIES = {
    "command": "command",
    "angle": "angle",
    "position": "position",
    "length": "piston position",
    "velocity": "velocity",
    "pressure_head": "head side pressure",
    "pressure_rod": "rod side pressure",
    "pressure_supply": "supply pressure",
}
_LACKS = {
    "force": "a force on the {axis} drive",
    "flow_head": "an oil flow into the {axis} head side",
    "flow_rod": "an oil flow into the {axis} rod side",
    "flow_through": "an oil flow from the {axis} head side to its rod side",
    "command": "a signal added to the {axis} command",
    "flow_supply": "an additional pump flow",
}
_VARIABLES = {
    "time": "time", "position": "position", "velocity": "velocity", "command": "command",
    "spool": "spool position", "pump_speed": "pump speed", "force": "load",
    "pressure_head": "head side pressure", "pressure_rod": "rod side pressure",
    "pressure_supply": "supply pressure",
}  # fmt: skip
_TOLD = 3  # calibrated numbers that the verdict tells
_AT_LIMIT = 0.98  # of an input's largest size: an estimate at its bound is no size
_UNSEEN = 0.005  # fraction of the gap that is printed as 0 %
_SLIGHT = 0.1  # of the noise: a gap below it hardly shows in single predictions

_LAWS = {
    "force": "the balance of forces",
    "flow": "the balance of oil flows",
    "valve": "the flow through the valve",
    "supply": "the pump and its relief valve",
    "flow_head": "the balance of oil flows on the head side",
    "flow_rod": "the balance of oil flows on the rod side",
    "closure": "the geometry of the linkage",
    "motion": "the motion of the axis",
    "geometry": "the geometry of the linkage",
    "timing": "the timing of the signals",
    "sensor": "the sensor readings",
}


def law_words(law: str) -> str:
    """What a law is about, in plain words."""
    return _LAWS.get(law, f"the law `{law}`")


def channel_words(channel: str) -> str:
    """A channel in plain words.

    >>> channel_words("pressure_rod.boom"), channel_words("pressure_supply")
    ('boom rod side pressure', 'supply pressure')
    """
    kind, _, axis = channel.partition(".")
    return f"{axis} {_QUANTITIES.get(kind, kind.replace('_', ' '))}".strip()


def variable_words(variable: str) -> str:
    """A variable of a learned law in plain words.

    >>> variable_words("pressure_rod.swing")
    'rod side pressure of the swing'
    """
    name, _, axis = variable.partition(".")
    words = _VARIABLES.get(name, name.replace("_", " "))
    return f"{words} of the {axis}" if axis else words


def learned_words(
    balance: str, axis: str, variable: str, size: float, unit: str, resembles: str, other: str = ""
) -> str:
    """What a learned law does, in a sentence or two.

    >>> learned_words("force", "boom", "position", 9e3, "N", "", "velocity.swing")
    'A force on the boom drive, 9 kN RMS, that varies with position and the velocity of the swing.'
    """
    how = f"that varies with the {variable_words(variable)}"
    if other:
        how += f" and the {variable_words(other)}"
    how = how.replace("the position", "position").replace("the time", "time")
    text = f"{_capital(_LACKS[balance].format(axis=axis))}, {amount(size, unit)} RMS, {how}."
    return f"{text} It resembles {resembles.replace('_', ' ')}." if resembles else text


def learned_title(law: LearnedLaw) -> str:
    """On what a learned law acts and on what it depends, in a few words."""
    what = _LACKS[law.balance].format(axis=law.axis).partition(" ")[2]
    where = f", at the median {variable_words(law.other)}" if law.other else ""
    return _capital(f"{what} over {variable_words(law.variable)}{where}")


def lack_words(lack: Lack) -> str:
    """What a model lacks in one balance.

    >>> lack_words(Lack("flow_head", "boom", 2e-4, "m^3/s", 0.05))
    'Missing in the model: an oil flow into the boom head side of 12 L/min (standard deviation).'
    >>> lack_words(Lack("force", "boom", 900.0, "N", 1.0))
    'The model cannot follow the boom: a force on the boom drive as large as its physical limit would be missing.'
    """
    what = _LACKS[lack.balance].format(axis=lack.axis)
    if lack.part > _AT_LIMIT:
        return f"The model cannot follow the {lack.axis}: {what} as large as its physical limit would be missing."
    return f"Missing in the model: {what} of {amount(lack.size, lack.unit)} (standard deviation)."


def lack_title(balance: str, axis: str) -> str:
    """A residual input in a few words.

    >>> lack_title("flow_head", "boom")
    'Oil flow into the boom head side'
    """
    return _capital(_LACKS[balance].format(axis=axis).partition(" ")[2])


def number_title(key: str) -> str:
    """A calibrated number in plain words.

    >>> number_title("valve_gain.boom.ratio"), number_title("area.boom.area_head")
    ('valve gain of the boom: ratio', 'area of the boom: head')
    """
    kind, place, *rest = key.split(".")
    where = _PLACES.get(place, f"of the {place.replace('_', ' ')}")
    what = " ".join(rest).removeprefix(f"{kind}_").replace("_", " ")
    title = f"{kind.replace('_', ' ')} {where}"
    return f"{title}: {what}" if what and what != kind.replace("_", " ") else title


def most_moved(gap: Gap) -> list[str]:
    """Keys of the calibrated numbers, those whose interval lies farthest from the given first."""

    def moved(key: str) -> float:
        e = gap.calibration[key]
        half = 0.5 * (e.high - e.low)
        return abs(e.value - e.nominal) / half if half > 0 else 0.0

    return sorted(gap.calibration, key=moved, reverse=True)


def effect_title(effect: NamedEffect | Alternative | Candidate) -> str:
    """Name and place of an effect.

    >>> effect_title(Alternative("pressure_offset", "boom.head", 0.5))
    'pressure offset of the boom head side'
    """
    place = _PLACES.get(effect.location)
    if place is None:
        words = effect.location.replace(".", " ").replace("_", " ").replace("/", " ").split()
        words = words[::-1] if words[:1] == ["supply"] else words  # supply.rear: of the rear supply
        place = "of the " + " ".join(_SIDES.get(word, word) for word in words)
    return f"{effect.name.replace('_', ' ')} {place}" if effect.location else effect.name


def parameter_words(name: str, estimate: Estimate) -> str:
    """A parameter with its interval and what the model has.

    >>> parameter_words("mass", Estimate(251.2, "kg", 247.9, 254.5, 0.0))
    'mass 251.2 kg (95 % interval 247.9 to 254.5 kg; the model has 0 kg)'
    """
    s = in_customary_units(estimate, name)
    sure = f"95 % interval {s.low} to {s.high} {s.unit}"
    if "-" in (s.low, s.high):
        sure = "no interval available"
    model = "" if s.nominal == "-" else f"; the model has {s.nominal} {s.unit}"
    return f"{name.replace('_', ' ')} {s.value} {s.unit} ({sure}{model})"


def probability_text(probability: float) -> str:
    """A probability in percent, never rounded to certainty.

    >>> probability_text(0.62), probability_text(0.99999)
    ('62 %', 'over 99.9 %')
    """
    if not math.isfinite(probability):
        return "not known"
    if probability > 0.999:
        return "over 99.9 %"
    return "under 0.1 %" if probability < 0.001 else f"{100 * probability:.3g} %"


def share_words(share: float) -> str:
    """A share of the gap in percent, `-` where it is not known.

    >>> share_words(0.634), share_words(math.nan)
    ('63 %', '-')
    """
    return f"{100 * share:.0f} %" if math.isfinite(share) else "-"


def gap_closed(size: GapSize) -> float:
    """Part of the gap that the patch closes, at most 1; NaN where none is known above the noise."""
    if size.noise_floor is None:
        return math.nan
    above = size.before - size.noise_floor
    return min((size.before - size.after) / above, 1.0) if above > 0 else math.nan


def headline(gap: Gap) -> str:
    """The verdict in one line."""
    if gap.verdict == "no_gap":
        within = " within the uncertainty of its parameters" if gap.calibration else ""
        varying = [d.name.replace("_", " ").replace(".", " ") for d in gap.differences if not math.isnan(d.deviation)]
        if varying:
            return (
                f"Model and machine agree{within}, apart from differences between the runs: {_listed(varying, 'and')}"
            )
        return f"Model and machine agree{within}"
    if gap.verdict == "partly":
        remainder = "the remaining difference has no known cause"
        return _capital("; ".join([*map(_brief, gap.effects), remainder]))
    if gap.verdict == "learned":
        return f"Model and machine differ; {_closing_changes(gap)}, but the cause is not in the library"
    if gap.verdict == "unknown" or not gap.effects:
        likely = (e for e in gap.effects if e.mechanism_probability > LIKELY)
        known = " and ".join(map(effect_title, likely))
        also = f"apart from {known}, " if known else ""
        if not known and (changes := _closing_changes(gap)):
            return f"Model and machine differ; {changes}, but the cause is not identified"
        return f"Model and machine differ; {also}no known effect explains the difference"
    titles = [effect_title(effect) for effect in gap.effects]
    if gap.verdict == "ambiguous":
        unsure = _unsure(gap)
        rivals = [effect_title(a) for a in unsure.alternatives]
        titles = [t for t in titles if t != effect_title(unsure)]
        either = "Either " + " or ".join([effect_title(unsure), *rivals])
        return ", and ".join([either, *titles])
    return _capital("; ".join(map(_brief, gap.effects)))


def _closing_changes(gap: Gap) -> str:
    """Return which unnamed changes close which fraction of the gap; empty if they close none of it."""
    closed = gap_closed(gap.size)
    what = ["learned laws"] * bool(gap.learned) + ["calibrated parameters"] * bool(gap.calibration)
    if not what or not closed > _UNSEEN:
        return ""
    return f"{_listed(what, 'and')} close {_closed_words(gap)} of the gap"


def _closed_words(gap: Gap) -> str:
    """Fraction of the gap that is closed; never 100 % if a residual test says that something remains."""
    percent = 100.0 * max(gap_closed(gap.size), 0.0)
    return f"{min(math.floor(percent), 99) if failed_tests(gap) else percent:.0f} %"


def verdict_words(gap: Gap) -> tuple[str, ...]:
    """The verdict in a few sentences, one text per thought."""
    if gap.verdict == "no_gap":
        rest = _calibrated(gap) or ("The model needs no change.",)
        return (_agreement(gap), *rest)
    if gap.verdict in ("unknown", "learned"):
        return (
            *_unknown(gap), *_effects(gap), *_calibrated(gap), *_shrinking(gap), *_experiment(gap)
        )  # fmt: skip
    count = len(gap.effects)
    where = _COUNTS[count] if count < len(_COUNTS) else f"{count} places"
    first = f"The machine differs from its model in {where}."
    if gap.verdict == "ambiguous":
        first = f"{first[:-1]}, but these data do not determine which effect it is."
    if gap.verdict == "partly":
        first = f"{first[:-1]} with an identified effect; the remaining difference has no known cause."
    rivals = _rivals(gap)
    rest = (*_calibrated(gap), *_shrinking(gap), *rivals, *_leftover(gap), *_experiment(gap))
    return (first, *_effects(gap), *rest)


def failed_tests(gap: Gap) -> list[str]:
    """Names of the residual tests that the final model does not pass."""
    return [name for name, test in gap.tests.items() if not test.get("passed", True)]


def _unsure(gap: Gap) -> NamedEffect:
    """The effect with alternatives, or the least sure one."""
    with_rivals = [effect for effect in gap.effects if effect.alternatives]
    return min(with_rivals or gap.effects, key=lambda effect: effect.probability)


def _brief(effect: NamedEffect) -> str:
    numbers = [(name, in_customary_units(e, name)) for name, e in effect.parameters.items()]
    facts = ", ".join(f"{name.replace('_', ' ')} {s.value} {s.unit}" for name, s in numbers)
    return f"{effect_title(effect)}: {facts}" if facts else effect_title(effect)


def _effects(gap: Gap) -> tuple[str, ...]:
    return tuple(_effect(effect, _run(gap)) for effect in gap.effects)


def _effect(effect: NamedEffect, run: str) -> str:
    facts = ", ".join(parameter_words(n, e) for n, e in effect.parameters.items())
    known = EFFECTS.get(base_effect(effect.name))
    what = f"{effect_title(effect)} ({known.description})" if known else effect_title(effect)
    if effect.profile:
        facts = f"{profile_words(effect)}; mean {facts}"
    text = _capital(f"{what}: {facts}. Probability {probability_text(effect.probability)}.")
    if effect.share < _UNSEEN:
        return f"{text} This holds for the fitted runs; {run} does not show it, its predictions are as good without it."
    if math.isfinite(effect.share):
        text += f" Without it, {share_words(effect.share)} of the gap on {run} reappears."
    return text


def profile_words(effect: NamedEffect) -> str:
    """How the coefficient of an effect varies: its range, and where it is largest."""
    profile = effect.profile
    assert profile
    ((key, estimate),) = effect.parameters.items()
    least, most = min(profile.values), max(profile.values)
    where = amount(profile.points[profile.values.index(most)], profile.variable_unit)
    return (
        f"{key.replace('_', ' ')} between {amount(least, estimate.unit, key)} and {amount(most, estimate.unit, key)},"
        f" largest at a {variable_words(profile.variable)} of {where}"
    )


def _calibrated(gap: Gap) -> tuple[str, ...]:
    if not gap.calibration:
        return ()
    told = [
        f"{number_title(key)} {s.value} {s.unit} (model {s.nominal})"
        for key in most_moved(gap)[:_TOLD]
        for s in [in_customary_units(gap.calibration[key], key.rpartition(".")[2])]
    ]
    count = len(gap.calibration)
    many = f"{count} uncertain parameters were" if count > 1 else "One uncertain parameter was"
    most = f"largest changes: {', '.join(told)}"
    return (f"{many} calibrated within the limits of the machine file; {most}.",)


def _agreement(gap: Gap) -> str:
    size = gap.size
    if gap.calibration:
        return (
            "There is no gap except for the values of uncertain parameters. With these calibrated,"
            f" the prediction error on {_run(gap)}, which was not fitted, is"
            f" {_times(size.after, size)} instead of {size.before:.2f}."
        )
    return (
        f"There is no gap: on {_run(gap)}, which was not fitted, the prediction error of the model"
        f" is {_times(size.before, size)}."
    )


def _shrinking(gap: Gap) -> tuple[str, ...]:
    size = gap.size
    parts = len(gap.effects) + len(gap.learned) + bool(gap.calibration)
    if not parts:
        return ()
    text = (
        f"With {'this change' if parts == 1 else 'all these changes'} of the model, the prediction"
        f" error on {_run(gap)}, which was not fitted, changes from {size.before:.2f} to"
        f" {_times(size.after, size)}"
    )
    if size.noise_floor is None:
        return (f"{text}.",)
    if size.before - size.noise_floor < _SLIGHT:
        return (f"{text}. The effect is weak: it hardly changes the predictions of this run.",)
    return (f"{text}: {_closed_words(gap)} of the gap is closed.",)


def _times(value: float, size: GapSize) -> str:
    if size.noise_floor is None:
        return f"{value:.2f} times the sensor noise"
    return f"{value:.2f} times the sensor noise (a perfect model has {size.noise_floor:.2f})"


def _rivals(gap: Gap) -> tuple[str, ...]:
    texts = []
    for effect in gap.effects:
        form = bool(effect.other_forms) and effect.mechanism_probability >= SURE
        rivals = effect.other_forms if form else effect.alternatives
        if not rivals or (effect.probability >= SURE if form else gap.verdict == "named"):
            continue
        told = [f"{effect_title(a)} ({probability_text(a.probability)})" for a in rivals]
        others = f"{effect_title(effect)} from {_listed(told, 'or')}"
        if form:
            text = f"Its form is not identifiable: these data do not distinguish {others}."
        else:
            text = (
                f"These data do not distinguish {others}, because they have the same effect on the available sensors."
            )
        texts.append(f"{text} The patched model contains the first of them.")
    return tuple(texts)


def _leftover(gap: Gap) -> tuple[str, ...]:
    failed = failed_tests(gap)
    located = _located(gap) if gap.unknown else ()
    if not failed:
        return located
    tests = "test" if len(failed) == 1 else "tests"
    left = f"The explanation is incomplete: the remaining errors fail the {tests} {_listed(failed, 'and')}."
    return (left, *located)


def _unknown(gap: Gap) -> tuple[str, ...]:
    size = gap.size
    error = f"on {_run(gap)} the prediction error is {_times(size.before, size)}."
    changes = _closing_changes(gap)
    first = f"Model and machine differ, and no known effect explains the difference: {error}"
    if size.noise_floor is not None and size.before <= size.noise_floor:
        first = (
            "Model and machine differ in the fitted runs, and no known effect explains the difference; the held-out run"
            f" does not show it: {error}"
        )
    elif changes:
        first = f"Model and machine differ: {error} {_capital(changes)}, but no known effect has their form."
    return (first, *_located(gap))


def _located(gap: Gap) -> tuple[str, ...]:
    """Where the unexplained part sits, and which laws were learned of it."""
    unknown = gap.unknown
    if unknown is None:
        return ()
    where = (
        f"The unexplained residual is in {law_words(unknown.law)}, most visible in the {channel_words(unknown.channel)}"
    )
    if unknown.depends_on:
        on = _listed([channel_words(name) for name in unknown.depends_on], "and")
        where += f"; it depends on the {on}"
    count = len(gap.learned)
    many = "One law was" if count == 1 else f"{count} laws were"
    learned = f"{many} learned from the data for it and added to the patched machine."
    return (f"{where}.", unknown.description, *([learned] if gap.learned else []))


def _experiment(gap: Gap) -> tuple[str, ...]:
    reason = (gap.next_experiment or {}).get("reason")
    return (f"Next experiment: {reason}",) if reason else ()


def _run(gap: Gap) -> str:
    return f"run {gap.before[0].run}" if gap.before else "the held-out run"


def _listed(words: list[str], joint: str) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {joint} {words[-1]}"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


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
    laws: Sequence[Learned], machine: Machine, shares: Mapping[tuple[str, str], float]
) -> tuple[LearnedLaw, ...]:
    """Return learned laws as curves, formulas and sentences.

    Args:
        laws: the laws.
        machine: the given model.
        shares: name and location -> share of the gap that it closes.
    """
    return tuple(_learned_law(machine, law, shares[law.hypothesis.key]) for law in laws)


def _learned_law(machine: Machine, law: Learned, share: float) -> LearnedLaw:
    """A law along its (first) variable, with the other variable at its median."""
    table, seen = law.table, law.seen
    variable, other = table.variables[0], table.variables[1] if len(table.variables) > 1 else ""
    points = np.unique(np.quantile(seen[variable], np.linspace(0.01, 0.99, _POINTS)))
    probe = {variable: points}
    if other:
        probe[other] = np.full(len(points), float(np.median(seen[other])))
    columns = table.columns(probe)
    error = np.sqrt(np.maximum(np.einsum("pk,kl,pl->p", columns, law.covariance, columns), 0.0))
    along = table.columns(law.seen) @ law.entries
    balance = "flow_head" if law.balance == THROUGH else law.balance
    (unit,) = input_units(machine, [Input(balance, law.axis)])
    resembles = "" if table.of else _resembles(law, along)
    size = float(np.sqrt(np.mean(along**2)))
    if law.balance == SUPPLY:
        variable, other = (_with_axis(v, law.axis) for v in (variable, other))
    return LearnedLaw(
        law.balance, law.axis, _formula(law),
        learned_words(law.balance, law.axis, variable, size, unit, resembles, other),
        resembles, variable, tuple(points.tolist()), tuple((columns @ law.entries).tolist()),
        tuple(error.tolist()), unit, variable_unit(machine, law.axis, variable), share, other,
    )  # fmt: skip


def _with_axis(variable: str, axis: str) -> str:
    """A variable with its drive, where it is one of a drive."""
    return f"{variable}.{axis}" if variable in DRIVE_VARIABLES else variable


def _formula(law: Learned) -> str:
    """The law's table as the term of the patched machine has it, with its numbers if they are few.

    A law of one variable is told point by point.
    """
    table = law.table
    if len(table.variables) == 1:
        pairs = ", ".join(f"{x:.3g}: {y:.3g}" for x, y in zip(table.points[0], law.entries, strict=True))
        return f"linear_table({table.variables[0]}; {pairs})"
    ways = (f"{v}: {len(p)} points from {p[0]:.3g} to {p[-1]:.3g}"
            for v, p in zip(table.variables, table.points, strict=True))  # fmt: skip
    return f"bilinear_table({'; '.join(ways)})"


def _turns(machine: Machine, axis: str) -> bool:
    """Whether an axis' drive moves in rad."""
    return machine.axes[axis].cylinder is None and machine.position_kind(axis) == "angle"


def variable_unit(machine: Machine, own_axis: str, variable: str) -> str:
    """SI unit of a law's variable; `own_axis` is that of the law."""
    name, _, axis = variable.partition(".")
    length = "rad" if _turns(machine, axis or own_axis) else "m"
    if name == "force":
        return "N m" if length == "rad" else "N"
    return _UNITS.get(name) or (f"{length}/s" if name == "velocity" else length)


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


def describe(lacks: Sequence[Lack], learned: Sequence[LearnedLaw], after: Sequence[Prediction]) -> Unknown:
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
            part if part == "time" or "." in part else f"{part}.{learned[0].axis}" for part in _variables(learned[0])
        )
        words += [one.description for one in learned]
    if not words:
        words = ["No missing force or flow explains it: check this sensor, its mounting and the"
                 " geometry of the linkage."]  # fmt: skip
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
