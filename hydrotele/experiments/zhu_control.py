"""Zhu 1994, chapter 3: what a teleoperator lets the operator feel, and whether it is stable.

All rows are computed from the two-port of `teleop.two_port` with the numbers of
`teleop/cat215_axis.yaml`. Sides that the document calls identical both have the master's numbers.
Nothing is random but the cases that are drawn from a fixed seed, so that every experiment has one
repetition.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from hydrotele.control.task_impedance import RecursiveLeastSquares
from hydrotele.core.errors import InputError
from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Comparison,
    Experiment,
    Judgement,
    Kind,
    Panel,
    Sample,
)
from hydrotele.experiments.intervals import check_exact, check_mean, collect, format_values
from hydrotele.experiments.scenario_runs import operator_changes, run_shipped, true_channel
from hydrotele.teleop.analysis import Case, first_change, gain_margin, holds, load_teleop_case
from hydrotele.teleop.findings import agreement
from hydrotele.teleop.two_port import (
    Impedance,
    TwoPort,
    hybrid,
    hybrid_scattering_norm,
    scattering_norm,
    transmitted,
    unstable_poles,
)

ROUNDING = (0.0, 1e-9)
"""Accepted relative error of a formula that is computed in two ways."""
_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.1, 5.0, 60)  # rad/s, what a hand moves
_WIDE = 2.0 * np.pi * np.geomspace(1e-3, 1e3, 2000)  # rad/s
_NOTICED = 0.23  # relative difference of a compliance that a hand notices; Tan 1995
_PASSIVE = 1.0 + 1e-9  # scattering norm, with rounding


def read_settings(changes: Changes, **defaults: float) -> dict[str, float]:
    """Settings of an experiment with its changes.

    Args:
        changes: setting -> value.
        **defaults: all settings.

    Returns:
        Setting -> value.

    Raises:
        InputError: a setting is not known.
    """
    if unknown := sorted(set(changes) - set(defaults)):
        known = ", ".join(defaults) or "none"
        raise InputError("changes", f"{', '.join(unknown)} unknown; there are: {known}")
    return defaults | dict(changes)


def exact_experiment(name: str, measure: Callable[[Changes], Sample], *claims: Claim) -> Experiment:
    """An experiment in which nothing is random."""
    return Experiment(name, partial(_measure_once, measure), claims, repetitions_fixed=1)


def _measure_once(measure: Callable[[Changes], Sample], seed: int, changes: Changes) -> Sample:
    return measure(changes)


def shipped_case() -> Case:
    """The axis of `cat215_axis.yaml` without delay."""
    return load_teleop_case().case().with_delay(0.0)


def identical_case() -> Case:
    """The same with the master's numbers on both sides."""
    case = shipped_case()
    return dataclasses.replace(case, slave=case.master, slave_control=case.master_control)


def _constant(value: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda s: np.full_like(s, value)


def _relative(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference over the largest expected size."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


# --- p. 28 to 32: the network ---------------------------------------------------------------------


def measure_hybrid_matrix(changes: Changes) -> Sample:
    """Hybrid matrix and felt impedance against the equations of Fig. 3.13, solved numerically."""
    given = read_settings(changes, velocity_back_sign=1.0)
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
        errors["matrix"] = max(errors["matrix"], _relative(hybrid(port, s), solved))
        # with F_e = Z_e V_e and V_h = 1
        whole = np.array([[1.0, -back - c2(s) * task(s)], [-c3(s), b + task(s)]])
        felt = np.linalg.solve(whole, np.array([a, c1(s)]))[0]
        found = transmitted(port, s, task)
        errors["felt"] = max(errors["felt"], float(abs(found / felt - 1.0)))
    return Sample(errors)


def judge_hybrid_matrix(samples: Sequence[Sample]) -> Judgement:
    """Judge both formulas."""
    values, reason = samples[0].values, "rounding: two ways to solve the same equations"
    return Judgement((
        check_exact("largest relative error of the hybrid matrix (3.11)", values["matrix"],
                    ROUNDING, reason),
        check_exact("of the felt impedance (3.12)", values["felt"], ROUNDING, reason),
    ))  # fmt: skip


def measure_delayed_channel(changes: Changes) -> Sample:
    """Scattering norm of a channel that only delays force and velocity."""
    given = read_settings(changes, wave_impedance=0.0)
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
        Panel("largest scattering norm [1]", delays, {"force and velocity sent as they are":
              np.array(norms), "lossless line": np.array(lossless)}, "delay [s]", True, True),
    ))  # fmt: skip


