"""What the gap search needs of a model: errors, sensitivities, priors and noise levels, behind one interface.

Two models implement it: `gap.machine_model` for the reduced model of a hydraulic machine in a Kalman filter, and
`gap.force_evidence` for the inverse dynamics of any MJCF. `gap.model_search` knows no other property of a model.
`docs/gap_method.md` states the objective that both evaluate.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Protocol

import numpy as np

from hydrotele.estimate.evidence import Fit, Judged
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.gap.dictionary import Version
from hydrotele.gap.laws import LawForm
from hydrotele.gap.regression import LevelScale, NormalEquations
from hydrotele.gap.run_differences import Quantity


class Linearisation(Protocol):
    """Columns of versions of effects, and of nuisance parameters, about one model."""

    @property
    def versions(self) -> Sequence[Version]:
        """The versions that the model can follow."""
        ...

    @property
    def is_own(self) -> np.ndarray:
        """Return for each nuisance column (K,) whether it is a parameter of the model itself."""
        ...

    @property
    def laws(self) -> Sequence[LawForm]:
        """The laws and profiles, instead of versions."""
        ...

    @property
    def parameters(self) -> Sequence[tuple[str, float]]:
        """Name and prior standard deviation [SI] of each nuisance column (K,)."""
        ...

    @property
    def fraction(self) -> float:
        """Fraction of the rows that the columns hold."""
        ...

    def list_laws(self, judged: Judged, effects: Collection[str], has_laws: bool) -> list[LawForm]:
        """Return profiles of effects, and laws over one variable, that may explain the residual inputs of a model."""
        ...

    def list_pairs(self, single: LawForm) -> list[LawForm]:
        """Return the laws over products of the variable of a law with another one."""
        ...

    def with_laws(self, laws: Sequence[LawForm]) -> "Linearisation":
        """Return the linearisation of laws instead of versions."""
        ...

    def equations(self, scale: LevelScale, joined: Sequence[int] = ()) -> tuple[list[NormalEquations], float]:
        """Return per run the normal equations with scaled residual inputs, and -2 log likelihood of all errors.

        Args:
            scale: factors on the noise levels.
            joined: indices of versions that form one group together; one group per version if empty.
        """
        ...


class GapModel(Protocol):
    """A model and its runs, for `gap.model_search`.

    A guess is one set of effects with parameters. The base is the guess whose filter gains and noise levels whiten the
    errors of others.
    """

    keep: Callable[[Judged], None]
    """Called with every model that the search accepts."""

    max_effects: int
    """Number of rounds after which a search ends."""

    level_scales: Sequence[LevelScale]
    """Factors on the noise levels at which effects are compared."""

    run_names: tuple[str, ...]
    """Names of the fitted runs, and the held-out one last."""

    def prepare(self, candidates: Sequence[Hypothesis], given: Judged) -> list[Hypothesis]:
        """Return the candidates with start values that the residual inputs of the given model suggest."""
        ...

    def uncertain_parameters(self, guess: Guess, scale: float = 1.0) -> Hypothesis:
        """Return the uncertain parameters that are not among the effects as one group, empty if it has that group.

        Args:
            guess: the guess.
            scale: standard deviation of their priors relative to the stated one.
        """
        ...

    def judge(self, guess: Guess, same: bool = False, reopened: bool = False) -> Judged:
        """Re-estimate the noise levels of a set of effects, starting from those of the base.

        Args:
            guess: the guess.
            same: whether the base is nearly the same guess.
            reopened: whether residual inputs that the base does not need are tried again.
        """
        ...

    def judge_from(self, guess: Guess, judged: Judged) -> Judged:
        """Re-estimate the noise levels of a set of effects, starting from those of another model."""
        ...

    def set_base(self, judged: Judged) -> Judged:
        """Whiten the errors of later guesses with the gains of this one; return it."""
        ...

    def compact(self, judged: Judged) -> Judged:
        """Return a model without what `set_base` can compute again, so that it needs little memory."""
        return judged

    def fit(self, guess: Guess, steps: int) -> Fit:
        """Fit the parameters of some effects with the gains of the base."""
        ...

    def settle(self, judged: Judged, wanted: float = np.inf) -> tuple[Judged, Fit]:
        """Alternate fits and estimates of the noise levels until neither changes; the result is the base.

        Args:
            judged: the model.
            wanted: a loss; a model that does not approach it is not fitted to the end.
        """
        ...

    def refine(self, now: Judged, guess: Guess, scale: LevelScale, dense: bool) -> tuple[Judged, Fit] | None:
        """Fit an extension of a model and re-estimate its noise levels; None if the model cannot follow the runs.

        Args:
            now: the model, which is the base before and afterwards.
            guess: its extension.
            scale: factors on the noise levels with which the fit begins.
            dense: whether many parameters are added, whose sensitivities are computed once.
        """
        ...

    def linearise(self, guess: Guess, versions: Sequence[Version], uncertain: Hypothesis) -> Linearisation:
        """Compute the columns of versions and of the uncertain parameters about the base."""
        ...

    def propose_noise(self, judged: Judged, min_gain: float) -> Judged | None:
        """Return the base with coloured noise of the channels that show it, None without any.

        Args:
            judged: the base.
            min_gain: twice the log likelihood that the coloured noise of a channel must bring.
        """
        ...

    def compare_noise(self, judged: Judged, min_gain: float) -> Judged:
        """Find the coloured noise of the base again; return the model with the most evidence, which is the base."""
        ...

    def list_quantities(self, candidates: Sequence[Hypothesis]) -> Mapping[str, Quantity]:
        """Return the parameters that may differ between runs."""
        return {}

    def compare_disturbances(
        self, judged: Judged, candidates: Sequence[Hypothesis]
    ) -> list[tuple[tuple[Hypothesis, np.ndarray], float, LevelScale]]:
        """Compare force pulses and periodic forces with none.

        Args:
            judged: the base.
            candidates: effects, among them pulses.

        Returns:
            Per disturbance and scale the effect with its deviation (p,), twice its log Bayes factor, and the scale.
        """
        return []

    def try_start_values(self, judged: Judged, candidates: Sequence[Hypothesis]) -> list[Judged]:
        """Return a model with the effects whose start values improve it most, without the linear step."""
        ...

    def search_backlash(
        self, judged: Judged, effect: Hypothesis, tell: Callable[[str, float], None]
    ) -> Judged | None:  # fmt: skip
        """Return a model with backlash; None if nothing is missing there, or it does not help."""
        ...

    def select_priors(self, guess: Guess) -> Guess:
        """Select the prior of every learned law and profile of the base by its evidence."""
        return guess
