"""The workflow: find, name, calibrate, learn, add, show; from a Dataset to a Gap."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from hydrotele.effects import locate_error_in_effect_file
from hydrotele.effects.effect import with_value
from hydrotele.estimate.colour import Colour
from hydrotele.estimate.evidence import Evidence, Judged, posterior_covariance
from hydrotele.estimate.filter import input_sizes, input_units
from hydrotele.estimate.hypothesis import CALIBRATION, LEARNED, Guess, Hypothesis, hypotheses, limit_to_domain
from hydrotele.estimate.levels import rippled, stated_jitter
from hydrotele.estimate.track import STEP, Levels, Track, known_levels, track_run
from hydrotele.gap.answer import answer_document, answer_words
from hydrotele.gap.balances import run_balances
from hydrotele.gap.calibrating import (
    FreeCalibration,
    calibrate_freely,
)
from hydrotele.gap.description import describe, effect_title, learned_laws
from hydrotele.gap.experiment import next_experiment
from hydrotele.gap.explanation import compare_contenders, list_rejections, trace_inputs
from hydrotele.gap.heldout import compare_heldout
from hydrotele.gap.initial_regressions import run_initial_regressions, with_start_values
from hydrotele.gap.interim import Interim, keep_better
from hydrotele.gap.laws import LawHypothesis, learned_of, with_profile
from hydrotele.gap.machine_model import MachineModel
from hydrotele.gap.model_search import search_model
from hydrotele.gap.posterior import Posterior, sample_posterior
from hydrotele.gap.residuals import (
    constancy,
    has_sizes,
    left_over,
    perfect_tracks,
    residual_tests,
    rms,
)
from hydrotele.gap.result import (
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
    Verdict,
    VerdictExplanation,
)
from hydrotele.gap.rivals import TOLD, Found, effect_probabilities
from hydrotele.gap.run_differences import (
    NUISANCE,
    between_run_differences,
    difference_words,
    list_quantities,
    widen_to_new_run,
)
from hydrotele.gap.verdict import compare_held_out, count_unexplained, verdict_of
from hydrotele.logs.dataset import Dataset, RunData, exchange_heldout
from hydrotele.logs.dataset_reduction import downsample, select_exciting_segments
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.machine import Machine

_WORTH_TELLING = 0.005  # probability below which an alternative is left out
_ALIKE = 1.0e-3  # of the squares of what an effect changes: readings that are alike to 3 %
_NORMAL95 = 1.96
_FLOOR = (0.5, 2.0)  # RMS between which a perfect model's errors must lie
_OFF = 0.05  # by which noise must differ from the stated to be noted
_JITTER = 0.2  # by which jitter must
_FAR = 3.0  # stated uncertainties, by which a calibrated number must
Progress = Callable[[str, float], None]


# The search's own workers take the processors; threads of BLAS beside them wait for one another,
# and products of matrices then take ten times as long. Nor may results depend on their number.
@threadpool_limits.wrap(limits=1, user_api="blas")
def find_gap(
    data: Dataset,
    progress: Progress | None = None,
    effects: Sequence[str] = (),
    jobs: int = 2,
    keep: Callable[[Interim], None] | None = None,
    warn: Callable[[str], None] = lambda text: None,
    *,
    may_exchange: bool = True,
) -> Gap:
    """Find the physical effects that explain the difference between a model and its logs.

    Args:
        data: the logs; the effects are fitted to the fit runs and tested on the held-out run.
        progress: called with (name of the present step, completed fraction).
        effects: names of the effects to test; all if empty. If some are named, no law is learned and
            open-loop predictions calibrate nothing, because the cause may be an effect that was not tested.
        jobs: number of processes.
        keep: called with the best answer so far, each time that there is a better one.
        warn: called with one sentence per gross error of the logs, before the search.
        may_exchange: whether the search may hold out another run, if the held-out run shows an effect that the
            fitted runs do not show and do not contradict.

    Returns:
        The result of the search.

    Raises:
        CannotFollowError: the filter of the given machine cannot follow the readings.
        InputError: a custom effect allows no value, or its file raised an error.

    Examples:
        Two logs of a rig with a friction of 600 N, and a model with 150 N. Two effects are tried instead of all.

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
        >>> gap = ht.find_gap(data, effects=["coulomb_friction", "valve_gain"], jobs=1)
        >>> gap.verdict
        'named'
        >>> for effect in gap.effects:
        ...     found = effect.parameters["coulomb"]
        ...     print(effect.name, effect.location, f"{found.value:.0f} +- {0.5 * (found.high - found.low):.0f} N")
        coulomb_friction slide 594 +- 8 N
    """
    begin = time.perf_counter()
    report = progress or (lambda text, share: None)
    logged, given, notes = data, data.machine, []
    opened = None if effects else calibrate_freely(data, jobs, lambda text: report(text, 0.0))
    if opened:
        data = dataclasses.replace(data, machine=opened.machine)
        notes.append(opened.note)
    candidates, errors = limit_to_domain(hypotheses(data.machine, effects), data.machine)
    for error in errors:
        if error.__cause__ and (own := locate_error_in_effect_file(error.__cause__)):
            raise own
        notes.append(f"Not tried: {error}.")
    data = downsample(select_exciting_segments(data))
    report("run initial regressions", 0.0)
    initial = run_initial_regressions(data)
    for gross in initial.errors:
        warn(gross.description)
    candidates = with_start_values(candidates, initial)
    evidence = Evidence(data, data.fit, jobs, STEP, lacking=True)
    interim = keep_better(data.machine, keep, begin) if keep else lambda judged: None
    leader = ""

    def keep_best(judged: Judged) -> None:
        nonlocal leader
        leader = best_words(judged.guess)
        interim(judged)

    def tell(text: str, share: float) -> None:
        report(f"{text}; best so far: {leader}" if leader else text, share)

    evidence.keep = keep_best
    try:
        found = search_model(MachineModel(evidence), candidates, tell, has_laws=not effects)
        tell("compare the held-out run with the fitted runs", 0.92)
        own = compare_heldout(evidence, found, candidates)
        found = own.found
        if own.is_open and may_exchange:
            report("hold out another run", 0.0)
            return find_gap(exchange_heldout(logged), progress, effects, jobs, keep, warn, may_exchange=False)
        held_out = None
        if found.guess.parts:
            tell("compare with the given machine on the held-out run", 0.94)
            held_out = compare_held_out(evidence, found.base, found.judged)
            if held_out.is_worse:
                notes.append(held_out.words)
                found = found.emptied()
                keep_best(evidence.set_base(found.base))
        tell("evaluate on the held-out run", 0.96)
        outcome = _Outcome.of(evidence, found.judged, given)
        nominal, patched, judge = data.machine, outcome.patched, outcome.judge
        before, after = outcome.asked, outcome.after
        tests, floor = judge.tests(evidence, found.judged, after)
        evidence.set_base(found.judged)
        scatter = tests.get("constancy", {}).get("value", 1.0)
        covariance = posterior_covariance(evidence, found.guess, scatter)
        laws = learned_of(evidence, found.judged, covariance)
        spread = np.sqrt(np.diag(covariance))
        differences = (*between_run_differences(found.guess, covariance, own.spread), *own.differences)
        notes += [difference_words(d) for d in differences]
        notes += [
            f"{h.name} of {h.location} acts in {', '.join(h.runs)}; the corrected machine does not contain it."
            for h in found.guess.hypotheses if h.runs and h.name not in NUISANCE
        ]  # fmt: skip
        shares = judge.shares(found.guess, before, after, floor, evidence.map)
        traces = trace_inputs(evidence.data, found.base, found.judged)
    finally:
        evidence.close()
    learned = learned_laws([law for law in laws if not law.form_of], nominal, shares)
    profiles = {law.hypothesis.key: law for law in laws if law.form_of}
    named = _named(found, spread, shares)
    named = tuple(with_profile(data.machine, e, profiles.get((e.name, e.location))) for e in named)
    left = left_over(before[0], after[0], data.channels, floor)
    named = count_unexplained(
        named, learned, left, _lost(tests, learned), [run.name for run in (data.heldout, *data.fit)]
    )
    size = GapSize(rms(before[:1]), rms(after[:1]), floor)
    # process noise may stand for what is missing
    bounded = dataclasses.replace(size, noise_floor=None) if judge.ripple else size
    is_worse = held_out is not None and held_out.is_worse  # a gap of the fitted runs remains
    failed = is_worse or any(not test["passed"] for test in tests.values())
    verdict = verdict_of(named, learned, failed, bounded)
    notes += [words for effect in named if (words := answer_words(effect))]
    if held_out and not is_worse:
        notes.append(held_out.words)
    lacks = _lacks(data.machine, found.judged)
    predictions = tuple(_prediction(t, data) for t in before)
    improved = tuple(_prediction(t, data) for t in after)
    unknown = None
    if failed or learned:
        unknown = describe(lacks, learned, improved)
    laws, units = _laws(dataclasses.replace(data, machine=given), patched, judge.levels.noise)
    tell("done", 1.0)
    calibration = _calibration(found.guess, spread)
    if opened:  # what free runs left uncertain was the search's prior, not the machine's
        patched = with_value(patched, "uncertainty", given.uncertainty)
    jitter = _jitter(data, judge.levels)
    if jitter[0] != jitter[1] and data.sensors:
        patched = with_value(patched, f"sensors.{data.sensors}.jitter", jitter[0])
    posterior = None
    if named or calibration or opened or differences:
        fits = widen_to_new_run(found.guess, covariance, data.machine, list_quantities(data.machine, candidates))
        posterior = _sample_posterior(data, given, opened, fits, judge.levels)
    return Gap(
        machine=given,
        patched=patched,
        verdict=verdict,
        effects=named,
        unknown=unknown if verdict != "no_gap" else None,
        size=size,
        ranking=tuple(
            Candidate(
                s.hypothesis.name, s.hypothesis.location, s.factor,
                {} if isinstance(s.hypothesis, LawHypothesis) else s.hypothesis.values(s.deviation),
                {key: p.unit for key, p in s.hypothesis.parameters.items()},
            )
            for s in found.ranking[:15]
        ),
        before=predictions,
        after=improved,
        laws=laws,
        law_units=units,
        tests=tests,
        next_experiment=_experiment(given, verdict, named, unknown),
        calibration=_all_calibrated(opened.numbers if opened else {}, calibration, named),
        learned=learned,
        lacks=lacks,
        noise=_noise(data, judge.levels),
        jitter=jitter,
        notes=(*data.notes, *notes, *_notes(found, data, judge.levels, floor)),
        unused_channels=data.unused_channels,
        answers=tuple(answer_document(named)),
        initial=initial,
        explanation=VerdictExplanation(
            compare_contenders(found, named),
            list_rejections(found, named, [n for n in notes if "rejected" in n]),
            traces,
        ),
        posterior=posterior,
        differences=differences,
        seconds=time.perf_counter() - begin,
    )  # fmt: skip


def best_words(guess: Guess) -> str:
    """Name what a hypothesis consists of, for a progress display; empty for the given machine.

    >>> best_words(Guess(((Hypothesis("payload", "tool", {}), np.zeros(0)),)))
    'payload at the tool'
    """
    words = []
    for hypothesis in guess.hypotheses:
        if hypothesis.name == CALIBRATION:
            words.append("calibrated parameters")
        elif hypothesis.name.startswith(LEARNED):
            words.append("a learned law")
        else:
            words.append(effect_title(Alternative(*hypothesis.key, 0.0)))
    return " and ".join(dict.fromkeys(words))


class _Judge:
    """Tracks that only the sensors' noise may disturb, with the noise that was found."""

    def __init__(self, data: Dataset, judged: Judged) -> None:
        found = judged.tracks[0].levels
        self.data, self.ripple = data, rippled(found)
        drift = found.drift if self.ripple else {}
        self.levels = Levels(found.noise, drift=drift, jitter=found.jitter, colours=found.colours)
        self.runs = (data.heldout, *data.fit)

    def tracks(
        self, models: Sequence[Machine | Guess], each: Callable, runs: Sequence | None = None
    ) -> list[tuple[Track, ...]]:
        """Per model the tracks of the held-out run and the fit runs, or of some runs."""
        runs = self.runs if runs is None else runs
        pairs = [(self.machine_in(model, run), run) for run in runs for model in models]
        found = list(each(
            lambda pair: track_run(pair[0], self.data, pair[1], levels=self.levels), pairs,
        ))  # fmt: skip
        return [tuple(found[k :: len(models)]) for k in range(len(models))]

    def machine_in(self, model: Machine | Guess, run: RunData) -> Machine:
        """Return the machine of a model in a run."""
        return model if isinstance(model, Machine) else model.machine(self.data.machine, run.name)

    def tests(self, evidence: Evidence, judged: Judged, tracks: Sequence[Track]) -> tuple[dict, float | None]:
        """Tests of what a guess leaves, and the noise floor: what readings of its own leave.

        A floor is refused where the perfect machine's own runs cannot be followed: they left the
        model's range, or the filter does not hold them. With process noise (ripple, contact, what
        the rows are too slow for) or coloured noise of sensors it is that noise that the floor counts,
        by definition 1.
        """
        noisy = dataclasses.replace(self.data, noise=self.levels.noise)
        known = self.ripple or bool(self.levels.colours)
        machines = [self.machine_in(judged.guess, track.run) for track in tracks]
        perfect = () if known else perfect_tracks(machines, noisy, tracks, evidence.map)
        floor = 1.0 if known else rms(perfect[:1])
        holds = np.isfinite(floor) and _FLOOR[0] < floor < _FLOOR[1]
        clean = holds and not known
        tests = residual_tests(tracks, self.data.channels, perfect if clean else ())
        if clean and has_sizes(judged.guess):
            made = Evidence(noisy, [track.run for track in perfect[1:]], 1, evidence.step)
            try:
                evidence.set_base(judged)
                made.set_base(judged.guess)
                tests["constancy"] = constancy(evidence, judged.guess, made)
            finally:
                made.close()
        return tests, floor if holds else None

    def shares(
        self, guess: Guess, before: Sequence[Track], after: Sequence[Track], floor: float | None, each: Callable,
    ) -> dict[tuple[str, str], float]:  # fmt: skip
        """Part -> share of the held-out run's gap that comes back without it.

        Of what acts for a while only, it is the share of all runs' gap.
        """

        def share(index: int) -> float:
            hypothesis = guess.parts[index][0]
            once = hypothesis.runs or {"start", "duration"} <= hypothesis.parameters.keys()  # not in every run
            (without,) = self.tracks([guess.without(index)], map, self.runs if once else self.runs[:1])
            then, now = (rms(t if once else t[:1]) ** 2 for t in (before, after))
            whole, back = then - (floor or 1.0) ** 2, rms(without) ** 2 - now
            return float(np.clip(back / whole, 0.0, 1.0)) if whole > 0 else 0.0

        found = each(share, range(len(guess.parts)))
        return {h.key: s for h, s in zip(guess.hypotheses, found, strict=True)}