def judge_delayed_channel(samples: Sequence[Sample]) -> Judgement:
    """Judge the smallest norm over the delays."""
    values = samples[0].values
    return Judgement(
        (check_exact("smallest over six delays from 1 ms to 5 s of the largest scattering norm",
                     values["least"], (_PASSIVE, np.inf), "above 1 is not passive (3.6)"),),
        note=f"the lossless line of the same delays has {values['lossless']:.3g}",
    )  # fmt: skip


_DELAYS, _FACTORS = np.array([0.0, 0.02, 0.1]), np.array([0.1, 1.0, 5.0, 30.0])


def measure_nyquist(changes: Changes) -> Sample:
    """Stability by the argument principle against a simulated kick, six structures."""
    given = read_settings(changes, simulated_task=1.0)
    case, right, cells = shipped_case(), 0, 0
    real = dataclasses.replace(
        case, task=dataclasses.replace(case.task, stiffness=given["simulated_task"] * 36e3)
    )
    for structure in ("position_position", "position_force", "rate_position", "rate_force"):
        predicted = agreement(case, structure, _DELAYS, _FACTORS)
        seen = predicted.seen
        if given["simulated_task"] != 1.0:
            seen = agreement(real, structure, _DELAYS, _FACTORS).seen
        right += int(np.sum(predicted.predicted == seen))
        cells += seen.size
    return Sample({"fraction": right / cells, "cells": float(cells)})


def judge_nyquist(samples: Sequence[Sample]) -> Judgement:
    """Judge the fraction of the cells."""
    values = samples[0].values
    return Judgement((
        check_exact(f"fraction of {values['cells']:.0f} loops (four structures, three delays, four"
                    " gains) in which the criterion and a simulated kick agree", values["fraction"],
                    (1.0, 1.0), "the criterion is necessary and sufficient"),
    ))  # fmt: skip


# --- p. 32 to 37: coordinating force and force feedback -------------------------------------------


def measure_coordinating_force(changes: Changes) -> Sample:
    """Scattering norm of the position-position structure, and its mechanical equivalent."""
    given = read_settings(changes, slave_gain=1.0, coupling_gain=1.0)
    case = identical_case()
    control, k = case.master_control, given["slave_gain"]
    held = Impedance(0.0, k * control.damping, k * control.stiffness)
    port = dataclasses.replace(case, slave_control=held).port("position_position")
    s = 1j * _WIDE
    # masses M_m and M_s joined by C: F_h = Z_m V_h + C (V_h - V_e), -F_e = Z_s V_e - C (V_h - V_e)
    a, b = port.master(s), port.slave(s)
    c = given["coupling_gain"] * control(s)
    whole = b + c
    rows = [[a + c - c * c / whole, c / whole], [-c / whole, 1.0 / whole]]
    network = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    found = hybrid(port, s)
    error = np.abs(found - network).max(axis=0) / np.abs(network).max(axis=0)
    return Sample({"norm": float(scattering_norm(port, s, 30.0).max()),
                   "difference": float(error.max())})  # fmt: skip


def judge_passive_coupling(samples: Sequence[Sample]) -> Judgement:
    """Judge the scattering norm."""
    return Judgement((
        check_exact("largest scattering norm, 1 mHz to 1 kHz", samples[0].values["norm"],
                    (0.0, _PASSIVE), "passive (3.6), with rounding"),
    ))  # fmt: skip


def judge_mechanical_equivalent(samples: Sequence[Sample]) -> Judgement:
    """Judge the difference of the two hybrid matrices."""
    return Judgement((
        check_exact("largest relative difference of the hybrid matrices",
                    samples[0].values["difference"], ROUNDING, "rounding"),
    ))  # fmt: skip


_DURATION = 16.0  # s of the first target, 20 kN


def measure_pressing(seed: int, changes: Changes) -> Sample:
    """Position error that a contact force causes against the noise of the measured position.

    The excavator presses with 20 kN under stiffness feedback. Also the joystick's stiffness
    against (4.1).
    """
    keys = {"duration": str(_DURATION)} | operator_changes(seed) | dict(changes)
    scenario, run = run_shipped("press_stiffness", keys)
    m = run.measured
    height = np.interp(m.time, run.truth.time, true_channel(run, "truth.tip.z"))
    error = m["tip_reference.z"] - m["tip_pose.z"]
    free, late = (m.time > 0.3) & (m.time < 1.0), m.time > _DURATION - 5.0
    shift = float(abs(error[late].mean() - error[free].mean()))
    noise = float((m["tip_pose.z"] - height)[late].std())
    force = float(np.mean(m["tip_force.z"][late]))
    return Sample({"ratio": shift / noise, "shift": shift, "noise": noise, "force": force}, (
        Panel("position error of the bucket [mm]", m.time, {
            "reference - measured": 1e3 * error, "reference - true":
            1e3 * (m["tip_reference.z"] - height)}),
        Panel("contact force [kN]", m.time, {"estimated": m["tip_force.z"] / 1e3}),
    ))  # fmt: skip


