"""The gap of a mechanism without hydraulics: from measured motion and forces to a Gap.

The search is that of any machine (`gap.model_search`), on inverse dynamics (`gap.force_evidence`). What it names is
written into the MJCF and its mapping, and that patched model is judged on a run that was not fitted.
"""

import math
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import norm
from threadpoolctl import threadpool_limits

from hydrotele.core.errors import InputError
from hydrotele.core.mjcf import read_mjcf
from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.gap.answer import answer_document, answer_words
from hydrotele.gap.description import describe
from hydrotele.gap.explanation import compare_contenders
from hydrotele.gap.force_columns import SENTENCES, ForceEffect, force_effects
from hydrotele.gap.force_evidence import NORMAL95, QUANTILES, ForceEvidence, NoiseShape, estimate_noise
from hydrotele.gap.mechanism_columns import (
    TYPICAL,
    Columns,
    Key,
    build_columns,
    common_band,
    force_unit,
    nominal_parameters,
    undone,
)
from hydrotele.gap.model_search import MIN_LOG_BAYES_FACTOR, Progress, search_model
from hydrotele.gap.patched import (
    COLUMNS_FILE,
    MJCF_FILE,
    patch_of,
    patched_mapping,
    patched_mjcf,
    sensor_errors,
    write_mechanism,
)
from hydrotele.gap.result import (
    LIKELY,
    Alternative,
    Candidate,
    Estimate,
    Gap,
    GapSize,
    InputTrace,
    Lack,
    NamedEffect,
    Prediction,
    Rejection,
    RunDifference,
    VerdictExplanation,
)
from hydrotele.gap.rivals import Found, effect_probabilities
from hydrotele.gap.run_differences import difference_words
from hydrotele.gap.verdict import verdict_of
from hydrotele.identify.mechanism import ColumnMapping, Mechanism, load_mechanism
from hydrotele.identify.record import IdentificationRecord
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.regressor import BODY_PARAMETERS

MIN_FORCE_SHARE = 0.02
"""Fraction of the RMS force of a drive below which a residual force is no gap: models of friction are no better."""
_MAX_ROUNDS = 4  # of taking sensor errors off the readings and searching again
_CHANGING = ("coulomb_friction", "force_pulse")  # effects on which noise or form depend
_UNCHANGED = 0.01  # prior standard deviations; a smaller change of the sensor errors ends these rounds
_FORM = 0.1  # of a drive's dry friction, by which its form near rest may differ: presliding is not in the model
_SHARPNESS = 0.5  # of the way from the expected sign of an uncertain rate to the sign of a calm one
_WORSE = 1.02  # times the given model's errors on the held-out run: no patch may do more
_MIN_PROBABILITY = 0.005  # below which an alternative is not listed
_DISTINCT = 3.0  # standard deviations from which a calibrated parameter is listed
_REJECTED = (
    "The changes found on the fitted runs increase the errors on the held-out run; they were"
    " rejected, and no effect is named."
)
_DIFFERS = (
    "{} at {}, found on the fitted runs, differs between parts of these runs ({:.2g} to {:.2g} times the fitted value,"
    " twice the log Bayes factor against a constant value {:.0f}); it was rejected."
)
_MINOR = (
    "{} at {} ({}) is in the patched model, because it explains a part of the force errors, but is not named: it is"
    " small, or something else probably causes them."
)
_HELD_OUT_ONLY = "A force of {:.3g} {} RMS acts on {} in the held-out run {} alone; the fitted runs do not show it."
METRIC = "RMS of the drive force errors divided by their noise, all drives, held-out run"


@dataclass(frozen=True)
class MechanismModel:
    """A mechanism as a model that a gap is found against.

    Attributes:
        name: of the MJCF.
        mjcf: the XML.
        mapping: its columns.
        tool: empty; machines have one.
    """

    name: str
    mjcf: str
    mapping: ColumnMapping
    tool: str = ""


class _Task(NamedTuple):
    """The given model and the runs."""

    mjcf: str | Path
    mechanism: Mechanism
    given: MechanismModel
    nominal: Mapping[str, float]
    fit: Sequence[IdentificationRecord]
    heldout: IdentificationRecord
    band: float

    @property
    def drives(self) -> tuple[str, ...]:
        return tuple(self.mechanism.setup.chain.drives)

    def unit(self, joint: str) -> str:
        return force_unit(self.mechanism.setup.chain, joint)

    def effects_of(self, guess: Guess) -> list[tuple[ForceEffect, np.ndarray]]:
        """Accepted effects with their parameter values."""
        return [(h, np.array(list(h.values(d).values()))) for h, d in guess.parts
                if isinstance(h, ForceEffect)]  # fmt: skip


