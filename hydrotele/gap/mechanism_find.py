"""The gap of a mechanism without hydraulics: from measured motion and forces to a Gap.

Calibrate what may be off, name what differs, patch the MJCF, judge the patched model on a run that
was not fitted, and say what is left.
"""

import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.core.mjcf import read_mjcf
from hydrotele.gap.description import channel_words, lack_words
from hydrotele.gap.find import Progress, detail_words, verdict_of, without_details
from hydrotele.gap.mechanism_columns import (
    SENTENCES,
    Columns,
    Key,
    MechanismEffect,
    build_columns,
    common_band,
    mechanism_effects,
    separate_setup,
    undone,
)
from hydrotele.gap.mechanism_evidence import (
    Evidence,
    Fitted,
    Left,
    Noise,
    effects_by_part,
    find_left,
    find_noise,
    gather_evidence,
    loud_windows,
    noise_of,
    possible_errors,
    row_weights,
    whitened,
    with_variation,
)
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
    Alternative,
    Candidate,
    Estimate,
    Gap,
    GapSize,
    Lack,
    NamedEffect,
    Prediction,
    Unknown,
)
from hydrotele.identify.mechanism import ColumnMapping, Mechanism, load_mechanism
from hydrotele.identify.record import IdentificationRecord
from hydrotele.multibody.regressor import BODY_PARAMETERS

_ODDS = 6.0  # twice the log odds by which naming an effect must beat not naming it, beside the
# number of effects that are tried
_MOST = 20  # effects
_SCARCE = 5.0  # equations per column, below which all columns together tell noise too small
_FEW = 3  # effects up to which exchanges are tried after every new one
_ROUNDS = 4  # of taking sensors' defects off the readings
_SAME = 0.01  # of a prior's width, within which a round has changed nothing
_BETTER = 1e-3  # by which an exchange must be better
_WORTH_TELLING = 0.005
_SHARES = (1.0, 0.5, 0.25, 0.1)  # of the stated uncertainty that are tried: how far the numbers
# are off is found, too
_CALIBRATED = 10.0  # twice the log odds from which numbers of the model count as off
_TOLD = 3.0  # standard deviations from which a calibrated number is told
_NORMAL95 = 1.96
_SPOILT = -4.0  # standard deviations by which an effect may better the held-out run too little
_WORSE = 1.02  # times the given model's errors on the held-out run: no patch may do more
_REJECTED = (
    "The changes found on the fitted runs increase the errors on the held-out run; they were"
    " rejected, and no effect is named."
)
_SPOILS = "{} at {}, found on the fitted runs, increases the errors on the held-out run; it was rejected."
_DIFFERS = "{} at {}, found on the fitted runs, differs between parts of these runs ({} {} {}); it was rejected."
_TURNS = 0.05  # doubt of a sign from which what is left may be the form of dry friction near rest
_LISTED = 3  # notes of that kind
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


@dataclass(frozen=True)
class _Found:
    """Result of a search: evidence, all candidates, and the chosen ones fitted together.

    `off` are the standard deviations of the numbers that `evidence` integrates out. `weak` would be
    chosen but for their size, and are `refused` with others that are not needed.
    """

    columns: Columns
    noise: Noise
    evidence: Evidence
    effects: list[MechanismEffect]
    fitted: Fitted
    weak: tuple[Fitted, ...]
    singles: list[Fitted]
    refused: frozenset[Key]
    off: dict[str, float]

    @property
    def total(self) -> float:
        """Twice the log evidence of the numbers' errors and the effects together."""
        return self.evidence.evidence + self.fitted.score

    def coefficients(self) -> np.ndarray:
        """(m,) what effects and calibrated numbers add along all columns."""
        evidence = self.evidence
        value = evidence.coefficients(self.fitted)
        deviation, _ = evidence.calibrated(self.fitted)
        value[[evidence.places[name] for name in evidence.calibrate]] += deviation
        return value