def judge_position_error(samples: Sequence[Sample]) -> Judgement:
    """Judge the position error over the noise."""
    return Judgement(
        (check_mean("position error that the contact causes over the RMS noise of the measured"
                    " position", collect(samples, "ratio"), (-np.inf, 1.0),
                    "smaller than the noise"),),
        note=f"{format_values(samples, 'shift', 1e3)} mm with"
        f" {format_values(samples, 'force', 1e-3)} kN; noise {format_values(samples, 'noise', 1e3)}"
        " mm, that of the angle sensors of khoshzaban1992",
    )  # fmt: skip


def measure_direct_force(changes: Changes) -> Sample:
    """Largest factor on the reflected force for which the loop is stable."""
    given = read_settings(changes, task=1.0)
    case, k = shipped_case(), given["task"]
    task = Impedance(0.0, k * case.task.damping, k * case.task.stiffness)
    case = dataclasses.replace(case, task=task)
    late = case.with_delay(0.02)
    return Sample({
        "rate": gain_margin(case, "rate_force"),
        "position": gain_margin(case, "position_force"),
        "late_rate": gain_margin(late, "rate_force"),
        "late_position": gain_margin(late, "position_force"),
    })  # fmt: skip


def judge_rate_force(samples: Sequence[Sample]) -> Judgement:
    """Judge whether rate control without delay has a limit, and a smaller one than position."""
    v = samples[0].values
    ratio = v["rate"] / v["position"]
    return Judgement(
        (
            check_exact("largest stable factor on the reflected force under rate control, without"
                        " delay", v["rate"], (0.0, 100.0), "a limit exists; 100 times the shipped"
                        " reflection, 450 N in the hand for 25 kN, counts as none"),
            check_exact("the same over that of position control", ratio, (0.0, 1.0 - 1e-9),
                        "rate control is the less stable one"),
        ),
        note=f"with 20 ms each way {v['late_rate']:.2f} under rate control,"
        f" {v['late_position']:.2f} under position control: with delay position control is the less"
        " stable one at these gains",
    )  # fmt: skip


def judge_position_force(samples: Sequence[Sample]) -> Judgement:
    """Judge whether direct force under position control has a limit that a smaller gain keeps."""
    v = samples[0].values
    return Judgement(
        (check_exact("largest stable factor on the reflected force under position control, 20 ms"
                     " each way", v["late_position"], (1e-9, 1.0 - 1e-9),
                     "unstable as it is shipped, and a smaller gain makes it stable"),),
        note=f"without delay: {v['position']:.3g}",
    )  # fmt: skip


def measure_opacity(changes: Changes) -> Sample:
    """How far the felt impedance is from the task's, over what a hand moves."""
    given = read_settings(changes, transparent=0.0)
    case, s, values, curves = shipped_case(), 1j * _FREQUENCIES, {}, {}
    names = {"position_position": "position_position", "position_force": "position_force",
             "rate_force": "rate_force"}  # fmt: skip
    for name, structure in names.items():
        if given["transparent"]:
            structure = "four_channel_position"
        felt = transmitted(case.port(structure), s, case.task) / case.task(s)
        values[name] = float(np.abs(felt - 1.0).max())
        curves[name.replace("_", "-")] = np.abs(felt)
    return Sample(values, (
        Panel("felt over the task's impedance [1]", _FREQUENCIES / (2.0 * np.pi), curves,
              "frequency [Hz]", True),
    ))  # fmt: skip


def _judge_opacity(*structures: str) -> Callable[[Sequence[Sample]], Judgement]:
    def judge(samples: Sequence[Sample]) -> Judgement:
        return Judgement(tuple(
            check_exact(
                f"largest relative difference of the felt and the task's impedance,"
                f" {name.replace('_', '-')}", samples[0].values[name], (_NOTICED, np.inf),
                "a hand notices 23 % of a compliance (Tan 1995)",
            ) for name in structures
        ))  # fmt: skip

    return judge


# --- p. 37 to 43: transparency under position control ---------------------------------------------


def random_impedance(rng: np.random.Generator, base: Impedance) -> Impedance:
    """A passive impedance within a factor of ten either way of another one."""
    factors = 10.0 ** rng.uniform(-1.0, 1.0, 3)
    return Impedance(*(factors * (base.mass, base.damping, base.stiffness)))