@dataclasses.dataclass(frozen=True)
class _Outcome:
    """Predictions of the given and of the corrected machine for all runs, the held-out one first.

    Attributes:
        judge: with the noise that was found.
        patched: the corrected machine.
        asked: tracks of the machine that the user gave.
        after: of the corrected one.
    """

    judge: _Judge
    patched: Machine
    asked: tuple[Track, ...]
    after: tuple[Track, ...]

    @classmethod
    def of(cls, evidence: Evidence, judged: Judged, given: Machine) -> "_Outcome":
        """Predict the runs with the given machine and with a fitted model."""
        data, judge = evidence.data, _Judge(evidence.data, judged)
        models = [given, judged.guess] if judged.guess.parts or given is not data.machine else [given]
        tracks = judge.tracks(models, evidence.map)
        return cls(judge, judged.guess.machine(data.machine), tracks[0], tracks[-1])


def _lost(tests: Mapping[str, dict], laws: Sequence[LearnedLaw]) -> set[str]:
    """Axes in whose channels something remains or a law was learned; "" for a channel without axis."""
    channels = [t["channel"] for name, t in tests.items() if not t["passed"] and name != "constancy"]
    axes = {parse_channel(channel).axis or "" for channel in channels}
    return axes | {law.axis for law in laws if law.share > 0.0}


