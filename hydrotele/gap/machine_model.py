"""The reduced model of a hydraulic machine in a Kalman filter, as `gap.gap_model.GapModel`."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from hydrotele.estimate.colour import Colour
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged
from hydrotele.estimate.filter import Gains
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis, calibration
from hydrotele.estimate.levels import linear_filter, linear_run, propose_colours
from hydrotele.estimate.track import COARSE, Levels, Track, first_rows, row_variances, state_drift, track_run
from hydrotele.gap.backlash import BACKLASH, add_backlash, is_unexplained
from hydrotele.gap.calibrating import fit_until_settled
from hydrotele.gap.dictionary import Dictionary, Version, build_dictionary
from hydrotele.gap.disturbances import compare_disturbances, is_pulse, list_disturbances
from hydrotele.gap.gap_model import GapModel
from hydrotele.gap.laws import LawForm, LawHypothesis, best_prior, list_forms, list_pairs, states_after_rows
from hydrotele.gap.regression import OWN_SCALE, RESIDUAL_SCALES, LevelScale, NormalEquations, reweight_columns
from hydrotele.gap.run_differences import Quantity, list_quantities, rescale_between_runs
from hydrotele.gap.run_variables import Seen, see_run
from hydrotele.machine.machine import Machine

_CORRELATION_ROWS = (2.0, 6.0, 20.0, 60.0)  # correlation times of first-order noise in all channels, in rows of a log
_REFINEMENT = 1.7  # factor on the best of them, both ways: half of their distance
LINEAR_STEP_SECONDS = 12.0
"""Seconds of each run that the linear step uses; the refinement uses all."""
_LEAST_GAIN = 0.01  # twice the log likelihood: parameters within a tenth of their standard deviations
_STARTED = 2  # effects that are fitted from a start value in one round
_MAX_EFFECTS = 8  # rounds, so that a search ends where no effect of the library is right


class MachineModel(GapModel):
    """Evidence on the runs of a hydraulic machine, see `gap.gap_model.GapModel`."""

    max_effects = _MAX_EFFECTS
    level_scales = tuple(LevelScale(size) for size in RESIDUAL_SCALES)

    def __init__(self, evidence: Evidence) -> None:
        """Take the evidence, with noise levels that it estimates."""
        self.evidence = evidence
        self.run_names = tuple(run.name for run in (*evidence.runs, evidence.data.heldout))
        self.keep: Callable[[Judged], None] = lambda judged: evidence.keep(judged)

    def prepare(self, candidates: Sequence[Hypothesis], given: Judged) -> list[Hypothesis]:
        """Return the candidates: pulses start where their interval has the largest Bayes factor."""
        return list(candidates)

    def uncertain_parameters(self, guess: Guess, scale: float = 1.0) -> Hypothesis:
        """Return the uncertain parameters of the machine file, without those of the effects that are there."""
        if any(h.name == CALIBRATION for h in guess.hypotheses):
            return Hypothesis(CALIBRATION, "all", {})
        group = calibration(self.evidence.data.machine, frozenset(guess.names))
        table = {k: dataclasses.replace(p, prior_std=scale * p.prior_std) for k, p in group.parameters.items()}
        return dataclasses.replace(group, parameters=table)

    def judge(self, guess: Guess, same: bool = False, reopened: bool = False) -> Judged:
        """Re-estimate the noise levels of a set of effects."""
        return self.evidence.judged(guess, same, reopened)

    def judge_from(self, guess: Guess, judged: Judged) -> Judged:
        """Re-estimate the noise levels of a set of effects from those of another model."""
        return self.evidence.judged_from(guess, judged.tracks[0].levels)

    def set_base(self, judged: Judged) -> Judged:
        """Set the base of later errors."""
        return self.evidence.set_base(judged)

    def compact(self, judged: Judged) -> Judged:
        """Leave out gains and Jacobians."""
        return judged.compact()

    def fit(self, guess: Guess, steps: int) -> Fit:
        """Fit with the gains of the base."""
        return self.evidence.fit(guess, 0.0, steps=steps, step=MIDDLE)

    def settle(self, judged: Judged, wanted: float = np.inf) -> tuple[Judged, Fit]:
        """Alternate fits and estimates of the noise levels."""
        found = fit_until_settled(self.evidence, judged, wanted, _LEAST_GAIN)
        return rescale_between_runs(*found, self.evidence.runs)

    def refine(self, now: Judged, guess: Guess, scale: LevelScale, dense: bool) -> tuple[Judged, Fit] | None:
        """Fit an extension on the nonlinear filter and re-estimate its noise levels."""
        evidence = self.evidence
        tracks = tuple(scale_residual_inputs(t, scale.residual) for t in now.tracks)
        evidence.set_base(Judged(now.guess, tracks, now.loss))
        try:
            kept = evidence.slopes(guess, evidence.errors(guess, COARSE), step=COARSE) if dense else None
            fit = evidence.fit(guess, 0.0, steps=4, step=MIDDLE, kept=kept)
            count = len(now.guess.parts)
            added = [part for part in fit.guess.parts[count:] if not is_irrelevant(*part)]
            if not np.isfinite(fit.loss) or not added:
                return None
            if len(added) < len(guess.parts) - count:  # one effect of a pair is not there
                fit = evidence.fit(Guess((*fit.guess.parts[:count], *added)), 0.0, steps=4, step=MIDDLE)
            evidence.set_base(now)
            if scale.residual == 1.0:
                judged = evidence.judged(fit.guess)
            else:
                judged = evidence.judged_from(fit.guess, tracks[0].levels)
        finally:
            evidence.set_base(now)
        return rescale_between_runs(judged, fit, evidence.runs) if np.isfinite(judged.loss) else None

    def linearise(self, guess: Guess, versions: Sequence[Version], uncertain: Hypothesis) -> "FilterLinearisation":
        """Compute columns in the first seconds of each run."""
        tracks = [_first_seconds(track) for track in self.evidence.tracks]
        table = build_dictionary(self.evidence, guess, versions, uncertain, tracks)
        rows = sum(len(t.whitened) for t in self.evidence.tracks)
        machine = guess.machine(self.evidence.data.machine)
        return FilterLinearisation(self.evidence, machine, tracks, table, sum(len(t.whitened) for t in tracks) / rows)

    def list_quantities(self, candidates: Sequence[Hypothesis]) -> Mapping[str, Quantity]:
        """Return uncertain parameters, and those of effects with one; none of a single run."""
        if len(self.evidence.runs) < 2:
            return {}
        return list_quantities(self.evidence.data.machine, candidates)

    def compare_disturbances(
        self, judged: Judged, candidates: Sequence[Hypothesis]
    ) -> list[tuple[tuple[Hypothesis, np.ndarray], float, LevelScale]]:
        """Compare them on all rows of the runs."""
        evidence, taken = self.evidence, {h.key for h in judged.guess.hypotheses}
        tried = [h for h in list_disturbances(evidence.data, candidates, judged) if h.key not in taken]
        found = []
        for scale in self.level_scales if tried else ():
            tracks = evidence.map(lambda track, rho=scale.residual: scale_residual_inputs(track, rho), evidence.tracks)
            gained = sum(old.loss - new.loss for old, new in zip(evidence.tracks, tracks, strict=True))
            found += [(part, gained + f, scale) for part, f in compare_disturbances(tried, tracks, evidence.map)]
        return found

    def try_start_values(self, judged: Judged, candidates: Sequence[Hypothesis]) -> list[Judged]:
        """Filter the run that fits worst with each start value of the effects that state some; judge the best ones.

        A filter that believes late readings follows them, so the response of its errors to a delay has the wrong sign.
        Here the filter has the effect, and no residual inputs, which would hide it.
        """
        evidence, levels = self.evidence, judged.tracks[0].levels
        if not levels.inputs:
            return []
        machine, taken = judged.guess.machine(evidence.data.machine), {h.key for h in judged.guess.hypotheses}
        worst = max(judged.tracks, key=lambda t: float(np.nanmean(t.whitened**2))).run
        run = worst.select_rows(0, round(LINEAR_STEP_SECONDS / worst.period))
        own = dataclasses.replace(levels, inputs=(), sizes=np.zeros(0))

        def loss(start: tuple[Hypothesis, np.ndarray] | None) -> float:
            changed = start[0].machine(machine, start[1]) if start else machine
            return track_run(changed, evidence.data, run, None, evidence.step, own).loss

        starts = [
            (h, s) for h in candidates if h.key not in taken and not is_pulse(h) for s in h.starts if np.any(s)
        ]  # fmt: skip
        before, *losses = evidence.map(loss, [None, *starts])
        best: dict[tuple[str, str], tuple[float, int]] = {}
        for index, after in enumerate(losses):
            if after < min(before, best.get(starts[index][0].key, (np.inf, 0))[0]):
                best[starts[index][0].key] = after, index
        chosen = [starts[index] for _, index in sorted(best.values())[:_STARTED]]
        evidence.set_base(judged)
        found = [
            add_backlash(evidence, judged.guess, h.location)
            if h.name == BACKLASH
            else evidence.judged(judged.guess.plus(h, start), reopened=True)
            for h, start in chosen
        ]
        return [one for one in found if one and np.isfinite(one.loss)]

    def search_backlash(
        self, judged: Judged, effect: Hypothesis, tell: Callable[[str, float], None]
    ) -> Judged | None:  # fmt: skip
        """Search backlash of an axis whose motion the model does not explain."""
        if effect.key in {h.key for h in judged.guess.hypotheses} or not is_unexplained(judged, effect.location):
            return None
        tell(f"search for backlash of the {effect.location}", 0.7)
        return add_backlash(self.evidence, judged.guess, effect.location)

    def select_priors(self, guess: Guess) -> Guess:
        """Select priors in the linearised model of all rows."""
        evidence = self.evidence
        parts, slopes, first = list(guess.parts), evidence.base_slopes(evidence.slope_step), 0
        for index, (hypothesis, deviation) in enumerate(guess.parts):
            own = slice(first, first + hypothesis.size)
            first += hypothesis.size
            if not isinstance(hypothesis, LawHypothesis):
                continue
            form = hypothesis.form
            columns = evidence.responses(form.hypothesis(np.eye(form.basis.shape[1])), evidence.tracks)
            assert columns is not None
            target = columns @ (hypothesis.root @ deviation) - evidence.base_errors
            others = np.delete(slopes, own, axis=1)
            marginal = NormalEquations.of(target, [columns], others).marginalise(np.full(others.shape[1], OWN_SCALE))
            _, root, mean = best_prior(form, marginal.right, marginal.blocks[0])
            parts[index] = form.hypothesis(root), mean
        return Guess(tuple(parts))

    def propose_noise(self, judged: Judged, min_gain: float) -> Judged | None:
        """Propose coloured noise from the spectra of the smoothed noise."""
        levels = propose_colours(self.evidence.data, judged.tracks, min_gain)
        if levels is None:
            return None
        found = self.evidence.judged_from(judged.guess, levels)
        return found if np.isfinite(found.loss) else None

    def compare_noise(self, judged: Judged, min_gain: float) -> Judged:
        """Find coloured noise again, now with the same correlation time in all channels, too.

        Slow noise of several sensors is explained by residual inputs as well, and each channel alone then shows too
        little of it. So all channels get a first-order part at once, and the residual inputs must bring their evidence
        anew. Coloured noise that was found before an effect that changes the spectra is looked for again. Without
        residual inputs and coloured noise, none of it can be hidden.
        """
        evidence, levels = self.evidence, judged.tracks[0].levels
        if not levels.inputs and not levels.colours:
            return judged
        total, shares = levels.noise.copy(), np.full(len(levels.noise), np.sqrt(0.5))
        for colour in levels.colours:
            total[colour.channel] = np.hypot(total[colour.channel], colour.size)
        period = max(track.run.period for track in judged.tracks)

        def charged_score(found: Judged) -> float:
            return found.loss + min_gain * len(found.tracks[0].levels.colours)

        def with_noise(white: np.ndarray, colours: tuple[Colour, ...]) -> Judged:
            evidence.set_base(judged)
            start = dataclasses.replace(levels, noise=white, colours=colours, inputs=(), sizes=np.zeros(0))
            return evidence.judged_from(judged.guess, start)

        def first_order(rows: float) -> Judged:
            colours = (Colour(c, float(size), rows * period) for c, size in enumerate(shares * total))
            return with_noise(shares * total, tuple(colours))

        common = {rows: first_order(rows).compact() for rows in _CORRELATION_ROWS}
        best_rows = min(common, key=lambda rows: charged_score(common[rows]))
        common |= {rows: first_order(rows).compact() for rows in (best_rows / _REFINEMENT, best_rows * _REFINEMENT)}
        found = [judged, *common.values()]
        if levels.colours:
            white = with_noise(total, ())
            evidence.set_base(white)
            again = self.propose_noise(white, min_gain)
            found += [white, *([again] if again else [])]
        return evidence.set_base(min(found, key=charged_score))


def is_irrelevant(hypothesis: Hypothesis, deviation: np.ndarray) -> bool:
    """Return whether an effect changes every parameter by less than the library states as the smallest relevant change.

    A long log shows a difference of two integrators as a bandwidth that is 0.5 % off.
    """
    return bool(np.all(np.abs(deviation) < hypothesis.least))


@dataclass(frozen=True)
class FilterLinearisation:
    """Columns of the linearised filter, see `gap.gap_model.Linearisation`.

    Attributes:
        evidence: the runs.
        machine: the model.
        tracks: of the first seconds of each run.
        table: the columns.
        fraction: of the rows that the columns hold.
        units: balance and axis -> what a unit changes in the states of each track.
    """

    evidence: Evidence
    machine: Machine
    tracks: Sequence[Track]
    table: Dictionary
    fraction: float
    units: dict[tuple[str, str], list[np.ndarray]] = field(default_factory=dict)

    @property
    def versions(self) -> Sequence[Version]:
        """The versions of the dictionary."""
        return self.table.versions

    @property
    def is_own(self) -> np.ndarray:
        """Return (K,) whether a nuisance column is a parameter of the model."""
        return self.table.own

    @property
    def laws(self) -> Sequence[LawForm]:
        """The laws of the dictionary."""
        return self.table.laws

    @property
    def parameters(self) -> Sequence[tuple[str, float]]:
        """Name and prior standard deviation of each nuisance column."""
        return self.table.parameters

    @cached_property
    def unchanged_runs(self) -> list[np.ndarray]:
        """States of the model a row after those of each track, for the changes that laws make."""
        return self.evidence.map(lambda track: states_after_rows(self.machine, track), self.tracks)

    @cached_property
    def seen_runs(self) -> list[Seen]:
        """Variables of each run."""
        return [see_run(self.machine, self.evidence.data, track) for track in self.tracks]

    def list_laws(self, judged: Judged, effects: Collection[str], has_laws: bool) -> list[LawForm]:
        """Return laws of the balances with residual inputs."""
        return list_forms(self.evidence, judged, self.seen_runs, effects, has_laws)

    def list_pairs(self, single: LawForm) -> list[LawForm]:
        """Return products with the other variables of the drive."""
        return list_pairs(self.seen_runs, single)

    def with_laws(self, laws: Sequence[LawForm]) -> "FilterLinearisation":
        """Return the same with the columns of laws."""
        new = {(law.balance, law.axis): law for law in laws if (law.balance, law.axis) not in self.units}
        tracks, unchanged_runs, each = self.tracks, self.unchanged_runs, self.evidence.map

        def change(law: LawForm) -> list[np.ndarray]:
            pairs = zip(tracks, unchanged_runs, strict=True)
            return [law.unit_changes(self.machine, track, unchanged) for track, unchanged in pairs]

        self.units.update(zip(new, each(change, list(new.values())), strict=True))
        table = self.table.with_laws(laws, self.units, tracks, self.seen_runs, each)
        return dataclasses.replace(self, table=table)

    def equations(self, scale: LevelScale, joined: Sequence[int] = ()) -> tuple[list[NormalEquations], float]:
        """Run the filter again on its own linearisation with the residual inputs scaled."""
        tracks, table = self.tracks, self.table
        groups = table.law_columns if table.laws else table.columns
        if joined:
            groups = (np.hstack([groups[g] for g in joined]),)
        edges = np.cumsum([0, *(t.whitened.size for t in tracks)])
        widths = np.cumsum([0, *(c.shape[1] for c in groups), table.nuisance.shape[1]])

        def of_run(index: int) -> tuple[NormalEquations, float]:
            track, rows = tracks[index], slice(edges[index], edges[index + 1])
            scaled = scale_residual_inputs(track, scale.residual)
            columns = np.hstack([*(c[rows] for c in groups), table.nuisance[rows]]).astype(float)
            missing = ~np.isfinite(track.whitened)
            if scale.residual != 1.0:
                there = columns.reshape(*track.whitened.shape, -1)
                there *= np.where(missing, 0.0, track.gains.spread)[:, :, None]
                reweight_columns(
                    track.gains.slope, track.flow, missing, track.gains.gain, scaled.gains.gain, there,
                )  # fmt: skip
                there /= np.where(missing, 1.0, scaled.gains.spread)[:, :, None]
            parts = [columns[:, a:b] for a, b in zip(widths[:-2], widths[1:-1], strict=True)]
            errors = -np.nan_to_num(scaled.whitened).ravel()
            return NormalEquations.of(errors, parts, columns[:, widths[-2] :]), scaled.loss

        found = self.evidence.map(of_run, range(len(tracks)))
        return [terms for terms, _ in found], sum(loss for _, loss in found)


def _first_seconds(track: Track) -> Track:
    """Return the first seconds of a linearised track, with its transition Jacobians."""
    rows = round(LINEAR_STEP_SECONDS / track.run.period)
    first = dataclasses.replace(first_rows(track, rows), flow=track.flow[:rows])
    there = np.isfinite(first.whitened)
    loss = float(np.sum(first.whitened[there] ** 2 + 2.0 * np.log(first.gains.spread[there])))
    return dataclasses.replace(first, loss=loss)


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
