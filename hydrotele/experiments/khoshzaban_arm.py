"""Simulated calibrations of Khoshzaban 1992, sections 3.7 and 5.1: Tables 4 to 6.

The true machine is the nominal machine of the thesis, as in its own simulations (p. 56). The thesis
gives only the ranges and drifts of the trajectories in Figs 16 to 18. Every repetition therefore
draws new link motions and sensor errors; the published values belong to one trajectory.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hydrotele.calibrate.arm import identify_arm
from hydrotele.calibrate.design import sweep_poses
from hydrotele.calibrate.loop import Loop, loop_of, unit_of
from hydrotele.core.errors import InputError
from hydrotele.experiments.calibrator_readings import (
    RESOLVER,
    bend_level_joints,
    draw_sweeps,
    simulate_readings,
    true_numbers,
)
from hydrotele.experiments.comparison import (
    Changes,
    Check,
    Claim,
    Experiment,
    Judgement,
    Sample,
)
from hydrotele.experiments.intervals import (
    MAJORITY,
    check_exact,
    check_fraction,
    check_mean,
    check_population,
    check_statistic,
    collect,
)
from hydrotele.machine.machine_file import load_machine

MOVED = ("stick", "boom", "swing")
"""Links whose stages the thesis simulates, in its order."""

LISTS = {
    "pitch": {"offset.calibrator_twist", "offset.calibrator_yoke", "offset.grapple",
              "alpha.grapple", "a.grapple", "d.grapple", "alpha.pitch", "a.pitch"},
    "stick": {"held.pitch", "alpha.stick", "a.stick", "beta.stick"},
    "boom": {"held.stick", "alpha.boom", "a.boom", "beta.boom"},
    "swing": {"held.boom", "d.boom", "alpha.swing", "a.swing"},
}  # fmt: skip
"""Identifiable parameters of each stage by section 3.6.4 (pp. 55-56), without those of the ball."""

IDENTIFIED = {
    link: (f"p_xy.{link}", f"p_z.{link}", *sorted(names)) for link, names in LISTS.items()
}
"""Parameters identified in each stage, including the ball's distance and height."""

LENGTHS = ("p_z.swing", "p_xy.swing", "a.swing", "a.boom", "d.boom", "a.stick")
"""Identified lengths of Tables 4 to 6; `p_z.swing` is -d0 and `p_xy.swing` is -a0."""

TWISTS = ("alpha.swing", "alpha.boom", "beta.boom", "alpha.stick", "beta.stick")
"""Identified twists of Tables 4 to 6."""

SHORT = {"p_z.swing": "d0", "p_xy.swing": "a0", "a.swing": "a1", "a.boom": "a2", "d.boom": "d2",
         "a.stick": "a3"}  # fmt: skip

NOMINAL = {"p_z.swing": -0.840, "p_xy.swing": 2.160, "a.swing": 0.340, "a.boom": 5.180,
           "d.boom": -0.110, "a.stick": 1.800}  # fmt: skip
"""Table 2 (p. 56) [m]."""

# Tables 4 (p. 59), 5 and 6 (p. 61): identified lengths [m] with the signs of LENGTHS, twists
# minus those of Table 2 [deg], and iterations of links 3, 2 and 1.
PUBLISHED_LENGTHS = {
    "drift": (-0.908, 2.160, 0.306, 5.188, -0.110, 1.797),
    "sensor": (-0.913, 2.161, 0.298, 5.199, -0.100, 1.796),
    "flexible": (-0.758, 2.163, 0.513, 4.992, 0.728, 1.770),
}
PUBLISHED_TWISTS = {
    "drift": (0.0, 0.0, 0.0, 0.0, 0.0), "sensor": (-0.1, 0.2, -0.2, 0.0, 0.0),
    "flexible": (-6.7, 13.4, -7.4, -0.7, 0.0),
}  # fmt: skip
PUBLISHED_ITERATIONS = {"drift": (6, 11, 5), "sensor": (6, 14, 7), "flexible": (8, 20, 12)}


def published_error(case: str, name: str) -> float:
    """Return the error of a length in Tables 4 to 6 relative to Table 2 [m]."""
    return PUBLISHED_LENGTHS[case][LENGTHS.index(name)] - NOMINAL[name]