def _named(found: Found, spread: np.ndarray, shares: Mapping) -> tuple[NamedEffect, ...]:
    """Return the effects of a search, the most probable first."""
    effects, first = [], 0
    fitted = {track.run.name for track in found.judged.tracks}
    for index, (hypothesis, deviation) in enumerate(found.guess.parts):
        own = spread[first : first + hypothesis.size]
        first += hypothesis.size
        rest = found.without[index]
        if hypothesis.name in NUISANCE or hypothesis.name.startswith(LEARNED) or rest is None:
            continue
        chance, others = _chances(found, index, rest)
        estimates = {
            key: estimate for key, estimate in _estimates(hypothesis, deviation, own).items()
            if hypothesis.run_of(key) in fitted | {""}
        }  # fmt: skip
        effects.append(NamedEffect(*hypothesis.key, chance, estimates, others, shares[hypothesis.key]))
    return tuple(sorted(effects, key=lambda effect: -effect.probability))


def _estimates(hypothesis: Hypothesis, deviation: np.ndarray, spread: np.ndarray):
    values = hypothesis.values(deviation)
    table = {}
    for (key, p), own in zip(hypothesis.parameters.items(), spread, strict=True):
        reach = _NORMAL95 * own * p.prior_std
        low, high = max(p.lower_bound, values[key] - reach), min(p.upper_bound, values[key] + reach)
        table[key] = Estimate(values[key], p.unit, low, high, p.nominal)
    return table


