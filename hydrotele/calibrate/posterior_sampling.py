"""Differential evolution, and MCMC sampling with differential-evolution moves.

Both take a function of many parameter sets at once. The sampler is emcee's ensemble with DEMove and
DESnookerMove. Its convergence is assessed by autocorrelation time, split R-hat and effective sample
size.

Source: Storn and Price 1997; ter Braak 2006, ter Braak and Vrugt 2008 (moves); Foreman-Mackey et
al. 2013 (emcee); Gelman et al., Bayesian Data Analysis, 3rd ed., 11.4 (split R-hat); Sokal 1997.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import differential_evolution

from hydrotele.core.errors import InputError

Cost = Callable[[np.ndarray], np.ndarray]  # (S, p) -> (S,)
_MAX_RHAT = 1.05  # maximum split R-hat of mixed chains
_MIN_AUTOCORRELATION_TIMES = 50.0  # minimum chain length in autocorrelation times, as recommended by emcee
MIN_STEPS = 40  # steps: four draws of every tenth step, so that each half chain has a variance
MAX_STEPS = 100_000  # steps: a chain of 1 GB for 54 parameters
_JUMP_FRACTION = 0.1  # fraction of DE moves with the full difference, which jump between modes


@dataclass(frozen=True)
class EvolutionResult:
    """Result of a search by differential evolution.

    Attributes:
        values: (p,) best parameters.
        cost: cost of the best parameters.
        generations: number of generations.
        evaluations: number of evaluated parameter sets.
        converged: whether the population converged before the maximum number of generations.
        history: (generations,) best cost of each generation.
    """

    values: np.ndarray
    cost: float
    generations: int
    evaluations: int
    converged: bool
    history: np.ndarray


def minimize_by_evolution(
    cost: Cost, low: np.ndarray, high: np.ndarray, *, seed: int = 0, population: int = 6,
    generations: int = 20000, cost_tolerance: float = 1e-5,
) -> EvolutionResult:  # fmt: skip
    """Minimise a function by differential evolution, without gradient or start values.

    The strategy is SciPy's `randtobest1bin` with crossover 0.95 and a varying mutation. Calibration
    errors are strongly correlated, so most coordinates must change together, and a population that
    only follows its best member converges prematurely. The search ends when the costs of the
    population differ by less than `cost_tolerance`.

    Args:
        cost: function of (S, p) parameter sets, such as half the weighted sum of squares.
        low: (p,) lower bounds.
        high: (p,) upper bounds.
        seed: seed of the random generator.
        population: population size per parameter.
        generations: maximum number of generations.
        cost_tolerance: range of the population's costs at which the search ends. If the cost is minus a
            log likelihood, the best cost is then within about 1e-2 of the minimum.

    Returns:
        The best parameters, without a final gradient search.

    >>> found = minimize_by_evolution(lambda x: np.sum((x - 1.0) ** 2, axis=1), np.zeros(3) - 5, np.zeros(3) + 5)
    >>> bool(np.abs(found.values - 1.0).max() < 0.02), found.converged
    (True, True)
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    history: list[float] = []
    evaluations = 0

    def evaluate_population(x: np.ndarray) -> np.ndarray:
        nonlocal evaluations  # SciPy counts a whole population as one evaluation
        evaluations += x.shape[1] if x.ndim == 2 else 1
        found = cost(np.ascontiguousarray(x.T) if x.ndim == 2 else x[None])
        return found if x.ndim == 2 else found[0]

    def record_and_check_convergence(intermediate_result) -> bool:
        history.append(float(intermediate_result.fun))
        return bool(np.ptp(intermediate_result.population_energies) < cost_tolerance)

    found = differential_evolution(
        evaluate_population, list(zip(low, high, strict=True)), strategy="randtobest1bin",
        mutation=(0.4, 0.9), recombination=0.95, popsize=population, maxiter=generations, tol=0.0,
        polish=False, init="latinhypercube", rng=np.random.default_rng(seed), vectorized=True,
        updating="deferred", callback=record_and_check_convergence,
    )  # fmt: skip
    return EvolutionResult(found.x, float(found.fun), int(found.nit), evaluations,
                     len(history) > 0 and found.nit < generations, np.array(history))  # fmt: skip


