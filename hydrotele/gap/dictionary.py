"""The dictionary of the gap search: what each possible effect changes in the whitened prediction errors.

A version of an effect is a group of columns at one amplitude. An effect whose law is not linear in its parameters (a
relief valve that opens earlier, friction that holds) has a different version at every amplitude; the regression
averages over them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.track import COARSE, Track
from hydrotele.gap.laws import LawForm
from hydrotele.gap.run_variables import Seen

AMPLITUDES = (0.3, 2.0, -2.0)
"""Parameter changes [prior standard deviations] at which columns are formed. The large ones are for effects with one
parameter and without stated start values."""
SCANNED_FRACTIONS = tuple((k + 0.5) / 20.0 for k in range(20))
"""Places in the range of a parameter at which a custom effect is tried in addition."""
_LIBRARY = "hydrotele."  # start of the module names of the library's effects
_MIN_AMPLITUDE = 0.05  # prior standard deviations; a bound that is nearer leaves no room for a difference
_START_RANGE = (0.3, 3.0)  # multiples of a version's amplitude within which the first refinement starts


@dataclass(frozen=True)
class Version:
    """An effect at one amplitude, with q columns.

    Attributes:
        hypothesis: the effect at a location, with p parameters.
        steps: (p, q) normalised parameter deviations of the columns.
        is_scanned: whether a parameter was set to a place in its range; the refinement starts there.
    """

    hypothesis: Hypothesis
    steps: np.ndarray
    is_scanned: bool = False

    @property
    def lengths(self) -> np.ndarray:
        """(q,) amplitude of each column [prior standard deviations]."""
        return np.linalg.norm(self.steps, axis=0)

    @property
    def bounds(self) -> np.ndarray:
        """(q, 2) bounds of the coefficient of each column alone [prior standard deviations]."""
        unit, low, high = self.steps / self.lengths, self.hypothesis.low, self.hypothesis.high
        found = np.empty((unit.shape[1], 2))
        for k, column in enumerate(unit.T):
            moved = column != 0.0
            ends = np.sort([low[moved] / column[moved], high[moved] / column[moved]], axis=0)
            found[k] = ends[0].max(), ends[1].min()
        return found

    def deviation(self, mean: np.ndarray) -> np.ndarray:
        """Return the deviation (p,) at which to start the refinement.

        Args:
            mean: (q,) posterior means of the coefficients [prior standard deviations].
        """
        if self.is_scanned:
            return self.steps[:, 0]
        ratio = mean / self.lengths
        if len(ratio) == 1 and self.hypothesis.size > 1:
            ratio = np.clip(ratio, *_START_RANGE)
        return np.clip(self.steps @ ratio, self.hypothesis.low, self.hypothesis.high)


def list_versions(hypothesis: Hypothesis) -> list[Version]:
    """Return the versions of an effect: one per amplitude, and one per start value that it states.

    A parameter that a bound holds on one side is moved to the other side.
    """
    found: list[Version] = []
    starts = [s for s in hypothesis.starts if np.any(s)]
    for start in starts:
        found.append(Version(hypothesis, start[:, None].astype(float)))
    found += [Version(hypothesis, step[:, None], True) for step in scan_ranges(hypothesis)]
    for amplitude in AMPLITUDES[: 1 if starts or hypothesis.size > 1 else None]:
        steps = [_room(hypothesis, k, amplitude) for k in range(hypothesis.size)]
        if all(abs(step) >= _MIN_AMPLITUDE for step in steps):
            found.append(Version(hypothesis, np.diag(steps)))
    unique: list[Version] = []
    for version in found:
        if not any(np.array_equal(version.steps, other.steps) for other in unique):
            unique.append(version)
    return unique


def scan_ranges(hypothesis: Hypothesis) -> list[np.ndarray]:
    """Return deviations (p,) at which each parameter of a custom effect takes values from its whole range.

    Its likelihood may have several maxima between the bounds. The other parameters have the first start value, or a
    small amplitude. Effects of the library state start values that cover their ranges.
    """
    if hypothesis.name not in EFFECTS or EFFECTS[hypothesis.name].apply.__module__.startswith(_LIBRARY):
        return []
    starts = [s for s in hypothesis.starts if np.any(s)] or [np.full(hypothesis.size, AMPLITUDES[0])]
    found = []
    for k in range(hypothesis.size):
        low, high = hypothesis.low[k], hypothesis.high[k]
        for fraction in SCANNED_FRACTIONS if np.isfinite(high - low) else ():
            step = starts[0].astype(float).copy()
            step[k] = low + fraction * (high - low)
            found.append(step)
    return [step for step in found if np.any(step)]


def _room(hypothesis: Hypothesis, k: int, amplitude: float) -> float:
    """Return the step of a parameter, to the other side where a bound leaves less than half of it."""
    inside = float(np.clip(amplitude, hypothesis.low[k], hypothesis.high[k]))
    if abs(inside) >= 0.5 * abs(amplitude):
        return inside
    return float(np.clip(-amplitude, hypothesis.low[k], hypothesis.high[k]))


@dataclass(frozen=True)
class Dictionary:
    """Columns of many versions about one model.

    Attributes:
        versions: G versions.
        columns: per version (E, q) change of the whitened errors per prior standard deviation.
        nuisance: (E, K) the same of the model's own and of the uncertain parameters.
        own: (K,) whether a nuisance column is a parameter of the model itself.
        laws: L laws and profiles.
        law_columns: per law (E, q) change of the whitened errors per unit of each function of its basis.
        parameters: (K,) name of each nuisance column, and its prior standard deviation [SI].
    """

    versions: tuple[Version, ...]
    columns: tuple[np.ndarray, ...]
    nuisance: np.ndarray
    own: np.ndarray
    laws: tuple[LawForm, ...] = ()
    law_columns: tuple[np.ndarray, ...] = ()
    parameters: tuple[tuple[str, float], ...] = ()

    def with_laws(self, laws: Sequence[LawForm], units: Mapping[tuple[str, str], Sequence[np.ndarray]],
                  tracks: Sequence[Track], seen: Sequence[Seen], each: Callable) -> "Dictionary":  # fmt: skip
        """Return a dictionary of laws instead of versions.

        Args:
            laws: L laws.
            units: balance and axis -> what a unit changes in the states of each track, see `LawForm.unit_changes`.
            tracks: as of `build_dictionary`.
            seen: their variables.
            each: `map`, or that of a pool.
        """

        def of_law(law: LawForm) -> np.ndarray:
            runs = zip(tracks, seen, units[law.balance, law.axis], strict=True)
            return np.concatenate([law.columns(t, s, unit) for t, s, unit in runs]).astype(np.float32)

        columns = tuple(each(of_law, laws))
        return replace(self, versions=(), columns=(), laws=tuple(laws), law_columns=columns)


def build_dictionary(
    evidence: Evidence, guess: Guess, versions: Sequence[Version], uncertain: Hypothesis, tracks: Sequence[Track]
) -> Dictionary:
    """Compute the columns of versions and of the uncertain parameters.

    Args:
        evidence: whose base is the model to extend.
        guess: that model; its own parameters are nuisance, too.
        versions: of the effects to add.
        uncertain: the uncertain parameters together.
        tracks: of the base, or the first rows of them.

    Returns:
        The columns; versions that the model cannot follow are left out.
    """
    base = evidence.errors(guess, COARSE, tracks)

    def difference(moved: Guess, length: float) -> np.ndarray:
        return ((evidence.errors(moved, COARSE, tracks) - base) / length).astype(np.float32)

    def of_version(version: Version) -> np.ndarray:
        columns = zip(version.steps.T, version.lengths, strict=True)
        return np.column_stack([difference(guess.plus(version.hypothesis, s), a) for s, a in columns])

    def of_parameter(index: int) -> np.ndarray:
        if index in linear:
            return linear[index].astype(np.float32)
        moved = whole.deviation
        moved[index] += nudges[index]
        return difference(whole.at(moved), nudges[index])

    whole = guess.plus(uncertain, np.zeros(uncertain.size)) if uncertain.size else guess
    nudges = whole.nudges()
    linear, first = dict[int, np.ndarray](), 0
    for hypothesis in guess.hypotheses:
        responses = evidence.responses(hypothesis, tracks)
        if responses is not None:
            linear |= {first + k: column for k, column in enumerate(responses.T)}
        first += hypothesis.size
    nuisance = evidence.map(of_parameter, range(len(nudges)))
    columns = evidence.map(of_version, versions)
    valid = [k for k, c in enumerate(columns) if np.isfinite(c).all() and np.any(c)]
    table = np.column_stack(nuisance) if nuisance else np.zeros((len(base), 0), np.float32)
    finite = np.atleast_1d(np.isfinite(table).all(axis=0))
    own = np.arange(len(nudges)) < len(guess.deviation)
    versions, columns = [versions[k] for k in valid], [columns[k] for k in valid]
    sizes = [p.prior_std for h in whole.hypotheses for p in h.parameters.values()]
    parameters = tuple(pair for pair, kept in zip(zip(whole.names, sizes, strict=True), finite, strict=True) if kept)
    return Dictionary(tuple(versions), tuple(columns), table[:, finite], own[finite], parameters=parameters)
