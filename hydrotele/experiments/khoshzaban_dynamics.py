"""Chapter 4 of Khoshzaban 1992: dynamic calibration of a hydraulic machine with minor links.

Section 4.4, by simulation: forces of the complete and the reduced model, which parameters can be
identified, and what the sensors' accuracy does to them. Section 4.6 is in `khoshzaban_prediction`.
"""

from collections.abc import Sequence

import numpy as np

from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Comparison,
    Experiment,
    Judgement,
    Panel,
    Sample,
)
from hydrotele.experiments.intervals import (
    check_exact,
    check_mean,
    check_statistic,
    collect,
    format_values,
)
from hydrotele.experiments.khoshzaban_models import (
    DRIVES,
    PERIOD,
    UNITS,
    Motion,
    document_setup,
    draw_motion,
    draw_states,
    find_base,
    make_regressor,
    read_settings,
    scale_cylinders,
    stack_rows,
)
from hydrotele.experiments.khoshzaban_prediction import PREDICTION, SENSOR_ACCURACY
from hydrotele.identify.identifiability import (
    COMBINATION,
    FULL,
    UNIDENTIFIABLE,
    Identifiability,
    identifiability,
)
from hydrotele.identify.smoothing import smooth
from hydrotele.machine.machine_file import load_machine

FORCE_SETTINGS = {
    "cylinder_scale": 1.0,  # of mass, mass moments and inertia of all tubes and rods
    "rods_beyond_pins": False,  # whether rods' centres of mass lie beyond their pins
}
_LARGE = 0.5  # of its peak, from which the factor between two forces means something


