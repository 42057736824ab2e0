"""Experiments of Abdellatif 2008 on the hexapod PaLiDA, repeated in simulation.

The identification experiments (sections 2 to 5.3) cover base parameters, excitation, data
processing, estimates and their covariance. The control experiments (section 5.4) compare
feedforward with nominal and with identified parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from hydrotele.core.files import models_folder
from hydrotele.experiments.abdellatif_base_parameters import STRUCTURE
from hydrotele.experiments.abdellatif_processing import HARMONICS, PROCESSING, average_periods
from hydrotele.experiments.abdellatif_trials import (
    ENCODER_FEEDBACK,
    PERIODS_PER_TRIAL,
    TRIAL_SERIES,
    TRIAL_SETTINGS,
    simulate_trials,
)
from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    Series,
    merge_settings,
)
from hydrotele.experiments.palida import (
    PLOTTED_DRIVE,
    POSE_HIGH,
    POSE_LOW,
    PUBLISHED_PARAMETERS,
    compute_force_covariance,
    load_excitation,
    load_robot,
    make_drive_limits,
    simulate_excitation,
    simulate_measurement,
)
from hydrotele.experiments.palida_control import plan_circle, plan_square, track_path
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_fraction,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.identify.estimation import reduce_parameters
from hydrotele.identify.excitation import Excitation, compute_information
from hydrotele.identify.mechanism import ColumnMapping, load_mechanism
from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.multibody.inverse_dynamics import project_on_drives
from hydrotele.multibody.regressor import Regressor

# Friction of the passive joints, section 2.2.

HINGES = ("alpha", "beta")


@cache
def load_complete_friction_setup() -> RegressorSetup:
    """Return PaLiDA's regressor setup with separate dry and viscous friction of every passive hinge."""
    mapping, folder = load_robot().mechanism.mapping, models_folder() / "palida"
    complete = ColumnMapping(
        position=mapping.position, force=mapping.force, coordinates=mapping.coordinates,
        passive_friction=mapping.passive_friction, offsets=False,
        equal_parameters=tuple(g for g in mapping.equal_parameters if not g[0].startswith(HINGES)),
        zero_parameters=tuple(a for a in mapping.zero_parameters if not a.startswith("viscous")),
    )  # fmt: skip
    return load_mechanism(folder / "palida.xml", complete).setup


def build_complete_friction_regressor(motion: np.ndarray) -> Regressor:
    """Compute PaLiDA's regressor along a motion, with separate friction parameters of every passive hinge.

    Args:
        motion: (3, n, 6) poses, rates and accelerations of the platform.

    Returns:
        The regressor of the drive forces.
    """
    setup = load_complete_friction_setup()
    return setup.compute_regressor(project_on_drives(setup.chain, setup.given_joints, *motion))


def measure_friction_reduction(seed: int, changes: Changes) -> Sample:
    """Reduce the friction model of PaLiDA's passive joints to the parameters that simulated data identify.

    The model starts with 24 parameters of dry and viscous friction of the 12 passive joints (hinges).
    Insignificant parameters are dropped. Parameters of one kind (dry or viscous friction of alpha or of
    beta hinges) with strongly correlated estimates get one common parameter.

    Args:
        seed: seed of the measurement noise.
        changes: `hinge_scatter`: relative difference of the dry friction of each hinge from the
            mean of its kind, with alternating sign.

    Returns:
        Numbers of all model parameters before and after the reduction (`start`, `stop`), numbers of
        `dropped` and `merged` parameters, and `reached`: whether of the hinges' friction exactly one dry
        friction parameter remains for all alpha hinges, and one for all beta hinges.
    """
    settings = merge_settings({"hinge_scatter": 0.0}, changes)
    cycle = simulate_excitation()
    if settings["hinge_scatter"]:
        full = build_complete_friction_regressor(cycle.motion)
        scatter = np.array([
            settings["hinge_scatter"] * value * (-1.0) ** int(name[-1])
            if name.startswith("coulomb") and _is_passive(name) else 0.0
            for name, value in zip(full.names, full.nominal, strict=True)
        ])  # fmt: skip
        cycle = cycle._replace(force=cycle.force + full.matrix @ scatter)
    record = simulate_measurement(cycle, PERIODS_PER_TRIAL, np.random.default_rng([22, seed]))
    data = average_periods(record, cycle.period)
    table = build_complete_friction_regressor(data.motion)
    names = [one.column for one in PUBLISHED_PARAMETERS[:10]]
    names += [name for name in table.names if name.startswith(("coulomb", "viscous"))]
    columns = [table.names.index(name) for name in names]
    kinds = [[name for name in names if name.startswith(f"{kind}.{joint}")]
             for kind in ("coulomb", "viscous") for joint in HINGES]  # fmt: skip
    found = reduce_parameters(
        table.matrix[:, :, columns], data.force, data.covariance / PERIODS_PER_TRIAL, names, kinds
    )
    passive = [group for group in found.groups if _is_passive(group[0])]
    reached = sorted((len(g), g[0].partition(".")[0]) for g in passive) == [(6, "coulomb")] * 2
    number = np.arange(len(found.steps))
    dropped, merged = (sum(s.action == a for s in found.steps) for a in ("drop", "merge"))
    values = {"start": found.steps[0].parameters, "stop": found.steps[-1].parameters,
              "reached": reached, "dropped": dropped, "merged": merged}  # fmt: skip
    return Sample(values, (
        Panel("parameters left [1]", number, {"": np.array([s.parameters for s in found.steps])},
              "step", discrete=True),
        *(
            Panel(label, number, {"": np.array([
                step.statistic if step.action == action else np.nan for step in found.steps
            ])}, "step", discrete=True)
            for action, label in (("drop", "estimate / standard deviation [1]"),
                                  ("merge", "correlation of merged [1]"))
        ),
        Panel("squared residual per degree [1]", number,
              {"": np.array([step.misfit for step in found.steps])}, "step", discrete=True),
    ))  # fmt: skip