def _chances(found: Found, index: int, rest: Judged) -> tuple[float, tuple[Alternative, ...]]:
    """Probability of an effect against its rivals and against none, and those of the rivals."""
    rivals = [r for r in found.rivals[index] if np.isfinite(r.judged.loss)]
    table = effect_probabilities(found.judged, found.charges[index], rest, rivals)
    alike = min(TOLD, _ALIKE * apart(found.judged, rest))
    others = [
        Alternative(
            r.hypothesis.name, r.hypothesis.location, float(chance),
            apart(found.judged, r.judged) < alike,
        )
        for r, chance in zip(rivals, table[2:], strict=True) if chance >= _WORTH_TELLING
    ]  # fmt: skip
    return float(table[0]), tuple(others)


def apart(one: Judged, other: Judged) -> float:
    """Sum of squares of what two guesses predict differently, in standard deviations."""
    return sum(float(np.nansum((a.whitened - b.whitened) ** 2)) for a, b in zip(one.tracks, other.tracks, strict=True))


def _prediction(track: Track, data: Dataset) -> Prediction:
    run = track.run
    clock = run.start + run.period * np.arange(len(run.command))
    return Prediction(run.name, clock, data.channels, track.predicted, run.reading, track.whitened)


def _lacks(machine: Machine, judged: Judged) -> tuple[Lack, ...]:
    """The unknown inputs that remain, the largest first."""
    levels = judged.tracks[0].levels
    largest, units = input_sizes(machine, levels.inputs), input_units(machine, levels.inputs)
    found = [
        Lack(i.balance, i.axis, float(size), unit, float(size / most))
        for i, size, most, unit in zip(levels.inputs, levels.sizes, largest, units, strict=True)
    ]
    return tuple(sorted(found, key=lambda lack: -lack.part))