def measure_forces(seed: int, changes: Changes) -> Sample:
    """Forces of the complete and the reduced model along a motion.

    Args:
        seed: of the motion.
        changes: of `FORCE_SETTINGS`.

    Returns:
        Factors between the forces, and their differences.
    """
    settings = read_settings(FORCE_SETTINGS, changes)
    motion = draw_motion(np.random.default_rng(seed))
    table = make_regressor(document_setup("complete"), motion)
    parameters = scale_cylinders(table, settings["cylinder_scale"])
    if settings["rods_beyond_pins"]:
        turned = [name.startswith("moment_x") and name.endswith("_rod") for name in table.names]
        parameters = np.where(turned, -parameters, parameters)
    complete = table.matrix @ parameters
    reduced = table.matrix @ scale_cylinders(table, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.maximum(np.abs(complete / reduced), np.abs(reduced / complete))
    share = np.abs(complete) / np.abs(complete).max(axis=0)
    difference = np.sqrt(np.mean((complete - reduced) ** 2, axis=0))
    usual = np.sqrt(np.mean(complete**2, axis=0))
    values = {}
    for k, drive in enumerate(DRIVES):
        twice = factor[:, k] >= 2.0
        values[f"factor.{drive}"] = float(factor[share[:, k] >= _LARGE, k].max())
        values[f"twice.{drive}"] = float(twice.mean())
        values[f"twice_below.{drive}"] = float(share[twice, k].max(initial=0.0))
        values[f"difference.{drive}"] = float(difference[k])
        values[f"relative.{drive}"] = float(difference[k] / usual[k])
        values[f"peak_rate.{drive}"] = float(np.abs(motion[1][:, k]).max())
        values[f"peak.{drive}"] = float(np.abs(complete[:, k]).max())
    return Sample(values, _force_panels(motion, complete, reduced))


MOTION_LABELS = ("joint angle [deg]", "joint rate [rad/s]", "joint acceleration [rad/s^2]")
FORCE_LABELS = tuple(
    f"{what} of the {drive} [{unit}]"
    for what, drive, unit in zip(("torque", "force", "force"), DRIVES, UNITS, strict=True)
)


def _force_panels(motion: Motion, complete: np.ndarray, reduced: np.ndarray) -> tuple[Panel, ...]:
    time = PERIOD * np.arange(len(complete))
    angles, rates, accelerations = motion
    parts = (np.rad2deg(angles), rates, accelerations)
    panels = [
        Panel(label, time, {drive: part[:, k] for k, drive in enumerate(DRIVES)})
        for label, part in zip(MOTION_LABELS, parts, strict=True)
    ]
    for k, label in enumerate(FORCE_LABELS):
        curves = {"complete model": complete[:, k], "reduced model": reduced[:, k]}
        errors = {"complete less reduced": complete[:, k] - reduced[:, k]}
        panels.append(Panel(label, time, curves, errors=errors,
                            error_label=f"difference [{UNITS[k]}]"))  # fmt: skip
    return tuple(panels)


def judge_factor(samples: Sequence[Sample]) -> Judgement:
    """The factor between the models' forces has to reach two where the force is large."""
    largest = np.max([collect(samples, f"factor.{drive}") for drive in DRIVES], axis=0)
    check = check_mean(
        "largest factor between both models' forces, of three drives, at instants with more than"
        " half of the peak force",
        largest, (2.0, np.inf), '"a factor of two or more"; a factor near zero force means nothing',
        published=2.0,
    )  # fmt: skip
    twice = "; ".join(
        f"{d}: {format_values(samples, f'twice.{d}', 100.0, 0)} % of the time, where its force is"
        f" below {100 * collect(samples, f'twice_below.{d}').max():.0f} % of its peak"
        for d in DRIVES
    )
    relative = ", ".join(f"{d} {format_values(samples, f'relative.{d}', 100.0)} %" for d in DRIVES)
    return Judgement(
        (check,),
        "Table 13's cylinders, of 200 kg each beside links of 1830 and 688 kg, are too light for it:"
        " the boom's force reaches a factor of two with cylinders eight times as heavy (2.05), the"
        " swing's torque with ten times (1.99), the stick's with twice (2.2). Rods whose centres of"
        " mass lie beyond their pins, as mcx = 50 kg m reads in the rod's frame, give 1.35. Only"
        " where the stick's force is small does the factor exceed two.",
        note=f"RMS difference over RMS force: {relative}; factor of two: {twice}",
    )


def judge_proximal(samples: Sequence[Sample]) -> Judgement:
    """The boom's force has to be wrong by more than its sensors are, and more than the stick's."""
    rows = np.stack([collect(samples, f"difference.{d}") for d in ("boom", "stick")], axis=1)
    checks = (
        check_mean(
            "RMS difference of both models' forces, boom", rows[:, 0],
            (SENSOR_ACCURACY[1], np.inf), "large: above the sensors' accuracy (p. 108)", unit="N",
        ),
        check_statistic(
            "the same, boom over stick", rows,
            lambda r: float(np.linalg.norm(r[:, 0]) / max(np.linalg.norm(r[:, 1]), 1e-300)),
            (1.0, np.inf), "the proximal cylinder's error is the larger one",
        ),
    )  # fmt: skip
    sizes = ", ".join(
        f"{d} {format_values(samples, f'difference.{d}', digits=0)} {u}"
        for d, u in zip(DRIVES, UNITS, strict=True)
    )
    relative = ", ".join(f"{d} {format_values(samples, f'relative.{d}', 100.0)} %" for d in DRIVES)
    return Judgement(
        checks,
        "Of its own RMS force the stick's error is the larger one.",
        note=f"RMS differences {sizes}; of the RMS force {relative}",
    )


def judge_motion(samples: Sequence[Sample]) -> Judgement:
    """Motions are drawn within the axes' ticks, which are all that is legible."""
    rates = ", ".join(f"{d} {format_values(samples, f'peak_rate.{d}', digits=2)}" for d in DRIVES)
    return Judgement(note=f"drawn anew in every repetition; largest rates {rates} rad/s")


FORCES = Experiment(
    "complete and reduced model", measure_forces,
    (
        Claim(
            "simulated motions", "Simulated trajectory of the swing, the boom, the stick (axes in"
            " the document's signs: -40 to 20, -50 to 0, 0 to 150 deg; 0.4, 0.4, 1.5 rad/s; 5 s)",
            "Figs 30 to 32, pp. 102 to 104", "caption", judge_motion, panels=MOTION_LABELS,
        ),
        Claim(
            "neglected minor links: factor of two",
            '"neglecting the dynamics of the minor links (hydraulic actuators) may overestimate or'
            " underestimate the forces/torques applied to the joints/links of the arm by a factor"
            ' of two or more."',
            "Fig. 33, pp. 105 and 123", "document", judge_factor,
            broken={"cylinder_scale": 0.0}, broken_how="cylinders without mass",
            panels=FORCE_LABELS,
        ),
        Claim(
            "neglected minor links: proximal links",
            '"a large error in force/torque prediction results, especially for the proximal links,'
            ' if we simply ignore the dynamics of the minor links"',
            "Fig. 33, pp. 105 and 106", "document", judge_proximal,
            broken={"cylinder_scale": 0.0}, broken_how="cylinders without mass", panels=(),
        ),
    ),
)  # fmt: skip
"""Figs 30 to 33."""


COUNT_SETTINGS = {
    "ball_joints": True,  # ends of the cylinders in the document's model
    "pins": True,  # whether the model that is compared has pins instead
    "tilt_deg": 0.0,  # of the ground
    "states": 300,  # random states of the regressor
}
TABLE_13 = {"deleted": 31, "combined": 24, "full": 27}
"""Unidentifiable, linearly identifiable and fully identifiable parameters of 82 (p. 107)."""

PIN_COUNTS = {"deleted": 37, "combined": 25, "full": 20}
"""The same with pins, of this project."""


def count_parameters(told: Identifiability) -> dict[str, int]:
    """Counts in the document's words.

    Columns that have no effect and columns for which others can stand are deleted, and count as
    unidentifiable; what remains is as many as the rank.

    Args:
        told: classification of all parameters.

    Returns:
        `deleted`, `combined` (kept, and standing for a combination), `full`.

    Source: Khoshzaban 1992, p. 100.
    """
    rank, full = len(told.base), told.counts[FULL]
    return {"deleted": len(told.names) - rank, "combined": rank - full, "full": full}


def measure_identifiability(seed: int, changes: Changes) -> Sample:
    """Classify the 82 parameters of the complete model with ball joints and with pins.

    Args:
        seed: of the random states.
        changes: of `COUNT_SETTINGS`.

    Returns:
        Counts, and how clear the rank is.
    """
    settings = read_settings(COUNT_SETTINGS, changes)
    states = draw_states(settings["states"], seed)
    values = {}
    for kind, ball in (("document", settings["ball_joints"]), ("pins", not settings["pins"])):
        setup = document_setup("complete", ball, settings["tilt_deg"])
        table = make_regressor(setup, states)
        told = identifiability(stack_rows(table), table.names, table.units)
        values |= {f"{kind}.{name}": n for name, n in count_parameters(told).items()}
        values |= {f"{kind}.smallest": told.gap[0], f"{kind}.next": told.gap[1]}
        status = dict(zip(told.names, told.status, strict=True))
        lost = [name for name, s in status.items() if s == UNIDENTIFIABLE]
        swing = [name for name in told.names if name.endswith(".swing")][:9]
        values[f"{kind}.without_effect"] = len(lost)
        values[f"{kind}.first_nine_lost"] = float(lost == swing)
        values[f"{kind}.swing_combined"] = float(status["inertia_zz.swing"] == COMBINATION)
    return Sample(values)


def judge_table_13(samples: Sequence[Sample]) -> Judgement:
    """The counts have to be those of the table."""
    values = samples[0].values
    words = {"deleted": "unidentifiable", "combined": "linearly identifiable",
             "full": "fully identifiable"}  # fmt: skip
    checks = tuple(
        check_exact(f"{words[name]} parameters", values[f"document.{name}"], (n, n),
                    "a count", published=n)
        for name, n in TABLE_13.items()
    )  # fmt: skip
    pins = "/".join(f"{values[f'pins.{name}']:.0f}" for name in TABLE_13)
    return Judgement(
        checks,
        "The counts hold for cylinders that carry no moment about their axes (Eq. 4.23, ball"
        " joints). With pins the moment is carried, six combinations of the tubes' and rods'"
        " parameters and the links' inertias can no longer be separated.",
        note=f"with pins {pins}; singular values on either side of the rank"
        f" {values['document.smallest']:.1g} and {values['document.next']:.0g} of the largest",
    )


def judge_pins(samples: Sequence[Sample]) -> Judgement:
    """With pins the counts are those of this project."""
    values = samples[0].values
    return Judgement(
        tuple(
            check_exact(f"{name} parameters", values[f"pins.{name}"], (n, n), "a count")
            for name, n in PIN_COUNTS.items()
        )
    )


def judge_swing(samples: Sequence[Sample]) -> Judgement:
    """Nine of the swing's parameters have no effect, the tenth shows in a combination."""
    values = samples[0].values
    return Judgement(
        (
            check_exact("parameters without effect", values["document.without_effect"], (9, 9),
                        "the first nine of the swing", published=9),
            check_exact("they are the first nine of the swing",
                        values["document.first_nine_lost"], (1, 1), "1: yes"),
            check_exact("Izz of the swing shows in a combination",
                        values["document.swing_combined"], (1, 1), "1: yes"),
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
            "Table 13, pp. 106 and 107", "document", judge_table_13,
            broken={"ball_joints": False}, broken_how="cylinders that end in pins",
        ),
        Claim(
            "identifiability with pins",
            "With cylinders that end in pins, 37 of the 82 parameters are unidentifiable, 25"
            " linearly identifiable and 20 fully identifiable.",
            "beside Table 13", "additional", judge_pins,
            broken={"pins": False}, broken_how="cylinders that end in ball joints",
        ),
        Claim(
            "parameters of the swing",
            '"the first nine parameters of the first link (cabin) are not identifiable because this'
            ' link has only one degree of freedom about its z axis"; Izz, alone, is identifiable'
            " only in linear combination in a multi-link manipulator",
            "Tables 13 and 16, pp. 107 and 113", "document", judge_swing,
            broken={"tilt_deg": 10.0}, broken_how="a machine on ground with a slope of 10 deg",
        ),
    ),
    repetitions_fixed=1,
)  # fmt: skip
"""Table 13."""


