"""The gap search as one model selection: add, exchange and remove effects by their log evidence.

Every model is a set of effects with parameters, perhaps with the uncertain parameters of the machine file as one dense
group. Its log evidence has noise levels and residual inputs re-estimated for it. `docs/gap_method.md` states the model.

1. Linearise the whitened errors in every effect (`gap.dictionary`) and compare all of them by their Bayes factors,
   maximised over the size of the residual inputs and the scale of the parameter uncertainty (`gap.regression`).
2. Refine the best few, re-estimate their noise levels, and compare their evidence.
3. Add the best one if its Bayes factor is large enough, and repeat.
4. Remove every effect whose removal costs less than that; exchange an effect for a better rival.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.estimate.evidence import Fit, Judged, invert_information, occam_penalty
from hydrotele.estimate.hypothesis import BETWEEN_RUNS, CALIBRATION, Guess, Hypothesis
from hydrotele.gap.answer import family_of
from hydrotele.gap.backlash import BACKLASH
from hydrotele.gap.dictionary import list_versions
from hydrotele.gap.disturbances import is_pulse
from hydrotele.gap.gap_model import GapModel, Linearisation
from hydrotele.gap.laws import LAW_OVER_TWO, LawForm, LawHypothesis, best_prior
from hydrotele.gap.regression import (
    OWN_SCALE,
    LevelScale,
    Marginal,
    NormalEquations,
    compare_groups,
    sum_equations,
    sum_of_single_effects,
)
from hydrotele.gap.result import LIKELY
from hydrotele.gap.rivals import Found, Ranked, Rival, moved_last
from hydrotele.gap.run_differences import (
    NUISANCE,
    Quantity,
    between_runs,
    common_value,
    compare_between_runs,
    effect_of,
    find_columns,
    has_common_value,
)

MIN_LOG_BAYES_FACTOR = 20.0
"""Twice the log Bayes factor that an effect must bring. The choice among 200 candidates costs 2 log 200 = 10.6."""
PARAMETER_SCALES = (0.0, 0.1, 0.3, 1.0, 3.0)
"""Standard deviations of the uncertain parameters, relative to those that the machine file states."""
_JOINT = 40  # best effects among which a pair is looked for
_LAWS_AT_ONCE = 30  # in memory: 500 columns
_COMPONENTS = 4  # of the sum of single effects
_TRIED = 4  # candidates that are refined in each round, and as many of other families
_RIVALS = 3  # candidates that are refined in the place of an accepted effect
_CLOSE = 100.0  # twice the log Bayes factor; a rival that stays farther behind is not fitted to the end
_KEPT = 50  # effects that are linearised again after the first round
_SETTLED = 1.0  # twice the log likelihood; a smaller change of the noise levels' likelihood ends their estimation
_MAX_NOISE_ROUNDS = 3  # of the estimation of the noise levels
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
    """A round of the search: the model before and after, and the other refined models, all compact."""

    before: Model
    after: Model
    others: tuple[Model, ...]


def compact(model: GapModel, one: Model) -> Model:
    """Return a model that needs little memory; `GapModel.set_base` computes the rest again."""
    return replace(one, judged=model.compact(one.judged))


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
        scale: of the noise levels at which it explains the data best.
        parameter_scale: standard deviation of the uncertain parameters; 0 of an effect.
    """

    parts: tuple[tuple[Hypothesis, np.ndarray], ...]
    factor: float
    scale: LevelScale
    parameter_scale: float = 0.0

    @property
    def law(self) -> LawForm | None:
        """The law or profile; None of effects and of the calibration."""
        first = self.parts[0][0] if self.parts else None
        return first.form if isinstance(first, LawHypothesis) else None

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the effects."""
        return tuple(family_of(h.name) for h, _ in self.parts)

    @property
    def key(self) -> tuple[str, str]:
        """Name and location of the first effect."""
        return self.parts[0][0].key if self.parts else (CALIBRATION, "all")


def search_model(
    model: GapModel, candidates: Sequence[Hypothesis], progress: Progress | None = None, has_laws: bool = False
) -> Found:
    """Find the effects that the data ask for.

    Args:
        model: of the fit runs.
        candidates: the effects.
        progress: called with (what is done, fraction done).
        has_laws: whether laws without a known cause are learned.

    Returns:
        The model, its rivals, and the first ranking.
    """
    tell = progress or (lambda text, share: None)
    tell("estimate the noise levels of the given model", 0.0)
    given = Model(settle_noise(model, model.judge(Guess())))
    model.keep(given.judged)
    candidates = model.prepare(candidates, given.judged)
    now, rounds, first = add_effects(model, given, candidates, has_laws, tell)
    tell("compare coloured noise", 0.85)
    now = compare_colours(model, now)
    now = compare_common_values(model, now, candidates)
    tell("remove unnecessary effects", 0.87)
    now, rests = remove_needless(model, rounds[0].before if rounds else given, now, rounds)
    tell("compare alternative effects", 0.9)
    now, rests, rivals = exchange(model, now, rests, rounds)
    now = replace(now, judged=model.set_base(now.judged))
    charges = tuple(
        occam_penalty(moved_last(now.fit.information, now.guess, k), h.size) if now.fit else 0.0
        for k, h in enumerate(now.guess.hypotheses)
    )
    without = tuple(
        None if h.name in NUISANCE else rest.judged for h, rest in zip(now.guess.hypotheses, rests, strict=True)
    )
    ranking = tuple(
        Ranked(p.parts[0][0], p.factor, p.parts[0][1])
        for p in first if len(p.parts) == 1 and p.factor > 0.0
    )  # fmt: skip
    return Found(given.judged, now.judged, now.fit, ranking, charges, without, rivals)


def add_effects(
    model: GapModel, now: Model, candidates: Sequence[Hypothesis], has_laws: bool, tell: Progress
) -> tuple[Model, list[Round], tuple[Proposal, ...]]:
    """Add effects, laws, the calibration, coloured noise and differences between runs as long as each brings enough.

    Args:
        model: whose base is `now`.
        now: the model.
        candidates: the effects.
        has_laws: whether laws without a known cause are learned.
        tell: called with (what is done, fraction done).

    Returns:
        The model, the rounds, and the proposals of the first one.
    """
    quantities, effects = model.list_quantities(candidates), list(dict.fromkeys(c.name for c in candidates))
    first = tuple[Proposal, ...]()
    keys: set[tuple[str, str]] | None = None
    rounds: list[Round] = []
    direct = [c for c in candidates if c.name == BACKLASH]
    candidates = [c for c in candidates if c.name != BACKLASH]
    for index in range(model.max_effects):
        share = 0.05 + 0.8 * index / model.max_effects
        tell("compare effects", share)
        pool = [c for c in candidates if keys is None or c.key in keys]
        proposals, varying, compare_pairs = propose(
            model, now, [c for c in pool if not is_pulse(c)], quantities, effects, has_laws
        )
        proposals = sorted([*proposals, *propose_disturbances(model, now, candidates)], key=lambda p: -p.factor)
        first = first or tuple(proposals)
        kept = [p.key for p in proposals if not p.law][:_KEPT]
        keys = keys or {*kept, *(effect_of(p.key[1]) for p in varying[:_KEPT])}
        tell("refine the best effects", share + 0.03)
        models = extensions(model, now, proposals)
        others = [*colour_noise(model, now), *extensions(model, now, varying[:1])]
        if not index and all(is_incomplete(m) for m in models):
            others += search_directly(model, now, model.try_start_values(now.judged, [*candidates, *direct]))
        better = min((*models, *others), key=lambda m: m.charged_score, default=now)
        if better.charged_score < now.charged_score:
            now = renew_noise(model, now, better)
        if not better.charged_score < now.charged_score:
            better = min(extensions(model, now, compare_pairs()), key=lambda m: m.charged_score, default=now)
            if better.charged_score < now.charged_score:
                now = renew_noise(model, now, better)
        if not better.charged_score < now.charged_score:
            started = model.try_start_values(now.judged, candidates) if index else []
            started += [j for c in direct if (j := model.search_backlash(now.judged, c, tell)) is not None]
            better = min(search_directly(model, now, started), key=lambda m: m.charged_score, default=now)
        if not better.charged_score < now.charged_score:
            break
        settled = compare_common_values(model, settle(model, better), candidates)
        rivals = tuple(compact(model, m) for m in models if m is not better)
        rounds.append(Round(compact(model, now), compact(model, settled), rivals))
        now = settled
        model.keep(now.judged)
    return now, rounds, first


def compare_common_values(model: GapModel, now: Model, candidates: Sequence[Hypothesis]) -> Model:
    """Give a parameter that differs between the runs another common value, where its mean is significantly nonzero.

    Values that are nearly the same in all runs are one wrong value, which an effect names; whether it also differs
    between the runs is then compared again. No difference between runs stands without the effect of its mean.

    Args:
        model: whose base is `now`; the returned model is the base afterwards.
        now: the model, settled.
        candidates: the effects.
    """
    known = {c.key: c for c in candidates if c.size == 1}
    for part in now.guess.parts:
        effect = known.get(effect_of(part[0].location))
        if part[0].name != BETWEEN_RUNS or effect is None or effect.key in keys_of(now):
            continue
        if not has_common_value(part[1][:-1]):
            continue
        index = next(k for k, (h, _) in enumerate(now.guess.parts) if h is part[0])
        own, varying = common_value(effect, *part)
        rest = now.guess.without(index)
        judged = [model.judge(guess, reopened=True) for guess in (rest.plus(*own), rest.plus(*varying).plus(*own))]
        found = [compact(model, settle(model, Model(one))) for one in judged if np.isfinite(one.loss)]
        now = min(found, key=lambda m: m.charged_score, default=now)
        now = replace(now, judged=model.set_base(now.judged))
    return now


def is_incomplete(one: Model) -> bool:
    """Return whether a model has residual inputs."""
    return bool(one.judged.tracks[0].levels.inputs)


def search_directly(model: GapModel, now: Model, found: Sequence[Judged]) -> list[Model]:
    """Return models that were started beside the linear step, fitted.

    Args:
        model: whose base is `now`; it is the base afterwards, too.
        now: the model.
        found: extensions of it.
    """
    settled = [compact(model, settle(model, Model(judged))) for judged in found]
    model.set_base(now.judged)
    return settled


def renew_noise(model: GapModel, now: Model, better: Model) -> Model:
    """Estimate the noise levels of a model from those of a better one, too, and return it with the likelier ones.

    The likelihood of the noise levels may have several maxima. Without this, an effect of size zero wins if only its
    noise levels reached the higher maximum.

    Args:
        model: whose base is `now`; the returned model is the base afterwards.
        now: the model.
        better: an extension of it.
    """
    if better.colours != now.colours:
        return now
    again = Model(model.judge_from(now.guess, better.judged), now.fit, now.penalty)
    if not again.score < now.score - _SETTLED:
        return now
    return Model(settle_noise(model, again.judged), now.fit, now.penalty)


def settle_noise(model: GapModel, judged: Judged) -> Judged:
    """Re-estimate the noise levels of a model until its likelihood no longer changes; it becomes the base."""
    for _ in range(_MAX_NOISE_ROUNDS):
        model.set_base(judged)
        again = model.judge(judged.guess, same=True)
        if again.loss > judged.loss - _SETTLED:
            break
        judged = again
    return model.set_base(judged)


def settle(model: GapModel, one: Model, target: float = np.inf) -> Model:
    """Alternate fits and estimates of the noise levels until neither changes; the model becomes the base.

    The prior of a law was selected while residual inputs hid a part of it. It is selected again as long as that brings
    evidence.

    Args:
        model: the data.
        one: the model.
        target: a score; a model that does not approach it is not fitted to the end.
    """
    if not one.guess.parts:
        return Model(settle_noise(model, one.judged))
    found = _settle_fit(model, one.judged, target - one.penalty)
    while found.score < target and any(isinstance(h, LawHypothesis) for h in found.guess.hypotheses):
        again = _settle_fit(model, model.judge(model.select_priors(found.guess), same=True), np.inf)
        if again.score > found.score - _SETTLED:
            model.set_base(found.judged)
            break
        found = again
    return found


def _settle_fit(model: GapModel, judged: Judged, wanted: float) -> Model:
    judged, fit = model.settle(judged, wanted)
    return Model(settle_noise(model, judged), fit, fit.whole_penalty)


# -- linear step ------------------------------------------------------------------------------------------------------


def propose(
    model: GapModel, now: Model, candidates: Sequence[Hypothesis], quantities: Mapping[str, Quantity] | None = None,
    effects: Collection[str] = (), has_laws: bool = False,
) -> tuple[list[Proposal], list[Proposal], Callable[[], list[Proposal]]]:  # fmt: skip
    """Rank effects, laws, and parameters that may differ between the runs, by their Bayes factors in the linear model.

    The density of the errors is known in closed form for every size of the residual inputs. An effect is proposed with
    the size and the version that make it largest; the calibration with the size and the scale of the uncertain
    parameters that do.

    Args:
        model: whose base is `now`.
        now: the model.
        candidates: effects that may be added.
        quantities: parameters that may differ between the runs.
        effects: names of effects whose coefficient may vary.
        has_laws: whether learned laws are compared, too.

    Returns:
        Perhaps a pair of effects, then one proposal per effect, and one of the calibration alone, the best first;
        and one proposal per parameter that may differ, the best first; and a function that compares the laws over two
        variables, which take the most time and are the most flexible.
    """
    taken = {h.key for h in now.guess.hypotheses}
    versions = [v for c in candidates if c.key not in taken for v in list_versions(c)]
    uncertain = model.uncertain_parameters(now.guess)
    table = model.linearise(now.guess, versions, uncertain)
    best: dict[tuple[str, str], Proposal] = {}
    varying: dict[tuple[str, str], Proposal] = {}
    columns = find_columns(table.parameters, table.versions, quantities or {})
    chosen: dict[tuple[str, str], int] = {}
    gains: dict[LevelScale, float] = {}
    starts: list[float] = []

    def compare(table: Linearisation) -> None:
        for level in model.level_scales:
            by_run, loss = table.equations(level)
            terms = sum_equations(by_run)
            for parameter_scale in PARAMETER_SCALES[: 1 if not uncertain.size or table.laws else None]:
                scales = np.where(table.is_own, OWN_SCALE, parameter_scale)
                marginal = terms.marginalise(scales)
                total = loss - terms.squares + marginal.loss
                starts.append(total)
                gained = (starts[0] - total) / table.fraction
                if parameter_scale > 0.0:
                    _keep(best, Proposal((), gained, level, parameter_scale))
                    continue
                gains[level] = gained
                for index, part, factor in _compare_columns(table, terms, marginal):
                    proposal = Proposal((part,), gained + factor / table.fraction, level)
                    if _keep(best, proposal) and not table.laws:
                        chosen[proposal.key] = index
                own = () if table.laws else compare_between_runs(by_run, columns, scales, PARAMETER_SCALES[1:])
                for column, scale, factor, mean in own:
                    group = between_runs(column.quantity, model.run_names, scale)
                    part = group, np.clip(np.append(mean, 0.0), group.low, group.high)  # the held-out run is unknown
                    _keep(varying, Proposal((part,), gained + factor / table.fraction, level))

    def compare_laws(laws: Sequence[LawForm]) -> None:
        new = [law for law in laws if law.key not in taken]
        for begin in range(0, len(new), _LAWS_AT_ONCE):
            compare(table.with_laws(new[begin : begin + _LAWS_AT_ONCE]))

    compare(table)
    forms = table.list_laws(now.judged, effects, has_laws)
    compare_laws(forms)
    free = [form for form in forms if not form.effect and form.key in best]

    def compare_pairs() -> list[Proposal]:
        if free:
            compare_laws(table.list_pairs(max(free, key=lambda form: best[form.key].factor)))
        return sorted((p for p in best.values() if p.law and p.law.kind == LAW_OVER_TWO), key=lambda p: -p.factor)

    ranked, differing = (sorted(found.values(), key=lambda p: -p.factor) for found in (best, varying))
    single = [p for p in ranked if p.key in chosen and p.factor > 0.0]
    if not single:
        return ranked, differing, compare_pairs
    scale = single[0].scale
    pair = propose_pair(table, [chosen[p.key] for p in single[:_JOINT]], scale)
    if pair is None:
        return ranked, differing, compare_pairs
    joint = Proposal(pair[0], gains[scale] + pair[1] / table.fraction, scale)
    return [joint, *ranked], differing, compare_pairs


def _compare_columns(
    table: Linearisation, terms: NormalEquations, marginal: Marginal
) -> Iterator[tuple[int, tuple[Hypothesis, np.ndarray], float]]:
    """Yield the place of each version, or of each law with each of its priors, its start, and twice its factor."""
    if not table.laws:
        factors, means = compare_groups(
            terms.edges, marginal.right, marginal.blocks, [v.bounds for v in table.versions]
        )
        for index, (version, factor, mean) in enumerate(zip(table.versions, factors, means, strict=True)):
            yield index, (version.hypothesis, version.deviation(mean)), float(factor)
    for index, law in enumerate(table.laws):
        right, block = marginal.right[terms.edges[index] : terms.edges[index + 1]], marginal.blocks[index]
        factor, root, mean = best_prior(law, right, block)
        yield index, (law.hypothesis(root), mean), factor


def propose_disturbances(model: GapModel, now: Model, candidates: Sequence[Hypothesis]) -> list[Proposal]:
    """Rank force pulses and periodic forces, in one run or in all, on all rows of the runs.

    Args:
        model: whose base is `now`.
        now: the model.
        candidates: effects, among them pulses.
    """
    found: dict[tuple[str, str], Proposal] = {}
    for part, factor, scale in model.compare_disturbances(now.judged, candidates):
        _keep(found, Proposal((part,), factor, scale))
    return list(found.values())


def propose_pair(
    table: Linearisation, chosen: Sequence[int], scale: LevelScale
) -> tuple[tuple[tuple[Hypothesis, np.ndarray], ...], float] | None:
    """Propose two effects that act together, by a sum of single effects.

    Args:
        table: linearised versions.
        chosen: one version of each of the best effects.
        scale: of the noise levels.

    Returns:
        The effects with their deviations, and twice the log Bayes factor of both together; None if fewer than two
        components prefer an effect.
    """
    by_run, _ = table.equations(scale, chosen)
    chosen_versions = [table.versions[g] for g in chosen]
    marginal = sum_equations(by_run).marginalise(np.where(table.is_own, OWN_SCALE, 0.0))
    edges = np.cumsum([0, *(v.steps.shape[1] for v in chosen_versions)])
    gram = marginal.blocks[0]
    chances, _ = sum_of_single_effects(gram, marginal.right, edges, _COMPONENTS)
    leaders = list(dict.fromkeys(int(row[:-1].argmax()) for row in chances if row[:-1].max() > LIKELY))[:2]
    if len(leaders) < 2:
        return None
    own = np.concatenate([np.arange(edges[g], edges[g + 1]) for g in leaders])
    width = np.array([0, len(own)])
    bounds = np.vstack([chosen_versions[g].bounds for g in leaders])
    factors, (mean,) = compare_groups(width, marginal.right[own], [gram[np.ix_(own, own)]], [bounds])
    split = np.split(mean, [edges[leaders[0] + 1] - edges[leaders[0]]])
    versions = [chosen_versions[g] for g in leaders]
    parts = tuple((v.hypothesis, v.deviation(m)) for v, m in zip(versions, split, strict=True))
    return parts, float(factors[0])


def _keep(best: dict[tuple[str, str], Proposal], proposal: Proposal) -> bool:
    """Keep a proposal if it is the best one of its effect; return whether it is."""
    if proposal.key in best and proposal.factor <= best[proposal.key].factor:
        return False
    best[proposal.key] = proposal
    return True


# -- refinement -------------------------------------------------------------------------------------------------------


def extensions(model: GapModel, now: Model, proposals: Sequence[Proposal]) -> list[Model]:
    """Refine the best proposals that the linear step holds for better than the model; all but the best are compact."""
    better = [p for p in proposals if p.factor > MIN_LOG_BAYES_FACTOR]
    effects, laws = [p for p in better if not p.law], {p.law.kind: p for p in reversed(better) if p.law}
    # the linear step may rank a family far too low; its best effect is refined where the others do not explain all
    rest = effects[_TRIED:]
    further = sorted({p.families: p for p in reversed(rest)}.values(), key=lambda p: -p.factor)[:_TRIED]
    found: list[Model] = []
    for index, proposal in enumerate((*effects[:_TRIED], *laws.values(), *further)):
        if index >= _TRIED + len(laws) and not all(map(is_incomplete, found)):
            break
        if (refined := refine(model, now, proposal)) is not None:
            best = min((*found, refined), key=lambda m: m.charged_score)
            found = [m if m is best else compact(model, m) for m in (*found, refined)]
    return found


def refine(model: GapModel, now: Model, proposal: Proposal) -> Model | None:
    """Fit a proposal together with a model, re-estimate the noise levels, and compute the evidence.

    Args:
        model: whose base is `now`; it is the base afterwards, too.
        now: the model.
        proposal: what is added.

    Returns:
        The extended model; None where it cannot follow the runs, or the change is not relevant.
    """
    guess, dense = now.guess, not proposal.parts
    if dense:
        group = model.uncertain_parameters(guess, proposal.parameter_scale)
        guess = guess.plus(group, np.zeros(group.size)) if group.size else guess
    found = model.refine(now.judged, Guess((*guess.parts, *proposal.parts)), proposal.scale, dense)
    if (
        found is None
        or linear_factor(found[1], range(len(now.guess.parts), len(found[1].guess.parts))) < MIN_LOG_BAYES_FACTOR
    ):
        return None
    return Model(found[0], found[1], found[1].whole_penalty)


def linear_factor(fit: Fit, chosen: Collection[int]) -> float:
    """Return twice the log Bayes factor of some parts of a fit by the errors alone, with kept noise levels.

    A parameter that only makes the predicted errors smaller, such as a leakage that damps their growth, lowers the
    objective without explaining a reading. Here it counts nothing.

    Args:
        fit: linearised about its parameters; the posterior is normal.
        chosen: indices of the parts.
    """
    part_of = np.repeat(np.arange(len(fit.guess.parts)), [h.size for h in fit.guess.hypotheses])
    own = np.isin(part_of, list(chosen))
    order = np.concatenate([np.flatnonzero(~own), np.flatnonzero(own)])
    deviation = fit.guess.deviation[own]
    precision = np.linalg.inv(invert_information(fit.information)[np.ix_(own, own)])
    penalty = occam_penalty(fit.information[np.ix_(order, order)], len(deviation))
    return float(deviation @ precision @ deviation) - penalty


def colour_noise(model: GapModel, now: Model) -> list[Model]:
    """Return a model with coloured noise of the channels whose readings show it, or nothing; no other part is new."""
    judged = model.propose_noise(now.judged, MIN_LOG_BAYES_FACTOR)
    return [Model(judged, now.fit, now.penalty)] if judged else []


def compare_colours(model: GapModel, now: Model) -> Model:
    """Find coloured noise again for the final set of effects; return the model with more evidence, the base."""
    judged = model.compare_noise(now.judged, MIN_LOG_BAYES_FACTOR)
    return now if judged is now.judged else settle(model, Model(judged, now.fit, now.penalty))


# -- removal and exchange ---------------------------------------------------------------------------------------------


def without_part(model: GapModel, given: Model, now: Model, index: int, rounds: Sequence[Round]) -> Model:
    """Return a model without one of its effects, fitted again; the larger model is the base afterwards."""
    guess = now.guess.without(index)
    key = now.guess.hypotheses[index].key
    # no difference between runs stands without the effect of its mean
    guess = Guess(tuple(p for p in guess.parts if p[0].name != BETWEEN_RUNS or effect_of(p[0].location) != key))
    if not guess.parts and not now.colours:
        return given
    for known in rounds:
        if keys_of(known.before) == {h.key for h in guess.hypotheses} and known.before.colours == now.colours:
            return known.before
    model.set_base(now.judged)
    rest = compact(model, settle(model, Model(model.judge(guess, reopened=True))))
    model.set_base(now.judged)
    return rest


def remove_needless(
    model: GapModel, given: Model, now: Model, rounds: Sequence[Round]
) -> tuple[Model, list[Model]]:  # fmt: skip
    """Remove effects, the weakest first, as long as that costs less than the smallest Bayes factor.

    Returns:
        The model, and for each of its parts the model without it.
    """
    while True:
        rests = [without_part(model, given, now, k, rounds) for k in range(len(now.guess.parts))]
        costs = [rest.score - now.score for rest in rests]
        if now.fit:
            costs = [min(cost, linear_factor(now.fit, [k])) for k, cost in enumerate(costs)]
        if not costs or min(costs) > MIN_LOG_BAYES_FACTOR:
            return now, rests
        now = rests[int(np.argmin(costs))]


def exchange(
    model: GapModel, now: Model, rests: Sequence[Model], rounds: Sequence[Round]
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
            other if is_same(origin.before, rest) else add_rival(model, rest, origin, other)
            for other in origin.others if _is_rival(keys_of(other) - keys_of(origin.before), taken)
        ]  # fmt: skip
        models = sorted((m for m in models if m.score < rest.score), key=lambda m: m.score)[:_RIVALS]
        models = [
            compact(model, settle(model, m, now.score + _CLOSE))
            if m.score < now.score + _CLOSE or is_of_family(m, hypothesis, taken)
            else m
            for m in models
        ]
        models.sort(key=lambda m: m.score)
        same_size = [m for m in models if len(m.guess.parts) == len(rests)]
        if best is now and same_size and same_size[0].score < now.score:
            best = same_size[0]
            new = keys_of(best) - keys_of(rest)  # a pair with the new effect is no rival of it
            models = [now, *(m for m in models if m is not best and not keys_of(m) & new)]
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


def add_rival(model: GapModel, rest: Model, origin: Round, other: Model) -> Model:
    """Fit a rival together with the rest of the model."""
    old = keys_of(origin.before)
    guess = rest.guess
    for hypothesis, deviation in other.guess.parts:
        if hypothesis.key not in old | keys_of(rest):
            guess = guess.plus(hypothesis, deviation)
    model.set_base(rest.judged)
    fit = model.fit(guess, 2)
    return compact(model, Model(model.judge(fit.guess), fit, fit.whole_penalty))


def _rival(model: Model, rest: Model) -> Rival:
    """Describe a model by the effect that it has in addition to the rest."""
    keys = [h.key for h in model.guess.hypotheses]
    index = next(k for k, key in enumerate(keys) if key not in keys_of(rest) and key[0] != CALIBRATION)
    hypothesis = model.guess.hypotheses[index]
    assert model.fit
    charge = occam_penalty(moved_last(model.fit.information, model.guess, index), hypothesis.size)
    return Rival(hypothesis, model.judged, charge, model.fit)