@dataclass(frozen=True)
class _Result:
    """A model, fitted, and what the held-out run says of it.

    Attributes:
        judged: the model on the fitted runs.
        calibration: uncertain parameter -> its change and standard deviation, if they bring evidence.
        patched: the MJCF with it.
        then: held-out columns of the given model.
        now: of the patched one.
        sizes: (2, k) residual forces of the fitted runs and of the held-out run [N] or [N m]; 0 where no evidence.
        heldout: the held-out run with the patched model as the given one.
        differences: what the held-out run has in addition.
    """

    judged: Judged
    calibration: Mapping[str, tuple[float, float]]
    patched: MechanismModel
    then: Columns
    now: Columns
    sizes: np.ndarray
    heldout: ForceEvidence
    differences: tuple[RunDifference, ...] = ()

    def share(self) -> np.ndarray:
        """(2, k) residual forces over the RMS of the drives' forces."""
        return self.sizes / np.sqrt(np.mean(self.then.measured**2, axis=0))

    @property
    def is_lacking(self) -> np.ndarray:
        """(2, k) whether a force is missing in the fitted runs, and in the held-out run."""
        return self.share() > MIN_FORCE_SHARE


@threadpool_limits.wrap(limits=1, user_api="blas")  # results may not depend on the number of threads
def find_force_gap(
    mjcf: str | Path, mapping: str | Path | ColumnMapping | None,
    fit: Sequence[IdentificationRecord], heldout: IdentificationRecord,
    progress: Progress | None = None, effects: Sequence[str] = (), notes: Sequence[str] = (),
) -> Gap[MechanismModel]:  # fmt: skip
    """Find where the model of a mechanism and its logs disagree.

    Args:
        mjcf: file of the given model.
        mapping: of its columns, or its file.
        fit: records of the runs that decide, in the measured joints.
        heldout: the run that judges.
        progress: called with (what is being done, share done).
        effects: names of the effects to try; all if empty.
        notes: to hand on.

    Returns:
        The gap, named or not.

    Raises:
        InputError: an effect is not known, or the runs cannot be followed.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text, share: None)
    if strange := [name for name in effects if name not in SENTENCES]:
        raise InputError(
            f"--effect {strange[0]}",
            f"is not an effect of mechanisms; valid: {', '.join(sorted(SENTENCES))}",
        )
    mechanism = load_mechanism(mjcf, mapping)
    given = MechanismModel(mechanism.setup.chain.name, read_mjcf(mjcf).flatten(), mechanism.mapping)
    nominal = nominal_parameters(mechanism)
    task = _Task(mjcf, mechanism, given, nominal, fit, heldout, common_band(fit, mechanism))
    evidence, found = _search(task, effects, tell)
    tell("evaluate the patched model on the held-out run", 0.9)
    chances = _probabilities(evidence, found)
    small = {h.key for h, v in task.effects_of(found.guess) if _is_small(h, v)} | _brief_pulses(evidence, found.guess)
    judged, untrue = found.judged, list[str]()
    varying: dict[Key, str] = {}
    while varying := _varying(evidence, judged):
        untrue += varying.values()
        judged = _remove_effects(evidence, judged, varying)
    then, is_rejected = build_columns([heldout], mechanism, task.band), False
    result = _evaluate(task, evidence, judged, then)
    if not _error_ratio(task, evidence, result) <= _WORSE:
        is_rejected, untrue = True, [*untrue, _REJECTED]  # a gap of the fitted runs remains
        evidence, found = _given_model(task)
        result = _evaluate(task, evidence, found.judged, then)
    described = _describe_effects(task, evidence, result, chances)
    named = tuple(e for e in described if e.mechanism_probability >= LIKELY and (e.name, e.location) not in small)
    minor = tuple(e for e in described if e not in named)
    result = _compare_heldout(result, mechanism.setup.chain, nominal)
    shape, rows = evidence.shape, slice(0, min(len(result.then.time), len(result.now.time)))
    before, after = (_predictions(task, evidence, shape, result, rows, which) for which in (False, True))
    lacks = _lacks(task, result)
    unknown = None
    if lacks:
        unknown = describe(lacks, (), after)
        depends = _dependence(evidence, result)
        unknown = replace(unknown, depends_on=depends, channel=_channels(task)[task.drives.index(lacks[0].axis)])
    rms = [np.sqrt(np.nanmean(one[0].whitened ** 2, axis=0)) for one in (before, after)]
    total = [float(np.sqrt(np.mean(one**2))) for one in rms]
    size = GapSize(total[0], total[1], 1.0, METRIC)
    more = [
        f"Forces are compared below {task.band:.3g} Hz.",
        *(_MINOR.format(e.name, e.location, _numbers({k: v.value for k, v in e.parameters.items()})) for e in minor),
    ]
    of_fit, of_heldout = result.is_lacking
    more += [_HELD_OUT_ONLY.format(result.sizes[1, k], task.unit(drive), drive, heldout.name)
             for k, drive in enumerate(task.drives) if of_heldout[k] and not of_fit[k]]  # fmt: skip
    more += [difference_words(d) for d in result.differences]
    more += [words for effect in named if (words := answer_words(effect))]
    tell("done", 1.0)
    return Gap(
        machine=given, patched=result.patched,
        verdict=verdict_of(named, (), is_rejected or bool(result.is_lacking.any()), size),
        effects=named, unknown=unknown, size=size, ranking=_ranking(found),
        before=before, after=after,
        laws={"force": {
            drive: {"before": float(a * std), "after": float(b * std), "noise": float(std)}
            for drive, a, b, std in zip(task.drives, *rms, shape.std, strict=True)
        }},
        law_units={"force": task.unit(task.drives[0])}, tests=_tests(result),
        calibration=_calibration(task, result), lacks=lacks,
        noise={c: (float(std), float("nan")) for c, std in zip(_channels(task), shape.std, strict=True)},
        notes=(*notes, *untrue, *more), differences=result.differences, answers=tuple(answer_document(named)),
        explanation=VerdictExplanation(
            compare_contenders(found, named), _rejections(found, named, minor, untrue),
            _traces(task, evidence, result),
        ),
        seconds=time.perf_counter() - begin,
    )  # fmt: skip


def uncertain_parameters(mechanism: Mechanism, nominal: Mapping[str, float]) -> dict[str, float]:
    """Return the parameters of the MJCF that are uncertain, by the relative uncertainty of the mapping.

    Args:
        mechanism: the model.
        nominal: of `nominal_parameters`.

    Returns:
        Parameter -> standard deviation. Moments and products of inertia are uncertain relative to the body's mass and
        size.
    """
    off, chain, std = mechanism.mapping.relative_uncertainty, mechanism.setup.chain, {}
    for body, ten in zip(chain.bodies, chain.inertia, strict=True):
        mass, spread = float(ten[0]), float(ten[4] + ten[7] + ten[9]) / 2.0
        reach = np.sqrt(max(spread, 0.0) * max(mass, 0.0))
        for kind in BODY_PARAMETERS:
            std[f"{kind}.{body}"] = mass if kind == "mass" else reach if kind.startswith("moment") else spread
    sizes = {name: off * std.get(name, abs(value)) for name, value in nominal.items()}
    return {name: size for name, size in sizes.items() if size > 0.0}


def uncertain_form(mechanism: Mechanism, columns: Columns, about: Mapping[str, float]) -> dict[str, float]:
    """Return what no model knows: column -> standard deviation.

    How dry friction acts near rest, how sharply it turns, and where between two rows forces and positions were read.

    Args:
        mechanism: the given model.
        columns: of the runs.
        about: parameter -> how much it differs from the given one, as far as is known.
    """
    form = {"delay.force": columns.row / math.sqrt(12.0)}  # uniform over a row
    for one in mechanism.setup.friction_terms:
        found = about.get(f"coulomb.{one.location}", 0.0)
        dry = abs(one.nominal.get("coulomb", 0.0) + found) + abs(one.nominal.get("stribeck", 0.0))
        if one.location in columns.drives and dry > 0.0:
            form |= {f"stribeck{number}.{one.location}": _FORM * dry for number in (0, 2)}
            form[f"sharpness.{one.location}"] = _SHARPNESS * dry
    return form


def _search(task: _Task, names: Sequence[str], tell: Progress) -> tuple[ForceEvidence, Found]:
    """Search; search again about the effects on which the columns depend, until nothing changes.

    These are sensor errors, which are taken off the readings, dry friction, whose form near rest is uncertain, and
    force pulses, which are no noise.
    """
    applied: dict[Key, np.ndarray] = {}
    sensors: Sequence[tuple[ForceEffect, np.ndarray]] = ()
    pulses = np.zeros((0, 0))
    chain, joints, about = task.mechanism.setup.chain, task.mechanism.measured_joints, {}
    for turn in range(_MAX_ROUNDS):
        begin = 0.9 * turn / _MAX_ROUNDS
        tell(f"compute the regressors of all effects, round {turn + 1}", begin)
        columns = build_columns(task.fit, task.mechanism, task.band, sensor_errors(sensors, chain, joints), about)
        columns = undone(columns, {h.key: v for h, v in sensors}, {h.key: h.columns[0] for h, _ in sensors})
        effects = force_effects(chain, columns, task.nominal, applied)
        effects = [one for one in effects if not names or one.name in names]
        without = replace(columns, measured=columns.measured - pulses) if columns.gap.shape == pulses.shape else columns
        evidence = _evidence(task, columns, about, estimate_noise(without), not names or "force_pulse" in names)
        found = search_model(
            evidence, effects, lambda text, share, begin=begin: tell(text, begin + 0.9 * share / _MAX_ROUNDS)
        )
        sensors = [pair for pair in task.effects_of(found.guess) if sensor_errors([pair], chain, joints)]
        known = [*sensors, *(pair for pair in task.effects_of(found.guess) if pair[0].name in _CHANGING)]
        pulses = evidence.force_of(Guess(tuple(part for part in found.guess.parts if interval_of(part[0]))))
        value = evidence.changes(found.judged)
        about = {name: value[k] for k, name in enumerate(columns.names) if name in task.nominal}
        steps = [np.abs(v - applied.get(h.key, [p.nominal for p in h.parameters.values()]))
                 / [p.prior_std for p in h.parameters.values()] for h, v in known]  # fmt: skip
        if {h.key for h, _ in known} == set(applied) and all(np.all(step < _UNCHANGED) for step in steps):
            break
        applied = {h.key: v for h, v in known}
    return evidence, found


def _evidence(
    task: _Task, columns: Columns, about: Mapping[str, float], shape: NoiseShape, has_pulses: bool = False
) -> ForceEvidence:  # fmt: skip
    form, uncertain = uncertain_form(task.mechanism, columns, about), uncertain_parameters(task.mechanism, task.nominal)
    return ForceEvidence(columns, shape, _root(columns, form), _root(columns, uncertain), has_pulses=has_pulses)


def _root(columns: Columns, stds: Mapping[str, float]) -> np.ndarray:
    """(m, r) root of the covariance of independent coefficients of some columns, column -> standard deviation."""
    out = np.zeros((len(columns.names), len(stds)))
    for k, (name, std) in enumerate(stds.items()):
        out[columns.names.index(name), k] = std
    return out


def _given_model(task: _Task) -> tuple[ForceEvidence, Found]:
    """Evidence on the readings as they are, and a search that found nothing."""
    columns = build_columns(task.fit, task.mechanism, task.band)
    evidence = _evidence(task, columns, {}, estimate_noise(columns))
    judged = evidence.judge(Guess())
    return evidence, Found(judged, judged, None, (), (), (), ())


def interval_of(hypothesis: Hypothesis) -> tuple[float, float] | None:
    """Return start and duration [s] of an effect that acts in one run for a limited time, None for others."""
    return hypothesis.interval if isinstance(hypothesis, ForceEffect) else None


def _is_small(effect: ForceEffect, values: np.ndarray) -> bool:
    """Return whether an effect is smaller than its smallest relevant change in all parameters together."""
    facts = [p for p in effect.parameters.values() if p.min_relevant_change > 0.0]
    change = [(v - p.nominal) / p.min_relevant_change
              for v, p in zip(values, effect.parameters.values(), strict=True) if p in facts]  # fmt: skip
    return float(np.linalg.norm(change)) < 1.0


def _brief_pulses(evidence: ForceEvidence, guess: Guess) -> set[Key]:
    """Return pulses with a smaller RMS over all rows than a missing force must have."""
    rms = np.sqrt(np.mean(evidence.columns.measured**2, axis=0))
    found = set()
    for h, deviation in guess.parts:
        force = np.sqrt(np.mean(evidence.force_of(Guess(((h, deviation),))) ** 2, axis=0))
        if interval_of(h) and np.max(force / rms) < MIN_FORCE_SHARE:
            found.add(h.key)
    return found


def _numbers(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items())


def _remove_effects(evidence: ForceEvidence, judged: Judged, dropped: Collection[Key]) -> Judged:
    """Fit a model again without some effects."""
    if not dropped:
        return judged
    parts = tuple(part for part in judged.guess.parts if part[0].key not in dropped)
    rest = evidence.judge(Guess(parts))
    return evidence.settle(rest)[0] if parts else rest


def _varying(evidence: ForceEvidence, judged: Judged) -> dict[Key, str]:
    """Return effects with one parameter whose mean over the runs is not known, because they differ -> a sentence.

    They are rejected if the 95 % interval of the mean holds 0. Of a single run, its parts
    take the place of the runs.
    """
    told: dict[Key, str] = {}
    columns = evidence.columns
    runs = np.repeat(np.arange(len(columns.runs), dtype=float), np.diff(columns.starts))
    last = columns.time.max()
    for hypothesis, deviation in judged.guess.parts:
        if hypothesis.size > 1 or interval_of(hypothesis):
            continue
        force = evidence.force_of(Guess(((hypothesis, deviation),)))
        factors, values = evidence.compare_laws(judged, force, [(runs * last + columns.time,)])
        ratios = 1.0 + values[0]
        each = ratios
        if (count := len(columns.runs)) > 1:
            low, high = np.quantile(runs * last + columns.time, QUANTILES)
            of_run = (np.linspace(low, high, len(ratios)) // last).astype(int)
            each = np.array([ratios[of_run == run].mean() for run in range(count) if np.any(of_run == run)])
        if factors[0] > MIN_LOG_BAYES_FACTOR and _sign_doubt(each) > 0.025:
            told[hypothesis.key] = _DIFFERS.format(*hypothesis.key, ratios.min(), ratios.max(), factors[0])
    return told


def _sign_doubt(values: np.ndarray) -> float:
    """Return the probability that the mean (of which `values` (n,) are samples) has not the sign of their average.

    Normal samples; a flat prior of the mean, and of the standard deviation between 0 and the average: an effect that
    varies by more than its size has no constant parameter.
    """
    mean, count = abs(float(values.mean())), len(values)
    widths = mean * np.linspace(0.01, 1.0, 100)
    square = float(np.sum((values - values.mean()) ** 2))
    log = -(count - 1) * np.log(widths) - 0.5 * square / widths**2
    weights = np.exp(log - log.max())
    return float(weights @ norm.cdf(-mean * math.sqrt(count) / widths) / weights.sum())


def _evaluate(task: _Task, evidence: ForceEvidence, judged: Judged, then: Columns) -> _Result:
    """Patch the MJCF with a model and evaluate it on the held-out run."""
    mechanism, columns = task.mechanism, evidence.columns
    patched, now = task.given, then
    calibration = {}
    if evidence.calibration_gain(judged) > MIN_LOG_BAYES_FACTOR:
        numbers = dict(zip(columns.names, zip(*evidence.calibration(judged), strict=True), strict=True))
        calibration = {name: numbers[name] for name in uncertain_parameters(mechanism, task.nominal)}
    if judged.guess.parts or calibration:
        numbers = {name: change for name, (change, _) in calibration.items()}
        speeds = {joint: size[2] for joint, size in columns.sizes.items()}
        patch = patch_of(
            task.effects_of(judged.guess), mechanism.setup.chain, mechanism.measured_joints, numbers, task.nominal,
            speeds,
        )  # fmt: skip
        patched = replace(
            task.given, mjcf=patched_mjcf(task.mjcf, patch), mapping=patched_mapping(mechanism.mapping, patch)
        )
        with tempfile.TemporaryDirectory() as folder:
            write_mechanism(Path(folder), patched.mjcf, patched.mapping)
            better = load_mechanism(Path(folder, MJCF_FILE), Path(folder, COLUMNS_FILE))
        now = build_columns([task.heldout], better, task.band, patch.errors)
    form = _root(now, uncertain_form(mechanism, now, dict(zip(columns.names, evidence.changes(judged), strict=True))))
    known = dict(zip(evidence.columns.names, evidence.uncertainty(judged), strict=True))
    nothing = np.zeros_like(next(iter(known.values())))
    spread = np.array([known.get(name, nothing) for name in now.names])
    heldout = ForceEvidence(now, evidence.shape, form, spread, (1.0,))
    sizes = [_missing_forces(one, own) for one, own in ((evidence, judged), (heldout, heldout.judge(Guess())))]
    return _Result(judged, calibration, patched, then, now, np.array(sizes), heldout)


def _compare_heldout(result: _Result, chain: Chain, nominal: Mapping[str, float]) -> _Result:
    """Find what the held-out run alone has, if forces are missing there only; the rest is missing in the model."""
    of_fit, of_heldout = result.is_lacking
    if not np.any(of_heldout & ~of_fit):
        return result
    evidence, run = result.heldout, result.now.runs[0]
    found = search_model(evidence, force_effects(chain, result.now, nominal, {}))
    spread, first, told = np.sqrt(np.diag(evidence.covariance(found.judged))), 0, []
    for h, deviation in found.guess.parts:
        for (name, p), value, s in zip(
            h.parameters.items(), h.values(deviation).values(), spread[first:], strict=False
        ):
            place = h.location.removesuffix(f".{run}")
            more = "start {:.4g} s, duration {:.4g} s".format(*interval) if (interval := interval_of(h)) else ""
            sizes = {run: (value - p.nominal, float(s * p.prior_std))}
            told.append(RunDifference(f"{h.name}.{place}.{name}", p.unit, math.nan, sizes, details=more))
        first += h.size
    return replace(
        result, sizes=np.array([result.sizes[0], _missing_forces(evidence, found.judged)]), differences=tuple(told)
    )


def _missing_forces(evidence: ForceEvidence, judged: Judged) -> np.ndarray:
    """RMS (k,) of the forces that are missing in a model [N] or [N m], 0 where they bring no evidence.

    Errors that the readings do not allow as noise are a missing force that varies quickly.
    """
    largest = evidence.columns.max_noise / evidence.shape.std
    noise = judged.tracks[0].levels.noise
    found = evidence.shape.missing_forces(
        evidence.remaining_force(judged), evidence.columns.doubt, np.minimum(noise, largest)
    )
    is_there = (evidence.residual_gain(judged) > MIN_LOG_BAYES_FACTOR) | (noise > largest)
    return np.where(is_there, found, 0.0)


def _error_ratio(task: _Task, evidence: ForceEvidence, result: _Result) -> float:
    """RMS error of the patched model on the held-out run over that of the given one."""
    squares = [
        np.mean((evidence.shape.weights(one.doubt) * one.gap / evidence.shape.std) ** 2)
        for one in (result.then, result.now)
    ]
    return float(np.sqrt(squares[1] / squares[0]))


def _probabilities(evidence: ForceEvidence, found: Found) -> dict[Key, tuple[float, tuple[Alternative, ...]]]:
    """Effect -> its probability, and those of its alternatives.

    If a force is still missing on the drive that the effect moves most, the probability against rivals and none is
    multiplied with the fraction of the variance of the missing force that the effect explains there.
    """
    out = {}
    for index, (hypothesis, deviation) in enumerate(found.guess.parts):
        rest = found.without[index]
        if rest is None:
            continue
        rivals = [
            replace(r, occam_penalty=r.occam_penalty + _penalty(r.judged) - _penalty(rest))
            for r in found.rivals[index] if np.isfinite(r.judged.loss)
        ]  # fmt: skip
        charge = found.charges[index] + _penalty(found.judged) - _penalty(rest)
        table = effect_probabilities(found.judged, charge, rest, rivals)
        force = evidence.force_of(Guess(((hypothesis, deviation),)))
        own = int(np.argmax(np.sqrt(np.mean(force**2, axis=0)) / evidence.shape.std))
        alike = evidence.judge_alike(rest.guess, found.judged)  # its uncertain parameters must not take the place
        now, without = (_missing_forces(evidence, one)[own] ** 2 for one in (found.judged, alike))
        trust = 1.0 - now / max(now, without) if now > 0.0 else 1.0
        others = tuple(
            Alternative(*r.hypothesis.key, trust * float(chance))
            for r, chance in zip(rivals, table[2:], strict=True) if chance >= _MIN_PROBABILITY
        )  # fmt: skip
        out[hypothesis.key] = trust * float(table[0]), others
    return out


def _penalty(judged: Judged) -> float:
    """Cost of the noise levels and of the marginalised parameters, which the blocks of the runs do not hold."""
    return judged.tracks[0].levels.penalty


def _describe_effects(
    task: _Task, evidence: ForceEvidence, result: _Result, chances: Mapping[Key, tuple[float, tuple[Alternative, ...]]]
) -> tuple[NamedEffect, ...]:  # fmt: skip
    """Effects of a model with probabilities, intervals, and the fraction of the gap that each closes.

    The gap is that of the held-out run, and of the drive that the effect moves most.
    """
    guess, then, now = result.judged.guess, result.then, result.now
    if not guess.parts:
        return ()
    spread = np.sqrt(np.diag(evidence.covariance(result.judged)))
    rows, shape, fit = min(len(then.time), len(now.time)), evidence.shape, evidence.columns
    errors = [shape.weights(c.doubt)[:rows] * c.gap[:rows] / shape.std for c in (then, now)]
    weight, rest = shape.weights(fit.doubt) / shape.std, evidence.remaining_force(result.judged)
    first, named = 0, []
    for hypothesis, deviation in guess.parts:
        std = spread[first : first + hypothesis.size]
        first += hypothesis.size
        change = evidence.coefficients(Guess(((hypothesis, deviation),)))
        if interval_of(hypothesis):  # it acts in a fitted run
            before, after, added = weight * fit.gap, weight * rest, weight * (fit.matrix @ change)
        else:
            force = then.matrix[:rows] @ change[: len(then.names)]
            before, after = errors
            added = shape.weights(then.doubt)[:rows] * force / shape.std
        own = int(np.argmax(np.mean(added**2, axis=0)))  # the drive that it moves most
        whole = float(np.mean(before[:, own] ** 2)) - 1.0
        back = float(np.mean((after + added)[:, own] ** 2) - np.mean(after[:, own] ** 2))
        share = float(np.clip(back / whole, 0.0, 1.0)) if whole > 0.0 else 0.0
        values, numbers = hypothesis.values(deviation), {}
        for (name, p), s in zip(hypothesis.parameters.items(), std, strict=True):
            reach = NORMAL95 * s * p.prior_std
            low, high = max(p.lower_bound, values[name] - reach), min(p.upper_bound, values[name] + reach)
            numbers[name] = Estimate(values[name], p.unit, low, high, p.nominal)
        if interval := interval_of(hypothesis):
            for name, value in zip(("start", "duration"), interval, strict=True):
                numbers[name] = Estimate(value, "s", value - fit.spacing, value + fit.spacing, 0.0)
        chance, others = chances[hypothesis.key]
        named.append(NamedEffect(*hypothesis.key, chance, numbers, others, share))
    return tuple(sorted(named, key=lambda e: (-round(e.probability, 3), -e.share)))


def _calibration(task: _Task, result: _Result) -> dict[str, Estimate]:
    """Calibrated parameters that differ from the MJCF."""
    told = {}
    for name, (change, s) in result.calibration.items():
        value, reach = task.nominal[name] + change, NORMAL95 * s
        if abs(change) > _DISTINCT * s:
            unit = parameter_unit(task.mechanism, name)
            told[name] = Estimate(value, unit, value - reach, value + reach, task.nominal[name])
    return told


def parameter_unit(mechanism: Mechanism, name: str) -> str:
    """SI unit of a regressor's parameter, such as `mass.link` or `viscous.joint`."""
    kind, _, place = name.partition(".")
    if kind in BODY_PARAMETERS:
        return BODY_PARAMETERS[kind]
    force = force_unit(mechanism.setup.chain, place)
    length = "m" if force == "N" else "rad"
    return {
        "viscous": f"{force} s/{length}", "viscous_asymmetry": f"{force} s/{length}",
        "quadratic": f"{force} s^2/{length}^2",
        "drive_inertia": "kg" if force == "N" else "kg m^2",
    }.get(kind, force)  # fmt: skip


