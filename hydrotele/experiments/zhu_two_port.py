"""Zhu 1994, pages 28 to 37: the two-port, its passivity and stability, direct force.

A two-port relates force and velocity of the operator's hand to those of the task. All rows except
that of a pressing excavator use the parameters of `teleop/cat215_axis.yaml`. If the document
assumes identical sides, master and slave both have the master's parameters. Random cases have a
fixed seed, so that most experiments have one repetition.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Evaluation,
    Experiment,
    Kind,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.scenario_runs import (
    make_random_operator_settings,
    read_true_channel,
    run_shipped_scenario,
)
from hydrotele.experiments.statistical_checks import (
    check_deterministic_value,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.teleop.case_file import TeleoperatorAxis, load_teleop_case
from hydrotele.teleop.linear_analysis import find_gain_margin
from hydrotele.teleop.simulation_check import compare_stability
from hydrotele.teleop.two_port import (
    Impedance,
    TwoPort,
    hybrid_matrix,
    hybrid_scattering_norm,
    scattering_norm,
    transmitted_impedance,
)

ROUNDING_RANGE = (0.0, 1e-9)
"""Accepted relative difference between two computations of the same quantity."""
HAND_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.1, 5.0, 60)  # rad/s, bandwidth of a human hand
WIDE_FREQUENCIES = 2.0 * np.pi * np.geomspace(1e-3, 1e3, 2000)  # rad/s
NOTICEABLE_DIFFERENCE = 0.23  # just noticeable relative difference of a compliance; Tan 1995
PASSIVE_NORM = 1.0 + 1e-9  # largest scattering norm of a passive two-port, with rounding


def make_deterministic_experiment(name: str, measure: Callable[[Changes], Sample], *claims: Claim) -> Experiment:
    """Return an experiment that is run once, because its measurement `measure` needs no seed."""
    return Experiment(name, partial(_measure_without_seed, measure), claims, fixed_repetitions=1)


def _measure_without_seed(measure: Callable[[Changes], Sample], seed: int, changes: Changes) -> Sample:
    return measure(changes)


def load_shipped_case() -> TeleoperatorAxis:
    """Load the teleoperator axis of `cat215_axis.yaml`, without communication delay."""
    return load_teleop_case().to_axis().with_delay(0.0)


def make_identical_sides_case() -> TeleoperatorAxis:
    """Return the shipped teleoperator axis with the master's parameters for master and slave."""
    case = load_shipped_case()
    return dataclasses.replace(case, slave=case.master, slave_control=case.master_control)


