"""The dictionary of the gap search: what each possible effect changes in the whitened prediction errors.

A version of an effect is a group of columns at one amplitude. An effect whose law is not linear in its parameters (a
relief valve that opens earlier, friction that holds) has a different version at every amplitude; the regression
averages over them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.track import COARSE, Track

AMPLITUDES = (0.3, 2.0, -2.0)
"""Parameter changes [prior standard deviations] at which columns are formed. The large ones are for effects with one
parameter and without stated start values."""
_MIN_AMPLITUDE = 0.05  # prior standard deviations; a bound that is nearer leaves no room for a difference
_START_RANGE = (0.3, 3.0)  # multiples of a version's amplitude within which the first refinement starts


@dataclass(frozen=True)
class Version:
    """An effect at one amplitude, with q columns.

    Attributes:
        hypothesis: the effect at a location, with p parameters.
        steps: (p, q) normalised parameter deviations of the columns.
    """

    hypothesis: Hypothesis
    steps: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """(q,) amplitude of each column [prior standard deviations]."""
        return np.linalg.norm(self.steps, axis=0)

    def deviation(self, mean: np.ndarray) -> np.ndarray:
        """Return the deviation (p,) at which to start the refinement.

        Args:
            mean: (q,) posterior means of the coefficients [prior standard deviations].
        """
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
    for amplitude in AMPLITUDES[: 1 if starts or hypothesis.size > 1 else None]:
        steps = [_room(hypothesis, k, amplitude) for k in range(hypothesis.size)]
        if all(abs(step) >= _MIN_AMPLITUDE for step in steps):
            found.append(Version(hypothesis, np.diag(steps)))
    unique: list[Version] = []
    for version in found:
        if not any(np.array_equal(version.steps, other.steps) for other in unique):
            unique.append(version)
    return unique


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
    """

    versions: tuple[Version, ...]
    columns: tuple[np.ndarray, ...]
    nuisance: np.ndarray
    own: np.ndarray


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
        moved = whole.deviation
        moved[index] += nudges[index]
        return difference(whole.at(moved), nudges[index])

    whole = guess.plus(uncertain, np.zeros(uncertain.size)) if uncertain.size else guess
    nudges = whole.nudges()
    nuisance = evidence.map(of_parameter, range(len(nudges)))
    columns = evidence.map(of_version, versions)
    valid = [k for k, c in enumerate(columns) if np.isfinite(c).all() and np.any(c)]
    table = np.column_stack(nuisance) if nuisance else np.zeros((len(base), 0), np.float32)
    finite = np.isfinite(table).all(axis=0)
    own = np.arange(len(nudges)) < len(guess.deviation)
    versions, columns = [versions[k] for k in valid], [columns[k] for k in valid]
    return Dictionary(tuple(versions), tuple(columns), table[:, finite], own[finite])