def _channels(task: _Task) -> tuple[str, ...]:
    return tuple(f"{'force' if task.unit(d) == 'N' else 'torque'}.{d}" for d in task.drives)


def _predictions(
    task: _Task, evidence: ForceEvidence, shape: NoiseShape, result: _Result, rows: slice, patched: bool
) -> tuple[Prediction, ...]:
    """Predictions of the given or the patched model, the held-out run first."""
    channels, then, fit = _channels(task), result.then, evidence.columns
    error, doubt = (result.now.gap, result.now.doubt) if patched else (then.gap, then.doubt)
    rest = evidence.remaining_force(result.judged) if patched else fit.gap

    def prediction(run: str, time: np.ndarray, measured, error, doubt) -> Prediction:
        return Prediction(run, time, channels, measured - error, measured, shape.weights(doubt) * error / shape.std)

    out = [prediction(then.runs[0], then.time[rows], then.measured[rows], error[rows], doubt[rows])]
    for run, a, b in zip(fit.runs, fit.starts[:-1], fit.starts[1:], strict=True):
        out.append(prediction(run, fit.time[a:b], fit.measured[a:b], rest[a:b], fit.doubt[a:b]))
    return tuple(out)


def _lacks(task: _Task, result: _Result) -> tuple[Lack, ...]:
    """Residual forces that remain, the largest first."""
    share, sizes = result.share().max(axis=0), result.sizes.max(axis=0)
    found = [
        Lack("force", drive, float(sizes[k]), task.unit(drive), float(share[k]))
        for k, drive in enumerate(task.drives) if share[k] > MIN_FORCE_SHARE
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda lack: -lack.part))