class _Patching(NamedTuple):
    """What it takes to patch the model and to judge it on the held-out run."""

    mjcf: str | Path
    mechanism: Mechanism
    given: MechanismModel
    nominal: Mapping[str, float]
    heldout: IdentificationRecord
    band: float
    then: Columns

    def of(self, found: _Found) -> tuple[MechanismModel, dict[str, Estimate], "_Judged"]:
        """The patched model, the calibrated numbers, and what the held-out run says of both."""
        mechanism = self.mechanism
        chosen = list(zip(found.fitted.effects, found.fitted.values, strict=True))
        calibration, numbers = _calibration(mechanism, found, self.nominal)
        patched, now = self.given, self.then
        if chosen or numbers:
            speeds = {joint: size[2] for joint, size in found.columns.sizes.items()}
            patch = patch_of(
                chosen, mechanism.setup.chain, mechanism.measured_joints, numbers, self.nominal, speeds
            )  # fmt: skip
            patched = replace(
                self.given, mjcf=patched_mjcf(self.mjcf, patch),
                mapping=patched_mapping(mechanism.mapping, patch),
            )  # fmt: skip
            with tempfile.TemporaryDirectory() as folder:
                write_mechanism(Path(folder), patched.mjcf, patched.mapping)
                better = load_mechanism(Path(folder, MJCF_FILE), Path(folder, COLUMNS_FILE))
            now = build_columns([self.heldout], better, self.band, patch.errors)
        return patched, calibration, _judged(mechanism, found, self.nominal, self.then, now)


def _emptied(fit, mechanism: Mechanism, band: float, found: _Found) -> _Found:
    """A search's result without what was chosen: readings and model as they are given."""
    columns = build_columns(fit, mechanism, band)
    noise = find_noise(columns)
    evidence = gather_evidence(columns, noise, {})
    return replace(
        found, columns=columns, noise=noise, evidence=evidence, fitted=evidence.fit([]), weak=(),
        off={},
    )  # fmt: skip