def _calibration(guess: Guess, spread: np.ndarray) -> dict[str, Estimate]:
    first = 0
    for hypothesis, deviation in guess.parts:
        if hypothesis.name == CALIBRATION:
            return _estimates(hypothesis, deviation, spread[first : first + hypothesis.size])
        first += hypothesis.size
    return {}


def _all_calibrated(
    freely: dict[str, Estimate], later: dict[str, Estimate], named: Sequence[NamedEffect]
) -> dict[str, Estimate]:
    """Numbers of free runs and of the search, as the patched machine has them, once each."""
    gone = {f"{e.name}.{e.location}.{key}" for e in named for key in e.parameters}
    first = {key: dataclasses.replace(e, nominal=freely[key].nominal) for key, e in later.items()
             if key in freely}  # fmt: skip
    return {k: e for k, e in (later | freely | first).items() if k not in gone}


def _sample_posterior(
    data: Dataset,
    given: Machine,
    opened: FreeCalibration | None,
    found: Sequence[tuple[Guess, np.ndarray]],
    levels: Levels,
) -> Posterior | None:
    """Draw samples of all parameters that the search, and a calibration before it (`opened`), changed."""
    noise = {channel: float(s) for channel, s in zip(data.channels, levels.whole_noise, strict=True)}
    # the search's uncertainties define which parameters a calibration has
    machine = with_value(given, "uncertainty", data.machine.uncertainty) if opened else data.machine
    jitter = _jitter(data, levels)
    if jitter[0] != jitter[1] and data.sensors:
        machine = with_value(machine, f"sensors.{data.sensors}.jitter", jitter[0])
    fits = [(opened.guess, opened.covariance), *found] if opened else found
    return sample_posterior(machine, fits, noise)