def measure_transparency(changes: Changes) -> Sample:
    """The four-channel structure: hybrid matrix, norm, error dynamics, random hands and tasks."""
    given = read_settings(changes, mass_error=0.0, delay=0.0)
    case = shipped_case().with_delay(given["delay"])
    port = case.port("four_channel_position")
    real = dataclasses.replace(case.slave, mass=case.slave.mass * (1.0 + given["mass_error"]))
    port = dataclasses.replace(port, slave=real)
    s, ideal = 1j * _FREQUENCIES, np.array([[0.0, 1.0], [-1.0, 0.0]])
    matrix = hybrid(port, s) * np.array([[1 / 30.0, 1.0], [1.0, 30.0]])  # of 30 N s/m
    roots = np.roots([
        case.master.mass + case.slave.mass,
        case.master_control.damping + case.slave_control.damping,
        case.master_control.stiffness + case.slave_control.stiffness,
    ])  # fmt: skip
    rng, stable = np.random.default_rng(334), []
    for _ in range(100):
        hand, task = random_impedance(rng, case.hand), random_impedance(rng, case.task)
        stable.append(holds(port, hand, task))
    return Sample({
        "matrix": float(np.abs(matrix - ideal).max()),
        "norm": float(scattering_norm(port, 1j * _WIDE, 30.0).max()),
        "slowest": float(roots.real.max()),
        "stable": float(np.mean(stable)),
    })  # fmt: skip


def judge_transparency(samples: Sequence[Sample]) -> Judgement:
    """Judge hybrid matrix and error dynamics."""
    v = samples[0].values
    return Judgement((
        check_exact("largest difference of the hybrid matrix from [[0, 1], [-1, 0]], relative to"
                    " 30 N s/m", v["matrix"], ROUNDING, "rounding"),
        check_exact("slowest pole of the position error (3.31)", v["slowest"], (-np.inf, -1e-9),
                    "asymptotic: left of the axis", unit="1/s"),
    ))  # fmt: skip


def judge_lossless(samples: Sequence[Sample]) -> Judgement:
    """Judge the scattering norm and the loops with random passive hands and tasks."""
    v = samples[0].values
    return Judgement((
        check_exact("largest scattering norm", v["norm"], (1.0 - 1e-9, _PASSIVE), "1 (3.33)",
                    published=1.0),
        check_exact("stable fraction of 100 random passive hands and tasks", v["stable"],
                    (1.0, 1.0), "stability is ensured with any strictly passive load"),
    ))  # fmt: skip


def intervening_port(case: Case, force_error: float = 0.0) -> TwoPort:
    """Four channels that need no acceleration, with an intervening impedance.

    Args:
        case: master and slave with damper and spring added to their masses.
        force_error: relative error of the force that is fed forward [1].

    Returns:
        The two-port of (3.37).
    """
    own, held = case.master_control, case.slave_control
    return TwoPort(
        case.master, case.slave, own, held, held, _constant(1.0), _constant(1.0 + force_error),
        lambda s: -own(s),
    )  # fmt: skip


def measure_intervening(changes: Changes) -> Sample:
    """Felt impedance and hybrid matrix of identical sides with added damper and spring."""
    given = read_settings(changes, slave_mass=1.0)
    case = identical_case()
    side = Impedance(case.master.mass, 10.0, 100.0)
    slave = dataclasses.replace(side, mass=given["slave_mass"] * side.mass)
    case = dataclasses.replace(case, master=side, slave=slave)
    port, s = intervening_port(case), 1j * _FREQUENCIES
    felt, expected = transmitted(port, s, case.task), side(s) + case.task(s)
    rng = np.random.default_rng(347)
    stable = [holds(port, random_impedance(rng, case.hand), random_impedance(rng, case.task))
              for _ in range(100)]  # fmt: skip
    return Sample(
        {"felt": _relative(felt, expected), "stable": float(np.mean(stable))},
        (Panel("impedance [N s/m]", _FREQUENCIES / (2.0 * np.pi), {
            "felt": np.abs(felt), "of the task": np.abs(case.task(s)), "intervening":
            np.abs(side(s))}, "frequency [Hz]", True),),
    )  # fmt: skip


def judge_intervening(samples: Sequence[Sample]) -> Judgement:
    """Judge (3.39) and the stability of (3.45) and (3.47)."""
    v = samples[0].values
    return Judgement((
        check_exact("largest relative difference of the felt impedance and Z_m + Z_e (3.39)",
                    v["felt"], ROUNDING, "rounding"),
        check_exact("stable fraction of 100 random passive hands and tasks", v["stable"],
                    (1.0, 1.0), "both loops are stable (3.45, 3.47)"),
    ))  # fmt: skip


_ERRORS = np.geomspace(1e-3, 100.0, 26)


def smallest_force_error(case: Case) -> float:
    """Smallest relative error of the force fed forward with which a loop is unstable.

    Args:
        case: the teleoperator with hand and task; four channels under position control.

    Returns:
        The error [1]; infinite where none up to 100 does it, 0 where the loop is unstable with the
        smallest one, 0.1 %.
    """
    port = case.port("four_channel_position")

    def is_stable(error: float) -> bool:
        wrong = dataclasses.replace(port, force_forward=_constant(1.0 + error))
        return holds(wrong, case.hand, case.task)

    if not is_stable(_ERRORS[0]):
        return 0.0
    found = first_change(is_stable, _ERRORS)
    return np.inf if found is None else found