def find_mechanism_gap(
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
    band = common_band(fit, mechanism)
    nominal = nominal_parameters(mechanism)
    found = _searched(fit, mechanism, band, nominal, effects, tell)
    tell("patch the model and evaluate it on the held-out run", 0.8)
    given = MechanismModel(mechanism.setup.chain.name, read_mjcf(mjcf).flatten(), mechanism.mapping)
    then = build_columns([heldout], mechanism, band)
    patching = _Patching(mjcf, mechanism, given, nominal, heldout, band, then)
    found, untrue, varies = _constant(found)
    notes = (*notes, *untrue)
    patched, calibration, judged = patching.of(found)
    while judged.spoiling:
        worst = min(judged.spoiling, key=judged.spoiling.__getitem__)
        notes = (*notes, _SPOILS.format(*worst))
        found = _without(found, [worst])
        patched, calibration, judged = patching.of(found)
    if not _rms(judged.after[0]) <= _WORSE * _rms(judged.before[0]):
        notes = (*notes, _REJECTED)
        found, patched, calibration = _emptied(fit, mechanism, band, found), given, {}
        judged = _judged(mechanism, found, nominal, then, then)
    judged = judged._replace(left=with_variation(judged.left, varies, judged.std))
    named = _named(found, judged.shares)
    named, details = _believable(named, judged)
    left = judged.left
    verdict = verdict_of(named, bool(left.lacking.any()), 1.0)
    lacks = _lacks(mechanism, left, then)
    unknown = None
    if left.lacking.any():
        unknown = _unknown(left, lacks, judged.after[0])
    channels = judged.before[0].channels
    tell("done", 1.0)
    return Gap(
        machine=given, patched=patched, verdict=verdict, effects=named, unknown=unknown,
        size=GapSize(_rms(judged.before[0]), _rms(judged.after[0]), 1.0, METRIC),
        ranking=_ranking(found), before=judged.before, after=judged.after,
        laws={"force": {
            drive: {
                "before": float(one * std), "after": float(other * std), "noise": float(std),
            } for drive, one, other, std in zip(
                mechanism.setup.chain.drives, _channel_rms(judged.before[0]),
                _channel_rms(judged.after[0]), judged.std, strict=True)
        }},
        law_units={"force": _unit(mechanism, mechanism.setup.chain.drives[0])},
        tests=left.tests, calibration=calibration, lacks=lacks,
        noise={channel: (float(std), float("nan"))
               for channel, std in zip(channels, judged.std, strict=True)},
        notes=(*notes, *map(detail_words, details), *_notes(found, band)),
        seconds=time.perf_counter() - begin,
    )  # fmt: skip


def _without(found: _Found, dropped: Iterable[Key]) -> _Found:
    """A search's result without some effects, the others fitted again."""
    dropped, fitted = frozenset(dropped), found.fitted
    kept = [(e, v) for e, v in zip(fitted.effects, fitted.values, strict=True)
            if e.key not in dropped]  # fmt: skip
    fitted = found.evidence.fit([e for e, _ in kept], [v for _, v in kept] or None)
    return replace(found, fitted=fitted, refused=found.refused | dropped)


def _constant(found: _Found) -> tuple[_Found, list[str], np.ndarray]:
    """A search's result without effects that differ from run to run.

    Returns:
        The result, what is said of the effects, and (k,) RMS of the drives' forces that these made.
    """
    told: list[str] = []
    moved = np.zeros(found.columns.measured.shape[1])
    while found.fitted.effects:
        parts = effects_by_part(found.columns, found.noise, found.off, found.fitted)
        differ = [k for k, many in enumerate(parts) if many]
        if not differ:
            break
        for k in differ:
            effect, value = found.fitted.effects[k], found.fitted.values[k]
            name, facts = next(iter(effect.parameters.items()))
            own = [float(part[0]) for part in parts[k]]
            values = f"{min(own):.3g} to {max(own):.3g}"
            told.append(_DIFFERS.format(*effect.key, name, values, facts.unit))
            at = [found.evidence.places[column] for column in effect.columns]
            force = found.columns.matrix[:, :, at] @ effect.coefficients(value)
            moved = np.hypot(moved, np.sqrt(np.mean(force**2, axis=0)))
        found = _without(found, [found.fitted.effects[k].key for k in differ])
    if len(told) > _LISTED:
        told = [
            *told[:_LISTED], f"{len(told) - _LISTED} more were rejected for the same reason."
        ]  # fmt: skip
    return found, told, moved


def nominal_parameters(mechanism: Mechanism) -> dict[str, float]:
    """Regressor's parameter -> its given value, of the setup with a column for everything.

    Args:
        mechanism: the model.

    Returns:
        The values; bodies' ten parameters are about their frames' origins.
    """
    setup = separate_setup(mechanism.setup)
    chain = setup.chain
    out = {
        f"{kind}.{body}": float(value)
        for body, row in zip(chain.bodies, chain.inertia, strict=True)
        for kind, value in zip(BODY_PARAMETERS, row, strict=True)
    }
    for one in setup.friction_terms:
        out |= {f"{kind}.{one.location}": float(value) for kind, value in one.nominal.items()}
    for joint in setup.drive_inertia:
        out[f"drive_inertia.{joint}"] = float(chain.armature[chain.index(joint)])
    return out


def _searched(fit, mechanism, band, nominal, names, tell) -> _Found:
    """Search; take sensors' defects off the readings and search again until nothing changes."""
    applied: dict[Key, np.ndarray] = {}
    known: Sequence[tuple[MechanismEffect, np.ndarray]] = ()
    found, about, shares = None, {}, _SHARES
    for turn in range(_ROUNDS):
        tell(f"compute the regressors of all effects, round {turn + 1}", 0.2 * turn)
        errors = sensor_errors(known, mechanism.setup.chain, mechanism.measured_joints)
        columns = build_columns(fit, mechanism, band, errors, about)
        columns = undone(columns, applied, {one.key: one.columns[0] for one, _ in known})
        effects = mechanism_effects(mechanism.setup.chain, columns, nominal, applied)
        if names:
            effects = [one for one in effects if one.name in names]
        tell(f"evaluate {len(effects)} effects, round {turn + 1}", 0.2 * turn + 0.15)
        noise = find_noise(columns)
        tried = [_search(columns, noise, mechanism, one, effects, found) for one in shares]
        choice = 2.0 * np.log(max(len(effects), 1))  # of one effect among all
        best = int(np.argmax([one.total - choice * len(one.fitted.effects) for one in tried]))
        found, shares = tried[best], shares[best : best + 1]
        if columns.gap.size < _SCARCE * len(columns.names):
            noise = noise_of(_unexplained(found), columns)
            found = _search(columns, noise, mechanism, shares[0], effects, found)
        known = [
            (one, value)
            for one, value in zip(found.fitted.effects, found.fitted.values, strict=True)
            if sensor_errors([(one, value)], mechanism.setup.chain, mechanism.measured_joints)
        ]
        value = found.evidence.coefficients(found.fitted)
        about = {name: value[k] for k, name in enumerate(columns.names) if name in nominal}
        steps = [np.abs(value - applied.get(one.key, one.start)) / one.scale for one, value in known]
        same = {one.key for one, _ in known} == set(applied)
        if same and max((float(s.max()) for s in steps), default=0.0) < _SAME:
            break
        applied = {one.key: value for one, value in known}
    assert found is not None
    return found


def _search(
    columns: Columns, noise: Noise, mechanism: Mechanism, share: float,
    effects: list[MechanismEffect], before: _Found | None,
) -> _Found:  # fmt: skip
    """Add what is most worth adding, drop what is not worth having, exchange what is better."""
    off = possible_errors(mechanism, columns, share)
    evidence = gather_evidence(columns, noise, off)
    need = _need(effects)
    singles = [evidence.fit([one]) for one in effects]
    first = [e.key for e in before.fitted.effects] if before else []
    chosen: list[MechanismEffect] = []
    for key in first:
        same = [(f.score, e) for e, f in zip(effects, singles, strict=True) if e.key == key]
        if same:
            chosen.append(max(same, key=lambda pair: pair[0])[1])
    now, weak, refused = evidence.fit(chosen), [], set()
    while len(chosen) < _MOST:
        left, taken = evidence.beside(now), {one.key for one in chosen} | refused
        options = [(left.fit([one]).score, k) for k, one in enumerate(effects)
                   if one.key not in taken]  # fmt: skip
        if not options or max(options)[0] < need:
            break
        one = effects[max(options)[1]]
        better = evidence.fit([*chosen, one], [*now.values, one.start])
        if better.score - now.score < need or _slight(one, better.values[-1]):
            refused.add(one.key)
            if better.score - now.score >= need:
                weak.append(better)
            continue
        chosen, now = [*chosen, one], better
        if len(chosen) <= _FEW:
            chosen, now = _improved(evidence, effects, chosen, now, need, refused)
    chosen, now = _improved(evidence, effects, chosen, now, need, refused)
    return _Found(columns, noise, evidence, effects, now, tuple(weak), singles, frozenset(refused), off)


def _need(effects: Sequence[MechanismEffect]) -> float:
    """Twice the log odds that speak against any one of so many effects before data do."""
    return 2.0 * np.log(max(len(effects), 1)) + _ODDS


def _slight(effect: MechanismEffect, value: np.ndarray) -> bool:
    """Whether an effect is smaller than worth naming."""
    least = np.array([one.min_relevant_change for one in effect.parameters.values()])
    nominal = np.array([one.nominal for one in effect.parameters.values()])
    counted = least > 0.0
    return float(np.linalg.norm((value - nominal)[counted] / least[counted])) < 1.0


def _improved(evidence, effects, chosen, now: Fitted, need: float, refused):
    """Without what is not needed, and with what explains the same better."""
    for _ in range(_FEW + len(chosen)):
        for k in range(len(chosen)):
            rest = [*chosen[:k], *chosen[k + 1 :]]
            without = evidence.fit(rest, [*now.values[:k], *now.values[k + 1 :]] if rest else None)
            if now.score - without.score < need or _slight(chosen[k], now.values[k]):
                chosen, now = rest, without
                break
            keys, left = {one.key for one in rest} | refused, evidence.beside(without)
            score, place = max((left.fit([one]).score, n) for n, one in enumerate(effects) if one.key not in keys)
            one = effects[place]
            if one is chosen[k] or without.score + score < now.score + _BETTER:
                continue
            other = evidence.fit([*rest, one], [*without.values, one.start])
            if other.score > now.score + _BETTER and not _slight(one, other.values[-1]):
                chosen, now = [*rest, one], other
                break
        else:
            break
    return chosen, now


def _named(found: _Found, shares: Mapping[Key, float]) -> list[NamedEffect]:
    """Effects with their probabilities against rivals and against none."""
    out, first = [], 0
    evidence, now = found.evidence, found.fitted
    many = np.log(max(len(found.effects), 1))
    spread = np.sqrt(np.maximum(np.diag(now.covariance), 0.0)) if now.effects else np.zeros(0)
    for k, effect in enumerate(now.effects):
        value = now.values[k]
        own = spread[first : first + len(value)]
        first += len(value)
        rest = [*now.effects[:k], *now.effects[k + 1 :]]
        values = [*now.values[:k], *now.values[k + 1 :]]
        without = evidence.fit(rest, values if rest else None)
        left, others = evidence.beside(without), {e.key for e in rest}
        scores: dict[Key, float] = {}
        for one in found.effects:
            if one.key in others or (one is not effect and one.key in found.refused):
                continue
            score = now.score if one is effect else without.score + left.fit([one]).score
            scores[one.key] = float(np.logaddexp(scores.get(one.key, -np.inf), 0.5 * score))
        none = 0.5 * without.score + many
        top = max(*scores.values(), none)
        weights = {key: float(np.exp(s - top)) for key, s in scores.items()}
        total = sum(weights.values()) + float(np.exp(none - top))
        rivals = sorted(
            (Alternative(*key, w / total) for key, w in weights.items()
             if key != effect.key and w / total >= _WORTH_TELLING),
            key=lambda a: -a.probability,
        )  # fmt: skip
        numbers = {
            name: Estimate(
                float(v), p.unit, float(max(v - _NORMAL95 * s, p.lower_bound)),
                float(min(v + _NORMAL95 * s, p.upper_bound)), p.nominal,
            )
            for (name, p), v, s in zip(effect.parameters.items(), value, own, strict=True)
        }  # fmt: skip
        out.append(NamedEffect(
            effect.name, effect.location, weights[effect.key] / total, numbers, tuple(rivals),
            shares[effect.key],
        ))  # fmt: skip
    return sorted(out, key=lambda e: (-round(e.probability, 3), -e.share))


def _calibration(mechanism: Mechanism, found: _Found, nominal: Mapping[str, float]):
    """Calibrated numbers of the model that are told, and the deviations of all; none where it fits.

    Numbers count as off where the data say so with the effects in the model.
    """
    nuisance = {name: std for name, std in found.off.items() if name not in nominal}
    sharp = gather_evidence(found.columns, found.noise, nuisance)
    values = list(found.fitted.values) or None
    as_given = sharp.fit(found.fitted.effects, values)
    gained = found.evidence.evidence + found.fitted.score - sharp.evidence - as_given.score
    if gained < _CALIBRATED:
        return {}, {}
    deviation, known = found.evidence.calibrated(found.fitted)
    spread = np.sqrt(np.maximum(np.diag(known), 0.0))
    numbers = {
        name: float(d) for name, d in zip(found.evidence.calibrate, deviation, strict=True)
        if name in nominal
    }  # fmt: skip
    told = {}
    for name, s in zip(found.evidence.calibrate, spread, strict=True):
        if name in numbers and abs(numbers[name]) > _TOLD * s:
            value = nominal[name] + numbers[name]
            told[name] = Estimate(
                value, parameter_unit(mechanism, name), value - _NORMAL95 * float(s),
                value + _NORMAL95 * float(s), nominal[name],
            )  # fmt: skip
    return told, numbers


def parameter_unit(mechanism: Mechanism, name: str) -> str:
    """SI unit of a regressor's parameter, such as `mass.link` or `viscous.joint`."""
    kind, _, place = name.partition(".")
    if kind in BODY_PARAMETERS:
        return BODY_PARAMETERS[kind]
    force = _unit(mechanism, place)
    length = "m" if force == "N" else "rad"
    return {
        "viscous": f"{force} s/{length}", "viscous_asymmetry": f"{force} s/{length}",
        "quadratic": f"{force} s^2/{length}^2",
        "drive_inertia": "kg" if force == "N" else "kg m^2",
    }.get(kind, force)  # fmt: skip


def _unit(mechanism: Mechanism, joint: str) -> str:
    chain = mechanism.setup.chain
    straight = joint in chain.joints and chain.tree.is_slide[chain.index(joint)]
    return "N" if straight else "N m"


class _Judged(NamedTuple):
    """What the held-out run says.

    Attributes:
        std: (k,) noise of the drives' forces, without what is lacking [N] or [N m].
        left: what the patched model lacks.
        shares: effect -> share of the gap that comes back without it.
        spoiling: effects without which, all else fitted again, the held-out run's squared errors,
            whitened by the noise, are smaller, and by more than noise explains if these effects are
            there -> by how much the errors grow without them.
        moved: effect -> (k,) RMS of what it does to every drive's force [N] or [N m].
        before: predictions of the given model, the held-out run first.
        after: of the patched one.
    """

    std: np.ndarray
    left: Left
    shares: Mapping[Key, float]
    spoiling: Mapping[Key, float]
    moved: Mapping[Key, np.ndarray]
    before: tuple[Prediction, ...]
    after: tuple[Prediction, ...]


def _judged(
    mechanism: Mechanism, found: _Found, nominal: Mapping[str, float], then: Columns, now: Columns
) -> _Judged:  # fmt: skip
    fit, noise = found.columns, found.noise
    rest = _unexplained(found)
    weight = row_weights(noise.doubtful, then.doubt)
    rows = min(len(then.time), len(now.time))  # a late sensor tells nothing of the last ones
    later = row_weights(noise.doubtful, now.doubt)
    spread = np.sqrt(found.evidence.predicted_variance(found.fitted, then.matrix).mean(axis=0))
    left = find_left(
        fit, now, rest, now.gap, noise.std, noise.weight * (fit.doubt < _TURNS),
        later * (now.doubt < _TURNS), spread,
    )  # fmt: skip
    std = noise.std * np.sqrt(np.where(left.lacking, np.clip(1.0 - left.share, 0.05, 1.0), 1.0))
    plain = {(e.key, e.variant): e for e in
             mechanism_effects(mechanism.setup.chain, then, nominal, {})}  # fmt: skip
    places = {name: k for k, name in enumerate(then.names)}
    before = (weight * then.gap / std)[:rows]
    after = (later * now.gap / std)[:rows]
    whole = float(np.mean(before**2)) - 1.0

    def squares(error: np.ndarray) -> float:
        return float(np.sum(whitened(error, replace(noise, weight=later[:rows]), (0, rows)) ** 2))

    shares, moved, spoiling, value_of_all = {}, {}, {}, found.coefficients()
    for effect, value in zip(found.fitted.effects, found.fitted.values, strict=True):
        own = plain.get((effect.key, effect.variant))
        if own is None:
            shares[effect.key], moved[effect.key] = 0.0, np.zeros(len(std))
            continue
        at = [places[name] for name in own.columns]
        added = then.matrix[:rows, :, at] @ own.coefficients(value)
        back = float(np.mean((after + weight[:rows] * added / std) ** 2) - np.mean(after**2))
        shares[effect.key] = float(np.clip(back / whole, 0.0, 1.0)) if whole > 0.0 else 0.0
        moved[effect.key] = np.sqrt(np.mean(added**2, axis=0))
        change = value_of_all - _without(found, [effect.key]).coefficients()
        error, change = now.gap[:rows], then.matrix[:rows] @ change
        expected = squares(change)
        gain = squares(error + change) - squares(error)
        if gain < min(0.0, expected + 2.0 * _SPOILT * np.sqrt(expected)):
            spoiling[effect.key] = gain
    channels = tuple(f"{'force' if _unit(mechanism, d) == 'N' else 'torque'}.{d}" for d in mechanism.setup.chain.drives)

    def prediction(run: str, time: np.ndarray, measured, error, whitened) -> Prediction:
        return Prediction(run, time, channels, measured - error, measured, whitened)

    logged = then.measured[:rows]
    predictions = [
        [prediction(then.runs[0], then.time[:rows], logged, then.gap[:rows], before)],
        [prediction(then.runs[0], then.time[:rows], logged, now.gap[:rows], after)],
    ]
    for run, first, last in zip(fit.runs, fit.starts[:-1], fit.starts[1:], strict=True):
        some = slice(first, last)
        for which, error in zip(predictions, (fit.gap, rest), strict=True):
            which.append(prediction(
                run, fit.time[some], fit.measured[some], error[some],
                (noise.weight * error / std)[some],
            ))  # fmt: skip
    return _Judged(std, left, shares, spoiling, moved, tuple(predictions[0]), tuple(predictions[1]))


def _unexplained(found: _Found) -> np.ndarray:
    """(n, k) of the fitted runs, after effects and calibrated numbers [N] or [N m]."""
    return found.columns.gap - found.columns.matrix @ found.coefficients()


def _believable(named: Sequence[NamedEffect], judged: _Judged):
    """Effects, and those that may only make up for what is lacking on the drive they move most."""
    places = {effect.location.partition(".")[0] for effect in named}
    named, small = without_details(named, bool(judged.left.lacking.any()), places)
    kept, details = [], list(small)
    for effect in named:
        moved = judged.moved[effect.name, effect.location]
        own = int(np.argmax(moved / judged.std))
        hidden = judged.left.lacking[own] and judged.left.size[own] > moved[own]
        (details if hidden else kept).append(effect)
    return tuple(kept), tuple(details)


def _rms(prediction: Prediction) -> float:
    return float(np.sqrt(np.nanmean(prediction.whitened**2)))


def _channel_rms(prediction: Prediction) -> np.ndarray:
    return np.sqrt(np.nanmean(prediction.whitened**2, axis=0))


def _lacks(mechanism: Mechanism, left: Left, judge: Columns) -> tuple[Lack, ...]:
    """Forces that remain, the largest first."""
    most = np.abs(judge.measured).max(axis=0)
    found = [
        Lack("force", drive, float(left.size[k]), _unit(mechanism, drive),
             float(left.size[k] / max(most[k], 1e-12)))
        for k, drive in enumerate(mechanism.setup.chain.drives) if left.lacking[k]
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda lack: -lack.part))