def root_mean_square(values: np.ndarray | Sequence[float]) -> float:
    """Return the root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def choose_settings(defaults: Mapping[str, Any], changes: Changes) -> dict[str, Any]:
    """Return the default settings of an experiment with changes applied.

    Raises:
        InputError: a changed key is not a setting.
    """
    unknown = sorted(set(changes) - set(defaults))
    if unknown:
        raise InputError(f"setting {unknown[0]}", f"is unknown; valid: {', '.join(defaults)}")
    return {**defaults, **changes}


class Condition(NamedTuple):
    """Disturbances of a simulated calibration.

    Attributes:
        drift: whether held links drift.
        accuracy: largest sensor error [rad].
        bend: standard deviation of the errors of bent joints [deg].
        lasting: whether a joint has the same error in all of its bent poses.
    """

    drift: bool
    accuracy: float = 0.0
    bend: float = 0.0
    lasting: bool = False


SETTINGS = {"drift": True, "accuracy": RESOLVER, "bend": 1.0, "bent_share": 0.35, "poses": 1.0}
"""Settings of `measure_simulations`.

- `drift`: whether held links drift.
- `accuracy`: largest sensor error [rad].
- `bend`: standard deviation of the errors of bent joints [deg].
- `bent_share`: fraction of the poses in which joints bend.
- `poses`: fraction of the document's number of poses.
"""


def identify_under(
    loop: Loop, condition: Condition, seed: int, share: float = 1.0, bent_share: float = 0.35
) -> dict[str, float]:
    """Identify links 3 to 1 from disturbed readings of the nominal machine.

    Args:
        loop: nominal chain, which is also the true one.
        condition: disturbances of the readings.
        seed: seed of trajectories and errors; the trajectories depend only on the seed.
        share: fraction of the document's number of poses.
        bent_share: fraction of the poses in which joints bend.

    Returns:
        `error.NAME` of the parameters [m] or [rad] and `iterations.LINK`. The error of a held
        link's angle is relative to its mean.
    """
    sweeps = draw_sweeps(np.random.default_rng([19, seed]), condition.drift, share)
    clean = [sweep_poses(loop, link, sweeps[link], seed) for link in MOVED]
    rng = np.random.default_rng([92, seed])
    stages = [
        simulate_readings(
            loop, one, rng if condition.accuracy else None, condition.accuracy or RESOLVER,
            bend_level_joints(loop, one, rng, condition.bend, bent_share, condition.lasting)
            if condition.bend else None,
        )
        for one in clean
    ]  # fmt: skip
    fit = identify_arm(loop, stages, weighted=False, chosen=IDENTIFIED)
    truth = dict(zip(fit.names, true_numbers(loop, loop, fit.names, clean), strict=True))
    truth |= {"p_xy.swing": float(np.hypot(*loop.ball[:2])), "p_z.swing": float(loop.ball[2])}
    kept = [n for n in fit.names if not n.startswith("p_") or n.endswith(".swing")]
    found = {f"error.{name}": fit.value(name) - truth[name] for name in kept}
    return found | {f"iterations.{stage.link}": float(stage.iterations) for stage in fit.stages}


def measure_simulations(seed: int, changes: Changes) -> Sample:
    """Identify the arm under every condition, with the same trajectories."""
    chosen = choose_settings(SETTINGS, changes)
    loop = loop_of(load_machine("calibrator"))
    drift, accuracy = chosen["drift"], chosen["accuracy"]
    conditions = {
        "drift": Condition(drift),
        "sensor": Condition(drift, accuracy),
        "flexible": Condition(drift, 0.0, chosen["bend"]),
        "lasting": Condition(drift, 0.0, chosen["bend"], True),
        "half": Condition(False, 0.5 * accuracy),
    }
    values = {}
    for case, condition in conditions.items():
        found = identify_under(loop, condition, seed, chosen["poses"], chosen["bent_share"])
        values |= {f"{case}.{name}": value for name, value in found.items()}
    for case in conditions:
        lengths = np.array([values[f"{case}.error.{n}"] for n in LENGTHS])
        values[f"{case}.lengths"] = root_mean_square(lengths)
        values[f"{case}.largest"] = float(np.abs(lengths).max())
        values[f"{case}.twists"] = root_mean_square([values[f"{case}.error.{n}"] for n in TWISTS])
        values[f"{case}.outer"] = root_mean_square(
            [values[f"{case}.error.{n}"] for n in TWISTS if not n.endswith(".swing")]
        )
        values[f"{case}.total"] = sum(values[f"{case}.iterations.{link}"] for link in MOVED)
    return Sample(values)


START_SETTINGS = {"length": 0.2, "angle": 10.0, "starts": 4, "poses": 1.0}
"""Settings of `measure_starts`.