def measure_force_error(changes: Changes) -> Sample:
    """Smallest error of the force fed forward that drives the loop unstable, and its causes."""
    given = read_settings(changes, scale=1.0)
    case = identical_case()

    def softer(scale: float) -> Case:
        control = case.master_control
        soft = Impedance(0.0, scale * control.damping, scale * control.stiffness)
        return dataclasses.replace(case, master_control=soft, slave_control=soft)

    def stiffer(scale: float) -> Case:
        hand = case.hand
        stiff = Impedance(hand.mass, np.sqrt(scale) * hand.damping, scale * hand.stiffness)
        return dataclasses.replace(case, hand=stiff)

    scales = np.geomspace(1.0, 1e-3, 13)
    limits = np.array([smallest_force_error(softer(scale)) for scale in scales])
    hands = np.geomspace(1.0, 1e3, 13)
    by_hand = np.array([smallest_force_error(stiffer(scale)) for scale in hands])
    enough, firm = scales[limits <= 0.05], hands[by_hand <= 0.05]
    port = case.port("four_channel_position")
    wrong = dataclasses.replace(port, force_forward=_constant(1.05))
    return Sample({
        "limit": smallest_force_error(softer(given["scale"])),
        "machine": smallest_force_error(shipped_case()),
        "late": smallest_force_error(case.with_delay(0.005)),
        "scale": float(enough[0]) if len(enough) else 0.0,
        "hand": float(firm[0]) if len(firm) else np.inf,
        "norm": float(scattering_norm(wrong, 1j * _WIDE, 30.0).max()),
    }, (Panel("smallest error that is unstable [1]", scales, {"identical sides": limits},
              "controllers' gains over those of Table 6.7 [1]", True, True),))  # fmt: skip


def judge_force_error(samples: Sequence[Sample]) -> Judgement:
    """Judge the smallest error against the reported 5 %."""
    v = samples[0].values
    return Judgement(
        (check_exact("smallest relative error of the force fed forward that is unstable",
                     v["limit"], (0.0, 0.05), "5 % is reported to be enough", published=0.05),),
        explanation="the loop is (Z_m + C_m + Z_s + C_s)(Z_h + Z_e) - e Z_h (Z_e - Z_m - C_m): an"
        " error e has to make e Z_h as large as both sides with their controllers, which the"
        " hand of this case is far from. 5 % suffices where the controllers' gains are multiplied"
        f" by {v['scale']:.2g}, or the hand's stiffness by {v['hand']:.2g}; gains, hand and task"
        " of the reported system are not in the document. With 5 % the two-port is no longer"
        f" passive (scattering norm {v['norm']:.4f})",
        note=f"with 5 ms each way {v['late']:.3g}; CAT 215 as the slave {v['machine']:.3g}",
    )  # fmt: skip


# --- p. 43 to 49: rate control --------------------------------------------------------------------


def measure_rate_force_extremes(changes: Changes) -> Sample:
    """Felt impedance of direct force under rate control with very stiff and very soft tasks."""
    given = read_settings(changes, structure_with_task=0.0)
    case, s = shipped_case(), 1j * _FREQUENCIES
    port = case.port("four_channel_rate" if given["structure_with_task"] else "rate_force")
    master, control = case.master(s), case.master_control(s)
    rate = case.gains.velocity / s * case.slave_control(s) * case.gains.force

    def felt(scale: float) -> np.ndarray:
        task = Impedance(0.0, scale * case.task.damping, scale * case.task.stiffness)
        return transmitted(port, s, task)

    return Sample({
        "stiff": _relative(felt(1e8), master + control + rate),
        "soft": _relative(felt(1e-8), master + control),
    })  # fmt: skip


def judge_rate_force_extremes(samples: Sequence[Sample]) -> Judgement:
    """Judge (3.50) and (3.51)."""
    v, reason = samples[0].values, "the task is 10^8 times stiffer or softer, which leaves 10^-4"
    return Judgement((
        check_exact("relative difference from (3.50), stiff task", v["stiff"], (0.0, 1e-4), reason),
        check_exact("from (3.51), soft task", v["soft"], (0.0, 1e-4), reason),
    ))  # fmt: skip