def _is_passive(name: str) -> bool:
    return name.partition(".")[2].startswith(HINGES)


def evaluate_friction_reduction(samples: Sequence[Sample]) -> Evaluation:
    """Check that over half of the simulated data sets lead to the published friction model of the passive joints.

    In the model of Abdellatif 2008 all passive joints of one kind share one dry friction parameter,
    and have no viscous friction.
    """
    check = check_fraction(
        "fraction of the data sets that lead to these 14 friction parameters",
        collect_values(samples, "reached") > 0.5, reason="more than half; the document had one data set",
    )  # fmt: skip
    first = samples[0].values
    return Evaluation((check,), note=(
        f"from {first['start']:.0f} parameters to {format_values(samples, 'stop')}; in the first"
        f" set {first['dropped']:.0f} are dropped and {first['merged']:.0f} merged"
    ))  # fmt: skip


REDUCTION = Experiment(
    "friction of the passive joints",
    measure_friction_reduction,
    (
        Claim(
            "friction of the passive joints",
            '"Parameters whose effects are beneath the disturbance level are eliminated. Parameters'
            ' with high correlation are replaced by a common parameter." "Friction in the passive'
            " joints is modelled only as dry friction with a common parameter for all"
            ' αj and another one for all βj -joints."',
            "Table 1, sections 2.2 and 5.1", "document", evaluate_friction_reduction,
            {"hinge_scatter": 0.5}, "dry friction of hinges of one kind differs by 50 %",
        ),
    ),
    max_repetitions=20,
)  # fmt: skip

# Excitation, sections 3 and 5.2.


def compare_excitation_with_random(seed: int, changes: Changes) -> Sample:
    """Compare the parameter precision of PaLiDA's designed excitation motion with that of a random motion.

    The random motion is scaled down until it keeps the same limits of pose and drives.

    Args:
        seed: seed of the random excitation.
        changes: `amplitude`: factor applied to the designed excitation.

    Returns:
        `ratio`: standard deviation of the parameters with the random excitation over that with the
        designed one (geometric mean over the axes of the confidence ellipsoid). `use`: utilization of
        the most restrictive limit by the designed excitation, 1 at the limit. `designed` and `random`:
        logarithm of the determinant of the information matrix of either motion.
    """
    settings = merge_settings({"amplitude": 1.0}, changes)
    best, bounds = load_excitation(), make_drive_limits()
    size = settings["amplitude"]
    best = replace(best, sin=size * best.sin, cos=size * best.cos)
    time = np.arange(240) * best.period / 240
    rng = np.random.default_rng(seed)
    wide = 0.3 * bounds.half_range[:, None] / np.arange(1, HARMONICS + 1)
    sin, cos = wide * rng.normal(size=(2, 6, HARMONICS))
    other = Excitation(bounds.axes, best.period, bounds.centre, sin, cos, 0.0, 0.0, len(PUBLISHED_PARAMETERS))
    for _ in range(200):
        if compute_limit_utilization(other, time) <= 1.0:
            break
        other = replace(other, sin=0.95 * other.sin, cos=0.95 * other.cos)
    designed, random = (_compute_information_log_determinant(one, time) for one in (best, other))
    motion = best.evaluate(time)[0]
    values = {
        "ratio": float(np.exp(0.5 * (designed - random) / len(PUBLISHED_PARAMETERS))),
        "use": compute_limit_utilization(best, time), "designed": designed, "random": random,
    }  # fmt: skip
    return Sample(values, (
        Panel("position [m]", time, dict(zip(("x", "y", "z"), motion.T[:3], strict=True))),
        Panel("orientation [deg]", time,
              dict(zip(("phi", "theta", "psi"), np.degrees(motion.T[3:]), strict=True))),
        Panel("leg length [m]", time,
              {f"leg {k + 1}": c for k, c in enumerate(load_robot().compute_leg_lengths(motion).T)}),
    ))  # fmt: skip


