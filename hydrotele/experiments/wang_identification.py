"""Wang 2012, chapter 4: redundant parameters, differential evolution (DE), and posterior sampling (MCMC)."""

from collections.abc import Sequence

import numpy as np

from hydrotele.calibrate.estimation import Prior
from hydrotele.calibrate.hybrid_calibration import (
    build_equations,
    calibrate_hybrid_robot,
    find_redundancy,
    restrict_to_fitted_parameters,
)
from hydrotele.calibrate.posterior_sampling import Posterior, minimize_by_evolution, sample_posterior
from hydrotele.experiments.comparison import (
    Changes,
    Check,
    Claim,
    Evaluation,
    Experiment,
    Marginals,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.experiments.wang_robots import (
    Drawing,
    compute_rms,
    compute_test_pose_errors,
    make_caption_claim,
    measure_nominal_robot,
    simulate_robot,
)
from hydrotele.kinematics.hybrid_error_model import ErrorModelKind, build_error_model, refined_model_parameters
from hydrotele.kinematics.hybrid_robot import load_hybrid
from hydrotele.simulate.pose_measurements import PLATFORM_TILT

MAX_RHAT = 1.1
"""Largest split R-hat of converged chains: Gelman et al., Bayesian Data Analysis, 11.4."""

MAX_LIKELIHOOD_EXCESS = 0.5
"""Largest accepted excess of DE's negative log likelihood over the optimum.

A change of one parameter by one standard deviation causes an excess of 0.5.
"""

SEARCH_HALF_WIDTH = 5.0
"""Half the width of DE's search region, in standard deviations of the manufacturing errors."""

MAX_PLOTTED_SAMPLES = 4000
"""Number of posterior samples kept for figures."""

FIGURE_CAPTIONS = {
    12: (49, ("a4", "theta4", "a1x", "a2x"), "δa4, δθ4, δa1x, δa2x"),
    13: (50, ("a4", "a3x", "a4x", "a5x"), "δa4, δa3x, δa4x, δa5x"),
    14: (50, ("d4", "a1y", "a2y", "a1x"), "δdd, δa1y, δa2y, δa1x"),
    15: (51, ("d4", "a3y", "a4y", "a5y"), "δd4, δa3y, δa4y, δa5y"),
    16: (51, ("theta4", "a1z", "a2z", "a3z"), "δθ4, δa1z, δa2z, δa3z"),
    17: (52, ("alpha4", "a1z", "a2z", "a3z"), "δα4, δa1z, δa2z, δa3z"),
}
"""Figure -> (page, parameters of this model, parameters as printed in the caption).

The available text does not define the dd of Fig. 14; d4 is used instead.
"""


def _downsample_posterior(posterior: Posterior) -> np.ndarray:
    flat = posterior.flat_sample
    return flat[:: max(1, len(flat) // MAX_PLOTTED_SAMPLES)]


def compare_posterior_with_null_space(seed: int, changes: Changes) -> Sample:
    """Compare the sampled posterior of a robot's 54 parameters with the null space of the Jacobian.

    The parameters are the errors of the D-H model of the robot IWR, measured in 25 poses. QR decomposition
    of the Jacobian finds the redundant ones. The prior is normal with the standard deviations of the
    manufacturing errors. Along a parameter direction with singular value s of the Jacobian, scaled by
    these, the posterior standard deviation is in theory 1 / sqrt(1 + s^2) times that of the prior.

    Args:
        seed: seed of robot, noise and chains.
        changes: `tilt_of_jacobian`: platform tilt of the poses analysed by QR [rad], None for the
            measured poses; `steps`: length of the chains.

    Returns:
        `redundant`: number of redundant parameters. `posterior over prior`: ratio of standard deviations
        along the redundant directions. `posterior over theory`: that along all other directions. `rhat`:
        largest split R-hat. `weak`: number of singular values below 1. Correlations for the figures,
        and posterior samples [mm or mrad].
    """
    settings = merge_settings({"tilt_of_jacobian": None, "steps": 4000}, changes)
    simulated = simulate_robot(400 + seed, 25, refined_only=False)
    eq = build_equations(simulated.model, simulated.measurement)
    scales, names = eq.scales, eq.names
    prior = Prior(np.zeros(54), scales)
    fit = calibrate_hybrid_robot(load_hybrid("iwr"), simulated.measurement, "dh", prior=prior).fit
    posterior = sample_posterior(
        lambda x: -eq.negative_log_likelihood(x) - 0.5 * np.sum((x / scales) ** 2, axis=1), fit.values,
        fit.covariance, names, steps=settings["steps"], burn_in=200, walkers=110, seed=seed,
    )  # fmt: skip
    analysed = eq
    if settings["tilt_of_jacobian"] is not None:
        analysed = build_equations(simulated.model, measure_nominal_robot(25, seed, settings["tilt_of_jacobian"]))
    found = find_redundancy(analysed)
    _, singular, rows = np.linalg.svd(analysed.jacobian(fit.values) * scales)
    scaled = (posterior.flat_sample - posterior.mean) / scales
    ratio = np.std(scaled @ rows.T, axis=0) * np.sqrt(1.0 + singular**2)
    correlation = posterior.correlation
    values = {
        "redundant": float(len(found.held_names)),
        "posterior over prior": float(np.std(scaled @ found.null_directions.T, axis=0).mean()),
        "posterior over theory": float(np.sqrt(np.mean(ratio[: found.rank] ** 2))),
        "rhat": float(posterior.rhat.max()),
        "weak": float(np.sum(singular < 1.0)),
    }
    at = {name: k for k, name in enumerate(names)}
    for figure, (_, shown, _) in FIGURE_CAPTIONS.items():
        for name in shown[1:]:
            values[f"{figure} {name}"] = float(correlation[at[shown[0]], at[name]])
    for name in ("a4", "theta4", "a1x"):
        values[f"mean {name}"] = 1e3 * float(posterior.mean[at[name]])
        values[f"deviation {name}"] = 1e3 * float(posterior.standard_deviations[at[name]])
        values[f"assumed {name}"] = 1e3 * float(simulated.errors[at[name]])
    arrays = {"draws": 1e3 * _downsample_posterior(posterior), "truth": 1e3 * simulated.errors,
              "names": np.array(names)}  # fmt: skip
    return Sample(values, (), arrays)


def _make_posterior_drawing(names: tuple[str, ...]) -> Drawing:
    def draw_marginals(samples: Sequence[Sample]):
        arrays = samples[0].arrays
        at = [list(arrays["names"]).index(name) for name in names]
        return (), Marginals(names, arrays["draws"][:, at], arrays["truth"][at])

    return draw_marginals


def _check_rhat(samples: Sequence[Sample]) -> Check:
    return check_mean("largest split R-hat of a parameter", collect_values(samples, "rhat"),
                      (1.0, MAX_RHAT), "converged chains, Gelman et al. 11.4")  # fmt: skip


def _evaluate_posterior_redundancy(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (check_mean("posterior over prior standard deviation along the redundant directions of QR",
                    collect_values(samples, "posterior over prior"), (0.9, 1.1),
                    "1: the data give no information there; 10 % is the error of a sampled standard deviation"),
         check_mean("posterior standard deviation over that from the singular values, RMS over the"
                    " other directions", collect_values(samples, "posterior over theory"), (0.9, 1.1),
                    "1: both methods agree; 10 % as for (1)"),
         _check_rhat(samples)),
        note=f"{format_values(samples, 'redundant', digits=0)} redundant parameters by QR; along"
        f" {format_values(samples, 'weak', digits=0)} directions the data are less informative than"
        " the prior of 1 mm and 1 mrad",
    )  # fmt: skip


def _make_correlation_description(figure: int, names: tuple[str, ...]):
    def describe_correlation(samples: Sequence[Sample]) -> str:
        parts = [f"{name} {format_values(samples, f'{figure} {name}', digits=2)}"
                 for name in names[1:]]  # fmt: skip
        return f"posterior correlation of {names[0]} with {', '.join(parts)}"

    return describe_correlation


def _make_estimate_description(names: tuple[str, ...]):
    def describe_estimates(samples: Sequence[Sample]) -> str:
        first = samples[0].values
        parts = [f"{name} assumed {first[f'assumed {name}']:.2f}, identified"
                 f" {first[f'mean {name}']:.2f} ± {first[f'deviation {name}']:.2f}"
                 for name in names]  # fmt: skip
        return f"with sensor noise, posterior mean ± standard deviation: {'; '.join(parts)} (mm or mrad, first robot)"

    return describe_estimates


REFINED_NAMES = ("a4", "theta4", "b1x", "b6z")
"""Parameters of the caption of Wang 2012, Fig. 18."""


def measure_refined_posterior(seed: int, changes: Changes) -> Sample:
    """Compare the sampled posterior of 36 parameters of the robot IWR with their least-squares estimate.

    The parameters are the errors of the refined D-H model of Wang 2012, measured in 25 poses.

    Args:
        seed: seed of robot, noise and chains.
        changes: `chain_noise`: sensor noise assumed by the chains over the true one; `steps`:
            length of the chains.

    Returns:
        `shift`: largest difference of posterior mean and least squares, in standard deviations of least
        squares. `ratio`: RMS ratio of posterior and least-squares standard deviations. `inside`: number
        of true errors inside their 95 % posterior intervals. `rhat`: largest split R-hat. Posterior
        samples [mm or mrad].
    """
    settings = merge_settings({"chain_noise": 1.0, "steps": 3000}, changes)
    simulated = simulate_robot(500 + seed, 25)
    names = refined_model_parameters(simulated.model)
    done = calibrate_hybrid_robot(load_hybrid("iwr"), simulated.measurement, "dh", names)
    eq, fit = restrict_to_fitted_parameters(done), done.fit
    weight = settings["chain_noise"] ** -2
    posterior = sample_posterior(
        lambda x: -weight * eq.negative_log_likelihood(x), fit.values, fit.covariance, eq.names,
        steps=settings["steps"], burn_in=200, walkers=74, seed=seed,
    )  # fmt: skip
    truth = simulated.errors[simulated.model.parameter_indices(names)]
    low, high = posterior.intervals.T
    values = {
        "shift": float(np.abs((posterior.mean - fit.values) / fit.standard_deviations).max()),
        "ratio": compute_rms(posterior.standard_deviations / fit.standard_deviations),
        "inside": float(np.sum((truth > low) & (truth < high))),
        "rhat": float(posterior.rhat.max()),
    }
    for name in REFINED_NAMES:
        at = names.index(name)
        values[f"mean {name}"] = 1e3 * float(posterior.mean[at])
        values[f"deviation {name}"] = 1e3 * float(posterior.standard_deviations[at])
        values[f"assumed {name}"] = 1e3 * float(truth[at])
    arrays = {
        "draws": 1e3 * _downsample_posterior(posterior),
        "truth": 1e3 * truth,
        "names": np.array(names),
    }
    return Sample(values, (), arrays)


def _evaluate_refined_posterior(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (check_mean("largest distance of a posterior mean from least squares, in standard"
                    " deviations", collect_values(samples, "shift"), (-np.inf, 0.2),
                    "with this shift a 95 % interval contains half a percent less"),
         check_mean("posterior over least-squares standard deviation, RMS of 36",
                    collect_values(samples, "ratio"), (0.95, 1.05),
                    "1 expected; a 95 % interval that is 5 % too short contains 94 %"),
         _check_rhat(samples)),
        note=f"{format_values(samples, 'inside', digits=1)} of 36 assumed errors are within the"
        " central 95 %",
    )  # fmt: skip


def count_independent_parameters(seed: int, changes: Changes) -> Sample:
    """Count the independent parameters of the error models, and calibrate 36 or all parameters of a robot.

    The models of the robot IWR, D-H and POE, have 54 parameters, which all have errors; 36 is the
    number of the refined model of Wang 2012.

    Args:
        seed: seed of robot and noise.
        changes: `tilt`: largest tilt of the platform [rad].

    Returns:
        `rank MODEL`: rank of the Jacobian of the D-H (`dh`) or POE (`poe`) model, also `without tilt` of
        the platform. `rank of 36`: rank for the refined model. Number of D-H parameters that the data
        determine well. `error with 36` and `error with 54`: RMS position error at test poses after
        calibration of as many parameters [m]. A panel shows the singular values of the D-H model.
    """
    settings = merge_settings({"tilt": PLATFORM_TILT}, changes)
    nominal, simulated = load_hybrid("iwr"), simulate_robot(600 + seed, 25, refined_only=False)
    measured = measure_nominal_robot(60, seed, settings["tilt"])
    untilted = measure_nominal_robot(60, seed, 0.0)
    values: dict[str, float] = {}
    for kind in ("dh", "poe"):
        model = build_error_model(nominal, kind)
        found = find_redundancy(build_equations(model, measured))
        values[f"rank {kind}"] = found.rank
        values[f"rank {kind} without tilt"] = find_redundancy(build_equations(model, untilted)).rank
        if kind == "dh":
            values["told"] = len(found.determined_names)
            singular = found.singular_values
    names = refined_model_parameters(simulated.model)
    values["rank of 36"] = find_redundancy(build_equations(simulated.model, measured, names)).rank
    for label, chosen in (("36", names), ("54", None)):
        robot = calibrate_hybrid_robot(nominal, simulated.measurement, "dh", chosen).robot
        values[f"error with {label}"] = compute_rms(
            compute_test_pose_errors(simulated, robot)[0])  # fmt: skip
    panel = Panel(
        "singular value over the largest [1]", np.arange(1, 55),
        {"Jacobian of 54 parameters, columns of length 1": np.maximum(singular, 1e-16)},
        "number [1]", log=True, discrete=True,
    )  # fmt: skip
    return Sample(values, (panel,))


def _evaluate_independent_parameters(samples: Sequence[Sample]) -> Evaluation:
    def format_count(name: str) -> str:
        return format_values(samples, name, digits=0)

    return Evaluation(
        (check_mean("number of independent parameters among the 54", collect_values(samples, "rank dh"), (36.0, 36.0),
                    "the refined model has 36, and must be minimal (p. 24)",
                    published=36.0),),
        f"Four parameters are redundant: theta4, d4, a4 and alpha4 have the same effect as a"
        f" common displacement of A1 to A6. Without tilt of the platform, errors of A_i and B_i cannot be"
        f" distinguished. The number then falls by the 18 coordinates of A1 to A6, to"
        f" {format_count('rank dh without tilt')} (D-H) or {format_count('rank poe without tilt')} (POE)."
        f" 36 parameters cannot describe a robot with errors in all 54: RMS position error"
        f" {format_values(samples, 'error with 36', 1e3, 2)}"
        f" mm at test poses, {format_values(samples, 'error with 54', 1e3, 3)} mm with all"
        " independent ones.",
        f"{format_count('told')} are determined to better than 0.5 mm or 0.5 mrad with this noise; the 36"
        f" have rank {format_count('rank of 36')}",
    )  # fmt: skip


def _identify_by_differential_evolution(seed: int, changes: Changes, kind: ErrorModelKind, poses: int) -> Sample:
    settings = merge_settings({"generations": 20000}, changes)
    simulated = simulate_robot(seed, poses, kind)
    names = refined_model_parameters(simulated.model)
    done = calibrate_hybrid_robot(load_hybrid("iwr"), simulated.measurement, simulated.model.kind, names)
    eq = restrict_to_fitted_parameters(done)
    box = SEARCH_HALF_WIDTH * eq.scales
    found = minimize_by_evolution(
        eq.negative_log_likelihood,
        -box,
        box,
        seed=seed,
        cost_tolerance=1e-3,
        generations=settings["generations"],
    )
    optimum = float(eq.negative_log_likelihood(done.fit.values[~done.fit.held][None])[0])
    return Sample(
        {"excess": found.cost - optimum, "evaluations": float(found.evaluations),
         "least squares": float(done.fit.evaluations + 2 * len(eq.names) * done.fit.iterations),
         "generations": float(found.generations)},
        arrays={"history": np.maximum(found.history - optimum, 1e-6)},
    )  # fmt: skip


def identify_dh_by_differential_evolution(seed: int, changes: Changes) -> Sample:
    """Identify the 36 parameters of a robot's refined D-H error model by differential evolution (DE) from 15 poses.

    `changes`: `generations`: largest number of generations. The result contains the `excess` of DE's
    negative log likelihood over that of least squares, `generations`, and numbers of model evaluations by
    DE (`evaluations`) and by `least squares`.
    """
    return _identify_by_differential_evolution(100 + seed, changes, "dh", 15)


def identify_poe_by_differential_evolution(seed: int, changes: Changes) -> Sample:
    """Identify 36 parameters of a robot's POE error model by differential evolution (DE) from 25 poses.

    `changes`: `generations`: largest number of generations. The result contains the `excess` of DE's
    negative log likelihood over that of least squares, `generations`, and numbers of model evaluations by
    DE (`evaluations`) and by `least squares`.
    """
    return _identify_by_differential_evolution(200 + seed, changes, "poe", 25)


def _evaluate_differential_evolution(samples: Sequence[Sample]) -> Evaluation:
    effort = np.array([(s.values["evaluations"], s.values["least squares"]) for s in samples])
    return Evaluation(
        (check_mean("excess of DE's negative log likelihood over that of least squares",
                    collect_values(samples, "excess"), (-np.inf, MAX_LIKELIHOOD_EXCESS),
                    "one standard deviation of one parameter"),
         check_bootstrapped_statistic("evaluations of the model by DE over those by least squares", effort,
                         lambda rows: float(np.sum(rows[:, 0]) / np.sum(rows[:, 1])),
                         (1.0, np.inf), '"less computation time" of the linearization, p. 25')),
        note=f"DE starts within {SEARCH_HALF_WIDTH:g} standard deviations of the errors and stops"
        f" after {format_values(samples, 'generations', digits=0)} generations",
    )  # fmt: skip


def _describe_differential_evolution(samples: Sequence[Sample]) -> str:
    return (
        f"cost above the optimum {format_values(samples, 'excess', digits=3)} in units of log"
        f" likelihood after {format_values(samples, 'generations', digits=0)} generations"
    )


def _make_cost_history_drawing(count: int) -> Drawing:
    def draw_cost_history(samples: Sequence[Sample]):
        histories = [sample.arrays["history"] for sample in samples[:count]]
        longest = max(map(len, histories))
        curves = {f"data set {k}": np.pad(history, (0, longest - len(history)), mode="edge")
                  for k, history in enumerate(histories, 1)}  # fmt: skip
        panel = Panel("lowest cost above the optimum [log likelihood]", np.arange(1, longest + 1),
                      curves, "generation [1]", log=True)  # fmt: skip
        return (panel,), None

    return draw_cost_history


EVOLUTION_DH = Experiment(
    "D-H model by DE", identify_dh_by_differential_evolution,
    (
        Claim(
            "DE does not depend on initial values",
            '"whether the initial values are close to the optimum solution or not is'
            ' insignificant"; iterative linearization has "less computation time to converge"',
            "section 2.2 (p. 25, 26)", "document", _evaluate_differential_evolution, {"generations": 200},
            "DE is stopped after 200 generations",
        ),
        make_caption_claim(
            "DE on four data sets", "Fig. 10 (p. 45)",
            '"Simulation results of four different data sets."',
            lambda samples: _describe_differential_evolution(samples[:4]), _make_cost_history_drawing(4),
        ),
        make_caption_claim(
            "DE on five data sets of 15 poses", "Fig. 11 (p. 46)",
            '"Simulation results of 15 measurement poses in five different data sets."',
            _describe_differential_evolution, _make_cost_history_drawing(5),
        ),
    ),
    fixed_repetitions=5,
)  # fmt: skip

REDUNDANCY = Experiment(
    "54 parameters by MCMC", compare_posterior_with_null_space,
    (
        Claim(
            "redundancy by MCMC and by QR",
            '"the MCMC method has also been used to analyze parameter redundancy and parameter'
            ' identifiability of the hybrid error model"; "the identifiable parameters are'
            ' calculated from QR decomposition of the analytical observation matrix"',
            "section 2.2 (p. 26), section 2.1 (p. 23)", "document", _evaluate_posterior_redundancy,
            {"tilt_of_jacobian": 0.0}, "QR analyses poses without tilt, MCMC those with tilt",
            panel_labels=(),
        ),
        make_caption_claim(
            "54 parameters, without measurement noise", "Table 3 (p. 47)",
            '"Nominal values, assumed errors, identified posterior mean values, and standard'
            ' deviations for the 54-parameter model (without measurement noise)"',
            _make_estimate_description(("a4", "theta4", "a1x")),
        ),
        *(make_caption_claim(
            f"posterior of Fig. {figure}", f"Fig. {figure} (p. {page})",
            '"2D marginal posterior distributions and 1D marginal density for parameters'
            f' {words}."',
            _make_correlation_description(figure, names), _make_posterior_drawing(names),
        ) for figure, (page, names, words) in FIGURE_CAPTIONS.items()),
    ),
    max_repetitions=3,
)  # fmt: skip

RANK_EXPERIMENT = Experiment(
    "independent parameters", count_independent_parameters,
    (
        Claim(
            "54 parameters are refined to 36",
            '"for the 54-parameter model"; "for the refined 36-parameter model"; "The kinematic'
            ' model must contain only a minimal number of parameters and the redundant parameters'
            ' have to be eliminated"', 
            "titles of Tables 3 to 5 (p. 47, 53, 54), section 2.1 (p. 24)", "document",
            _evaluate_independent_parameters, {"tilt": 0.0}, "the platform never tilts",
        ),
    ),
    max_repetitions=10,
)  # fmt: skip

REFINED_POSTERIOR = Experiment(
    "36 parameters by MCMC", measure_refined_posterior,
    (
        Claim(
            "MCMC and least squares agree on 36 parameters",
            "Posterior means and standard deviations of the 36 parameters with sensor noise equal"
            " those of least squares.", "Table 5, section 3.4", "additional",
            _evaluate_refined_posterior, {"chain_noise": 2.0},
            "MCMC assumes twice the true sensor noise", panel_labels=(),
        ),
        make_caption_claim(
            "36 parameters, with measurement noise", "Table 5 (p. 54)",
            '"Nominal values, assumed errors, identified posterior mean values, and standard'
            ' deviations for the refined 36-parameter model (with measurement noise)"',
            _make_estimate_description(REFINED_NAMES),
        ),
        make_caption_claim(
            "posterior of Fig. 18", "Fig. 18 (p. 55)",
            '"2D marginal posterior distributions and 1D marginal density for parameters δa4, δθ4,'
            ' δb1x, δb6z."', _make_estimate_description(REFINED_NAMES), _make_posterior_drawing(REFINED_NAMES),
        ),
    ),
    max_repetitions=3,
)  # fmt: skip

EVOLUTION_POE = Experiment(
    "POE model by DE", identify_poe_by_differential_evolution,
    (
        make_caption_claim(
            "fitness of DE, POE model", "Fig. 19 (p. 59)",
            '"Fitness values of four different runs with four different measurement data sets."',
            _describe_differential_evolution, _make_cost_history_drawing(4),
        ),
    ),
    fixed_repetitions=4,
)  # fmt: skip

EXPERIMENTS = (EVOLUTION_DH, REDUNDANCY, RANK_EXPERIMENT, REFINED_POSTERIOR, EVOLUTION_POE)
"""Experiments in the order of the document."""