def rate_port(case: Case, velocity_gain: float = 1.0) -> TwoPort:
    """The usable four-channel structure under rate control, (3.59).

    Args:
        case: master and slave with damper and spring added to their masses.
        velocity_gain: slave's velocity over the master's position [1/s].

    Returns:
        The two-port; of identical sides it lets the master and the task be felt.
    """
    own, held, k = case.master_control, case.slave_control, velocity_gain
    return TwoPort(
        case.master, case.slave, lambda s: own(s) * k / s, held, lambda s: held(s) * k / s,
        lambda s: s / k, lambda s: k / s, lambda s: -own(s),
    )  # fmt: skip


def measure_rate_transparency(changes: Changes) -> Sample:
    """Felt impedance and velocity of both four-channel structures under rate control."""
    given = read_settings(changes, slave_mass=1.0)
    case, s = identical_case(), 1j * _FREQUENCIES
    slave = dataclasses.replace(case.slave, mass=given["slave_mass"] * case.slave.mass)
    case = dataclasses.replace(case, slave=slave)
    usable = rate_port(case)
    felt, expected = transmitted(usable, s, case.task), case.master(s) + case.task(s)
    velocity = -hybrid(usable, s)[..., 1, 0] * s  # over the master's position
    return Sample(
        {"felt": _relative(felt, expected), "velocity": float(np.abs(velocity - 1.0).max())},
        (Panel("impedance [N s/m]", _FREQUENCIES / (2.0 * np.pi), {
            "felt": np.abs(felt), "of the task": np.abs(case.task(s))}, "frequency [Hz]", True),),
    )  # fmt: skip


def judge_rate_transparency(samples: Sequence[Sample]) -> Judgement:
    """Judge (3.61) and (3.64)."""
    v = samples[0].values
    return Judgement((
        check_exact("largest relative difference of the felt impedance and Z_m + Z_e (3.61)",
                    v["felt"], ROUNDING, "rounding"),
        check_exact("largest relative difference of the slave's velocity and the velocity gain"
                    " times the master's position (3.64)", v["velocity"], ROUNDING, "rounding"),
    ))  # fmt: skip


def measure_master_damping(changes: Changes) -> Sample:
    """Roots of the master's polynomial (3.72) without and with damping."""
    given = read_settings(changes, damping=0.0)
    rng = np.random.default_rng(372)
    control, mass, unstable = shipped_case().master_control, shipped_case().master.mass, []
    for _ in range(200):
        factor = 10.0 ** rng.uniform(-1.0, 1.0, 5)
        m, b, k = factor[0] * mass, factor[1] * control.damping, factor[2] * control.stiffness
        gain, spring = factor[3], 100.0 * factor[4]
        unstable.append(np.roots([m, given["damping"], spring + b * gain, k * gain]).real.max() > 0)
    case, side = identical_case(), Impedance(mass, given["damping"], 100.0)
    whole = dataclasses.replace(case, master=side, slave=side)
    poles = unstable_poles(rate_port(whole), Impedance(), case.task)
    bare = dataclasses.replace(case, hand=dataclasses.replace(case.hand, damping=0.0))
    seen = agreement(bare, "four_channel_rate", np.zeros(1), np.ones(1)).seen[0, 0]
    return Sample({"unstable": float(np.mean(unstable)), "poles": float(poles),
                   "kick": float(seen)})  # fmt: skip


def judge_master_damping(samples: Sequence[Sample]) -> Judgement:
    """Judge how often the polynomial without damping is unstable, and the loop without a hand."""
    v = samples[0].values
    return Judgement((
        check_exact("unstable fraction of 200 random masters without damping", v["unstable"],
                    (1.0, 1.0), "it can not be stable"),
        check_exact("unstable poles of the whole loop without damping and without a hand",
                    v["poles"], (1.0, np.inf), "it can not be stable"),
    ), "(3.71) is the master with the slave's channel cut, which is unstable without damping. The"
       " poles of the whole loop of identical sides are the zeros of (3.69), Z_m + C_m/(K_v s) +"
       " C_s, and of Z_m + Z_h + Z_e: the slave's controller damps them",
       "a simulated kick of the whole loop, the master and the hand without damping, "
       f"{'dies out' if v['kick'] else 'grows'}")  # fmt: skip


_TASKS = ((2.0, 150.0, 8000.0), (1.0, 60.0, 1500.0))  # kg, N s/m, N/m of two tasks in turn
_LATE = 4.0  # s before a task ends, over which its stiffness is judged