def compute_limit_utilization(motion: Excitation, time: np.ndarray) -> float:
    """Return the largest utilization of any pose or drive limit along a motion; 1 means at the limit.

    Args:
        motion: periodic motion of the pose.
        time: (n,) instants at which the motion is evaluated [s].
    """
    whole = motion.evaluate(time)
    inside = np.clip(whole[0], POSE_LOW, POSE_HIGH)
    return float(make_drive_limits().compute_utilisation(whole, np.stack([inside, whole[1], whole[2]])).max())


def _compute_information_log_determinant(motion: Excitation, time: np.ndarray) -> float:
    own = load_robot()
    base = own.base_parameters.base[own.order]
    held = compute_information(own.setup, motion.evaluate(time), compute_force_covariance(), base)
    return float(np.linalg.slogdet(held)[1])


def evaluate_designed_excitation(samples: Sequence[Sample]) -> Evaluation:
    """Check that the designed excitation is more precise than random ones and stays within its limits.

    The geometric mean of the ratio of standard deviations (random over designed) must exceed 1, and the
    utilization of every pose and drive limit must not exceed 1.
    """
    return Evaluation(
        (
            check_bootstrapped_statistic(
                "standard deviations of the parameters with random motions over those with the designed "
                "motion",
                collect_values(samples, "ratio"), lambda ratios: float(np.exp(np.mean(np.log(ratios)))),
                (1.0, np.inf), "the designed motion is more precise"),
            check_deterministic_value("use of the tightest limit", samples[0].values["use"], (0.0, 1.0),
                                      "within all limits, equation (25)"),
        ),
        note="logarithm of the determinant of the information matrix"
        f" {samples[0].values['designed']:.1f}; of the best random"
        f" motion {collect_values(samples, 'random').max():.1f}",
    )  # fmt: skip


DESIGN = Experiment(
    "excitation",
    compare_excitation_with_random,
    (
        Claim(
            "D-optimal excitation",
            '"it is recommended to opt for the D-optimal design" "for experimental identification'
            ' just a sufficiently good excitation trajectory is needed"; five harmonics',
            "Fig. 5, (22) to (26), section 5.2", "document", evaluate_designed_excitation,
            {"amplitude": 0.1}, "the amplitude of the motion is scaled by 0.1",
        ),
    ),
)  # fmt: skip

# Control, section 5.4.

TOOL_SPEEDS = (0.25, 0.5, 0.75, 1.0)  # tool speeds [m/s]; the text of the document gives none
STRATEGIES = ("linear control", "nominal feedforward", "identified feedforward")
PATH_PLANNERS: dict[str, Callable[..., np.ndarray]] = {"circle": plan_circle, "square": plan_square}