NOISE_SETTINGS = {
    "noise": 1.0,  # of all sensors, times their accuracy
    "residual_noise": 0.0,  # the same where the document has none
    "pressure_gain": 5.0,  # by which the better pressure sensors are more accurate
    "cylinders_known": False,  # whether the complete model's cylinders are known exactly
}
ANGLE_ACCURACY = np.deg2rad(0.1)
"""Limit of a resolver's error [rad] (p. 107)."""


def measure_errors(seed: int, changes: Changes) -> Sample:
    """Errors of the parameters with pressure sensors of 25 psi, of 5 psi, and without errors.

    Uniform errors of the angles and forces are added to the simulated motion and forces; rates and
    accelerations are exact, because the document adds errors of resolvers and pressures only. The
    better sensors have the same errors, five times smaller, and in `independent` others.

    Args:
        seed: of the motion and the errors.
        changes: of `NOISE_SETTINGS`.

    Returns:
        Errors of the base parameters, of the parameters' own sizes.
    """
    settings = read_settings(NOISE_SETTINGS, changes)
    rng = np.random.default_rng(seed)
    motion = draw_motion(rng)
    rows = len(motion[0])
    angles = ANGLE_ACCURACY * rng.uniform(-1.0, 1.0, (2, rows, 3))
    forces = np.array(SENSOR_ACCURACY) * rng.uniform(-1.0, 1.0, (2, rows, 3))
    scale, rest, gain = (settings[k] for k in ("noise", "residual_noise", "pressure_gain"))
    derived = smooth(motion[0] + scale * angles[0], PERIOD, ANGLE_ACCURACY / np.sqrt(3.0))
    five = scale / gain
    # cases that share a motion: errors of its angles, and factors and numbers of the force errors
    plans = (
        (_add_angles(motion, scale * angles[0]), {"25 psi": (scale, 0), "5 psi": (five, 0)}),
        (_add_angles(motion, scale * angles[1]), {"independent": (five, 1)}),
        (_add_angles(motion, rest * angles[0]), {"none": (rest, 0)}),
        (motion, {"pressures 25 psi": (scale, 0), "pressures 5 psi": (five, 0)}),
        ((derived.value, derived.rate, derived.acceleration),
         {"differentiated 25 psi": (scale, 0), "differentiated 5 psi": (five, 0)}),
    )  # fmt: skip
    arrays = {}
    for model in ("complete", "reduced"):
        known = model == "complete" and settings["cylinders_known"]
        base = find_base("reduced" if known else model)
        table = make_regressor(base.setup, motion)
        exact = table.matrix @ table.nominal
        for measured, cases in plans:
            noisy = [exact + factor * forces[draw] for factor, draw in cases.values()]
            errors = np.abs(base.estimate(measured, np.array(noisy)) - base.truth) / base.sizes
            arrays |= {f"{model}.{case}": e for case, e in zip(cases, errors, strict=True)}
    values = {name: float(np.median(errors)) for name, errors in arrays.items()}
    return Sample(values, arrays=arrays)