def measure_task_identification(seed: int, changes: Changes) -> Sample:
    """Mass, damper and spring of a task that changes, by recursive least squares."""
    given = read_settings(changes, forgetting=0.99, reset=8.0, noise=0.02)
    rng = np.random.default_rng([seed, 374])
    step, n = 0.02, 1000
    time = step * np.arange(n)
    w = np.array([0.7, 1.9, 4.1, 8.3])
    phase = w[:, None] * time + rng.uniform(0.0, 2.0 * np.pi, (4, 1))
    x = 0.005 * np.sin(phase).sum(axis=0)
    v = 0.005 * (w[:, None] * np.cos(phase)).sum(axis=0)
    a = -0.005 * (w[:, None] ** 2 * np.sin(phase)).sum(axis=0)
    rows = np.column_stack([a, v, x])
    first = time < 10.0
    truth = np.where(first[:, None], _TASKS[0], _TASKS[1])
    force = np.sum(rows * truth, axis=1)
    force += given["noise"] * np.sqrt(np.mean(force**2)) * rng.standard_normal(n)
    found = RecursiveLeastSquares(
        np.zeros(3), np.array([1e2, 1e3, 1e5]), forgetting=given["forgetting"],
        reset=given["reset"],
    )  # fmt: skip
    history = np.empty((n, 3))
    for i in range(n):
        found.update(rows[i], force[i])
        history[i] = found.value
    values = {}
    for name, end, task in (("before", 10.0, _TASKS[0]), ("after", 20.0, _TASKS[1])):
        late = (time > end - _LATE) & (time < end)
        values[name] = float(np.abs(history[late, 2] / task[2] - 1.0).max())
    return Sample(values, (
        Panel("stiffness of the task [kN/m]", time, {
            "true": truth[:, 2] / 1e3, "estimated": history[:, 2] / 1e3}),
    ))  # fmt: skip


def judge_task_identification(samples: Sequence[Sample]) -> Judgement:
    """Judge the stiffness of both tasks."""
    reason = "a hand does not notice 23 % of a compliance (Tan 1995); no size is published"
    return Judgement(
        tuple(
            check_mean(f"largest relative error of the stiffness in the last {_LATE:g} s"
                       f" {words} the task changes", collect(samples, name), (-np.inf, _NOTICED),
                       reason)
            for name, words in (("before", "before"), ("after", "after"))
        ),
        note=f"after the change {format_values(samples, 'after', 100.0)} %, forgetting 0.99 per"
        " 20 ms and resetting at 8 times the usual error",
    )  # fmt: skip


def _claim(
    name: str, quote: str, item: str, judge: Callable[[Sequence[Sample]], Judgement],
    broken: Changes, broken_how: str, kind: Kind = "document",
) -> Claim:  # fmt: skip
    return Claim(name, quote, item, kind, judge, broken, broken_how)