def _unknown(left: Left, lacks: Sequence[Lack], after: Prediction) -> Unknown:
    """Describe what no effect explains: where, on what it depends, when."""
    drives = [channel.partition(".")[2] for channel in after.channels]
    worst = drives.index(lacks[0].axis)
    words = [lack_words(lack) for lack in lacks[:3]]
    own = [law for law in left.laws if law.drive == worst]
    depends = tuple(dict.fromkeys(name for law in own for name in law.variables))
    if own:
        told = " and ".join(channel_words(name) for name in depends)
        words.append(
            f"{100 * float(left.share[worst]):.0f} % of the remaining force on {drives[worst]} depend on {told}."
        )
    else:
        words.append(
            f"The remaining force on {drives[worst]} does not depend on positions or velocities"
            " alone: check the time windows in which it occurs."
        )
    return Unknown(
        "force", after.channels[worst], depends, " ".join(words), None,
        loud_windows(after.time, after.whitened[:, worst]),
    )  # fmt: skip


def _ranking(found: _Found) -> tuple[Candidate, ...]:
    best: dict[Key, Fitted] = {}
    for effect, one in zip(found.effects, found.singles, strict=True):
        if effect.key not in best or one.score > best[effect.key].score:
            best[effect.key] = one
    order = sorted(best.values(), key=lambda one: -one.score)
    return tuple(
        Candidate(
            one.effects[0].name, one.effects[0].location, one.gain, one.gain - one.score,
            dict(zip(one.effects[0].parameters, map(float, one.values[0]), strict=True)),
            {name: p.unit for name, p in one.effects[0].parameters.items()},
        )
        for one in order[:15]
    )  # fmt: skip


def _notes(found: _Found, band: float) -> list[str]:
    notes = [f"Forces are compared below {band:.3g} Hz."]
    for one in found.weak:
        effect = one.effects[-1]
        told = ", ".join(
            f"{name} {value:.4g} {p.unit}"
            for (name, p), value in zip(effect.parameters.items(), one.values[-1], strict=True)
        )
        notes.append(
            f"{effect.name} at {effect.location}, {told}, is too small to be named and was not added to the model."
        )
    return notes