@dataclass(frozen=True)
class Posterior:
    """Posterior sample with convergence diagnostics.

    Attributes:
        names: the p parameters.
        sample: (draws, walkers, p) parameters at every `thin`-th step after the burn-in, where
            `thin` is an argument of `sample_posterior`; a walker is one chain.
        log_probability: (draws, walkers) log probability of the sample.
        acceptance_fraction: mean fraction of accepted moves.
        autocorrelation: (p,) integrated autocorrelation times [steps of the chain].
        rhat: (p,) split R-hat over walkers.
        effective_size: (p,) effective sample sizes.
        steps: number of steps after the burn-in.
        evaluations: number of evaluations of the log probability.
        converged: whether all R-hat are below 1.05 and the chain has 50 autocorrelation times.
        status: the convergence diagnostics as text.
    """

    names: tuple[str, ...]
    sample: np.ndarray
    log_probability: np.ndarray
    acceptance_fraction: float
    autocorrelation: np.ndarray
    rhat: np.ndarray
    effective_size: np.ndarray
    steps: int
    evaluations: int
    converged: bool
    status: str

    @property
    def flat_sample(self) -> np.ndarray:
        """(draws times walkers, p) draws of all walkers in one array."""
        return self.sample.reshape(-1, self.sample.shape[-1])

    @property
    def mean(self) -> np.ndarray:
        """(p,) posterior means."""
        return self.flat_sample.mean(axis=0)

    @property
    def standard_deviations(self) -> np.ndarray:
        """(p,) posterior standard deviations."""
        return self.flat_sample.std(axis=0, ddof=1)

    @property
    def correlation(self) -> np.ndarray:
        """(p, p) posterior correlations."""
        return np.corrcoef(self.flat_sample, rowvar=False)

    @property
    def intervals(self) -> np.ndarray:
        """(p, 2) central 95 % intervals."""
        return np.quantile(self.flat_sample, [0.025, 0.975], axis=0).T