def make_constant_block(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of the complex frequency s that has the same value at all frequencies."""
    return lambda s: np.full_like(s, value)


def compute_relative_error(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest absolute difference of two arrays over the largest expected magnitude."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


# --- p. 28 to 32: the network ---------------------------------------------------------------------


def measure_hybrid_matrix(changes: Changes) -> Sample:
    """Compare formulas of hybrid matrix and felt impedance with a numerical solution of the equations.

    The equations are those of the general two-port structure, Zhu 1994, Fig. 3.13, with random
    impedances.

    Args:
        changes: `velocity_back_sign`: sign of the velocity that is returned from the slave to the master,
            in the numerical solution.

    Returns:
        Largest relative errors of the formulas of hybrid matrix (`matrix`) and felt impedance (`felt`).
    """
    given = merge_settings({"velocity_back_sign": 1.0}, changes)
    rng = np.random.default_rng(313)
    errors = {"matrix": 0.0, "felt": 0.0}
    for _ in range(50):
        sizes = rng.uniform(0.2, 5.0, (9, 3))
        parts = [Impedance(*size) for size in sizes]
        master, slave, own, held, c1, c2, c3, c4, task = parts
        port = TwoPort(master, slave, own, held, c1, c2, c3, c4)
        w = rng.uniform(0.5, 20.0)
        s = np.array(1j * w)
        a, b = master(s) + own(s), slave(s) + held(s)
        back = given["velocity_back_sign"] * c4(s)
        # unknown F_h, V_e: F_h - C4 V_e = A V_h + C2 F_e; -C3 F_h + B V_e = C1 V_h - F_e
        matrix = np.array([[1.0, -back], [-c3(s), b]])
        solved = np.linalg.solve(matrix, np.array([[a, c2(s)], [c1(s), -1.0]]))
        solved[1] *= -1.0
        errors["matrix"] = max(errors["matrix"], compute_relative_error(hybrid_matrix(port, s), solved))
        # with F_e = Z_e V_e and V_h = 1
        whole = np.array([[1.0, -back - c2(s) * task(s)], [-c3(s), b + task(s)]])
        felt = np.linalg.solve(whole, np.array([a, c1(s)]))[0]
        found = transmitted_impedance(port, s, task)
        errors["felt"] = max(errors["felt"], float(abs(found / felt - 1.0)))
    return Sample(errors)


def evaluate_hybrid_matrix(samples: Sequence[Sample]) -> Evaluation:
    """Check that the formulas of hybrid matrix and felt impedance agree with a numerical solution.

    The formulas are Zhu 1994, (3.11) and (3.12), for the general two-port structure.
    """
    values, reason = samples[0].values, "rounding: two solutions of the same equations"
    return Evaluation((
        check_deterministic_value("largest relative error of the hybrid matrix (3.11)", values["matrix"],
                    ROUNDING_RANGE, reason),
        check_deterministic_value(
            "largest relative error of the felt impedance (3.12)", values["felt"], ROUNDING_RANGE, reason),
    ))  # fmt: skip


def measure_delayed_channel(changes: Changes) -> Sample:
    """Compute the scattering norm of a channel that only delays force and velocity.

    A norm above 1 means that the channel is not passive.

    Args:
        changes: `wave_impedance`: 0 for the delayed channel, 1 to compute `least` for a lossless
            transmission line in its place.

    Returns:
        `least`: smallest value over six delays of the largest norm over frequencies. `lossless`: largest
        norm of a lossless transmission line over delays and frequencies.
    """
    given = merge_settings({"wave_impedance": 0.0}, changes)
    delays = np.array([1e-3, 1e-2, 5e-2, 0.2, 1.0, 5.0])
    s = 1j * np.geomspace(0.05, 500.0, 4001)
    norms, lossless = [], []
    for delay in delays:
        late = np.exp(-s * delay)
        zero = np.zeros_like(s)
        plain = np.moveaxis(np.array([[zero, late], [-late, zero]]), (0, 1), (-2, -1))
        # b = 1: F_m = F_s late + (V_m - V_s late) b, V_s = V_m late + (F_m late - F_s) / b
        turn, secant = np.tanh(s * delay), 1.0 / np.cosh(s * delay)
        line = np.moveaxis(np.array([[turn, secant], [-secant, turn]]), (0, 1), (-2, -1))
        lossless.append(hybrid_scattering_norm(line).max())
        norms.append(hybrid_scattering_norm(line if given["wave_impedance"] else plain).max())
    return Sample({"least": min(norms), "lossless": max(lossless)}, (
        Panel("largest scattering norm [1]", delays, {"delayed force and velocity":
              np.array(norms), "lossless line": np.array(lossless)}, "delay [s]", True, True),
    ))  # fmt: skip


def evaluate_delayed_channel(samples: Sequence[Sample]) -> Evaluation:
    """Check that a channel with delayed force and velocity is not passive for any delay.

    For every tested delay, the largest scattering norm over frequencies must exceed 1.
    """
    values = samples[0].values
    return Evaluation(
        (check_deterministic_value(
            "largest scattering norm over frequency, smallest value of six delays from 1 ms to 5 s",
                     values["least"], (PASSIVE_NORM, np.inf), "above 1 is not passive (3.6)"),),
        note=f"a lossless line with the same delays has {values['lossless']:.3g}",
    )  # fmt: skip


_DELAYS, _GAIN_FACTORS = np.array([0.0, 0.02, 0.1]), np.array([0.1, 1.0, 5.0, 30.0])


def compare_nyquist_with_simulation(changes: Changes) -> Sample:
    """Compare predicted stability with the simulated impulse response of four teleoperator structures.

    The prediction applies the argument principle (Nyquist criterion) to the loop transfer functions. Three
    delays and four gains are tested per structure.

    Args:
        changes: `simulated_task`: stiffness factor of the simulated task.

    Returns:
        `fraction` of the loops in which prediction and simulation agree, and number of loops (`cells`).
    """
    given = merge_settings({"simulated_task": 1.0}, changes)
    case, right, cells = load_shipped_case(), 0, 0
    stiffness = given["simulated_task"] * case.task.stiffness
    real = dataclasses.replace(case, task=dataclasses.replace(case.task, stiffness=stiffness))
    for structure in ("position_position", "position_force", "rate_position", "rate_force"):
        predicted = compare_stability(case, structure, _DELAYS, _GAIN_FACTORS)
        seen = predicted.simulated
        if given["simulated_task"] != 1.0:
            seen = compare_stability(real, structure, _DELAYS, _GAIN_FACTORS).simulated
        right += int(np.sum(predicted.predicted == seen))
        cells += seen.size
    return Sample({"fraction": right / cells, "cells": float(cells)})


def evaluate_nyquist_agreement(samples: Sequence[Sample]) -> Evaluation:
    """Check that the Nyquist criterion and the simulated impulse response agree for all loops."""
    values = samples[0].values
    return Evaluation((
        check_deterministic_value(f"fraction of {values['cells']:.0f} loops (four structures, three delays, four"
                    " gains) "
                "in which the stability criterion and the simulated response to a kick (initial velocity) "
                "agree", values["fraction"],
                    (1.0, 1.0), "the criterion is necessary and sufficient"),
    ))  # fmt: skip


# --- p. 32 to 37: coordinating force and force feedback -------------------------------------------


def compare_with_mechanical_equivalent(changes: Changes) -> Sample:
    """Compare the position-position structure with two masses joined by a spring and a damper.

    Args:
        changes: `slave_gain`: gain of the slave's over the master's controller; `coupling_gain`: factor
            of spring and damper between the masses.

    Returns:
        `norm`: largest scattering norm of the position-position structure. `difference`: largest relative
        difference of its hybrid matrix from that of the joined masses.
    """
    given = merge_settings({"slave_gain": 1.0, "coupling_gain": 1.0}, changes)
    case = make_identical_sides_case()
    control, k = case.master_control, given["slave_gain"]
    held = Impedance(0.0, k * control.damping, k * control.stiffness)
    port = dataclasses.replace(case, slave_control=held).make_port("position_position")
    s = 1j * WIDE_FREQUENCIES
    # masses M_m and M_s joined by C: F_h = Z_m V_h + C (V_h - V_e), -F_e = Z_s V_e - C (V_h - V_e)
    a, b = port.master(s), port.slave(s)
    c = given["coupling_gain"] * control(s)
    whole = b + c
    rows = [[a + c - c * c / whole, c / whole], [-c / whole, 1.0 / whole]]
    network = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    found = hybrid_matrix(port, s)
    error = np.abs(found - network).max(axis=0) / np.abs(network).max(axis=0)
    return Sample({"norm": float(scattering_norm(port, s, 30.0).max()),
                   "difference": float(error.max())})  # fmt: skip


def evaluate_passivity(samples: Sequence[Sample]) -> Evaluation:
    """Check that the position-position structure is passive: its scattering norm is at most 1."""
    return Evaluation((
        check_deterministic_value("largest scattering norm, 1 mHz to 1 kHz", samples[0].values["norm"],
                    (0.0, PASSIVE_NORM), "passive (3.6), with rounding"),
    ))  # fmt: skip


def evaluate_mechanical_equivalent(samples: Sequence[Sample]) -> Evaluation:
    """Check that the position-position structure has the hybrid matrix of two joined masses.

    A spring and a damper join the masses. Differences may be rounding only.
    """
    return Evaluation((
        check_deterministic_value("largest relative difference of the hybrid matrices",
                    samples[0].values["difference"], ROUNDING_RANGE, "rounding"),
    ))  # fmt: skip


_FIRST_TARGET_DURATION = 16.0  # duration of the first target, 20 kN [s]


def measure_contact_position_error(seed: int, changes: Changes) -> Sample:
    """Compare the position error due to a contact force with the measurement noise.

    The excavator presses with 20 kN under stiffness feedback. The joystick's stiffness is also
    compared with the law of Zhu 1994, (4.1).

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        `shift`: change of the mean position error (reference minus measured height) from free motion to
        contact [m]. `noise`: standard deviation of measured minus true height [m]. `ratio`: shift over
        noise. `force`: estimated contact force [N]. `law`: RMS relative difference of the joystick's
        stiffness from (4.1).
    """
    keys = {"duration": str(_FIRST_TARGET_DURATION)} | make_random_operator_settings(seed) | dict(changes)
    scenario, run = run_shipped_scenario("press_stiffness", keys)
    m = run.measured
    height = np.interp(m.time, run.truth.time, read_true_channel(run, "truth.tip.z"))
    error = m["tip_reference.z"] - m["tip_pose.z"]
    free, late = (m.time > 0.3) & (m.time < 1.0), m.time > _FIRST_TARGET_DURATION - 5.0
    shift = float(abs(error[late].mean() - error[free].mean()))
    noise = float((m["tip_pose.z"] - height)[late].std())
    force = float(np.mean(m["tip_force.z"][late]))
    pushed = late & (np.abs(m["handle.z"]) > 1e-4)
    felt = -np.sign(m["handle.z"]) * m["tip_force.z"]  # stiffer where the hand presses on
    law = np.clip(600.0 + (4000.0 - 600.0) / 50e3 * felt, 300.0, 4000.0)
    off = float(np.sqrt(np.mean((m["handle_stiffness.z"] / law - 1.0)[pushed] ** 2)))
    values = {"ratio": shift / noise, "shift": shift, "noise": noise, "force": force, "law": off}
    return Sample(values, (
        Panel("position error of the bucket [mm]", m.time, {
            "reference - measured": 1e3 * error, "reference - true":
            1e3 * (m["tip_reference.z"] - height)}),
        Panel("contact force [kN]", m.time, {"estimated": m["tip_force.z"] / 1e3}),
    ))  # fmt: skip


def evaluate_position_error(samples: Sequence[Sample]) -> Evaluation:
    """Check that the position error due to a contact force is smaller than the measurement noise."""
    return Evaluation(
        (check_mean("position error due to contact over the RMS noise of the measured"
                    " position", collect_values(samples, "ratio"), (-np.inf, 1.0),
                    "smaller than the noise"),),
        note=f"position error {format_values(samples, 'shift', 1e3)} mm with a contact force of"
        f" {format_values(samples, 'force', 1e-3)} kN; RMS noise {format_values(samples, 'noise', 1e3)}"
        " mm, from the angle sensors of khoshzaban1992",
    )  # fmt: skip


def evaluate_stiffness_law(samples: Sequence[Sample]) -> Evaluation:
    """Check that the joystick's stiffness changes with the contact force by Zhu 1994, (4.1).

    The parameters of (4.1) are those of Tables 6.7 and 6.8. The RMS relative difference may be 5 %.
    """
    return Evaluation((
        check_mean("RMS difference of the stiffness along z from (4.1), relative",
                   collect_values(samples, "law"), (-np.inf, 0.05),
                   "log times of force and stiffness differ by up to 20 ms"),
    ))  # fmt: skip


def compute_direct_force_margins(changes: Changes) -> Sample:
    """Compute the gain margins of direct force feedback under rate and under position control.

    Args:
        changes: `task`: factor of the task's impedance.

    Returns:
        Largest stable factors of the reflected force, 1 for the shipped one: `rate` and `position`
        without delay, `late_rate` and `late_position` with a delay of 20 ms each way.
    """
    given = merge_settings({"task": 1.0}, changes)
    case, k = load_shipped_case(), given["task"]
    task = Impedance(0.0, k * case.task.damping, k * case.task.stiffness)
    case = dataclasses.replace(case, task=task)
    late = case.with_delay(0.02)
    return Sample({
        "rate": find_gain_margin(case, "rate_force"),
        "position": find_gain_margin(case, "position_force"),
        "late_rate": find_gain_margin(late, "rate_force"),
        "late_position": find_gain_margin(late, "position_force"),
    })  # fmt: skip


def evaluate_rate_force_margin(samples: Sequence[Sample]) -> Evaluation:
    """Check that rate control with direct force feedback has a stability limit even without delay.

    The limit is the largest stable factor of the reflected force. It must be at most 100, and below that
    of position control.
    """
    v = samples[0].values
    ratio = v["rate"] / v["position"]
    return Evaluation(
        (
            check_deterministic_value(
                "largest factor on the reflected force that is stable under rate control, without delay",
                v["rate"], (0.0, 100.0), "a limit exists; 100 times the shipped"
                        " reflection, 450 N in the hand for 25 kN, counts as no limit"),
            check_deterministic_value("this factor over that of position control", ratio, (0.0, 1.0 - 1e-9),
                        "rate control is less stable"),
        ),
        note=f"largest stable factor with 20 ms each way: {v['late_rate']:.2f} under rate control,"
        f" {v['late_position']:.2f} under position control: with delay position control is less"
        " stable at these gains",
    )  # fmt: skip


def evaluate_position_force_margin(samples: Sequence[Sample]) -> Evaluation:
    """Check that position control with direct force feedback becomes stable if its gain is reduced.

    With the shipped gain of the reflected force and a delay of 20 ms each way it must be unstable. With a
    smaller gain it must be stable.
    """
    v = samples[0].values
    return Evaluation(
        (check_deterministic_value(
            "largest factor on the reflected force that is stable under position control, delay of 20 "
                "ms each way", v["late_position"], (1e-9, 1.0 - 1e-9),
                     "unstable with the shipped gain, stable with a smaller gain"),),
        note=f"without delay: {v['position']:.3g}",
    )  # fmt: skip


def measure_impedance_difference(changes: Changes) -> Sample:
    """Compute how much the felt impedance differs from the task's impedance at hand frequencies.

    Args:
        changes: `transparent`: 1 to use the transparent four-channel structure instead of all structures.

    Returns:
        Largest magnitude of felt over task impedance minus 1, for the position-position, the
        position-force and the rate-force structure.
    """
    given = merge_settings({"transparent": 0.0}, changes)
    case, s, values, curves = load_shipped_case(), 1j * HAND_FREQUENCIES, {}, {}
    names = {"position_position": "position_position", "position_force": "position_force",
             "rate_force": "rate_force"}  # fmt: skip
    for name, structure in names.items():
        if given["transparent"]:
            structure = "four_channel_position"
        felt = transmitted_impedance(case.make_port(structure), s, case.task) / case.task(s)
        values[name] = float(np.abs(felt - 1.0).max())
        curves[name.replace("_", "-")] = np.abs(felt)
    return Sample(values, (
        Panel("felt over the task's impedance [1]", HAND_FREQUENCIES / (2.0 * np.pi), curves,
              "frequency [Hz]", True),
    ))  # fmt: skip


def _make_impedance_evaluation(*structures: str) -> Callable[[Sequence[Sample]], Evaluation]:
    def evaluate_impedance_difference(samples: Sequence[Sample]) -> Evaluation:
        return Evaluation(tuple(
            check_deterministic_value(
                f"largest relative difference of the felt and the task's impedance,"
                f" {name.replace('_', '-')}", samples[0].values[name], (NOTICEABLE_DIFFERENCE, np.inf),
                "23 % of a compliance is noticeable (Tan 1995)",
            ) for name in structures
        ))  # fmt: skip

    return evaluate_impedance_difference


def make_claim(
    name: str, quote: str, item: str, evaluate: Callable[[Sequence[Sample]], Evaluation],
    fault: Changes | None, fault_description: str, kind: Kind = "document",
) -> Claim:  # fmt: skip
    """Return a claim of Zhu 1994; its arguments have another order than those of `Claim`."""
    return Claim(name, quote, item, kind, evaluate, fault, fault_description)


EXPERIMENTS: tuple[Experiment, ...] = (
    make_deterministic_experiment("hybrid matrix", measure_hybrid_matrix, make_claim(
        "general structure: hybrid matrix",
        '"The hybrid matrix of this two-port teleoperator system can be easily derived" (3.11,'
        " 3.12)", "p. 30, Fig. 3.13", evaluate_hybrid_matrix, {"velocity_back_sign": -1.0},
        "the returned velocity has the wrong sign in the equations",
    )),
    make_deterministic_experiment("delayed channel", measure_delayed_channel, make_claim(
        "delay: not passive",
        '"It can be shown that the standard method of communicating forces and velocity between the'
        ' master and slave in a teleoperator system leads to a nonpassive system for any time'
        ' delay."', "p. 28, Eq. 3.8", evaluate_delayed_channel, {"wave_impedance": 1.0},
        "a lossless line instead of the delayed channel; its norm is exactly 1, and only a norm "
                "above 1 agrees",
    )),
    make_deterministic_experiment("Nyquist criterion", compare_nyquist_with_simulation, make_claim(
        "closed-loop stability by the loop transfer functions",
        'the Nyquist plots of LG1 and LG2 "can not encircle the critical point" for a stable'
        " system", "p. 31, Fig. 3.14", evaluate_nyquist_agreement, {"simulated_task": 0.01},
        "the simulated task is a hundred times softer than that of the criterion",
    )),
    make_deterministic_experiment("coordinating force", compare_with_mechanical_equivalent, make_claim(
        "position-position structure: passive",
        '"coordinating force (position error) method can be shown to be passive under position'
        ' control"; "any circuit network made up of strictly passive" "components is itself'
        ' passive, thus the system can not go unstable"', "p. 32, Figs 3.15, 3.16",
        evaluate_passivity, {"slave_gain": 3.0},
        "the slave's controller three times as stiff as the master's",
    ), make_claim(
        "position-position structure: mechanical equivalence",
        '"The mechanical equivalent of the above two-port teleoperator system is shown" as two'
        " masses joined by a spring and a damper", "p. 33, Fig. 3.17", evaluate_mechanical_equivalent,
        {"coupling_gain": 2.0}, "a spring and a damper twice as large between the masses",
    )),
    Experiment("pressing", measure_contact_position_error, (make_claim(
        "rate-position structure: position error below noise",
        '"the position gain is so high for hydraulic mobile machines such as excavators and'
        ' feller-bunchers that there is virtually no position error for feedback considering the'
        ' noise"', "p. 34, Fig. 3.18", evaluate_position_error, {"servo.position_gain": "1.0"},
        "joint loops with an eighth of the position gain",
    ), make_claim(
        "stiffness adjustment",
        "the stiffness of the joystick is that of (4.1) with Tables 6.7 and 6.8",
        "p. 51, Fig. 4.24", evaluate_stiffness_law, {"pilot.reflection": "none"}, "no force reflection",
        "input",
    )), max_repetitions=6),
    make_deterministic_experiment("direct force, linear", compute_direct_force_margins, make_claim(
        "position-force structure: reduced gain",
        '"For position control with direct force feedback, stability can be achieved by reducing'
        ' the loop gain"', "p. 36, Fig. 3.19", evaluate_position_force_margin, {"task": 1e-6},
        "a task a million times softer, which reflects no force",
    ), make_claim(
        "rate control with direct force feedback",
        '"Therefore rate control with direct force feedback tends to be unstable even without'
        ' time-delay in the system."', "p. 37", evaluate_rate_force_margin, {"task": 1e-6},
        "a task a million times softer, which reflects no force",
    )),
    make_deterministic_experiment("felt impedance", measure_impedance_difference, make_claim(
        "structures that are not transparent, position control",
        '"the position-position structure does not provide transparency, nor does the'
        ' position-force structure if the dynamics of the system can not be neglected"',
        "p. 37, Figs 3.15, 3.19", _make_impedance_evaluation("position_position", "position_force"),
        {"transparent": 1.0}, "the transparent four-channel structure instead",
    ), make_claim(
        "structures that are not transparent, rate control",
        '"The position-force structure does not provide transparency nor does the rate-force'
        ' structure."', "p. 43", _make_impedance_evaluation("rate_force"), {"transparent": 1.0},
        "the transparent four-channel structure instead",
    )),
)  # fmt: skip