`length` [m] and `angle` [deg] are the largest distances of an initial estimate from nominal,
`starts` is the number of initial estimates, and `poses` is the fraction of the poses.
"""


def measure_starts(seed: int, changes: Changes) -> Sample:
    """Identify the arm from the same readings with several initial estimates."""
    chosen = choose_settings(START_SETTINGS, changes)
    loop = loop_of(load_machine("calibrator"))
    rng = np.random.default_rng([7, seed])
    sweeps = draw_sweeps(rng, share=chosen["poses"])
    stages = [simulate_readings(loop, sweep_poses(loop, link, sweeps[link], seed), rng)
              for link in MOVED]  # fmt: skip
    first = identify_arm(loop, stages, weighted=False, chosen=IDENTIFIED)
    length, angle = chosen["length"], np.radians(chosen["angle"])
    moved = [n for n in first.names if n.partition(".")[0] in ("alpha", "a", "d", "beta")]
    # In the stages of stick and boom, the ball's height is relative to the initial estimate of d.
    compared = [n for n in first.names if not n.startswith("p_") or n.endswith(".swing")]
    worst = 0.0
    for _ in range(chosen["starts"]):
        start = {
            name: loop.value(name) + rng.uniform(-1.0, 1.0) * (
                length if unit_of(name) == "m" else angle
            ) for name in moved
        }  # fmt: skip
        fit = identify_arm(loop.with_values(start), stages, weighted=False, chosen=IDENTIFIED)
        worst = max(worst, *(abs(fit.value(n) - first.value(n)) for n in compared))
    return Sample({"spread": worst})


def measure_exact(seed: int, changes: Changes) -> Sample:
    """Identify the arm from readings without errors."""
    chosen = choose_settings({"accuracy": 0.0}, changes)
    loop = loop_of(load_machine("calibrator"))
    found = identify_under(loop, Condition(False, chosen["accuracy"]), seed)
    errors = [value for name, value in found.items() if name.startswith("error.")]
    return Sample({"worst": float(np.abs(errors).max())})


def check_lengths(samples: Sequence[Sample], case: str) -> list[Check]:
    """Return checks whether the published length errors agree with the repetitions."""
    return [
        check_population(
            f"error of {SHORT[name]}", 1e3 * collect(samples, f"{case}.error.{name}"),
            1e3 * published_error(case, name), "mm", log=False,
        ) for name in LENGTHS
    ]  # fmt: skip


def check_leader(samples: Sequence[Sample], case: str) -> Check:
    """Return a check of the fraction of trajectories in which d0 has the largest length error."""
    leads = [abs(s.values[f"{case}.error.p_z.swing"]) >= s.values[f"{case}.largest"]
             for s in samples]  # fmt: skip
    return check_fraction(
        "trajectories in which d0 has the largest error", leads, MAJORITY,
        "more than half of the trajectories; the publication had one",
    )  # fmt: skip


def describe_lengths(samples: Sequence[Sample], case: str) -> str:
    """Return the RMS errors of the lengths over the repetitions as text."""
    sizes = [f"{SHORT[n]} {1e3 * root_mean_square(collect(samples, f'{case}.error.{n}')):.0f}"
             for n in LENGTHS]  # fmt: skip
    return f"RMS errors in mm: {', '.join(sizes)}"


def check_rms_ratio(
    quantity: str, samples: Sequence[Sample], names: tuple[str, str], accepted: tuple[float, float],
    reason: str, published: float | None = None,
) -> Check:  # fmt: skip
    """Return a check of the ratio of the RMS values of two results over the repetitions."""
    rows = np.column_stack([collect(samples, name) for name in names])

    def ratio(values: np.ndarray) -> float:
        return root_mean_square(values[:, 0]) / root_mean_square(values[:, 1])

    return check_statistic(quantity, rows, ratio, accepted, reason, published=published)


A3_REASON = (
    "a3 is identified first; its error depends only on the boom's drift in the stick's stage, of"
    " which Fig. 16(b) gives only the size"
)


def judge_drift(samples: Sequence[Sample]) -> Judgement:
    """Compare the errors under drift alone with Table 4."""
    # alpha 1 is the only twist that drift changes; it is printed as -90.0 deg.
    twist = check_population(
        "error of alpha 1", np.degrees(collect(samples, "drift.error.alpha.swing")), 0.0, "deg",
        log=False,
    )  # fmt: skip
    return Judgement(
        (check_leader(samples, "drift"), *check_lengths(samples, "drift"), twist),
        A3_REASON,
        note=describe_lengths(samples, "drift"),
    )


def judge_sensors(samples: Sequence[Sample]) -> Judgement:
    """Compare the errors under drift and sensor errors with Table 5."""
    twists = check_population(
        "RMS error of alpha and beta", np.degrees(collect(samples, "sensor.twists")),
        root_mean_square(PUBLISHED_TWISTS["sensor"]), "deg",
    )  # fmt: skip
    proportion = check_rms_ratio(
        "alpha and beta errors of links 2 and 3, sensors within 0.1 deg over 0.05 deg", samples,
        ("sensor.outer", "half.outer"), (1.5, 2.5), "proportional is 2, within a quarter", 2.0,
    )  # fmt: skip
    return Judgement(
        (check_leader(samples, "sensor"), *check_lengths(samples, "sensor"), twists, proportion),
        A3_REASON,
        note=describe_lengths(samples, "sensor"),
    )


def judge_flexible(samples: Sequence[Sample]) -> Judgement:
    """Compare the errors under drift and bent joints with Table 6."""
    largest = {case: max(abs(published_error(case, n)) for n in LENGTHS)
               for case in ("flexible", "sensor")}  # fmt: skip
    ratio = largest["flexible"] / largest["sensor"]
    lengths = root_mean_square([published_error("flexible", n) for n in LENGTHS])
    a2, a3 = (abs(published_error("flexible", n)) for n in ("a.boom", "a.stick"))
    checks = (
        check_rms_ratio(
            "largest length error over that with sensors and drift", samples,
            ("flexible.largest", "sensor.largest"), (0.5 * ratio, 2.0 * ratio),
            "a factor of 2 around a single sample of errors", ratio,
        ),
        check_population("RMS error of the lengths", 1e3 * collect(samples, "flexible.lengths"),
                         1e3 * lengths, "mm"),
        check_population("RMS error of alpha and beta",
                         np.degrees(collect(samples, "flexible.twists")),
                         root_mean_square(PUBLISHED_TWISTS["flexible"]), "deg"),
        check_rms_ratio(
            "error of a2 over that of a3", samples,
            ("flexible.error.a.boom", "flexible.error.a.stick"), (0.5 * a2 / a3, np.inf),
            "errors grow very rapidly from the last link to the first: at least half as much",
            a2 / a3,
        ),
    )  # fmt: skip
    lasting = check_lasting_ratio(samples)
    twists = root_mean_square(np.degrees(collect(samples, "lasting.twists")))
    return Judgement(
        checks,
        "errors that are independent in every pose average out over 300 poses; if each joint"
        f" has one constant error in a stage, {lasting.describe()} and the RMS error of alpha and"
        f" beta is {twists:.1f} deg",
        describe_lengths(samples, "flexible"),
    )


def check_lasting_ratio(samples: Sequence[Sample]) -> Check:
    """Return a check of the largest error if a joint has one error in all bent poses of a stage."""
    ratio = 838.0 / 73.0
    return check_rms_ratio(
        "the largest length error over that with sensors and drift", samples,
        ("lasting.largest", "sensor.largest"), (0.5 * ratio, 2.0 * ratio),
        "a factor of 2 around a single sample of errors", ratio,
    )  # fmt: skip


def judge_lasting(samples: Sequence[Sample]) -> Judgement:
    """Compare the errors under drift and constantly bent joints with Table 6."""
    return Judgement((check_lasting_ratio(samples),), note=describe_lengths(samples, "lasting"))


def judge_relative_error(samples: Sequence[Sample]) -> Judgement:
    """Compare the relative error of a1 with p. 60."""
    size = NOMINAL["a.swing"]
    half = 100.0 * collect(samples, "half.error.a.swing") / size
    both = 100.0 * np.abs(collect(samples, "sensor.error.a.swing")) / size
    return Judgement((
        check_statistic(
            "95 % limit (1.96 RMS) with 0.05 deg and no drift", half,
            lambda values: 1.96 * root_mean_square(values), (1.25, 5.0),
            "a factor of 2 around the maximum of an unknown number of runs", unit="%",
            published=2.5,
        ),
        check_population("error with drift and 0.1 deg", both, 10.0, "%"),
    ))  # fmt: skip


def judge_sensor_share(samples: Sequence[Sample]) -> Judgement:
    """Compare the fraction of a1's error due to the sensors with p. 60."""
    rows = np.column_stack([collect(samples, f"{case}.error.a.swing")
                            for case in ("half", "sensor", "drift")])  # fmt: skip

    def share(values: np.ndarray) -> float:
        return 2.0 * root_mean_square(values[:, 0]) / root_mean_square(values[:, 1])

    alone = root_mean_square(rows[:, 2]) / root_mean_square(rows[:, 1])
    return Judgement(
        (check_statistic("error of a1 by sensors of 0.1 deg over that with drift", rows, share,
                         (0.35, 0.65), "half, to one digit", published=0.5),),
        f"drift alone causes {alone:.2f} times the error of both, so that the sensors contribute"
        " little; by Tables 4 and 5, drift causes 34 of 42 mm",
    )  # fmt: skip