def _add_angles(motion: Motion, errors: np.ndarray) -> Motion:
    return motion[0] + errors, motion[1], motion[2]


def _errors(samples: Sequence[Sample], name: str) -> np.ndarray:
    """(n, p) errors of all repetitions."""
    return np.array([sample.arrays[name] for sample in samples])


def _ratio_of_means(rows: np.ndarray) -> float:
    """Median over parameters of the ratio of two geometric means over repetitions (n, 2, p)."""
    logs = np.mean(np.log(np.maximum(rows, np.finfo(float).tiny)), axis=0)
    return float(np.median(np.exp(logs[0] - logs[1])))


def _improved(samples: Sequence[Sample], model: str, better: str) -> np.ndarray:
    """(n,) fraction of parameters whose error falls 10 to 100 times."""
    ratio = _errors(samples, f"{model}.25 psi") / _errors(samples, f"{model}.{better}")
    return np.mean((ratio >= 10.0) & (ratio <= 100.0), axis=1)


def _improvement_judge(model: str, more: str = ""):
    """Judge of the errors with 25 psi over those with 5 psi; `more` ends its note."""

    def judge(samples: Sequence[Sample]) -> Judgement:
        pairs = {
            name: np.stack([_errors(samples, f"{model}.{k}") for k in names], axis=1)
            for name, names in (
                ("", ("25 psi", "5 psi")),
                ("pressures", ("pressures 25 psi", "pressures 5 psi")),
                ("differentiated", ("differentiated 25 psi", "differentiated 5 psi")),
            )
        }
        reason = '"10 to 100 times"'
        independent = _improved(samples, model, "independent")
        checks = (
            check_statistic("error with 25 psi over error with 5 psi, median of the parameters",
                            pairs[""], _ratio_of_means, (10.0, 100.0), reason),
            check_mean("fraction of parameters whose error falls 10 to 100 times in one run with"
                       " independent errors", independent, (0.5, 1.0), "most parameters"),
        )  # fmt: skip
        only, smoothed = (_ratio_of_means(pairs[k]) for k in ("pressures", "differentiated"))
        return Judgement(
            checks,
            "The estimate is linear in the forces: five times smaller pressure errors make errors"
            f" five times smaller ({only:.3g} with exact angles), and fewer than five times where"
            f" angles are differentiated ({smoothed:.3g}). In single runs with independent errors"
            f" the ratio scatters: {100 * independent.mean():.0f} % of the parameters fall 10 to"
            " 100 times; of two independent normal errors of ratio 5 it would be 26 %. The"
            " document compares one run with one run.",
            note=f"runs in which most parameters fall 10 to 100 times:"
            f" {100 * np.mean(independent > 0.5):.0f} %{more}",
        )

    return judge