def _tests(result: _Result) -> dict[str, dict]:
    """Tests of the residual forces, in fractions of the drives' forces."""
    share = result.share().max(axis=1)
    return {
        name: {"value": float(value), "limit": MIN_FORCE_SHARE, "passed": bool(value <= MIN_FORCE_SHARE)}
        for name, value in zip(("residual_force", "heldout_residual_force"), share, strict=True)
    }


def _dependence(evidence: ForceEvidence, result: _Result) -> tuple[str, ...]:
    """Variables of a function that explains the largest residual force of the fitted runs best; none if none does."""
    columns = evidence.columns
    worst = int(np.argmax(result.share().max(axis=0)))
    force = np.zeros(columns.gap.shape)
    force[:, worst] = TYPICAL * np.sqrt(np.mean(columns.measured[:, worst] ** 2))
    names = list(columns.states)
    for many in (1, 2):
        chosen = list(combinations(names, many))
        series = [[columns.states[name] for name in some] for some in chosen]
        factors, _ = evidence.compare_laws(result.judged, force, series)
        if factors.max() > MIN_LOG_BAYES_FACTOR:
            return chosen[int(np.argmax(factors))]
    return ()


def _ranking(found: Found) -> tuple[Candidate, ...]:
    return tuple(
        Candidate(
            *s.hypothesis.key, s.factor, s.hypothesis.values(s.deviation),
            {name: p.unit for name, p in s.hypothesis.parameters.items()},
        )
        for s in found.ranking[:15]
    )  # fmt: skip