def measure_tracking_errors(seed: int, changes: Changes) -> Sample:
    """Simulate path tracking of PaLiDA with three control strategies on a circle and a square at four speeds.

    The strategies are linear control alone, with feedforward of nominal parameters, and with
    feedforward of identified parameters.

    Args:
        seed: seed of the identification and of the encoder noise.
        changes: `force_scale`: factor applied to the force readings in the identification.

    Returns:
        Per path, from RMS actuator errors: `growth` is the error of linear control at the highest over
        that at the lowest speed. `nominal` is the largest ratio at one speed of nominal feedforward to
        linear control, `identified` that of identified to nominal feedforward. Also RMS errors of
        actuator 5 and of the tool position at the highest speed for both feedforwards [mm], and the
        number of MuJoCo `warnings`.
    """
    settings = merge_settings({"force_scale": 1.0}, changes)
    trial = simulate_trials(seed, TRIAL_SETTINGS | {"trials": 1, "friction_excess": 0.0})
    identified = settings["force_scale"] * trial.value[0]  # the estimate is linear in the forces
    models = (None, np.array([one.prior for one in PUBLISHED_PARAMETERS]), identified)
    values: dict[str, float] = {"warnings": 0.0}
    panels = []
    for path, plan in PATH_PLANNERS.items():
        rms = {name: np.zeros(len(TOOL_SPEEDS)) for name in STRATEGIES}
        tracked = {}
        for k, speed in enumerate(TOOL_SPEEDS):
            motion = plan(speed, laps=1.0)
            for name, model in zip(STRATEGIES, models, strict=True):
                tracked[name] = track_path(motion, model, seed)
                rms[name][k] = np.sqrt(np.mean(tracked[name].error ** 2))
                values["warnings"] += tracked[name].warnings
        none, nominal, best = rms.values()
        values[f"{path} growth"] = float(none[-1] / none[0])
        values[f"{path} nominal"] = float(np.max(nominal / none))
        values[f"{path} identified"] = float(np.max(best / nominal))
        panels.append(Panel(f"RMS actuator error on the {path} [mm]", np.array(TOOL_SPEEDS),
                            {name: 1e3 * one for name, one in rms.items()}, "speed [m/s]",
                            discrete=True))  # fmt: skip
        fast = {name: tracked[name] for name in STRATEGIES[1:]}
        time = fast[STRATEGIES[1]].time
        for label, curves in (
            (f"error of actuator 5 on the {path} [mm]",
             {name: 1e3 * one.error[:, PLOTTED_DRIVE] for name, one in fast.items()}),
            (f"Cartesian error on the {path} [mm]",
             {name: 1e3 * np.linalg.norm(one.pose_error[:, :3], axis=1)
              for name, one in fast.items()}),
        ):  # fmt: skip
            panels.append(Panel(label, time, curves))
            nominal, best = (float(np.sqrt(np.mean(curve**2))) for curve in curves.values())
            values |= {f"{label}, nominal": nominal, f"{label}, identified": best}
    return Sample(values, tuple(panels))


def evaluate_actuator_errors(samples: Sequence[Sample], path: str) -> Evaluation:
    """Check the RMS actuator errors of the three control strategies on one path.

    The error of linear control at the highest speed must be at least 1.5 times that at the lowest. At
    every speed, nominal feedforward must reduce the error, and feedforward of identified parameters must
    reduce it further, to at most 0.8 times that of nominal feedforward. The claim is unavailable if
    MuJoCo warned of an unstable simulation.

    Args:
        samples: samples of `measure_tracking_errors`.
        path: `circle` or `square`.
    """
    if collect_values(samples, "warnings").any():
        return Evaluation(unavailable="MuJoCo warned of an unstable simulation")
    curves = samples[0].panels[[p.label for p in samples[0].panels].index(
        f"RMS actuator error on the {path} [mm]")].curves  # fmt: skip
    rows = "; ".join(
        f"{speed:g} m/s: " + ", ".join(f"{curve[k]:.3f}" for curve in curves.values()) + " mm"
        for k, speed in enumerate(TOOL_SPEEDS)
    )
    return Evaluation(
        (
            check_mean(
                "RMS error of linear control at the highest speed over that at the lowest speed",
                collect_values(samples, f"{path} growth"), (1.5, np.inf),
                '"significant decreasing accuracy": at least 1.5 times the error'),
            check_mean(
                "error with the nominal model over that of linear control, largest of all speeds",
                collect_values(samples, f"{path} nominal"), (0.0, 1.0), '"improves always"'),
            check_mean(
                "error with the identified model over that with the nominal model, largest of all speeds",
                collect_values(samples, f"{path} identified"), (0.0, 0.8),
                '"outperforms clearly": by a fifth of the error, at every speed'),
        ),
        note=f"linear, nominal, identified: {rows}",
    )  # fmt: skip


def evaluate_circle_errors(samples: Sequence[Sample]) -> Evaluation:
    """Check the RMS actuator errors of three control strategies on the circle.

    The strategies are linear control, feedforward of nominal parameters, and feedforward of identified
    parameters. Each must have smaller errors than the one before, the last by at least a fifth. The
    error of linear control must grow at least 1.5-fold from the lowest to the highest speed.
    """
    return evaluate_actuator_errors(samples, "circle")


def evaluate_square_errors(samples: Sequence[Sample]) -> Evaluation:
    """Check the RMS actuator errors of three control strategies on the square.

    The strategies are linear control, feedforward of nominal parameters, and feedforward of identified
    parameters. Each must have smaller errors than the one before, the last by at least a fifth. The
    error of linear control must grow at least 1.5-fold from the lowest to the highest speed.
    """
    return evaluate_actuator_errors(samples, "square")