EXPERIMENTS: tuple[Experiment, ...] = (
    exact_experiment("hybrid matrix", measure_hybrid_matrix, _claim(
        "general structure: hybrid matrix",
        '"The hybrid matrix of this two-port teleoperator system can be easily derived" (3.11,'
        " 3.12)", "p. 30, Fig. 3.13", judge_hybrid_matrix, {"velocity_back_sign": -1.0},
        "the velocity that comes back has the wrong sign in the equations",
    )),
    exact_experiment("delayed channel", measure_delayed_channel, _claim(
        "delay: not passive",
        '"It can be shown that the standard method of communicating forces and velocity between the'
        ' master and slave in a teleoperator system leads to a nonpassive system for any time'
        ' delay."', "p. 28, Eq. 3.8", judge_delayed_channel, {"wave_impedance": 1.0},
        "a lossless line in place of the plain channel",
    )),
    exact_experiment("Nyquist criterion", measure_nyquist, _claim(
        "closed-loop stability by the loop transfer functions",
        'the Nyquist plots of LG1 and LG2 "can not encircle the critical point" for a stable'
        " system", "p. 31, Fig. 3.14", judge_nyquist, {"simulated_task": 0.01},
        "the simulated task is a hundred times softer than the one of the criterion",
    )),
    exact_experiment("coordinating force", measure_coordinating_force, _claim(
        "position-position structure: passive",
        '"coordinating force (position error) method can be shown to be passive under position'
        ' control"; "any circuit network made up of strictly passive components is itself passive,'
        ' thus the system can not go unstable"', "p. 32, Figs 3.15, 3.16", judge_passive_coupling,
        {"slave_gain": 3.0}, "the slave's controller three times as stiff as the master's",
    ), _claim(
        "position-position structure: mechanical equivalence",
        '"The mechanical equivalent of the above two-port teleoperator system is shown" as two'
        " masses joined by a spring and a damper", "p. 33, Fig. 3.17", judge_mechanical_equivalent,
        {"coupling_gain": 2.0}, "a spring and a damper twice as large between the masses",
    )),
    Experiment("pressing", measure_pressing, (_claim(
        "rate-position structure: position error below noise",
        '"the position gain is so high for hydraulic mobile machines such as excavators and'
        ' feller-bunchers that there is virtually no position error for feedback considering the'
        ' noise"', "p. 34, Fig. 3.18", judge_position_error, {"servo.position_gain": "1.0"},
        "joint loops with an eighth of the position gain",
    ),), max_repetitions=6),
    exact_experiment("direct force, linear", measure_direct_force, _claim(
        "position-force structure: reduced gain",
        '"For position control with direct force feedback, stability can be achieved by reducing'
        ' the loop gain"', "p. 36, Fig. 3.19", judge_position_force, {"task": 1e-6},
        "a task a million times softer, which reflects no force",
    ), _claim(
        "rate control with direct force feedback",
        '"Therefore rate control with direct force feedback tends to be unstable even without'
        ' time-delay in the system."', "p. 37", judge_rate_force, {"task": 1e-6},
        "a task a million times softer, which reflects no force",
    )),
    exact_experiment("felt impedance", measure_opacity, _claim(
        "structures that are not transparent, position control",
        '"the position-position structure does not provide transparency, nor does the'
        ' position-force structure if the dynamics of the system can not be neglected"',
        "p. 37, Figs 3.15, 3.19", _judge_opacity("position_position", "position_force"),
        {"transparent": 1.0}, "the transparent four-channel structure instead",
    ), _claim(
        "structures that are not transparent, rate control",
        '"The position-force structure does not provide transparency nor does the rate-force'
        ' structure."', "p. 43", _judge_opacity("rate_force"), {"transparent": 1.0},
        "the transparent four-channel structure instead",
    )),
    exact_experiment("four channels, position control", measure_transparency, _claim(
        "transparency under position control",
        'H = [[0, 1], [-1, 0]] (3.28); "Thus the slave tracks the master position asymptotically."',
        "p. 39", judge_transparency, {"mass_error": 0.1}, "a slave 10 % heavier than assumed",
    ), _claim(
        "transparent teleoperator: lossless and stable",
        '"Therefore, from the network point of view, this two-port is passive" (norm 1, 3.33);'
        ' "Hence when it is connected to any strictly passive load, the system'
        ' stability is ensured."', "p. 39", judge_lossless, {"delay": 0.05}, "50 ms each way",
    )),
    exact_experiment("intervening impedance", measure_intervening, _claim(
        "intervenient impedance",
        '"Thus the operator indeed feels the object\'s impedance and an intervenient impedance as'
        ' we expected."', "p. 41, Fig. 3.20", judge_intervening, {"slave_mass": 3.0},
        "a slave three times as heavy as the master",
    )),
    exact_experiment("force feed-forward error", measure_force_error, _claim(
        "force feed-forward error of 5 %",
        '"reported an error of only 5% in the force feed forward could drive the system unstable"',
        "p. 43", judge_force_error, {"scale": 3.0}, "controllers three times as stiff",
    )),
    exact_experiment("direct force, extremes", measure_rate_force_extremes, _claim(
        "rate-force structure: extremes",
        '"At these extremes, the operator could only feel some dynamics of the master-slave system;'
        ' it has nothing to do with the dynamics of the task."', "p. 43",
        judge_rate_force_extremes, {"structure_with_task": 1.0}, "the transparent structure",
    )),
    exact_experiment("four channels, rate control", measure_rate_transparency, _claim(
        "transparency under rate control",
        '"Thus we have the same impedance as for position control, which can be interpreted as the'
        ' master impedance plus the task impedance."; "therefore the slave is indeed under rate'
        ' control"', "p. 46, Fig. 3.21", judge_rate_transparency, {"slave_mass": 3.0},
        "a slave three times as heavy as the master",
    )),
    exact_experiment("damping of the master", measure_master_damping, _claim(
        "rate control: damping of the master",
        '"otherwise, the system can not be stable" (B_mc = 0 in 3.72)', "p. 48",
        judge_master_damping, {"damping": 200.0}, "a damped master",
    )),
    Experiment("task identification", measure_task_identification, (_claim(
        "transparency via impedance identification",
        '"On-line recursive least-squares estimation can be used to identify the task impedance'
        ' parameters. In addition, the resetting and forgetting factor technique can be employed to'
        ' deal with a changing environment."', "p. 48, Fig. 3.22", judge_task_identification,
        {"forgetting": 1.0, "reset": 1e9}, "neither forgetting nor resetting",
    ),)),
)  # fmt: skip

UNAVAILABLE: tuple[Comparison, ...] = ()

DRAWINGS: dict[str, str] = {
    "Figure 1.1": "sketch of a kinematically similar master and slave",
    "Figure 1.2": "sketch of a kinematically dissimilar master and slave",
    "Figure 1.3": "drawing of an excavator",
    "Figure 1.4": "photograph",
    "Figure 1.5": "drawing of a feller-buncher",
    "Figure 1.6": "photograph",
    "Figure 3.10": "sketch of an ideal teleoperator",
    "Figure 3.11": "block diagram of a one-port and a two-port",
    "Figure 3.12": "block diagram of operator, teleoperator and task",
}