def _rejections(
    found: Found, named: Sequence[NamedEffect], minor: Sequence[NamedEffect], untrue: Sequence[str]
) -> tuple[Rejection, ...]:
    """What was tried and not named, with the test that it failed."""
    out = [Rejection(e.name, e.location, "probability", e.mechanism_probability, LIKELY) for e in minor]
    if not found.guess.parts:
        out += [
            Rejection(*s.hypothesis.key, "twice the log Bayes factor", s.factor, MIN_LOG_BAYES_FACTOR)
            for s in found.ranking[:3] if s.factor < MIN_LOG_BAYES_FACTOR
        ]  # fmt: skip
    return (*out, *(Rejection("", "", sentence, np.nan, np.nan) for sentence in untrue))


def _traces(task: _Task, evidence: ForceEvidence, result: _Result) -> tuple[InputTrace, ...]:
    """Force errors of the drive whose error is largest, over the first fitted run, with what the model adds."""
    columns = evidence.columns
    rows = slice(columns.starts[0], columns.starts[1])
    added = columns.gap[rows] - evidence.remaining_force(result.judged)[rows]
    order = np.argsort(-np.sqrt(np.mean(columns.gap**2, axis=0)) / evidence.shape.std)
    return tuple(
        InputTrace(
            columns.runs[0], "force", task.drives[k], task.unit(task.drives[k]), columns.time[rows],
            columns.gap[rows, k], columns.gap[rows, k] - added[:, k], added[:, k],
        )
        for k in order[:4]
    )  # fmt: skip
