"""The gap search as one model selection: add, exchange and remove effects by their log evidence.

Every model is a set of effects with parameters, perhaps with the uncertain parameters of the machine file as one dense
group. Its log evidence has noise levels and residual inputs re-estimated for it. `docs/gap_method.md` states the model.

1. Linearise the whitened errors in every effect (`gap.dictionary`) and compare all of them by their Bayes factors,
   maximised over the size of the residual inputs and the scale of the parameter uncertainty (`gap.regression`).
2. Refine the best few, re-estimate their noise levels, and compare their evidence.
3. Add the best one if its Bayes factor is large enough, and repeat.
4. Remove every effect whose removal costs less than that; exchange an effect for a better rival.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.estimate.colour import Colour
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, occam_penalty
from hydrotele.estimate.filter import Gains
from hydrotele.estimate.hypothesis import BETWEEN_RUNS, CALIBRATION, Guess, Hypothesis, calibration
from hydrotele.estimate.levels import linear_filter, linear_run, propose_colours
from hydrotele.estimate.track import COARSE, Levels, Track, first_rows, row_variances, state_drift
from hydrotele.gap.answer import family_of
from hydrotele.gap.calibrating import fit_until_settled
from hydrotele.gap.dictionary import Dictionary, build_dictionary, list_versions
from hydrotele.gap.disturbances import compare_disturbances, is_pulse, list_disturbances
from hydrotele.gap.regression import (
    NormalEquations,
    compare_groups,
    reweight_columns,
    sum_equations,
    sum_of_single_effects,
)
from hydrotele.gap.result import LIKELY
from hydrotele.gap.rivals import Rival, moved_last
from hydrotele.gap.run_differences import (
    NUISANCE,
    Quantity,
    between_runs,
    compare_between_runs,
    effect_of,
    find_columns,
    list_quantities,
    rescale_between_runs,
)
from hydrotele.gap.screening import Screened
from hydrotele.gap.search import Found
from hydrotele.machine.machine import Machine

MIN_LOG_BAYES_FACTOR = 20.0
"""Twice the log Bayes factor that an effect must bring. The choice among 200 candidates costs 2 log 200 = 10.6."""
RESIDUAL_SCALES = (1.0, 0.3, 0.1, 0.03)
"""Sizes of the residual inputs, relative to the estimated ones, at which effects are compared."""
_CORRELATION_ROWS = (2.0, 6.0, 20.0, 60.0)  # correlation times of first-order noise in all channels, in rows of a log
_REFINEMENT = 1.7  # factor on the best of them, both ways: half of their distance
PARAMETER_SCALES = (0.0, 0.1, 0.3, 1.0, 3.0)
"""Standard deviations of the uncertain parameters, relative to those that the machine file states."""
_OWN_SCALE = 10.0  # prior standard deviations within which the parameters of accepted effects may move again
_SECONDS = 12.0  # s of each run that the linear step uses; the refinement uses all
_JOINT = 40  # best effects among which a pair is looked for
_COMPONENTS = 4  # of the sum of single effects
_TRIED = 4  # candidates that are refined in each round
_RIVALS = 3  # candidates that are refined in the place of an accepted effect
_CLOSE = 100.0  # twice the log Bayes factor; a rival that is farther behind is not fitted to the end
_KEPT = 50  # effects that are linearised again after the first round
_MAX_EFFECTS = 8  # rounds, so that a search ends where no effect of the library is right
_SETTLED = 1.0  # twice the log likelihood; a smaller change of the noise levels' likelihood ends their estimation
_MAX_NOISE_ROUNDS = 3  # of the estimation of the noise levels
_EXCLUDED = ("backlash",)  # its likelihood has a local optimum at every contact; needs a separate search
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Model:
    """A set of effects with its evidence.

    Attributes:
        judged: the effects, fitted, with their own noise levels.
        fit: their last fit; None without effects.
        penalty: log determinant of the posterior precision of all parameters, prior included.
    """

    judged: Judged
    fit: Fit | None = None
    penalty: float = 0.0

    @property
    def score(self) -> float:
        """-2 log evidence, up to a constant."""
        return self.judged.loss + self.penalty

    @property
    def guess(self) -> Guess:
        """The effects and their parameters."""
        return self.judged.guess

    @property
    def colours(self) -> frozenset[int]:
        """Channels whose noise has a coloured part."""
        return frozenset(c.channel for c in self.judged.tracks[0].levels.colours)

    @property
    def charged_score(self) -> float:
        """The score plus what every effect and every coloured noise must bring."""
        return self.score + MIN_LOG_BAYES_FACTOR * (len(self.guess.parts) + len(self.colours))


@dataclass(frozen=True)
class Round:
    """A round of the search: the model before and after, and the other refined models."""

    before: Model
    after: Model
    others: tuple[Model, ...]


def keys_of(model: Model) -> set[tuple[str, str]]:
    """Return names and locations of the effects of a model."""
    return {h.key for h in model.guess.hypotheses}


def is_same(one: Model, other: Model) -> bool:
    """Return whether two models have the same effects, and coloured noise of the same channels."""
    return keys_of(one) == keys_of(other) and one.colours == other.colours


@dataclass(frozen=True)
class Proposal:
    """One effect, a pair of effects, or the calibration, as the linear regression proposes it.

    Attributes:
        parts: the effects and the deviations (p,) at which to start; empty for the calibration.
        factor: twice its log Bayes factor, extrapolated from the rows of the linear step to all rows.
        residual_scale: size of the residual inputs at which it explains the data best.
        parameter_scale: standard deviation of the uncertain parameters; 0 of an effect.
    """

    parts: tuple[tuple[Hypothesis, np.ndarray], ...]
    factor: float
    residual_scale: float
    parameter_scale: float = 0.0

    @property
    def key(self) -> tuple[str, str]:
        """Name and location of the first effect."""
        return self.parts[0][0].key if self.parts else (CALIBRATION, "all")

    @property
    def varies_between_runs(self) -> bool:
        """Whether it lets a parameter differ from run to run."""
        return self.key[0] == BETWEEN_RUNS


def search_model(evidence: Evidence, candidates: Sequence[Hypothesis], progress: Progress | None = None) -> Found:
    """Find the effects that the data ask for.

    Args:
        evidence: on the fit runs, with noise levels that it estimates.
        candidates: the effects.
        progress: called with (what is done, fraction done).

    Returns:
        The model, its rivals, and the first ranking.
    """
    tell = progress or (lambda text, share: None)
    tell("estimate the noise levels of the given model", 0.0)
    given = Model(settle_noise(evidence, evidence.judged(Guess())))
    evidence.keep(given.judged)
    candidates = [c for c in candidates if c.name not in _EXCLUDED]
    quantities = list_quantities(evidence.data.machine, candidates)
    rounds, first = add_effects(evidence, given, candidates, quantities, tell)
    now = rounds[-1].after if rounds else given
    tell("compare coloured noise", 0.85)
    now = compare_colours(evidence, now)
    tell("remove unnecessary effects", 0.87)
    now, rests = remove_needless(evidence, given, now, rounds)
    tell("compare alternative effects", 0.9)
    now, rests, rivals = exchange(evidence, now, rests, rounds)
    evidence.set_base(now.judged)
    charges = tuple(
        occam_penalty(moved_last(now.fit.information, now.guess, k), h.size) if now.fit else 0.0
        for k, h in enumerate(now.guess.hypotheses)
    )
    without = tuple(
        None if h.name in NUISANCE else rest.judged for h, rest in zip(now.guess.hypotheses, rests, strict=True)
    )
    ranking = tuple(
        Screened(p.parts[0][0], p.factor, p.factor, p.parts[0][1])
        for p in first if len(p.parts) == 1 and p.factor > 0.0
    )  # fmt: skip
    return Found(given.judged, now.judged, now.fit, ranking, charges, without, rivals, None)


def add_effects(
    evidence: Evidence, now: Model, candidates: Sequence[Hypothesis], quantities: Mapping[str, Quantity], tell: Progress
) -> tuple[list[Round], tuple[Proposal, ...]]:
    """Add effects, the calibration, coloured noise and differences between runs as long as each brings enough.

    Args:
        evidence: whose base is the model.
        now: the model.
        candidates: the effects.
        quantities: parameters that may differ between the runs.
        tell: called with (what is done, fraction done).

    Returns:
        The rounds, and the proposals of the first one.
    """
    first = tuple[Proposal, ...]()
    keys: set[tuple[str, str]] | None = None
    rounds: list[Round] = []
    for index in range(_MAX_EFFECTS):
        share = 0.05 + 0.8 * index / _MAX_EFFECTS
        tell("compare effects", share)
        pool = [c for c in candidates if keys is None or c.key in keys]
        proposals, varying = propose(evidence, now, [c for c in pool if not is_pulse(c)], quantities)
        disturbances = propose_disturbances(evidence, now, candidates)
        proposals = sorted([*proposals, *disturbances], key=lambda p: -p.factor)
        first = first or tuple(proposals)
        keys = keys or {p.key for p in proposals[:_KEPT]} | {effect_of(p.key[1]) for p in varying[:_KEPT]}
        tell("refine the best effects", share + 0.03)
        models = extensions(evidence, now, proposals)
        others = [*colour_noise(evidence, now), *extensions(evidence, now, varying[:1])]
        better = min((*models, *others), key=lambda m: m.charged_score, default=now)
        if not better.charged_score < now.charged_score:
            break
        settled = settle(evidence, better)
        rounds.append(Round(now, settled, tuple(m for m in models if m is not better)))
        now = settled
        evidence.keep(now.judged)
    return rounds, first


def settle_noise(evidence: Evidence, judged: Judged) -> Judged:
    """Re-estimate the noise levels of a model until its likelihood no longer changes; it becomes the base."""
    for _ in range(_MAX_NOISE_ROUNDS):
        evidence.set_base(judged)
        again = evidence.judged(judged.guess, same=True)
        if again.loss > judged.loss - _SETTLED:
            break
        judged = again
    return evidence.set_base(judged)


def settle(evidence: Evidence, model: Model) -> Model:
    """Alternate fits and estimates of the noise levels until neither changes; the model becomes the base."""
    if not model.guess.parts:
        return Model(settle_noise(evidence, model.judged))
    judged, fit = rescale_between_runs(*fit_until_settled(evidence, model.judged), evidence.runs)
    return Model(settle_noise(evidence, judged), fit, fit.whole_penalty)


# -- linear step ------------------------------------------------------------------------------------------------------


def propose(
    evidence: Evidence, now: Model, candidates: Sequence[Hypothesis], quantities: Mapping[str, Quantity] | None = None
) -> tuple[list[Proposal], list[Proposal]]:
    """Rank effects, and parameters that may differ between the runs, by their Bayes factors in the linearised model.

    The density of the errors is known in closed form for every size of the residual inputs. An effect is proposed with
    the size and the version that make it largest; the calibration with the size and the scale of the uncertain
    parameters that do.

    Args:
        evidence: whose base is the model.
        now: the model.
        candidates: effects that may be added.
        quantities: parameters that may differ between the runs.

    Returns:
        Perhaps a pair of effects, then one proposal per effect, and one of the calibration alone, the best first;
        and one proposal per parameter that may differ, the best first.
    """
    taken = {h.key for h in now.guess.hypotheses}
    versions = [v for c in candidates if c.key not in taken for v in list_versions(c)]
    machine = evidence.data.machine
    names = frozenset(n for n, h in zip(now.guess.names, _owners(now.guess), strict=True) if h != CALIBRATION)
    uncertain = Hypothesis(CALIBRATION, "all", {}) if (CALIBRATION, "all") in taken else calibration(machine, names)
    tracks = [_first_seconds(track) for track in evidence.tracks]
    table = build_dictionary(evidence, now.guess, versions, uncertain, tracks)
    fraction = sum(len(t.whitened) for t in tracks) / sum(len(t.whitened) for t in evidence.tracks)
    best: dict[tuple[str, str], Proposal] = {}
    varying: dict[tuple[str, str], Proposal] = {}
    columns = find_columns(table, quantities or {}) if len(tracks) > 1 else []
    run_names = tuple(run.name for run in (*evidence.data.fit, evidence.data.heldout))
    chosen: dict[tuple[str, str], int] = {}
    gains: dict[float, float] = {}
    has_calibration, start = (CALIBRATION, "all") in taken, None
    for residual_scale in RESIDUAL_SCALES:
        by_run, loss = _normal_equations(evidence, tracks, table, residual_scale)
        terms = sum_equations(by_run)
        for parameter_scale in PARAMETER_SCALES[: 1 if has_calibration else None]:
            marginal = terms.marginalise(np.where(table.own, _OWN_SCALE, parameter_scale))
            total = loss - terms.squares + marginal.loss
            start = total if start is None else start
            gained = (start - total) / fraction
            if parameter_scale > 0.0:
                _keep(best, Proposal((), gained, residual_scale, parameter_scale))
                continue
            factors, means = compare_groups(terms.edges, marginal.right, marginal.blocks)
            gains[residual_scale] = gained
            scales = np.where(table.own, _OWN_SCALE, 0.0)
            for column, scale, factor, mean in compare_between_runs(by_run, columns, scales, PARAMETER_SCALES[1:]):
                group = between_runs(column.quantity, run_names, scale)
                part = group, np.clip(np.append(mean, 0.0), group.low, group.high)  # the held-out run is unknown
                _keep(varying, Proposal((part,), gained + factor / fraction, residual_scale))
            for index, (version, factor, mean) in enumerate(zip(table.versions, factors, means, strict=True)):
                part = version.hypothesis, version.deviation(mean)
                proposal = Proposal((part,), gained + float(factor) / fraction, residual_scale)
                if _keep(best, proposal):
                    chosen[proposal.key] = index
    ranked, differing = (sorted(found.values(), key=lambda p: -p.factor) for found in (best, varying))
    single = [p for p in ranked if p.parts]
    if not single:
        return ranked, differing
    scale = single[0].residual_scale
    kept = table.select([chosen[p.key] for p in single[:_JOINT]])
    pair = propose_pair(evidence, tracks, kept, scale)
    if pair is None:
        return ranked, differing
    return [Proposal(pair[0], gains[scale] + pair[1] / fraction, scale), *ranked], differing


def propose_disturbances(evidence: Evidence, now: Model, candidates: Sequence[Hypothesis]) -> list[Proposal]:
    """Rank force pulses and periodic forces, in one run or in all, on all rows of the runs.

    Args:
        evidence: whose base is the model.
        now: the model.
        candidates: effects, among them pulses.
    """
    taken = keys_of(now)
    tried = [h for h in list_disturbances(evidence.data, candidates, now.judged) if h.key not in taken]
    found: dict[tuple[str, str], Proposal] = {}
    for scale in RESIDUAL_SCALES if tried else ():
        tracks = evidence.map(lambda track, rho=scale: scale_residual_inputs(track, rho), evidence.tracks)
        gained = sum(old.loss - new.loss for old, new in zip(evidence.tracks, tracks, strict=True))
        for part, factor in compare_disturbances(tried, tracks, evidence.map):
            _keep(found, Proposal((part,), gained + factor, scale))
    return list(found.values())


def propose_pair(
    evidence: Evidence, tracks: Sequence[Track], table: Dictionary, residual_scale: float
) -> tuple[tuple[tuple[Hypothesis, np.ndarray], ...], float] | None:
    """Propose two effects that act together, by a sum of single effects.

    Args:
        evidence: whose base is the model.
        tracks: of the base, or the first rows of them.
        table: one version of each of the best effects.
        residual_scale: size of the residual inputs.

    Returns:
        The effects with their deviations, and twice the log Bayes factor of both together; None if fewer than two
        components prefer an effect.
    """
    joint = dataclasses.replace(table, columns=(np.hstack(table.columns),))
    marginal = sum_equations(_normal_equations(evidence, tracks, joint, residual_scale)[0]).marginalise(
        np.where(table.own, _OWN_SCALE, 0.0)
    )
    edges = np.cumsum([0, *(c.shape[1] for c in table.columns)])
    gram = marginal.blocks[0]
    chances, _ = sum_of_single_effects(gram, marginal.right, edges, _COMPONENTS)
    leaders = list(dict.fromkeys(int(row[:-1].argmax()) for row in chances if row[:-1].max() > LIKELY))[:2]
    if len(leaders) < 2:
        return None
    own = np.concatenate([np.arange(edges[g], edges[g + 1]) for g in leaders])
    width = np.array([0, len(own)])
    factors, (mean,) = compare_groups(width, marginal.right[own], [gram[np.ix_(own, own)]])
    split = np.split(mean, [edges[leaders[0] + 1] - edges[leaders[0]]])
    versions = [table.versions[g] for g in leaders]
    parts = tuple((v.hypothesis, v.deviation(m)) for v, m in zip(versions, split, strict=True))
    return parts, float(factors[0])


def _first_seconds(track: Track) -> Track:
    """Return the first seconds of a linearised track, with its transition Jacobians."""
    rows = round(_SECONDS / track.run.period)
    first = dataclasses.replace(first_rows(track, rows), flow=track.flow[:rows])
    there = np.isfinite(first.whitened)
    loss = float(np.sum(first.whitened[there] ** 2 + 2.0 * np.log(first.gains.spread[there])))
    return dataclasses.replace(first, loss=loss)


def _owners(guess: Guess) -> list[str]:
    return [h.name for h in guess.hypotheses for _ in h.parameters]


def _keep(best: dict[tuple[str, str], Proposal], proposal: Proposal) -> bool:
    """Keep a proposal if it is the best one of its effect; return whether it is."""
    if proposal.key in best and proposal.factor <= best[proposal.key].factor:
        return False
    best[proposal.key] = proposal
    return True


def _normal_equations(
    evidence: Evidence, tracks: Sequence[Track], table: Dictionary, residual_scale: float
) -> tuple[list[NormalEquations], float]:
    """Per run the normal equations with the residual inputs scaled, and -2 log likelihood of all errors there."""
    edges = np.cumsum([0, *(t.whitened.size for t in tracks)])
    widths = np.cumsum([0, *(c.shape[1] for c in table.columns), table.nuisance.shape[1]])

    def of_run(index: int) -> tuple[NormalEquations, float]:
        track, rows = tracks[index], slice(edges[index], edges[index + 1])
        scaled = scale_residual_inputs(track, residual_scale)
        columns = np.hstack([*(c[rows] for c in table.columns), table.nuisance[rows]]).astype(float)
        missing = ~np.isfinite(track.whitened)
        if residual_scale != 1.0:
            there = columns.reshape(*track.whitened.shape, -1)
            there *= np.where(missing, 0.0, track.gains.spread)[:, :, None]
            reweight_columns(
                track.gains.slope, track.flow, missing, track.gains.gain, scaled.gains.gain, there,
            )  # fmt: skip
            there /= np.where(missing, 1.0, scaled.gains.spread)[:, :, None]
        groups = [columns[:, a:b] for a, b in zip(widths[:-2], widths[1:-1], strict=True)]
        errors = -np.nan_to_num(scaled.whitened).ravel()
        return NormalEquations.of(errors, groups, columns[:, widths[-2] :]), scaled.loss

    found = evidence.map(of_run, range(len(tracks)))
    return [terms for terms, _ in found], sum(loss for _, loss in found)


def scale_residual_inputs(track: Track, scale: float) -> Track:
    """Return a linearised track with the standard deviations of its residual inputs scaled.

    The filter is run again on the track's own linearisation.
    """
    if scale == 1.0:
        return track
    names, levels = list(track.names), scale_levels(track.levels, scale)
    m = len(levels.inputs)
    run = linear_run(track, track.unknown_command_variances)
    initial = run.initial.copy()
    first = len(names) - m
    initial[first:] *= scale
    initial[:, first:] *= scale
    run = run._replace(initial=initial)
    whitened, width = np.empty(run.error.shape), np.empty(run.error.shape)
    gain = np.zeros(run.slope.shape)
    loss = linear_filter(
        run, row_variances(levels, track.run), state_drift(names, levels, track.run.period, track.scales),
        whitened, width, gain, np.empty(run.correction.shape), np.empty((0, len(names), len(names))),
    )  # fmt: skip
    gains = Gains(track.gains.slope, gain, width)
    return dataclasses.replace(track, levels=levels, loss=loss, whitened=whitened, gains=gains)


def scale_levels(levels: Levels, scale: float) -> Levels:
    """Scale the standard deviations of the residual inputs."""
    return dataclasses.replace(levels, sizes=scale * levels.sizes)


# -- refinement -------------------------------------------------------------------------------------------------------


def extensions(evidence: Evidence, now: Model, proposals: Sequence[Proposal]) -> list[Model]:
    """Refine the best proposals that the linear step holds for better than the model."""
    chosen = [p for p in proposals[:_TRIED] if p.factor > MIN_LOG_BAYES_FACTOR]
    return [m for m in (refine(evidence, now, p) for p in chosen) if m is not None]


def colour_noise(evidence: Evidence, now: Model) -> list[Model]:
    """Return a model with coloured noise of the channels whose readings show it; it has no other new part.

    Args:
        evidence: whose base is the model; it is the base afterwards, too.
        now: the model.

    Returns:
        That model, or nothing.
    """
    levels = propose_colours(evidence.data, now.judged.tracks, MIN_LOG_BAYES_FACTOR)
    if levels is None:
        return []
    judged = evidence.judged_from(now.guess, levels)
    return [Model(judged, now.fit, now.penalty)] if np.isfinite(judged.loss) else []


def compare_colours(evidence: Evidence, now: Model) -> Model:
    """Find coloured noise again for the final set of effects, now with the same correlation time in all channels, too.

    Slow noise of several sensors is explained by residual inputs as well, and each channel alone then shows too little
    of it. So all channels get a first-order part at once, and the residual inputs must bring their evidence anew.

    Args:
        evidence: whose base is the model that is returned afterwards.
        now: the model. Its coloured noise may have been found before an effect that changes the spectra.

    Returns:
        The model with other coloured noise if that has more evidence, else the given one.
    """
    levels = now.judged.tracks[0].levels
    total, shares = levels.noise.copy(), np.full(len(levels.noise), np.sqrt(0.5))
    for colour in levels.colours:
        total[colour.channel] = np.hypot(total[colour.channel], colour.size)
    period = max(track.run.period for track in now.judged.tracks)

    def with_noise(white: np.ndarray, colours: tuple[Colour, ...]) -> Model:
        evidence.set_base(now.judged)
        start = dataclasses.replace(levels, noise=white, colours=colours, inputs=(), sizes=np.zeros(0))
        return Model(evidence.judged_from(now.guess, start), now.fit, now.penalty)

    def first_order(rows: float) -> Model:
        colours = (Colour(c, float(size), rows * period) for c, size in enumerate(shares * total))
        return with_noise(shares * total, tuple(colours))

    common = {rows: first_order(rows) for rows in _CORRELATION_ROWS}
    best_rows = min(common, key=lambda rows: common[rows].charged_score)
    common |= {rows: first_order(rows) for rows in (best_rows / _REFINEMENT, best_rows * _REFINEMENT)}
    models = [now, *common.values()]
    if now.colours:
        white = with_noise(total, ())
        evidence.set_base(white.judged)
        models += [white, *colour_noise(evidence, white)]
    best = min(models, key=lambda model: model.charged_score)
    evidence.set_base(best.judged)
    return now if best is now else settle(evidence, best)


def refine(evidence: Evidence, now: Model, proposal: Proposal) -> Model | None:
    """Fit a proposal together with a model, re-estimate the noise levels, and compute the evidence.

    Args:
        evidence: whose base is the model; it is the base afterwards, too.
        now: the model.
        proposal: what is added.

    Returns:
        The extended model; None where the machine cannot follow the runs.
    """
    guess = extend(evidence.data.machine, now.guess, proposal)
    tracks = tuple(scale_residual_inputs(t, proposal.residual_scale) for t in now.judged.tracks)
    evidence.set_base(Judged(now.guess, tracks, now.judged.loss))
    try:
        kept = None
        if proposal.parameter_scale > 0.0:
            kept = evidence.slopes(guess, evidence.errors(guess, COARSE), step=COARSE)
        fit = evidence.fit(guess, 0.0, steps=4, step=MIDDLE, kept=kept)
        if not np.isfinite(fit.loss):
            return None
        evidence.set_base(now.judged)
        if proposal.residual_scale == 1.0:
            judged = evidence.judged(fit.guess)
        else:
            judged = evidence.judged_from(fit.guess, tracks[0].levels)
    finally:
        evidence.set_base(now.judged)
    judged, fit = rescale_between_runs(judged, fit, evidence.runs)
    return Model(judged, fit, fit.whole_penalty) if np.isfinite(judged.loss) else None


def extend(machine: Machine, guess: Guess, proposal: Proposal) -> Guess:
    """Add a proposal to a model: its effects, or the uncertain parameters."""
    if proposal.parts:
        return Guess((*guess.parts, *proposal.parts))
    group = scaled_calibration(machine, guess, proposal.parameter_scale)
    return guess.plus(group, np.zeros(group.size)) if group.size else guess


def scaled_calibration(machine: Machine, guess: Guess, scale: float) -> Hypothesis:
    """Return the uncertain parameters as one group, without those of the effects that are there.

    Args:
        machine: the given machine.
        guess: the effects.
        scale: standard deviation relative to what the machine file states.
    """
    names = frozenset(n for n, h in zip(guess.names, _owners(guess), strict=True) if h != CALIBRATION)
    group = calibration(machine, names)
    table = {k: dataclasses.replace(p, prior_std=scale * p.prior_std) for k, p in group.parameters.items()}
    return dataclasses.replace(group, parameters=table)


# -- removal and exchange ---------------------------------------------------------------------------------------------


def without_part(evidence: Evidence, given: Model, now: Model, index: int, rounds: Sequence[Round]) -> Model:
    """Return a model without one of its effects, fitted again; the larger model is the base afterwards."""
    guess = now.guess.without(index)
    if not guess.parts and not now.colours:
        return given
    for known in rounds:
        if keys_of(known.before) == {h.key for h in guess.hypotheses} and known.before.colours == now.colours:
            return known.before
    evidence.set_base(now.judged)
    rest = settle(evidence, Model(evidence.judged(guess, reopened=True)))
    evidence.set_base(now.judged)
    return rest


def remove_needless(
    evidence: Evidence, given: Model, now: Model, rounds: Sequence[Round]
) -> tuple[Model, list[Model]]:  # fmt: skip
    """Remove effects, the weakest first, as long as that costs less than the smallest Bayes factor.

    Returns:
        The model, and for each of its parts the model without it.
    """
    while True:
        rests = [without_part(evidence, given, now, k, rounds) for k in range(len(now.guess.parts))]
        costs = [rest.score - now.score for rest in rests]
        if not costs or min(costs) > MIN_LOG_BAYES_FACTOR:
            return now, rests
        now = rests[int(np.argmin(costs))]


def exchange(
    evidence: Evidence, now: Model, rests: Sequence[Model], rounds: Sequence[Round]
) -> tuple[Model, list[Model], tuple[tuple[Rival, ...], ...]]:
    """Compare each effect with what was refined in its place; a better rival replaces it.

    Returns:
        The model, for each part the model without it, and for each part its rivals.
    """
    rivals: list[tuple[Rival, ...]] = []
    order, best = list(range(len(rests))), now
    for index, (hypothesis, _) in enumerate(now.guess.parts):
        origin = next((r for r in rounds if hypothesis.key in keys_of(r.after) - keys_of(r.before)), None)
        if hypothesis.name in NUISANCE or origin is None:
            rivals.append(())
            continue
        rest, taken = rests[index], keys_of(now)
        models = [
            model if is_same(origin.before, rest) else add_rival(evidence, rest, origin, model)
            for model in origin.others if _is_rival(keys_of(model) - keys_of(origin.before), taken)
        ]  # fmt: skip
        models = sorted((m for m in models if m.score < rest.score), key=lambda m: m.score)[:_RIVALS]
        models = [
            settle(evidence, m) if m.score < now.score + _CLOSE or is_of_family(m, hypothesis, taken) else m
            for m in models
        ]
        models.sort(key=lambda m: m.score)
        same_size = [m for m in models if len(m.guess.parts) == len(rests)]
        if best is now and same_size and same_size[0].score < now.score:
            best = same_size[0]
            models = [now, *(m for m in models if m is not best)]
            order = [*(k for k in order if k != index), index]  # the effect added last is the last part
        rivals.append(tuple(_rival(m, rest) for m in models))
    return best, [rests[k] for k in order], tuple(rivals[k] for k in order)


def _is_rival(added: set[tuple[str, str]], taken: set[tuple[str, str]]) -> bool:
    """Return whether a model adds effects, and none that the accepted model has."""
    return bool(added - {(CALIBRATION, "all")}) and not added & taken


def is_of_family(model: Model, hypothesis: Hypothesis, taken: set[tuple[str, str]]) -> bool:
    """Return whether a model has another effect of the same family at the same place as an accepted one.

    Such a rival may be a special case of the accepted effect, such as one valve gain for both directions. Its fit has
    to end before the two can be compared, however far behind it is.
    """
    return any(
        location == hypothesis.location and family_of(name) == family_of(hypothesis.name)
        for name, location in keys_of(model) - taken
    )


def add_rival(evidence: Evidence, rest: Model, origin: Round, model: Model) -> Model:
    """Fit a rival together with the rest of the model."""
    old = keys_of(origin.before)
    guess = rest.guess
    for hypothesis, deviation in model.guess.parts:
        if hypothesis.key not in old | keys_of(rest):
            guess = guess.plus(hypothesis, deviation)
    evidence.set_base(rest.judged)
    fit = evidence.fit(guess, 0.0, steps=2, step=MIDDLE)
    return Model(evidence.judged(fit.guess), fit, fit.whole_penalty)


def _rival(model: Model, rest: Model) -> Rival:
    """Describe a model by the effect that it has in addition to the rest."""
    keys = [h.key for h in model.guess.hypotheses]
    index = next(k for k, key in enumerate(keys) if key not in keys_of(rest) and key[0] != CALIBRATION)
    hypothesis = model.guess.hypotheses[index]
    assert model.fit
    charge = occam_penalty(moved_last(model.fit.information, model.guess, index), hypothesis.size)
    return Rival(hypothesis, model.judged, charge, model.fit)