def judge_iterations(samples: Sequence[Sample]) -> Judgement:
    """Compare the numbers of iterations with p. 62."""
    totals = {case: sum(counts) for case, counts in PUBLISHED_ITERATIONS.items()}
    checks = []
    for case in ("sensor", "flexible"):
        ratio = totals[case] / totals["drift"]
        checks.append(check_rms_ratio(
            f"iterations, {case} over drift alone", samples, (f"{case}.total", "drift.total"),
            (1.0 + 0.5 * (ratio - 1.0), np.inf), "at least half of the published increase", ratio,
        ))  # fmt: skip
    most = [
        s.values[f"{case}.iterations.boom"]
        == max(s.values[f"{case}.iterations.{link}"] for link in MOVED)
        for s in samples
        for case in totals
    ]
    checks.append(check_fraction("calibrations in which link 2 needs most", most, MAJORITY,
                                 "more than half; in all three tables"))  # fmt: skip
    words = [f"{case} " + ", ".join(f"{collect(samples, f'{case}.iterations.{link}').mean():.0f}"
                                    for link in MOVED) for case in totals]  # fmt: skip
    return Judgement(
        tuple(checks),
        "the solver reduces its truncation of singular values in four steps, each of which needs at"
        " least one iteration, so that any data need about 8 iterations per link",
        f"links 3, 2 and 1: {'; '.join(words)}",
    )