def judge_large_errors(samples: Sequence[Sample]) -> Judgement:
    """Almost all parameters of the complete model have to be off by their own size or more."""
    errors = _errors(samples, "complete.25 psi")
    check = check_mean(
        "fraction of base parameters of the complete model that are off by more than half of their"
        " size", np.mean(errors > 0.5, axis=1), (0.8, 1.0),
        "almost all: four of five; a parameter that is off by half of its size has a large error",
    )  # fmt: skip
    medians = ", ".join(
        f"{m} {np.median(_errors(samples, f'{m}.25 psi')):.3g}" for m in ("complete", "reduced")
    )
    return Judgement((check,), note=f"median error over size: {medians}")


def judge_without_errors(samples: Sequence[Sample]) -> Judgement:
    """Without errors of the sensors the parameters have to come out as printed."""
    checks = tuple(
        check_statistic(
            f"largest error over size of the {model} model, median of the runs",
            _errors(samples, f"{model}.none"), lambda r: float(np.median(r.max(axis=1))),
            (0.0, 5e-4), "three digits are printed",
        )
        for model in ("complete", "reduced")
    )  # fmt: skip
    return Judgement(checks)


def judge_reduced_errors(samples: Sequence[Sample]) -> Judgement:
    """Parameters of both models have to be less wrong in the reduced one."""
    names = [find_base(model).names for model in ("complete", "reduced")]
    if samples[0].arrays["complete.none"].size == len(names[1]):
        names[0] = names[1]
    shared = [name for name in names[1] if name in names[0]]
    rows = np.stack(
        [
            _errors(samples, f"{model}.25 psi")[:, [own.index(name) for name in shared]]
            for model, own in zip(("complete", "reduced"), names, strict=True)
        ],
        axis=1,
    )
    check = check_statistic(
        f"error in the complete over error in the reduced model, median of {len(shared)} parameters"
        " that both have", rows, _ratio_of_means, (2.0, np.inf), "much less: at most half",
    )  # fmt: skip
    return Judgement((check,))


