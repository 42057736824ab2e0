"""The reduced model of a hydraulic machine in a Kalman filter, as `gap.gap_model.GapModel`."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.estimate.colour import Colour
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged
from hydrotele.estimate.filter import Gains
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis, calibration
from hydrotele.estimate.levels import linear_filter, linear_run, propose_colours
from hydrotele.estimate.track import COARSE, Levels, Track, first_rows, row_variances, state_drift
from hydrotele.gap.calibrating import fit_until_settled
from hydrotele.gap.dictionary import Dictionary, Version, build_dictionary
from hydrotele.gap.regression import NormalEquations, reweight_columns
from hydrotele.gap.screening import timed

_CORRELATION_ROWS = (2.0, 6.0, 20.0, 60.0)  # correlation times of first-order noise in all channels, in rows of a log
_REFINEMENT = 1.7  # factor on the best of them, both ways: half of their distance
_SECONDS = 12.0  # s of each run that the linear step uses; the refinement uses all
_MAX_EFFECTS = 8  # rounds, so that a search ends where no effect of the library is right


class MachineModel:
    """Evidence on the runs of a hydraulic machine, see `gap.gap_model.GapModel`."""

    max_effects = _MAX_EFFECTS

    def __init__(self, evidence: Evidence) -> None:
        """Take the evidence, with noise levels that it estimates."""
        self.evidence = evidence
        self.keep: Callable[[Judged], None] = lambda judged: evidence.keep(judged)

    def prepare(self, candidates: Sequence[Hypothesis], given: Judged) -> list[Hypothesis]:
        """Let effects that act for a while start where the residual force of the given machine is largest."""
        return timed(candidates, given)

    def uncertain_parameters(self, guess: Guess, scale: float = 1.0) -> Hypothesis:
        """Return the uncertain parameters of the machine file, without those of the effects that are there."""
        if any(h.name == CALIBRATION for h in guess.hypotheses):
            return Hypothesis(CALIBRATION, "all", {})
        group = calibration(self.evidence.data.machine, frozenset(guess.names))
        table = {k: dataclasses.replace(p, prior_std=scale * p.prior_std) for k, p in group.parameters.items()}
        return dataclasses.replace(group, parameters=table)

    def judged(self, guess: Guess, same: bool = False, reopened: bool = False) -> Judged:
        """Re-estimate the noise levels of a guess."""
        return self.evidence.judged(guess, same, reopened)

    def set_base(self, judged: Judged) -> Judged:
        """Set the base of later errors."""
        return self.evidence.set_base(judged)

    def fit(self, guess: Guess, steps: int) -> Fit:
        """Fit with the gains of the base."""
        return self.evidence.fit(guess, 0.0, steps=steps, step=MIDDLE)

    def settle(self, judged: Judged) -> tuple[Judged, Fit]:
        """Alternate fits and estimates of the noise levels."""
        return fit_until_settled(self.evidence, judged)

    def refine(self, now: Judged, guess: Guess, residual_scale: float, dense: bool) -> tuple[Judged, Fit] | None:
        """Fit an extension on the nonlinear filter and re-estimate its noise levels."""
        evidence = self.evidence
        tracks = tuple(scale_residual_inputs(t, residual_scale) for t in now.tracks)
        evidence.set_base(Judged(now.guess, tracks, now.loss))
        try:
            kept = evidence.slopes(guess, evidence.errors(guess, COARSE), step=COARSE) if dense else None
            fit = evidence.fit(guess, 0.0, steps=4, step=MIDDLE, kept=kept)
            if not np.isfinite(fit.loss):
                return None
            evidence.set_base(now)
            if residual_scale == 1.0:
                judged = evidence.judged(fit.guess)
            else:
                judged = evidence.judged_from(fit.guess, tracks[0].levels)
        finally:
            evidence.set_base(now)
        return (judged, fit) if np.isfinite(judged.loss) else None

    def linearise(self, guess: Guess, versions: Sequence[Version], uncertain: Hypothesis) -> "FilterLinearisation":
        """Compute columns in the first seconds of each run."""
        tracks = [_first_seconds(track) for track in self.evidence.tracks]
        table = build_dictionary(self.evidence, guess, versions, uncertain, tracks)
        rows = sum(len(t.whitened) for t in self.evidence.tracks)
        return FilterLinearisation(self.evidence, tracks, table, sum(len(t.whitened) for t in tracks) / rows)

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
        anew. Coloured noise that was found before an effect that changes the spectra is looked for again.
        """
        evidence, levels = self.evidence, judged.tracks[0].levels
        total, shares = levels.noise.copy(), np.full(len(levels.noise), np.sqrt(0.5))
        for colour in levels.colours:
            total[colour.channel] = np.hypot(total[colour.channel], colour.size)
        period = max(track.run.period for track in judged.tracks)

        def charged(found: Judged) -> float:
            return found.loss + min_gain * len(found.tracks[0].levels.colours)

        def with_noise(white: np.ndarray, colours: tuple[Colour, ...]) -> Judged:
            evidence.set_base(judged)
            start = dataclasses.replace(levels, noise=white, colours=colours, inputs=(), sizes=np.zeros(0))
            return evidence.judged_from(judged.guess, start)

        def first_order(rows: float) -> Judged:
            colours = (Colour(c, float(size), rows * period) for c, size in enumerate(shares * total))
            return with_noise(shares * total, tuple(colours))

        common = {rows: first_order(rows) for rows in _CORRELATION_ROWS}
        best_rows = min(common, key=lambda rows: charged(common[rows]))
        common |= {rows: first_order(rows) for rows in (best_rows / _REFINEMENT, best_rows * _REFINEMENT)}
        found = [judged, *common.values()]
        if levels.colours:
            white = with_noise(total, ())
            evidence.set_base(white)
            again = self.propose_noise(white, min_gain)
            found += [white, *([again] if again else [])]
        return evidence.set_base(min(found, key=charged))


@dataclass(frozen=True)
class FilterLinearisation:
    """Columns of the linearised filter, see `gap.gap_model.Linearisation`."""

    evidence: Evidence
    tracks: Sequence[Track]
    table: Dictionary
    fraction: float

    @property
    def versions(self) -> Sequence[Version]:
        """The versions of the dictionary."""
        return self.table.versions

    @property
    def own(self) -> np.ndarray:
        """Return (K,) whether a nuisance column is a parameter of the model."""
        return self.table.own

    def equations(self, residual_scale: float, joined: Sequence[int] = ()) -> tuple[NormalEquations, float]:
        """Run the filter again on its own linearisation with the residual inputs scaled."""
        tracks, table = self.tracks, self.table
        if joined:
            table = dataclasses.replace(table, columns=(np.hstack([table.columns[g] for g in joined]),))
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

        found = self.evidence.map(of_run, range(len(tracks)))
        terms = found[0][0]
        for other, _ in found[1:]:
            terms = terms + other
        return terms, sum(loss for _, loss in found)


def _first_seconds(track: Track) -> Track:
    """Return the first seconds of a linearised track, with its transition Jacobians."""
    rows = round(_SECONDS / track.run.period)
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