def judge_usual_errors(samples: Sequence[Sample]) -> Judgement:
    """Compare the relative errors under drift and sensor errors of 0.1 deg with p. 122."""
    errors = np.array([[abs(s.values[f"sensor.error.{n}"] / NOMINAL[n]) for n in LENGTHS]
                       for s in samples])  # fmt: skip
    rms = [f"{SHORT[n]} {100 * root_mean_square(errors[:, k]):.1f}" for k, n in enumerate(LENGTHS)]
    return Judgement(
        (check_mean("fraction of the lengths with errors below 5 %", (errors < 0.05).mean(axis=1),
                    MAJORITY, "usually: more than half"),),
        note=f"RMS errors in %: {', '.join(rms)}; Table 5 itself has 3 of 6 below 5 %",
    )  # fmt: skip


def judge_starts(samples: Sequence[Sample]) -> Judgement:
    """Check that all initial estimates give the same result (pp. 62 and 121)."""
    return Judgement((
        check_exact("largest difference of the results", float(collect(samples, "spread").max()),
                    (0.0, 5e-4), "half of the last printed digit of a length", unit="m or rad"),
    ))  # fmt: skip


def judge_exact(samples: Sequence[Sample]) -> Judgement:
    """Check that readings without errors give the true parameters."""
    return Judgement((
        check_exact("largest error of a parameter", float(collect(samples, "worst").max()),
                    (0.0, 1e-9), "rounding only", unit="m or rad"),
    ))  # fmt: skip