def evaluate_errors_at_highest_speed(samples: Sequence[Sample], quantity: str) -> Evaluation:
    """Check that identified feedforward gives smaller errors than nominal feedforward at the highest speed.

    The mean ratio of their RMS errors must be below 1 on the circle and on the square.

    Args:
        samples: samples of `measure_tracking_errors`.
        quantity: tracking error to compare on both paths: `error of actuator 5` or `Cartesian error`.
    """
    checks, notes = [], []
    for path in PATH_PLANNERS:
        label = f"{quantity} on the {path} [mm]"
        nominal, best = (collect_values(samples, f"{label}, {m}") for m in ("nominal", "identified"))
        checks.append(check_mean(f"RMS error on the {path}, identified over nominal",
                                 best / nominal, (0.0, 1.0), "smaller"))  # fmt: skip
        notes.append(f"{path} {nominal.mean():.3f} and {best.mean():.3f} mm")
    return Evaluation(tuple(checks), note=f"nominal and identified: {', '.join(notes)}")


def evaluate_drive_error(samples: Sequence[Sample]) -> Evaluation:
    """Check that identified feedforward reduces the RMS tracking error of actuator 5 against nominal feedforward.

    Errors are compared at the highest speed, on the circle and on the square.
    """
    return evaluate_errors_at_highest_speed(samples, "error of actuator 5")


def evaluate_tool_error(samples: Sequence[Sample]) -> Evaluation:
    """Check that identified feedforward reduces the RMS position error of the tool against nominal feedforward.

    Errors are compared at the highest speed, on the circle and on the square.
    """
    return evaluate_errors_at_highest_speed(samples, "Cartesian error")


_CONTROL_QUOTE = (
    '"the use of standard linear control (variation 1) exhibits a significant decreasing accuracy'
    ' with increasing speeds" "Using model-knowledge (variation 2 and 3) improves always the'
    ' tracking performance." "the compensation of identified model (variation 3) outperforms'
    ' clearly variation 2"'
)
_FORCE_SCALE_FAULT = {"force_scale": 0.5}
_FORCE_SCALE_FAULT_TEXT = "the identification reads half of the actual forces"

CONTROL = Experiment(
    "control",
    measure_tracking_errors,
    (
        Claim("control errors on the circle", _CONTROL_QUOTE, "Fig. 10, section 5.4", "document",
              evaluate_circle_errors, _FORCE_SCALE_FAULT, _FORCE_SCALE_FAULT_TEXT,
              ("RMS actuator error on the circle [mm]",)),
        Claim("control errors on the square", _CONTROL_QUOTE, "Fig. 10, section 5.4", "document",
              evaluate_square_errors, _FORCE_SCALE_FAULT, _FORCE_SCALE_FAULT_TEXT,
              ("RMS actuator error on the square [mm]",)),
        Claim("error of actuator 5",
              '"For the same arbitrarily chosen actuator, the tracking accuracy is higher if the'
              ' identified model is implemented."',
              "Fig. 11, section 5.4", "document", evaluate_drive_error, _FORCE_SCALE_FAULT, _FORCE_SCALE_FAULT_TEXT,
              tuple(f"error of actuator 5 on the {path} [mm]" for path in PATH_PLANNERS)),
        Claim("Cartesian error",
              '"The same results are noticeable for the cartesian tracking accuracy Δx"',
              "Fig. 12, section 5.4", "document", evaluate_tool_error, _FORCE_SCALE_FAULT, _FORCE_SCALE_FAULT_TEXT,
              tuple(f"Cartesian error on the {path} [mm]" for path in PATH_PLANNERS)),
    ),
    max_repetitions=3,
)  # fmt: skip

SERIES = Series(
    "abdellatif2008",
    "H. Abdellatif, B. Heimann, J. Kotlarski: On the Robust Dynamics Identification of Parallel"
    " Manipulators: Methodology and Experiments, 2008",
    100,
    (STRUCTURE, REDUCTION, DESIGN, PROCESSING, TRIAL_SERIES, ENCODER_FEEDBACK, CONTROL),
    items_without_result={
        "Fig. 1": "photograph and drawing of the robot",
        "Fig. 2": "scheme of a parallel manipulator",
        "Fig. 3": "block diagram of the frequency-domain processing, whose result is Fig. 6",
        "Fig. 4": "frames of a strut; the model has them, see `models/palida/README.md`",
    },
)