def sample_posterior(
    log_probability: Cost, start: np.ndarray, start_scatter: np.ndarray, names: Sequence[str], *,
    steps: int = 6000, burn_in: int | None = None, walkers: int | None = None, seed: int = 0,
    thin: int = 10,
) -> Posterior:  # fmt: skip
    """Sample a posterior with emcee's DEMove (80 %) and DESnookerMove (20 %).

    Args:
        log_probability: function of (S, p) parameter sets; -inf outside the prior.
        start: (p,) mean of the walkers' start, or (walkers, p) start of each walker.
        start_scatter: (p,) standard deviations or (p, p) covariance of the walkers' start.
        names: the p parameters.
        steps: steps of every walker after the burn-in.
        burn_in: number of burn-in steps; by default half of `steps`.
        walkers: number of chains; by default 4 p, because each half moves along differences of
            the other half, which must span all directions.
        seed: seed of the random generator.
        thin: every `thin`-th step is kept.

    Returns:
        The sample with its diagnostics.

    Raises:
        InputError: the start has no finite probability.
    """
    import emcee

    p = len(names)
    burn_in = steps // 2 if burn_in is None else burn_in
    rng = np.random.default_rng(seed)
    count = walkers or 4 * p
    if np.ndim(start) == 2:
        begin = np.asarray(start, float)
    elif np.ndim(start_scatter) == 2:
        begin = rng.multivariate_normal(start, start_scatter, size=count, method="svd")
    else:
        begin = start + np.asarray(start_scatter) * rng.normal(size=(count, p))
    if not np.isfinite(log_probability(begin)).all():
        raise InputError("posterior", "the start is outside the prior: start closer to it")
    full = emcee.moves.DEMove(gamma0=1.0)
    usual = emcee.moves.DEMove(gamma0=2.38 / np.sqrt(2.0 * p))
    moves = [
        (usual, 0.8 - _JUMP_FRACTION),
        (full, _JUMP_FRACTION),
        (emcee.moves.DESnookerMove(), 0.2),
    ]
    sampler = emcee.EnsembleSampler(len(begin), p, log_probability, moves=moves, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()
    state = begin
    if burn_in:
        state = sampler.run_mcmc(begin, burn_in, store=False, skip_initial_state_check=True)
    sampler.reset()
    sampler.run_mcmc(state, -(-steps // thin), thin_by=thin, skip_initial_state_check=True)
    chain = sampler.get_chain()
    probability = sampler.get_log_prob()
    assert chain is not None and probability is not None
    return diagnose_chain(names, chain, probability, float(np.mean(sampler.acceptance_fraction)),
                  (burn_in + steps) * len(begin), thin)  # fmt: skip


def diagnose_chain(
    names: Sequence[str], chain: np.ndarray, log_probability: np.ndarray, acceptance: float,
    evaluations: int, thin: int = 1,
) -> Posterior:  # fmt: skip
    """Compute the convergence diagnostics of MCMC chains, and return them with the sample.

    Args:
        names: the p parameters.
        chain: (draws, walkers, p) every `thin`-th step after the burn-in.
        log_probability: (draws, walkers) log probability of the chain.
        acceptance: fraction of accepted moves.
        evaluations: number of evaluations of the log probability.
        thin: steps between draws.

    Returns:
        The sample with its diagnostics.
    """
    tau, rhat = autocorrelation_time(chain), split_rhat(chain)
    effective = chain.shape[0] * chain.shape[1] / tau
    long = len(chain) / tau.max()
    good = bool(rhat.max() < _MAX_RHAT and long > _MIN_AUTOCORRELATION_TIMES)
    said = (
        f"{'converged' if good else 'not converged'}: split R-hat at most {rhat.max():.3f},"
        f" {long:.0f} autocorrelation times, effective size at least {effective.min():.0f}"
    )
    if not good:
        said += "; draw more steps"
    return Posterior(
        tuple(names), chain, np.asarray(log_probability), acceptance, thin * tau, rhat, effective,
        thin * len(chain), evaluations, good, said,
    )  # fmt: skip


def split_rhat(chain: np.ndarray) -> np.ndarray:
    """Compute split R-hat, a convergence measure that compares the halves of all chains.

    With within-chain variance W and between-chain variance B of the 2 m half chains of length n:
    R = sqrt(((n - 1) / n W + B / n) / W).

    Args:
        chain: (steps, walkers, p) the chains.

    Returns:
        (p,) R-hat, 1 for equal halves; above 1.05 the chains have not mixed.

    Source: Gelman et al., Bayesian Data Analysis, 3rd ed., 11.4.

    >>> still = np.random.default_rng(0).normal(size=(1000, 4, 1))
    >>> bool(split_rhat(still)[0] < 1.01), bool(split_rhat(still + np.arange(4)[:, None])[0] > 1.5)
    (True, True)
    """
    n = len(chain) // 2
    halves = np.concatenate([chain[:n], chain[n : 2 * n]], axis=1)
    within = halves.var(axis=0, ddof=1).mean(axis=0)
    between = n * halves.mean(axis=0).var(axis=0, ddof=1)
    return np.sqrt(((n - 1) / n * within + between / n) / np.maximum(within, 1e-300))


def autocorrelation_time(chain: np.ndarray) -> np.ndarray:
    """Compute the integrated autocorrelation time of an ensemble with Sokal's automatic window.

    Args:
        chain: (steps, walkers, p) the chains.

    Returns:
        (p,) autocorrelation times [steps of the given chains], at least 1.
    """
    import emcee

    return np.maximum(emcee.autocorr.integrated_time(chain, quiet=True, tol=0), 1.0)
