"""What the search for a gap yields.

`gap.json`: what scripts read of a Gap. Its keys are fixed.

Numbers as a mechanic says them: mm, deg, bar or MPa, ms, %, L/min, with honest digits.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np

from hydrotele.core.units import display_unit
from hydrotele.effects import EFFECTS
from hydrotele.gap.posterior import Posterior

SURE = 0.95
"""Probability of a mechanism below which it is called ambiguous."""
LIKELY = 0.5
"""Probability above which an effect may explain a part: likelier than all else."""

VARIES = "_by_"
"""Joins an effect and the variable with which its coefficient varies."""

Verdict = Literal["named", "partly", "ambiguous", "learned", "unknown", "no_gap"]


@dataclass(frozen=True)
class Estimate:
    """A fitted number with its 95 % interval, and the machine's value without the effect."""

    value: float
    unit: str
    low: float
    high: float
    nominal: float


@dataclass(frozen=True)
class Alternative:
    """Another explanation that the data cannot rule out.

    Attributes:
        name: of the library's effect.
        location: where it sits.
        probability: of it in the place of the named effect.
        same: whether it predicts the same readings, so that no data of these channels tell.
    """

    name: str
    location: str
    probability: float
    same: bool = False


@dataclass(frozen=True)
class Profile:
    """A coefficient that varies with one variable.

    Attributes:
        variable: such as `position`, of the same drive.
        variable_unit: SI.
        points: (k,) values of the variable.
        values: (k,) coefficient there [unit of the effect's parameter].
        spread: (k,) standard deviations.
    """

    variable: str
    variable_unit: str
    points: tuple[float, ...]
    values: tuple[float, ...]
    spread: tuple[float, ...]


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data ask for.

    Attributes:
        name: of the library's effect.
        location: where it sits.
        probability: that it is this effect there, and neither a rival nor something unknown.
        parameters: its numbers.
        alternatives: rivals that the data cannot rule out.
        share: of the gap on the held-out run that it closes, by what comes back without it.
        profile: coefficient of an effect that varies; the parameter is its mean then.
    """

    name: str
    location: str
    probability: float
    parameters: Mapping[str, Estimate]
    alternatives: tuple[Alternative, ...] = ()
    share: float = math.nan
    profile: Profile | None = None

    @property
    def other_forms(self) -> tuple[Alternative, ...]:
        """Alternatives that are the same mechanism at the same place, in another form.

        Also those at the same place that predict the same readings, as an offset of a centre of
        mass does what a larger inertia does where the axis of rotation is vertical.
        """
        own = EFFECTS[self.name].mechanism if self.name in EFFECTS else ""
        return tuple(
            a for a in self.alternatives
            if a.location == self.location
            and (a.same or (own and a.name in EFFECTS and EFFECTS[a.name].mechanism == own))
        )  # fmt: skip

    @property
    def mechanism_probability(self) -> float:
        """Probability of its mechanism at this place, in this or another form."""
        return self.probability + sum(a.probability for a in self.other_forms)


@dataclass(frozen=True)
class LearnedLaw:
    """A law found from the data, in physical variables, that no effect of the library states.

    Attributes:
        balance: force, flow or command, to which it adds.
        axis: of the drive.
        formula: in words of the variables.
        description: one sentence.
        resembles: the library's effect that has nearly this form, or empty.
        variable: on what it depends.
        points: (k,) values of the variable [its unit].
        values: (k,) what the law adds there [unit].
        spread: (k,) standard deviations of the values.
        unit: of the values.
        variable_unit: of the points.
        share: of the gap on the held-out run that it closes.
        other: a second variable on which it depends, at its median in `values`; or empty.
    """

    balance: str
    axis: str
    formula: str
    description: str
    resembles: str
    variable: str
    points: tuple[float, ...]
    values: tuple[float, ...]
    spread: tuple[float, ...]
    unit: str
    variable_unit: str
    share: float = math.nan
    other: str = ""


@dataclass(frozen=True)
class Lack:
    """What a model lacks in one balance, as an unknown input of the filter.

    Attributes:
        balance: force, flow_head, flow_rod, command or flow_supply.
        axis: on which it acts.
        size: its standard deviation [unit].
        unit: SI.
        part: of the largest that makes sense (full force, rated flow, full command).
    """

    balance: str
    axis: str
    size: float
    unit: str
    part: float


@dataclass(frozen=True)
class Unknown:
    """A disagreement that no effect of the library explains.

    Attributes:
        law: the law that fails: force, flow, valve or sensor.
        channel: the channel that shows it most.
        depends_on: quantities that it depends on, such as `position.stick`.
        description: one paragraph in plain words.
        term: the learned law's formula, or None.
        windows: (start, end) [s] in the held-out run where it shows most.
    """

    law: str
    channel: str
    depends_on: tuple[str, ...]
    description: str
    term: str | None = None
    windows: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class GapSize:
    """RMS of one-step prediction errors of the held-out run in units of the sensors' noise.

    `noise_floor` is what a perfect model has, near 1; None where it cannot be told.
    """

    before: float
    after: float
    noise_floor: float | None
    metric: str = "RMS of the whitened one-step prediction errors, all channels, held-out run"


@dataclass(frozen=True)
class Candidate:
    """A line of the ranking: what naming this effect alone would gain.

    Attributes:
        log_bayes_factor: twice the log Bayes factor against the given model, by the linear step.
        parameters: parameter -> value; empty for a law or a profile, whose coefficients alone say nothing.
        units: parameter -> its SI unit, where the library does not state it.
    """

    name: str
    location: str
    log_bayes_factor: float
    parameters: Mapping[str, float]
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Regression:
    """A fitted balance of one drive.

    Attributes:
        balance: force, flow or length.
        axis: the drive.
        unit: of the measured quantity, SI.
        coefficients: name (`factor`, `viscous`, `coulomb`, `per_position`, `constant`) -> estimate, whose
            `nominal` is that of the given machine.
        explained: fraction of the variance of the measured quantity that the fit explains, robust.
        explained_nominal: the same of the given machine; NaN if it states no number.
        rows: number of rows.
        points: name (`measured`, `model`, `velocity`, `position`, `drive`) -> (k,) values of some rows [SI].
    """

    balance: str
    axis: str
    unit: str
    coefficients: Mapping[str, Estimate]
    explained: float
    explained_nominal: float
    rows: int
    points: Mapping[str, np.ndarray] = field(repr=False)


@dataclass(frozen=True)
class GrossError:
    """A gross error of a log or of a machine file.

    Attributes:
        kind: `exchanged columns`, `wrong sign`, `wrong unit`, `factor` or `unexplained`.
        channels: the columns, or balance and drive.
        probability: of it against all alternatives.
        explained: fraction of the variance explained if it is corrected; NaN if nothing explains it.
        explained_as_logged: the same without a correction.
        description: one sentence.
    """

    kind: str
    channels: tuple[str, ...]
    probability: float
    explained: float
    explained_as_logged: float
    description: str


@dataclass(frozen=True)
class InitialRegressions:
    """What regressions on measured quantities say before a search.

    Attributes:
        regressions: by balance and drive, of the log as it is.
        errors: gross errors, in the order in which they were found.
    """

    regressions: tuple[Regression, ...]
    errors: tuple[GrossError, ...]


@dataclass(frozen=True)
class RunDifference:
    """A parameter that differs between runs, or a difference of one run from all others.

    Attributes:
        name: of the parameter, such as `viscous_friction.boom.viscous`, or of a disturbance and its drive.
        unit: SI.
        deviation: standard deviation between runs [unit]; NaN of a difference of one run.
        runs: run -> its difference from the common value and the standard deviation of that [unit].
        reach: half-width of the 95 % interval of the difference of a new run [unit]; NaN of one run's.
        details: other parameters of a disturbance, such as its start, in words.
    """

    name: str
    unit: str
    deviation: float
    runs: Mapping[str, tuple[float, float]]
    reach: float = math.nan
    details: str = ""


@dataclass(frozen=True)
class Contender:
    """A candidate in the place of a named effect.

    Attributes:
        name: of the effect.
        location: where it acts.
        log_bayes_factor: twice the log Bayes factor against no effect in this place.
        probability: of it, among all candidates and none.
    """

    name: str
    location: str
    log_bayes_factor: float
    probability: float


@dataclass(frozen=True)
class Comparison:
    """The candidates in the place of a named effect (name, location), the one with the largest Bayes factor first."""

    name: str
    location: str
    contenders: tuple[Contender, ...]


@dataclass(frozen=True)
class Rejection:
    """What was tried and not named.

    Attributes:
        name: of the effect; empty if the test says all.
        location: where it acts.
        test: that it failed.
        value: of the test; NaN if it has none.
        limit: that the value had to exceed; NaN if there is none.
    """

    name: str
    location: str
    test: str
    value: float
    limit: float


@dataclass(frozen=True)
class InputTrace:
    """A residual input along one run.

    Attributes:
        run: name of the run.
        balance: force, flow_head, flow_rod, command or flow_supply.
        axis: on which it acts.
        unit: SI.
        time: (n,) [s].
        given: (n,) what the given model misses [unit], NaN where unknown.
        remaining: (n,) what the corrected model misses [unit].
        added: (n,) what the corrected model adds in this balance [unit]; None if it adds states or nothing.
    """

    run: str
    balance: str
    axis: str
    unit: str
    time: np.ndarray
    given: np.ndarray
    remaining: np.ndarray
    added: np.ndarray | None


@dataclass(frozen=True)
class VerdictExplanation:
    """Why the verdict: candidates, rejections, and residual inputs over time."""

    comparisons: tuple[Comparison, ...] = ()
    rejections: tuple[Rejection, ...] = ()
    traces: tuple[InputTrace, ...] = ()


@dataclass(frozen=True)
class Prediction:
    """One-step predictions of one run by one model.

    Attributes:
        run: name of the run.
        time: (n,) [s].
        channels: the c channels.
        predicted: (n, c) one-step predicted readings [channel's unit].
        measured: (n, c) readings, NaN where missing.
        whitened: (n, c) prediction errors over their predicted standard deviation, NaN where
            missing; a perfect model gives white noise of size 1.
    """

    run: str
    time: np.ndarray
    channels: tuple[str, ...]
    predicted: np.ndarray
    measured: np.ndarray
    whitened: np.ndarray


Model = TypeVar("Model")


@dataclass(frozen=True)
class Gap(Generic[Model]):
    """Result of a gap search: verdict, effects, corrected machine and the evidence for them.

    Attributes:
        machine: the model that was given: a Machine, or the model of a mechanism.
        patched: the model with the named effects; the same object if nothing was named.
        verdict: named, partly, ambiguous, learned, unknown or no_gap.
        effects: the named effects, the most probable first.
        unknown: the part of the gap that no effect explains, or None.
        size: the gap on the held-out run before and after.
        ranking: single effects by gain, best first.
        before: predictions of the given model, the held-out run first, then the fit runs.
        after: predictions of the patched model, in the same order.
        laws: law -> axis or place -> {"before", "after", "noise"}: RMS balance residuals of the
            held-out run, [unit] as in `law_units`.
        law_units: law -> unit of its residual.
        tests: name of a residual test -> {"value", "limit", "passed"} of the final model.
        next_experiment: motion that would separate the alternatives or show the unknown part better, or None;
            has "reason" and "scenario" (a scenario as a dict).
        calibration: calibrated parameter -> its estimate.
        learned: laws that were learned from the data and are part of the patched machine.
        lacks: residual inputs of the patched machine (missing force, flow or command), the largest first.
        noise: channel -> (found, stated) standard deviation of a reading [SI]; NaN if not stated.
        jitter: (found, stated) standard deviation of the instants at which rows are read [s].
        notes: removed and repaired data, one sentence each.
        unused_channels: logged channels that were not used, with the reason, one sentence each.
        seconds: wall time of the search.
        open_loop: error of open-loop predictions with the measured forces: `horizon` [s], `before` and
            `after` (joint -> RMS [rad] or [m]); or None.
        answers: probabilities of location, family and law of each effect, see `gap.answer`; or None.
        initial: regressions on measured quantities before the search, or None.
        explanation: candidates, rejections and residual inputs, or None.
        posterior: samples of the parameters of effects and of calibrated parameters, or None.
        differences: parameters that differ between runs, and effects of the held-out run alone.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> effect = "[{name: coulomb_friction, location: slide, parameters: {coulomb: 600}}]"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for seed in "1", "2":
        ...         overrides = {"duration": "2", "log_rate": "100", "control_rate": "100", "seed": seed}
        ...         scenario = ht.load_scenario("rig_steps", {**overrides, "effects": effect})
        ...         run = ht.run_scenario(scenario)
        ...         ht.save_log(run.measured, Path(folder, f"run_{seed}.parquet"))
        ...     data = ht.load_dataset(folder, ht.load_machine("rig"))
        >>> gap = ht.find_gap(data, effects=["coulomb_friction"], jobs=1)

        The patched machine predicts the held-out run almost as well as the noise of the sensors allows: the RMS of
        the prediction errors, in units of the expected one, falls to about 1.

        >>> gap.size.before > 3.0, gap.size.after < 1.2
        (True, True)
        >>> for machine in gap.machine, gap.patched:
        ...     print(round(machine.axes["slide"].cylinder.friction.coulomb, -1))  # N
        150.0
        590.0
    """

    machine: Model
    patched: Model
    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    unknown: Unknown | None
    size: GapSize
    ranking: tuple[Candidate, ...]
    before: tuple[Prediction, ...]
    after: tuple[Prediction, ...]
    laws: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    law_units: Mapping[str, str] = field(default_factory=dict)
    tests: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    next_experiment: Mapping[str, Any] | None = None
    calibration: Mapping[str, Estimate] = field(default_factory=dict)
    learned: tuple[LearnedLaw, ...] = ()
    lacks: tuple[Lack, ...] = ()
    noise: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    jitter: tuple[float, float] = (0.0, 0.0)
    notes: tuple[str, ...] = ()
    seconds: float = 0.0
    open_loop: Mapping[str, Any] | None = None
    unused_channels: tuple[str, ...] = ()
    answers: tuple[Mapping[str, Any], ...] | None = None
    initial: InitialRegressions | None = None
    explanation: VerdictExplanation | None = None
    posterior: Posterior | None = None
    differences: tuple[RunDifference, ...] = ()


def gap_document(gap: Gap) -> dict[str, Any]:
    """Return a Gap as strict JSON: numbers and texts in SI units, null where a number is not finite.

    Args:
        gap: result of the search.

    Returns:
        Mapping with these keys; the table of `gap.json` in the guide to gap finding explains them further.

        - `verdict`: named, partly, ambiguous, learned, unknown or no_gap.
        - `effects`: the named effects, see `effect_document`. `share` is the fraction of the held-out run's
          gap that reappears without the effect. `mechanism_probability` adds the probabilities of
          alternatives that are the same mechanism with another law (a lag for a delay); it decides the
          verdict. An effect whose coefficient varies has a `profile`: `variable`, `points`
          [`variable_unit`], `values` and their standard deviations `spread`.
        - `calibration`: calibrated parameter -> `value`, `nominal`, `unit`, `ci95`.
        - `learned`: laws learned from the data: `balance` (force, flow_head, flow_rod, flow_through,
          flow_supply, command), `axis`, `variable`, `other` (a second variable, or empty), `formula`
          in SI, `points` [`variable_unit`], `values` there and their standard deviations `spread`
          [`unit`], `resembles` (a library effect or null), `share`, `description`.
        - `unknown`: the part of the gap that no effect explains, or null: `law`, `channel`, `depends_on`,
          `windows` [s], `description`.
        - `lacks`: residual inputs of the patched machine: `balance`, `axis`, standard deviation `size`
          [`unit`], `part` (relative to the largest plausible one).
        - `noise`: channel -> `found` and `stated` standard deviation of a reading [SI].
        - `jitter`: `found` and `stated` standard deviation of the sampling instants [s].
        - `gap`: RMS prediction errors of the held-out run `before` and `after` the correction, and
          `noise_floor`, that of a perfect model.
        - `tests`: residual test -> `value`, `limit`, `passed`.
        - `laws`: balance -> `unit` and `places`, place -> RMS `before`, `after` and `noise`.
        - `next_experiment`: `reason` and `scenario`, or null.
        - `notes`: on the data. `seconds`: duration of the search.
        - `unused_channels`: logged channels that were not used, with the reason.
        - `open_loop` (mechanisms only): error of open-loop predictions with the measured forces:
          `horizon` [s], `before` and `after` (joint -> RMS [rad] or [m]), or null.
        - `answers` (machines only): per effect `sure` (the most detailed of place, family and law that is
          sure), and the probabilities of `places`, `families` there, `laws`, and `none`.
        - `initial_regressions`: regressions on measured quantities before the search, see
          `regressions_document`.
        - `run_differences`: parameters that differ between runs, fields of `RunDifference`.
        - `explanation`: reasons of the verdict, see `explanation_document`.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import hydrotele as ht
        >>> effect = "[{name: coulomb_friction, location: slide, parameters: {coulomb: 600}}]"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for seed in "1", "2":
        ...         overrides = {"duration": "2", "log_rate": "100", "control_rate": "100", "seed": seed}
        ...         scenario = ht.load_scenario("rig_steps", {**overrides, "effects": effect})
        ...         run = ht.run_scenario(scenario)
        ...         ht.save_log(run.measured, Path(folder, f"run_{seed}.parquet"))
        ...     data = ht.load_dataset(folder, ht.load_machine("rig"))
        >>> gap = ht.find_gap(data, effects=["coulomb_friction"], jobs=1)
        >>> document = ht.gap_document(gap)
        >>> document["verdict"], [effect["name"] for effect in document["effects"]]
        ('named', ['coulomb_friction'])
        >>> document["effects"][0]["parameters"]["coulomb"]["unit"]
        'N'
    """
    unknown = gap.unknown and {
        "law": gap.unknown.law,
        "channel": gap.unknown.channel,
        "depends_on": list(gap.unknown.depends_on),
        "windows": [list(window) for window in gap.unknown.windows],
        "description": gap.unknown.description,
    }
    size = gap.size
    laws = {law: {"unit": gap.law_units.get(law, "1"), "places": places} for law, places in gap.laws.items()}
    open_loop = {} if gap.open_loop is None else {"open_loop": gap.open_loop}
    answers = {} if gap.answers is None else {"answers": gap.answers}
    initial = {} if gap.initial is None else {"initial_regressions": regressions_document(gap.initial)}
    why = {} if gap.explanation is None else {"explanation": explanation_document(gap.explanation)}
    differing = {"run_differences": [dataclasses.asdict(d) for d in gap.differences]} if gap.differences else {}
    return finite(open_loop | answers | initial | why | differing | {
        "verdict": gap.verdict,
        "effects": [effect_document(effect) for effect in gap.effects],
        "calibration": {
            key: {"value": e.value, "nominal": e.nominal, "unit": e.unit, "ci95": [e.low, e.high]}
            for key, e in gap.calibration.items()
        },
        "learned": [
            {**dataclasses.asdict(law), "resembles": law.resembles or None} for law in gap.learned
        ],
        "unknown": unknown,
        "lacks": [dataclasses.asdict(lack) for lack in gap.lacks],
        "noise": {
            channel: {"found": found, "stated": stated}
            for channel, (found, stated) in gap.noise.items()
        },
        "jitter": dict(zip(("found", "stated"), gap.jitter, strict=True)),
        "gap": {
            "metric": size.metric,
            "before": size.before,
            "after": size.after,
            "noise_floor": size.noise_floor,
        },
        "tests": gap.tests,
        "laws": laws,
        "next_experiment": gap.next_experiment,
        "unused_channels": list(gap.unused_channels),
        "notes": list(gap.notes),
        "seconds": gap.seconds,
    })  # fmt: skip


def regressions_document(found: InitialRegressions) -> dict:
    """Return the regressions as plain data for `gap.json`.

    Returns:
        `errors`: gross errors with `kind`, `channels`, `probability`, `explained`, `explained_as_logged`,
        `description`. `regressions`: `balance`, `axis`, `unit`, `explained` and `explained_nominal` (fraction of the
        variance), `rows`, and `coefficients`: name -> `value`, `nominal`, `unit`, `ci95`.
    """
    regressions = [
        {
            "balance": r.balance, "axis": r.axis, "unit": r.unit, "explained": r.explained,
            "explained_nominal": r.explained_nominal, "rows": r.rows,
            "coefficients": {
                name: {"value": e.value, "nominal": e.nominal, "unit": e.unit, "ci95": [e.low, e.high]}
                for name, e in r.coefficients.items()
            },
        }
        for r in found.regressions
    ]  # fmt: skip
    errors = [
        {
            "kind": e.kind, "channels": list(e.channels), "probability": e.probability, "explained": e.explained,
            "explained_as_logged": e.explained_as_logged, "description": e.description,
        }
        for e in found.errors
    ]  # fmt: skip
    return {"errors": errors, "regressions": regressions}


def explanation_document(why: VerdictExplanation) -> dict[str, Any]:
    """Return an explanation as plain data for `gap.json`.

    Returns:
        `candidates`: per named effect `name`, `location` and its `contenders` with `log_bayes_factor` (twice the log
        Bayes factor against none) and `probability`. `rejected`: `name`, `location`, `test`, `value`, `limit`.
        `residual_inputs`: `run`, `balance`, `axis`, `unit`, and RMS `given`, `remaining`, `added`.
    """

    def rms(values: np.ndarray | None) -> float | None:
        return None if values is None or not np.isfinite(values).any() else float(np.sqrt(np.nanmean(values**2)))

    return {
        "candidates": [dataclasses.asdict(c) for c in why.comparisons],
        "rejected": [dataclasses.asdict(r) for r in why.rejections],
        "residual_inputs": [
            {
                "run": t.run, "balance": t.balance, "axis": t.axis, "unit": t.unit, "given": rms(t.given),
                "remaining": rms(t.remaining), "added": rms(t.added),
            }
            for t in why.traces
        ],
    }  # fmt: skip


def effect_document(effect: NamedEffect) -> dict[str, Any]:
    """One effect as it stands in `gap.json`."""
    profile = {} if effect.profile is None else {"profile": dataclasses.asdict(effect.profile)}
    return profile | {
        "name": effect.name,
        "location": effect.location,
        "probability": effect.probability,
        "mechanism_probability": effect.mechanism_probability,
        "share": effect.share,
        "parameters": {
            name: {"value": e.value, "unit": e.unit, "ci95": [e.low, e.high]} for name, e in effect.parameters.items()
        },
        "alternatives": [
            {
                "name": a.name,
                "location": a.location,
                "probability": a.probability,
                "same": a.same,
            }
            for a in effect.alternatives
        ],
    }


def finite(data: Any) -> Any:
    """Data with Python types only, and None for what is not finite; keys become texts.

    >>> finite({"a": (np.float64(1), np.nan), 2: np.array([True])})
    {'a': [1.0, None], '2': [True]}
    """
    if isinstance(data, np.ndarray | np.generic):
        data = data.tolist()
    if hasattr(data, "items"):
        return {str(key): finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data


_LEAST_DIGITS, _MOST_DECIMALS = 3, 6


class CustomaryEstimate(NamedTuple):
    """An estimate in customary numbers, as texts without unit, and the unit; `-` if unknown."""

    value: str
    low: str
    high: str
    nominal: str
    unit: str


def amount(value: float, unit: str, parameter: str = "") -> str:
    """A number [unit] with three digits and its customary unit.

    >>> amount(0.0021, "m"), amount(-60e3, "Pa"), amount(0.0, "kg")
    ('2.1 mm', '-0.6 bar', '0 kg')
    """
    shown, factor = display_unit(unit, value, parameter)
    return f"{_rounded(value * factor)} {shown}"


def in_customary_units(estimate: Estimate, parameter: str = "") -> CustomaryEstimate:
    """An estimate in customary numbers; the interval decides how many digits are worth saying.

    >>> in_customary_units(Estimate(0.0853, "1", 0.0841, 0.0864, 0.04), "deadband")
    CustomaryEstimate(value='8.53', low='8.41', high='8.64', nominal='4', unit='%')
    """
    numbers = (estimate.value, estimate.low, estimate.high, estimate.nominal)
    size = max((abs(x) for x in numbers[:3] if math.isfinite(x)), default=math.nan)
    unit, factor = display_unit(estimate.unit, size, parameter)
    width = 0.5 * abs(estimate.high - estimate.low) * factor
    value, low, high = (_number(x * factor, width) for x in numbers[:3])
    return CustomaryEstimate(value, low, high, _rounded(estimate.nominal * factor), unit)


def _number(value: float, width: float) -> str:
    """With two digits of the half width of its interval, or three of its own without one."""
    if not math.isfinite(value):
        return "-"
    if not (math.isfinite(width) and width > 0):
        return _rounded(value)
    decimals = min(max(0, 1 - math.floor(math.log10(width))), _MOST_DECIMALS)
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def _rounded(value: float) -> str:
    """With three digits, never with an exponent where a person would write none."""
    if not math.isfinite(value):
        return "-"
    if value == 0 or not 1e-3 <= abs(value) < 1e6:
        return f"{value + 0.0:.{_LEAST_DIGITS}g}"
    decimals = max(0, _LEAST_DIGITS - 1 - math.floor(math.log10(abs(value))))
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