def _far(guess: Guess) -> list[str]:
    """Calibrated numbers that moved far beyond what is stated as uncertain."""
    return [
        f"{key} {p.nominal + d * p.prior_std:.4g} {p.unit} (model: {p.nominal:.4g}; {abs(d):.1f} times)"
        for hypothesis, deviation in guess.parts
        if hypothesis.name == CALIBRATION
        for (key, p), d in zip(hypothesis.parameters.items(), deviation, strict=True)
        if abs(d) > _FAR
    ]


def _noise(data: Dataset, levels: Levels) -> dict[str, tuple[float, float]]:
    return {
        channel: (float(found), float(stated))
        for channel, found, stated in zip(data.channels, levels.whole_noise, data.noise, strict=True)
    }


def _laws(data: Dataset, patched: Machine, noise: np.ndarray):
    """Balance residuals of the held-out run before and after."""
    before = after = run_balances(data.machine, data, data.heldout, noise)
    if patched is not data.machine:
        after = run_balances(patched, data, data.heldout, noise)
    laws, units = {}, {}
    for law, places in before.items():
        laws[law] = {
            place: {
                "before": found.rms,
                "after": after[law][place].rms,
                "noise": found.rms / found.normalised_rms if found.normalised_rms > 0 else 0.0,
            }
            for place, found in places.items()
        }
        units[law] = next(iter(places.values())).unit
    return laws, units


def _experiment(machine: Machine, verdict: Verdict, named: Sequence[NamedEffect], unknown):
    if verdict == "unknown" and unknown:
        place = unknown.channel.partition(".")[2] or "supply"
        return next_experiment(machine, "no known effect explains the data.", [(unknown.law, place)])
    unsure = [e for e in named if e.probability < SURE]
    if verdict not in ("ambiguous", "named") or not unsure:
        return None
    pairs = [(e.name, e.location) for e in unsure]
    pairs += [(a.name, a.location) for e in unsure for a in e.alternatives]
    return next_experiment(machine, "these data do not distinguish the effects.", pairs)


def _jitter(data: Dataset, levels: Levels) -> tuple[float, float]:
    """Jitter as found, and as stated [s]; what hardly differs from the stated one is that."""
    found, stated = levels.jitter, stated_jitter(data)
    return (found if abs(found - stated) > _JITTER * max(found, stated) else stated), stated


def _colour_words(channel: str, colour: Colour, white: float) -> str:
    """Describe the coloured noise of a channel."""
    share = colour.size**2 / (colour.size**2 + white**2)
    kind = f"with a resonance at {colour.frequency:.3g} Hz" if colour.frequency else "of first order"
    return (
        f"{100.0 * share:.0f} % of the noise variance of {channel} is coloured, {kind}"
        f" (correlation time {colour.memory:.2g} s)."
    )


def _notes(found: Found, data: Dataset, levels: Levels, floor: float | None) -> list[str]:
    notes = []
    ratio = levels.whole_noise / data.noise
    off = [
        f"{channel} {100 * (r - 1):+.0f} %" for channel, r in zip(data.channels, ratio, strict=True)
        if np.isfinite(r) and abs(r - 1.0) > _OFF
    ]  # fmt: skip
    if off:
        notes.append(f"The noise differs from the machine file: {', '.join(off)}.")
    notes += [_colour_words(data.channels[c.channel], c, levels.noise[c.channel]) for c in levels.colours]
    jitter, stated = _jitter(data, levels)
    if not jitter and stated:
        notes.append(f"The data show no sampling jitter; the machine file states {1e3 * stated:.3g} ms.")
    elif jitter != stated:
        notes.append(
            f"The sampling instants have a jitter of {1e3 * jitter:.3g} ms (standard deviation;"
            f" stated: {1e3 * stated:.3g} ms): the error of a reading grows with its rate of"
            " change, in all channels at once. The noise includes it."
        )
    if not known_levels(data):
        unstated = [c for c, n in zip(data.channels, data.noise, strict=True) if not np.isfinite(n)]
        notes.append(f"The machine file states no accuracy of {', '.join(unstated)}; their noise"
                     " was estimated from the readings.")  # fmt: skip
    if far := _far(found.guess):
        notes.append(
            f"Calibrated by more than {_FAR:g} times the stated uncertainty: {', '.join(far)}."
            " Either an effect is present or the stated uncertainty is too small."
        )
    if floor is None:
        notes.append(
            "The error of a perfect model is unknown, because the evaluation of runs simulated with"
            " the patched machine failed. The explanation is therefore not reported as complete."
        )
    return notes
