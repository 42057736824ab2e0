"""Chapter 4 of Khoshzaban 1992: dynamic calibration of a hydraulic machine with minor links.

Minor links are the tubes and rods of the cylinders; the reduced model neglects them. The module
compares forces of the complete and the reduced model (4.4.1) and classifies the identifiability of
the parameters (4.4.2). Sensor accuracy (4.4.3) is in `khoshzaban_sensor_accuracy`, and the measured
machine (4.6) is in `khoshzaban_prediction`.
"""

from collections.abc import Sequence

import numpy as np

from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Comparison,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.khoshzaban_prediction import PREDICTION
from hydrotele.experiments.khoshzaban_regressors import (
    DRIVES,
    SAMPLE_PERIOD,
    UNITS,
    Motion,
    make_regressor,
    make_thesis_regressor_setup,
    sample_motion,
    sample_states,
    scale_cylinder_inertia,
    stack_rows,
)
from hydrotele.experiments.khoshzaban_sensor_accuracy import (
    FORCE_ACCURACY,
    SENSOR_ACCURACY,
    SENSOR_NOISE_EXPERIMENT,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.identify.identifiability import (
    STATUS_COMBINATION,
    STATUS_FULL,
    STATUS_UNIDENTIFIABLE,
    Identifiability,
    classify_parameters,
)

FORCE_SETTINGS = {
    "cylinder_scale": 1.0,  # of mass, mass moments and inertia of all tubes and rods
    "rods_beyond_pins": False,  # whether rods' centres of mass lie beyond their pins
}
_MIN_FORCE_FRACTION = 0.5  # fraction of the peak force above which the factor between two forces is meaningful


def compare_model_forces(seed: int, changes: Changes) -> Sample:
    """Compare drive forces of the CAT 215 along a random motion with and without the inertia of the cylinders.

    Args:
        seed: seed of the motion.
        changes: `cylinder_scale`: factor of the cylinders' inertia; `rods_beyond_pins`: whether the
            centres of mass of the rods lie beyond their pins.

    Returns:
        Per drive, for the forces with (complete model) and without (reduced model) this inertia:
        largest `factor` between both, always at least 1, at instants with at least half of the peak
        force; fraction of instants with a factor of at least two (`twice`), and largest force over the
        peak force among these (`twice_below`); RMS `difference` [N m] or [N], also over the RMS force
        (`relative`); peak rate and peak force.
    """
    settings = merge_settings(FORCE_SETTINGS, changes)
    motion = sample_motion(np.random.default_rng(seed))
    table = make_regressor(make_thesis_regressor_setup("complete"), motion)
    parameters = scale_cylinder_inertia(table, settings["cylinder_scale"])
    if settings["rods_beyond_pins"]:
        turned = [name.startswith("moment_x") and name.endswith("_rod") for name in table.names]
        parameters = np.where(turned, -parameters, parameters)
    complete = table.matrix @ parameters
    reduced = table.matrix @ scale_cylinder_inertia(table, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.maximum(np.abs(complete / reduced), np.abs(reduced / complete))
    share = np.abs(complete) / np.abs(complete).max(axis=0)
    difference = np.sqrt(np.mean((complete - reduced) ** 2, axis=0))
    usual = np.sqrt(np.mean(complete**2, axis=0))
    values = {}
    for k, drive in enumerate(DRIVES):
        twice = factor[:, k] >= 2.0
        values[f"factor.{drive}"] = float(factor[share[:, k] >= _MIN_FORCE_FRACTION, k].max())
        values[f"twice.{drive}"] = float(twice.mean())
        values[f"twice_below.{drive}"] = float(share[twice, k].max(initial=0.0))
        values[f"difference.{drive}"] = float(difference[k])
        values[f"relative.{drive}"] = float(difference[k] / usual[k])
        values[f"peak_rate.{drive}"] = float(np.abs(motion[1][:, k]).max())
        values[f"peak.{drive}"] = float(np.abs(complete[:, k]).max())
    return Sample(values, _draw_forces(motion, complete, reduced))


MOTION_LABELS = ("joint angle [deg]", "joint rate [rad/s]", "joint acceleration [rad/s^2]")
FORCE_LABELS = tuple(
    f"{what} of the {drive} [{unit}]"
    for what, drive, unit in zip(("torque", "force", "force"), DRIVES, UNITS, strict=True)
)


def _draw_forces(motion: Motion, complete: np.ndarray, reduced: np.ndarray) -> tuple[Panel, ...]:
    time = SAMPLE_PERIOD * np.arange(len(complete))
    angles, rates, accelerations = motion
    parts = (np.rad2deg(angles), rates, accelerations)
    panels = [
        Panel(label, time, {drive: part[:, k] for k, drive in enumerate(DRIVES)})
        for label, part in zip(MOTION_LABELS, parts, strict=True)
    ]
    for k, label in enumerate(FORCE_LABELS):
        curves = {"complete model": complete[:, k], "reduced model": reduced[:, k]}
        errors = {"complete minus reduced": complete[:, k] - reduced[:, k]}
        panels.append(Panel(label, time, curves, errors=errors,
                            error_label=f"difference [{UNITS[k]}]"))  # fmt: skip
    return tuple(panels)


def evaluate_factor_between_forces(samples: Sequence[Sample]) -> Evaluation:
    """Check whether neglecting the cylinders' inertia changes a drive's force by a factor of two or more.

    Only instants with at least half of the drive's peak force count. The factor is the largest of all
    drives and instants, averaged over repetitions.
    """
    largest = np.max([collect_values(samples, f"factor.{drive}") for drive in DRIVES], axis=0)
    check = check_mean(
        "largest factor between both models' forces, of three drives, at instants with more than"
        " half of the peak force",
        largest, (2.0, np.inf),
        '"a factor of two or more"; a factor near zero force is meaningless', published=2.0,
    )  # fmt: skip
    twice = "; ".join(
        f"{d}: {format_values(samples, f'twice.{d}', 100.0, 0)} % of the time, always at instants with"
        f" less than {100 * collect_values(samples, f'twice_below.{d}').max():.0f} % of the peak force"
        for d in DRIVES
    )
    relative = ", ".join(f"{d} {format_values(samples, f'relative.{d}', 100.0)} %" for d in DRIVES)
    return Evaluation(
        (check,),
        "Table 13's cylinders of 200 kg each are too light compared with links of 1830 and 688 kg:"
        " the boom's force reaches a factor of two with cylinders eight times as heavy (2.05),"
        " the swing's torque with ten times (1.99), the stick's force with twice (2.2). Rods whose"
        " centres of mass lie beyond their pins, as the sign of m c_x suggests, give 1.35. The"
        " factor exceeds two only at instants with less than half of the drive's peak force.",
        note=f"RMS difference over RMS force: {relative}; factor of two: {twice}",
    )


def evaluate_proximal_error(samples: Sequence[Sample]) -> Evaluation:
    """Check that neglecting the cylinders' inertia causes a larger force error at the boom than at the stick.

    The force error is the RMS difference [N] between the models with and without this inertia. The boom's
    error must also exceed the accuracy of its force sensors.
    """
    rows = np.stack([collect_values(samples, f"difference.{d}") for d in ("boom", "stick")], axis=1)
    checks = (
        check_mean(
            "RMS difference of both models' forces, boom", rows[:, 0],
            (SENSOR_ACCURACY[1], np.inf), "above the sensors' accuracy (p. 108): large", unit="N",
        ),
        check_bootstrapped_statistic(
            "RMS difference of the boom over that of the stick", rows,
            lambda r: float(np.linalg.norm(r[:, 0]) / max(np.linalg.norm(r[:, 1]), 1e-300)),
            (1.0, np.inf), "the proximal cylinder's error is larger",
        ),
    )  # fmt: skip
    sizes = ", ".join(
        f"{d} {format_values(samples, f'difference.{d}', digits=0)} {u}" for d, u in zip(DRIVES, UNITS, strict=True)
    )
    relative = ", ".join(f"{d} {format_values(samples, f'relative.{d}', 100.0)} %" for d in DRIVES)
    return Evaluation(
        checks,
        "Relative to the RMS force, the stick's error is larger than the boom's.",
        note=f"RMS differences {sizes}; of the RMS force {relative}",
    )


def describe_motions(samples: Sequence[Sample]) -> Evaluation:
    """Return a note on the random motions that were simulated, without a verdict.

    Only the axis ticks of the published motions are legible (Khoshzaban 1992, Figs 30 to 32).
    """
    rates = ", ".join(f"{d} {format_values(samples, f'peak_rate.{d}', digits=2)}" for d in DRIVES)
    return Evaluation(note=f"a new random motion in every repetition; largest rates {rates} rad/s")


FORCE_COMPARISON = Experiment(
    "complete and reduced model", compare_model_forces,
    (
        Claim(
            "simulated motions", "Simulated trajectory of the swing, the boom, the stick (axes in"
            " the document's signs: -40 to 20, -50 to 0, 0 to 150 deg; 0.4, 0.4, 1.5 rad/s; 5 s)",
            "Figs 30 to 32, pp. 102 to 104", "caption", describe_motions, panel_labels=MOTION_LABELS,
        ),
        Claim(
            "neglected minor links: factor of two",
            '"neglecting the dynamics of the minor links (hydraulic actuators) may overestimate or'
            " underestimate the forces/torques applied to the joints/links of the arm by a factor"
            ' of two or more."',
            "Fig. 33, pp. 105 and 123", "document", evaluate_factor_between_forces,
            fault={"cylinder_scale": 0.0}, fault_description="cylinders without mass",
            panel_labels=FORCE_LABELS,
        ),
        Claim(
            "neglected minor links: proximal links",
            '"a large error in force/torque prediction results, especially for the proximal links,'
            ' if we simply ignore the dynamics of the minor links"',
            "Fig. 33, pp. 105 and 106", "document", evaluate_proximal_error,
            fault={"cylinder_scale": 0.0}, fault_description="cylinders without mass", panel_labels=(),
        ),
    ),
)  # fmt: skip
"""Figs 30 to 33."""


COUNT_SETTINGS = {
    "ball_joints": True,  # whether the cylinders of the document's model end in ball joints
    "pins": True,  # whether the cylinders of the second model end in pins
    "tilt_deg": 0.0,  # slope of the ground
    "states": 300,  # number of random states in the regressor
}
_CLASS_NAMES = {"deleted": "unidentifiable", "combined": "linearly identifiable", "full": "fully identifiable"}
TABLE_13 = {"deleted": 31, "combined": 24, "full": 27}
"""Unidentifiable, linearly identifiable and fully identifiable parameters of 82 (p. 107)."""

PIN_COUNTS = {"deleted": 37, "combined": 25, "full": 20}
"""The same counts for cylinders with pins, computed by this project."""


def count_identifiability_classes(classification: Identifiability) -> dict[str, int]:
    """Count the unidentifiable, linearly identifiable and fully identifiable parameters of a regressor.

    Regressor columns without effect and columns that depend linearly on others are deleted; their
    parameters count as unidentifiable. The number of remaining columns is the rank.

    Args:
        classification: classification of all parameters.

    Returns:
        Counts `deleted` (unidentifiable), `combined` (linearly identifiable: remaining columns that
        represent a combination of parameters) and `full` (fully identifiable).

    Source: Khoshzaban 1992, p. 100.
    """
    rank, full = len(classification.base), classification.status_counts[STATUS_FULL]
    return {"deleted": len(classification.names) - rank, "combined": rank - full, "full": full}


def measure_identifiability(seed: int, changes: Changes) -> Sample:
    """Classify the CAT 215's 82 dynamic parameters for cylinders that end in ball joints and in pins.

    Args:
        seed: seed of the random states.
        changes: `ball_joints`: whether the cylinders of the first case end in ball joints; `pins`:
            whether those of the second case end in pins; `tilt_deg`: slope of the ground; `states`:
            number of random states.

    Returns:
        Per case (`document`: ball joints, `pins`): counts as in `count_identifiability_classes`; the
        `smallest` nonzero singular value and the `next` one, over the largest; number of parameters
        `without_effect`; whether these are the first nine of the swing; whether the swing's inertia Izz
        is identifiable in a combination only.
    """
    settings = merge_settings(COUNT_SETTINGS, changes)
    states = sample_states(settings["states"], seed)
    values = {}
    for kind, ball in (("document", settings["ball_joints"]), ("pins", not settings["pins"])):
        setup = make_thesis_regressor_setup("complete", ball, settings["tilt_deg"])
        table = make_regressor(setup, states)
        told = classify_parameters(stack_rows(table), table.names, table.units)
        values |= {f"{kind}.{name}": n for name, n in count_identifiability_classes(told).items()}
        values |= {
            f"{kind}.smallest": told.singular_value_gap[0],
            f"{kind}.next": told.singular_value_gap[1],
        }
        status = dict(zip(told.names, told.status, strict=True))
        lost = [name for name, s in status.items() if s == STATUS_UNIDENTIFIABLE]
        swing = [name for name in told.names if name.endswith(".swing")][:9]
        values[f"{kind}.without_effect"] = len(lost)
        values[f"{kind}.first_nine_lost"] = float(lost == swing)
        values[f"{kind}.swing_combined"] = float(status["inertia_zz.swing"] == STATUS_COMBINATION)
    return Sample(values)


def evaluate_identifiability_counts(samples: Sequence[Sample]) -> Evaluation:
    """Check that 31 parameters are unidentifiable, 24 linearly and 27 fully identifiable.

    These counts are those of Khoshzaban 1992, Table 13, for cylinders that end in ball joints.
    """
    values = samples[0].values
    checks = tuple(
        check_deterministic_value(f"{_CLASS_NAMES[name]} parameters", values[f"document.{name}"], (n, n),
                    "a count", published=n)
        for name, n in TABLE_13.items()
    )  # fmt: skip
    pins = "/".join(f"{values[f'pins.{name}']:.0f}" for name in TABLE_13)
    return Evaluation(
        checks,
        "The counts hold for cylinders that transmit no moment about their axes (Eq. 4.23, ball"
        " joints). Cylinders with pins transmit this moment, so that six combinations of the tubes'"
        " and rods' parameters and the links' inertias cannot be separated.",
        note=f"counts for cylinders with pins {pins}; smallest singular value within the rank and largest beyond it"
        f" {values['document.smallest']:.1g} and {values['document.next']:.0g} of the largest",
    )


def evaluate_counts_with_pin_joints(samples: Sequence[Sample]) -> Evaluation:
    """Check the numbers of unidentifiable and identifiable parameters for cylinders that end in pins.

    They must be 37 unidentifiable, 25 linearly and 20 fully identifiable parameters, as computed by
    this project.
    """
    values = samples[0].values
    return Evaluation(
        tuple(
            check_deterministic_value(f"{_CLASS_NAMES[name]} parameters", values[f"pins.{name}"], (n, n), "a count")
            for name, n in PIN_COUNTS.items()
        )
    )


def evaluate_swing_parameters(samples: Sequence[Sample]) -> Evaluation:
    """Check that nine inertial parameters of the swing have no effect and Izz appears in a combination.

    No other parameter may be without effect. Khoshzaban 1992, p. 107, states this. Izz is the swing's
    moment of inertia about the swing axis.
    """
    values = samples[0].values
    return Evaluation(
        (
            check_deterministic_value("parameters without effect", values["document.without_effect"], (9, 9),
                        "the first nine of the swing", published=9),
            check_deterministic_value("these are the first nine of the swing (1: yes, 0: no)",
                        values["document.first_nine_lost"], (1, 1), "yes"),
            check_deterministic_value("Izz of the swing is identifiable only in a combination (1: yes, 0: no)",
                        values["document.swing_combined"], (1, 1), "yes"),
        ),
    )  # fmt: skip


IDENTIFIABILITY = Experiment(
    "identifiability", measure_identifiability,
    (
        Claim(
            "identifiability of 82 parameters",
            '"the 31 unidentifiable parameters in Table 13 are marked with "*", the 24 linearly'
            ' identifiable ones are marked with "f", and the 27 fully identifiable parameters are'
            ' marked with "t"."',
            "Table 13, pp. 106 and 107", "document", evaluate_identifiability_counts,
            fault={"ball_joints": False}, fault_description="cylinders that end in pins",
        ),
        Claim(
            "identifiability with pins",
            "With cylinders that end in pins, 37 of the 82 parameters are unidentifiable, 25"
            " linearly identifiable and 20 fully identifiable.",
            "supplement to Table 13", "additional", evaluate_counts_with_pin_joints,
            fault={"pins": False}, fault_description="cylinders that end in ball joints",
        ),
        Claim(
            "parameters of the swing",
            '"the first nine parameters of the first link (cabin) are not identifiable because this'
            ' link has only one degree of freedom about its z axis"; Izz, alone, is identifiable'
            " only in linear combination in a multi-link manipulator",
            "Tables 13 and 16, pp. 107 and 113", "document", evaluate_swing_parameters,
            fault={"tilt_deg": 10.0}, fault_description="a machine on ground with a slope of 10 deg",
        ),
    ),
    fixed_repetitions=1,
)  # fmt: skip
"""Table 13."""


EXPERIMENTS: tuple[Experiment, ...] = (
    FORCE_COMPARISON,
    IDENTIFIABILITY,
    FORCE_ACCURACY,
    SENSOR_NOISE_EXPERIMENT,
    PREDICTION,
)
"""Experiments of chapter 4, in the order of the document."""

UNAVAILABLE: tuple[Comparison, ...] = (
    Comparison(
        "identified parameters of the UBC machine", "Tables 16 and 17, pp. 115 and 116",
        "identified parameters of the UBC hydraulic manipulator, complete and reduced model",
        "document",
        Evaluation(
            unavailable="the excavator's logs are not published, and its parameters are unknown"
        ),
    ),
)  # fmt: skip
"""Rows of chapter 4 that cannot be computed."""

DRAWINGS = {
    "Fig. 26": "coordinate frames of a link",
    "Fig. 27": "free-body diagram of a major link",
    "Fig. 28": "schematic of a hydraulic actuator",
    "Fig. 29": "free-body diagram of a hydraulic actuator",
    "Fig. 34": "block diagram of measurement and identification",
}
"""Figures of chapter 4 without a result."""

TABLES_AND_FIGURES = (
    *(f"Table {n}" for n in range(13, 18)),
    *(f"Fig. {n}" for n in range(26, 38)),
)
"""All tables and figures of chapter 4."""