_TABLE_15 = (
    "; of 13 entries of Table 15 that are legible and whose true value is zero, 10 fall 10 to 100"
    " times in the document's own pair of runs"
)

NOISE = Experiment(
    "sensor accuracy", measure_errors,
    (
        Claim(
            "large errors of the complete model",
            '"almost all the identified parameters contain large errors"',
            "Table 14, pp. 108 and 109", "document", judge_large_errors,
            broken={"noise": 1e-6}, broken_how="sensors a million times more accurate",
        ),
        Claim(
            "five times better pressure sensors, complete model",
            '"The error in this case, however, is much less (10 to 100 times) than the error for'
            ' the accuracy of +-25 psi."',
            "Table 14, pp. 108, 109 and 123", "document", _improvement_judge("complete"),
            broken={"pressure_gain": 1.0}, broken_how="the better sensors are not better",
        ),
        Claim(
            "five times better pressure sensors, reduced model",
            '"The error in this case, however, is much less (10 to 100 times) than the error for'
            ' the accuracy of +-25 psi."',
            "Table 15, pp. 108 and 110", "document", _improvement_judge("reduced", _TABLE_15),
            broken={"pressure_gain": 1.0}, broken_how="the better sensors are not better",
        ),
        Claim(
            "no error without noise",
            '"if no noise is injected to the sensors, the error in sensor readings tends to zero'
            " and again we obtain the same error-free parameters for the major and minor links as"
            ' the ones tabulated in Table 13."',
            "Tables 13 to 15, pp. 108 and 110", "document", judge_without_errors,
            broken={"residual_noise": 0.01}, broken_how="a hundredth of the noise remains",
        ),
        Claim(
            "reduced model identified more accurately",
            '"the error in the individual parameters of the reduced model is much less than that of'
            ' the corresponding parameters for the complete model."',
            "Tables 14 and 15, p. 110", "document", judge_reduced_errors,
            broken={"cylinders_known": True}, broken_how="cylinders of the complete model known",
        ),
    ),
    max_repetitions=40,
)  # fmt: skip
"""Tables 14 and 15."""


ACCURACY_SETTINGS = {"accuracy_psi": 25.0}


def measure_accuracy(seed: int, changes: Changes) -> Sample:
    """Largest errors of the drives' forces by those of the pressures, with the machine's areas."""
    pressure = 6894.757 * read_settings(ACCURACY_SETTINGS, changes)["accuracy_psi"]
    machine = load_machine("cat215")
    return Sample(
        {d: pressure * float(np.sum(machine.axes[d].hydraulic_drive.areas)) for d in DRIVES}
    )


def judge_accuracy(samples: Sequence[Sample]) -> Judgement:
    """Errors have to round to those that are printed."""
    return Judgement(
        tuple(
            check_exact(f"largest error, {drive}", samples[0].values[drive],
                        (limit - 50.0, 1.001 * (limit + 50.0)), unit=unit, published=limit,
                        reason="printed to hundreds, with a pound force that is 0.1 % small")
            for drive, limit, unit in zip(DRIVES, SENSOR_ACCURACY, UNITS, strict=True)
        )
    )  # fmt: skip


ACCURACY = Experiment(
    "accuracy of forces", measure_accuracy,
    (
        Claim(
            "accuracy of forces", "cabin: +-1400 N m, boom: +-5700 N, stick: +-4200 N",
            "Eqs 4.33 and 4.61, p. 108", "input", judge_accuracy,
            broken={"accuracy_psi": 5.0}, broken_how="sensors of 5 psi",
        ),
    ),
    repetitions_fixed=1,
)  # fmt: skip
"""Errors of the forces on which Tables 14 and 15 rest."""

EXPERIMENTS: tuple[Experiment, ...] = (FORCES, IDENTIFIABILITY, ACCURACY, NOISE, PREDICTION)
"""Chapter 4, in its order."""

UNAVAILABLE: tuple[Comparison, ...] = (
    Comparison(
        "identified parameters of the UBC machine", "Tables 16 and 17, pp. 115 and 116",
        "identified parameters of the UBC hydraulic manipulator, complete and reduced model",
        "document",
        Judgement(
            unavailable="the excavator's logs are not published, and its parameters are not known"
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
"""Figures of chapter 4 that show no result."""

ITEMS = (
    *(f"Table {n}" for n in range(13, 18)),
    *(f"Fig. {n}" for n in range(26, 38)),
)
"""Tables and figures of chapter 4, from the document's lists."""