EXPERIMENTS = (
    Experiment("exact readings", measure_exact, (
        Claim(
            "readings without error", "every parameter is recovered", "section 3.7, p. 56",
            "additional", judge_exact, {"accuracy": 1e-6}, "sensor errors are within 1 urad",
        ),
    ), repetitions_fixed=1),
    Experiment("simulated calibrations", measure_simulations, (
        Claim(
            "drift alone",
            "The maximum error belongs to d0 (0.068 m); the drift does not contribute any"
            " significant error: a1 -34, a2 +8, a3 -3 mm, alpha and beta 0.0 deg",
            "Table 4, section 3.7.1, pp. 59-60", "document", judge_drift, {"drift": False},
            "held links do not drift",
        ),
        Claim(
            "drift and sensors of 0.1 deg",
            '"the accuracy of the calibrator sensors proportionally altered" alpha and beta (0.1 to'
            " 0.2 deg); d0 errs by 73 mm, a1 -42, a2 +19, a3 -4 mm",
            "Table 5, section 3.7.2, pp. 60-61", "document", judge_sensors,
            {"drift": False}, "held links do not drift",
        ),
        Claim(
            "drift and flexible joints",
            '"the error is dramatically higher than the previous cases and propagates from the last'
            ' link to the first link very rapidly": d2 838, a2 -188, a1 +173, d0 82, a3 -30 mm,'
            " alpha 2 13.4 deg, beta 2 -7.4 deg",
            "Table 6, section 3.7.3, pp. 61-62", "document", judge_flexible, {"bend": 0.0},
            "joints do not bend",
        ),
        Claim(
            "drift and joints that stay bent",
            "if each joint has one error, drawn from N(0, 1 deg), in all bent poses of a stage, the"
            " largest error grows as in Table 6",
            "Table 6, section 3.7.3, pp. 61-62", "additional", judge_lasting, {"bend": 0.0},
            "joints do not bend",
        ),
        Claim(
            "relative error of a1",
            '"one should expect a maximum relative error of 2.5% in a1" with sensors within 0.05'
            " deg; about 10 % with drift and 0.1 deg",
            "section 3.7.2, p. 60", "document", judge_relative_error,
            {"accuracy": 10.0 * RESOLVER}, "sensor errors are ten times as large",
        ),
        Claim(
            "share of the sensors in the error of a1",
            '"about half of the error obtained here is due to the sensor accuracy"',
            "section 3.7.2, p. 60", "document", judge_sensor_share, {"accuracy": 0.1 * RESOLVER},
            "sensor errors are a tenth as large",
        ),
        Claim(
            "iterations",
            '"the number of iterations required to identify the unknown parameters for a particular'
            ' joint increases dramatically as the data gets noisier": 22, 27, 40 for links 3, 2 and'
            " 1 together, link 2 needs most",
            "Tables 4 to 6, section 3.7.3, p. 62", "document", judge_iterations,
            {"accuracy": 0.0, "bend": 0.0}, "all three conditions have the same data",
        ),
        Claim(
            "errors with resolvers of 0.1 deg",
            '"errors in the identified parameters to be usually less than 5%"',
            "section 5.1, p. 122", "document", judge_usual_errors, {"accuracy": 50.0 * RESOLVER},
            "sensor errors are within 5 deg",
        ),
    )),
    Experiment("first estimates", measure_starts, (
        Claim(
            "first estimates",
            '"A number of different initial conditions were tried, but the iterations always ended'
            ' up with the same results"',
            "section 3.8.1, p. 62; section 5.1, p. 121", "document", judge_starts,
            {"length": 4.0, "angle": 90.0}, "starts up to 4 m and 90 deg from nominal",
        ),
    ), max_repetitions=10),
)  # fmt: skip
