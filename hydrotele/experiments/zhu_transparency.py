"""Zhu 1994, pages 37 to 49: transparency under position and under rate control.

A teleoperator is transparent if the operator feels the impedance of the task. The results are
computed from the two-port model, as in `zhu_two_port`.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from hydrotele.control.task_impedance import RecursiveLeastSquares
from hydrotele.experiments.comparison import (
    Changes,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.statistical_checks import (
    check_deterministic_value,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.experiments.zhu_two_port import (
    HAND_FREQUENCIES,
    NOTICEABLE_DIFFERENCE,
    PASSIVE_NORM,
    ROUNDING_RANGE,
    WIDE_FREQUENCIES,
    compute_relative_error,
    load_shipped_case,
    make_claim,
    make_constant_block,
    make_deterministic_experiment,
    make_identical_sides_case,
)
from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.linear_analysis import find_first_change, is_strictly_stable
from hydrotele.teleop.nyquist_criterion import count_unstable_poles
from hydrotele.teleop.simulation_check import compare_stability
from hydrotele.teleop.two_port import Impedance, TwoPort, hybrid_matrix, scattering_norm, transmitted_impedance

# --- p. 37 to 43: transparency under position control ---------------------------------------------


def sample_impedance(rng: np.random.Generator, base: Impedance) -> Impedance:
    """Draw a random passive impedance whose mass, damping and stiffness are 0.1 to 10 times those of `base`."""
    factors = 10.0 ** rng.uniform(-1.0, 1.0, 3)
    return Impedance(*(factors * (base.mass, base.damping, base.stiffness)))


def measure_transparency(changes: Changes) -> Sample:
    """Compute transparency, passivity and stability of a four-channel teleoperator under position control.

    Args:
        changes: `mass_error`: relative error of the slave's mass; `delay`: delay each way [s].

    Returns:
        `matrix`: largest difference of the hybrid matrix from [[0, 1], [-1, 0]], relative to 30 N s/m.
        `norm`: largest scattering norm. `slowest`: largest real part of the poles of the position error
        between slave and master [1/s]. `stable`: stable fraction of 100 loops with random hands and
        tasks.
    """
    given = merge_settings({"mass_error": 0.0, "delay": 0.0}, changes)
    case = load_shipped_case().with_delay(given["delay"])
    port = case.make_port("four_channel_position")
    real = dataclasses.replace(case.slave, mass=case.slave.mass * (1.0 + given["mass_error"]))
    port = dataclasses.replace(port, slave=real)
    s, ideal = 1j * HAND_FREQUENCIES, np.array([[0.0, 1.0], [-1.0, 0.0]])
    matrix = hybrid_matrix(port, s) * np.array([[1 / 30.0, 1.0], [1.0, 30.0]])  # of 30 N s/m
    roots = np.roots([
        case.master.mass + case.slave.mass,
        case.master_control.damping + case.slave_control.damping,
        case.master_control.stiffness + case.slave_control.stiffness,
    ])  # fmt: skip
    rng, stable = np.random.default_rng(334), []
    for _ in range(100):
        hand, task = sample_impedance(rng, case.hand), sample_impedance(rng, case.task)
        stable.append(is_strictly_stable(port, hand, task))
    return Sample({
        "matrix": float(np.abs(matrix - ideal).max()),
        "norm": float(scattering_norm(port, 1j * WIDE_FREQUENCIES, 30.0).max()),
        "slowest": float(roots.real.max()),
        "stable": float(np.mean(stable)),
    })  # fmt: skip


def evaluate_transparency(samples: Sequence[Sample]) -> Evaluation:
    """Check that a four-channel teleoperator transmits force and velocity unchanged (Zhu 1994, p. 39).

    Its hybrid matrix must be [[0, 1], [-1, 0]] up to rounding. The position error between slave and
    master must decay: its poles must have negative real parts.
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("largest difference of the hybrid matrix from [[0, 1], [-1, 0]], relative to"
                    " 30 N s/m", v["matrix"], ROUNDING_RANGE, "rounding"),
        check_deterministic_value("slowest pole of the position error (3.31)", v["slowest"], (-np.inf, -1e-9),
                    "asymptotic: negative real part", unit="1/s"),
    ))  # fmt: skip


def evaluate_passivity(samples: Sequence[Sample]) -> Evaluation:
    """Check that the four-channel teleoperator has scattering norm 1 and is stable with passive hands and tasks.

    The loop must be stable for all of 100 random passive hands and tasks.
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("largest scattering norm", v["norm"], (1.0 - 1e-9, PASSIVE_NORM), "1 (3.33)",
                    published=1.0),
        check_deterministic_value("stable fraction of 100 random passive hands and tasks", v["stable"],
                    (1.0, 1.0), "stability is ensured for any strictly passive load"),
    ))  # fmt: skip


def build_intervening_impedance_port(case: TeleoperatorAxis) -> TwoPort:
    """Return the four-channel two-port whose operator feels an additional impedance, Zhu 1994, (3.37).

    The additional impedance is that of the master. The channels need no acceleration signals.

    Args:
        case: teleoperator whose master and slave have a damper and a spring in addition to their masses.

    Returns:
        The two-port.
    """
    own, held = case.master_control, case.slave_control
    return TwoPort(
        case.master, case.slave, own, held, held, make_constant_block(1.0), make_constant_block(1.0),
        lambda s: -own(s),
    )  # fmt: skip


def measure_intervening_impedance(changes: Changes) -> Sample:
    """Compute the impedance felt through four channels if identical sides have an added damper and spring.

    Args:
        changes: `slave_mass`: factor of the slave's mass.

    Returns:
        `felt`: largest difference of the felt impedance from that of master plus task, over the largest
        magnitude of the latter. `stable`: stable fraction of 100 loops with random hands and tasks.
    """
    given = merge_settings({"slave_mass": 1.0}, changes)
    case = make_identical_sides_case()
    side = Impedance(case.master.mass, 10.0, 100.0)
    slave = dataclasses.replace(side, mass=given["slave_mass"] * side.mass)
    case = dataclasses.replace(case, master=side, slave=slave)
    port, s = build_intervening_impedance_port(case), 1j * HAND_FREQUENCIES
    felt, expected = transmitted_impedance(port, s, case.task), side(s) + case.task(s)
    rng = np.random.default_rng(347)
    stable = [is_strictly_stable(port, sample_impedance(rng, case.hand), sample_impedance(rng, case.task))
              for _ in range(100)]  # fmt: skip
    return Sample(
        {"felt": compute_relative_error(felt, expected), "stable": float(np.mean(stable))},
        (Panel("impedance [N s/m]", HAND_FREQUENCIES / (2.0 * np.pi), {
            "felt": np.abs(felt), "of the task": np.abs(case.task(s)), "intervening":
            np.abs(side(s))}, "frequency [Hz]", True),),
    )  # fmt: skip


def evaluate_intervening_impedance(samples: Sequence[Sample]) -> Evaluation:
    """Check that the operator feels the sum of master and task impedance and that loops are stable.

    This is Zhu 1994, (3.39), for four channels and identical sides with added damper and spring.
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("largest relative difference of the felt impedance and Z_m + Z_e (3.39)",
                    v["felt"], ROUNDING_RANGE, "rounding"),
        check_deterministic_value("stable fraction of 100 random passive hands and tasks", v["stable"],
                    (1.0, 1.0), "both loops are stable (3.45, 3.47)"),
    ))  # fmt: skip


_FORCE_ERRORS = np.geomspace(1e-3, 100.0, 26)


def find_destabilizing_force_error(case: TeleoperatorAxis) -> float:
    """Return the smallest relative error of the force feed-forward that destabilizes the closed loop.

    The four-channel structure under position control feeds the hand force forward to the slave.

    Args:
        case: teleoperator with hand and task.

    Returns:
        The error [1]; infinite if no error up to 100 destabilizes the loop, 0 if the smallest
        one, 0.1 %, does.
    """
    port = case.make_port("four_channel_position")

    def is_stable(error: float) -> bool:
        wrong = dataclasses.replace(port, force_forward=make_constant_block(1.0 + error))
        return is_strictly_stable(wrong, case.hand, case.task)

    if not is_stable(_FORCE_ERRORS[0]):
        return 0.0
    found = find_first_change(is_stable, _FORCE_ERRORS)
    return np.inf if found is None else found


def measure_destabilizing_force_error(changes: Changes) -> Sample:
    """Find the smallest destabilizing error of the force feed-forward under several conditions.

    Args:
        changes: `scale`: factor of the controllers' gains in `limit`.

    Returns:
        Smallest destabilizing relative errors: with identical sides (`limit`), with the shipped slave
        (`machine`), and with a delay of 5 ms each way (`late`). Largest factor of the controllers' gains
        (`scale`) and smallest factor of the hand's stiffness (`hand`) for which 5 % suffice. `norm`:
        scattering norm with 5 %.
    """
    given = merge_settings({"scale": 1.0}, changes)
    case = make_identical_sides_case()

    def soften_controllers(scale: float) -> TeleoperatorAxis:
        control = case.master_control
        soft = Impedance(0.0, scale * control.damping, scale * control.stiffness)
        return dataclasses.replace(case, master_control=soft, slave_control=soft)

    def stiffen_hand(scale: float) -> TeleoperatorAxis:
        hand = case.hand
        stiff = Impedance(hand.mass, np.sqrt(scale) * hand.damping, scale * hand.stiffness)
        return dataclasses.replace(case, hand=stiff)

    scales = np.geomspace(1.0, 1e-3, 7)
    limits = np.array([find_destabilizing_force_error(soften_controllers(scale)) for scale in scales])
    hands = np.geomspace(1.0, 1e3, 7)
    by_hand = np.array([find_destabilizing_force_error(stiffen_hand(scale)) for scale in hands])
    enough, firm = scales[limits <= 0.05], hands[by_hand <= 0.05]
    port = case.make_port("four_channel_position")
    wrong = dataclasses.replace(port, force_forward=make_constant_block(1.05))
    return Sample({
        "limit": find_destabilizing_force_error(soften_controllers(given["scale"])),
        "machine": find_destabilizing_force_error(load_shipped_case()),
        "late": find_destabilizing_force_error(case.with_delay(0.005)),
        "scale": float(enough[0]) if len(enough) else 0.0,
        "hand": float(firm[0]) if len(firm) else np.inf,
        "norm": float(scattering_norm(wrong, 1j * WIDE_FREQUENCIES, 30.0).max()),
    }, (Panel("smallest unstable error [1]", scales, {"identical sides": limits},
              "controllers' gains over those of Table 6.7 [1]", True, True),))  # fmt: skip


def evaluate_destabilizing_force_error(samples: Sequence[Sample]) -> Evaluation:
    """Check whether an error of at most 5 % of the force feed-forward destabilizes the four-channel structure.

    The error is relative. Master and slave are identical, under position control and without delay.
    """
    v = samples[0].values
    return Evaluation(
        (check_deterministic_value("smallest relative error of the force feed-forward that makes the loop unstable",
                     v["limit"], (0.0, 0.05), "5 % is reported to be enough", published=0.05),),
        explanation="the loop is (Z_m + C_m + Z_s + C_s)(Z_h + Z_e) - e Z_h (Z_e - Z_m - C_m): to"
        " destabilize it, e Z_h must be as large as both sides with their controllers; the hand of"
        " this case is much softer. 5 % suffices if the controllers' gains are multiplied"
        f" by {v['scale']:.2g}, or the hand's stiffness by {v['hand']:.2g}; gains, hand and task"
        " of the reported system are not in the document. With 5 % the two-port is no longer"
        f" passive (scattering norm {v['norm']:.4f})",
        note=f"smallest unstable error with a delay of 5 ms each way: {v['late']:.3g}; with the CAT 215 as the slave:"
        f" {v['machine']:.3g}",
    )  # fmt: skip


# --- p. 43 to 49: rate control --------------------------------------------------------------------


def measure_felt_impedance_extremes(changes: Changes) -> Sample:
    """Compute the impedance felt under rate control with force feedback for very stiff and very soft tasks.

    Args:
        changes: `structure_with_task`: 1 for the transparent four-channel structure, 0 for rate control
            with force feedback.

    Returns:
        Relative differences of the felt impedance from Zhu 1994, (3.50) for `stiff` and (3.51) for `soft`
        tasks.
    """
    given = merge_settings({"structure_with_task": 0.0}, changes)
    case, s = load_shipped_case(), 1j * HAND_FREQUENCIES
    port = case.make_port("four_channel_rate" if given["structure_with_task"] else "rate_force")
    master, control = case.master(s), case.master_control(s)
    rate = case.gains.velocity / s * case.slave_control(s) * case.gains.force

    def compute_felt_impedance(scale: float) -> np.ndarray:
        task = Impedance(0.0, scale * case.task.damping, scale * case.task.stiffness)
        return transmitted_impedance(port, s, task)

    return Sample({
        "stiff": compute_relative_error(compute_felt_impedance(1e8), master + control + rate),
        "soft": compute_relative_error(compute_felt_impedance(1e-8), master + control),
    })  # fmt: skip


def evaluate_felt_impedance_extremes(samples: Sequence[Sample]) -> Evaluation:
    """Check that the impedance felt for very stiff and very soft tasks does not depend on the task.

    It must be that of Zhu 1994, (3.50) for stiff and (3.51) for soft tasks, which contain only
    properties of master and slave.
    """
    v, reason = samples[0].values, "the task is 10^8 times stiffer or softer; 10^-4 remains"
    return Evaluation((
        check_deterministic_value("relative difference from (3.50), stiff task", v["stiff"], (0.0, 1e-4), reason),
        check_deterministic_value("relative difference from (3.51), soft task", v["soft"], (0.0, 1e-4), reason),
    ))  # fmt: skip


def build_rate_control_port(case: TeleoperatorAxis, velocity_gain: float = 1.0) -> TwoPort:
    """Return the four-channel two-port under rate control, Zhu 1994, (3.59).

    Args:
        case: teleoperator, whose masses and controllers are used.
        velocity_gain: slave's velocity over the master's position [1/s].

    Returns:
        The two-port. With identical sides, the felt impedance is that of master plus task.
    """
    own, held, k = case.master_control, case.slave_control, velocity_gain
    return TwoPort(
        case.master, case.slave, lambda s: own(s) * k / s, held, lambda s: held(s) * k / s,
        lambda s: s / k, lambda s: k / s, lambda s: -own(s),
    )  # fmt: skip


def measure_rate_transparency(changes: Changes) -> Sample:
    """Compute felt impedance and slave velocity of the four-channel structure under rate control.

    Args:
        changes: `slave_mass`: factor of the slave's mass.

    Returns:
        `felt`: relative error of the felt impedance against master plus task. `velocity`: relative error
        of the slave's velocity against the velocity gain times the master's position.
    """
    given = merge_settings({"slave_mass": 1.0}, changes)
    case, s = make_identical_sides_case(), 1j * HAND_FREQUENCIES
    slave = dataclasses.replace(case.slave, mass=given["slave_mass"] * case.slave.mass)
    case = dataclasses.replace(case, slave=slave)
    usable = build_rate_control_port(case)
    felt, expected = transmitted_impedance(usable, s, case.task), case.master(s) + case.task(s)
    velocity = -hybrid_matrix(usable, s)[..., 1, 0] * s  # over the master's position
    return Sample(
        {"felt": compute_relative_error(felt, expected), "velocity": float(np.abs(velocity - 1.0).max())},
        (Panel("impedance [N s/m]", HAND_FREQUENCIES / (2.0 * np.pi), {
            "felt": np.abs(felt), "of the task": np.abs(case.task(s))}, "frequency [Hz]", True),),
    )  # fmt: skip


def evaluate_rate_transparency(samples: Sequence[Sample]) -> Evaluation:
    """Check that under rate control the operator feels the sum of master and task impedance.

    The slave's velocity must be proportional to the master's position. These are Zhu 1994, (3.61)
    and (3.64).
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("largest relative difference of the felt impedance and Z_m + Z_e (3.61)",
                    v["felt"], ROUNDING_RANGE, "rounding"),
        check_deterministic_value("largest relative difference of the slave's velocity and the velocity gain"
                    " times the master's position (3.64)", v["velocity"], ROUNDING_RANGE, "rounding"),
    ))  # fmt: skip


def measure_stability_without_damping(changes: Changes) -> Sample:
    """Test whether four-channel rate control is stable if the master has no damping, Zhu 1994, (3.72).

    Args:
        changes: `damping`: damping of the master [N s/m].

    Returns:
        `unstable`: unstable fraction of 200 random characteristic polynomials (3.72). `poles`: number of
        unstable poles of the whole loop of identical sides without a hand. `kick`: 1 if the simulated
        impulse response of the loop with a hand without damping decays, else 0.
    """
    given = merge_settings({"damping": 0.0}, changes)
    rng = np.random.default_rng(372)
    control, mass, unstable = (
        load_shipped_case().master_control,
        load_shipped_case().master.mass,
        [],
    )
    for _ in range(200):
        factor = 10.0 ** rng.uniform(-1.0, 1.0, 5)
        m, b, k = factor[0] * mass, factor[1] * control.damping, factor[2] * control.stiffness
        gain, spring = factor[3], 100.0 * factor[4]
        unstable.append(np.roots([m, given["damping"], spring + b * gain, k * gain]).real.max() > 0)
    case, side = make_identical_sides_case(), Impedance(mass, given["damping"], 100.0)
    whole = dataclasses.replace(case, master=side, slave=side)
    poles = count_unstable_poles(build_rate_control_port(whole), Impedance(), case.task)
    bare = dataclasses.replace(whole, hand=dataclasses.replace(case.hand, damping=0.0))
    seen = compare_stability(bare, "four_channel_rate", np.zeros(1), np.ones(1)).simulated[0, 0]
    return Sample({"unstable": float(np.mean(unstable)), "poles": float(poles),
                   "kick": float(seen)})  # fmt: skip


def evaluate_stability_without_damping(samples: Sequence[Sample]) -> Evaluation:
    """Check that rate control without damping of the master is unstable.

    Both the characteristic polynomial of the master (Zhu 1994, (3.72)) and the whole loop without a
    hand must have unstable poles.
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("unstable fraction of 200 random masters without damping", v["unstable"],
                    (1.0, 1.0), "it can not be stable"),
        check_deterministic_value("unstable poles of the whole loop without damping and without a hand",
                    v["poles"], (1.0, np.inf), "it can not be stable"),
    ), "(3.71) describes the master without the slave's channel, which is unstable without"
       " damping. The"
       " poles of the whole loop of identical sides are the zeros of (3.69), Z_m + C_m/(K_v s) +"
       " C_s, and of Z_m + Z_h + Z_e: the slave's controller damps them",
       "a simulated kick of the whole loop, the hand without damping, "
       f"{'decays' if v['kick'] else 'grows'}")  # fmt: skip


_TASK_IMPEDANCES = (
    (2.0, 150.0, 8000.0),
    (1.0, 60.0, 1500.0),
)  # two successive tasks [kg], [N s/m], [N/m]
_EVALUATION_TIME = 4.0  # last seconds of a task, in which the stiffness error is evaluated [s]


def measure_task_identification(seed: int, changes: Changes) -> Sample:
    """Estimate mass, damping and stiffness of a simulated task by recursive least squares; the task changes once.

    Args:
        seed: seed of motion and noise.
        changes: `forgetting`: forgetting factor per sample of 20 ms; `reset`: prediction error over its
            usual size at which the covariance is reset; `noise`: RMS force noise over RMS force.

    Returns:
        Largest relative stiffness errors in the last 4 s `before` the task changes, and in the last 4 s
        of the run, `after` the change.
    """
    given = merge_settings({"forgetting": 0.99, "reset": 8.0, "noise": 0.02}, changes)
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
    truth = np.where(first[:, None], _TASK_IMPEDANCES[0], _TASK_IMPEDANCES[1])
    force = np.sum(rows * truth, axis=1)
    force += given["noise"] * np.sqrt(np.mean(force**2)) * rng.standard_normal(n)
    found = RecursiveLeastSquares(
        np.zeros(3), np.array([1e2, 1e3, 1e5]), forgetting=given["forgetting"],
        reset_ratio=given["reset"],
    )  # fmt: skip
    history = np.empty((n, 3))
    for i in range(n):
        found.update(rows[i], force[i])
        history[i] = found.value
    values = {}
    for name, end, task in (
        ("before", 10.0, _TASK_IMPEDANCES[0]),
        ("after", 20.0, _TASK_IMPEDANCES[1]),
    ):
        late = (time > end - _EVALUATION_TIME) & (time < end)
        values[name] = float(np.abs(history[late, 2] / task[2] - 1.0).max())
    return Sample(values, (
        Panel("stiffness of the task [kN/m]", time, {
            "true": truth[:, 2] / 1e3, "estimated": history[:, 2] / 1e3}),
    ))  # fmt: skip


def evaluate_task_identification(samples: Sequence[Sample]) -> Evaluation:
    """Check that the estimated stiffness of a changing task errs by less than 23 % before and after the change.

    The error is the largest one in the last 4 s before the change and in the last 4 s of the run,
    averaged over repetitions.
    """
    reason = "23 % of a compliance is not noticeable (Tan 1995); no size is published"
    return Evaluation(
        tuple(
            check_mean(f"largest relative error of the stiffness in the last {_EVALUATION_TIME:g} s"
                       f" {words} the task changes", collect_values(samples, name),
                       (-np.inf, NOTICEABLE_DIFFERENCE), reason)
            for name, words in (("before", "before"), ("after", "after"))
        ),
        note=f"after the change {format_values(samples, 'after', 100.0)} %, with forgetting factor"
        " 0.99 per 20 ms and resetting at 8 times the usual error",
    )  # fmt: skip


EXPERIMENTS: tuple[Experiment, ...] = (
    make_deterministic_experiment("four channels, position control", measure_transparency, make_claim(
        "transparency under position control",
        'H = [[0, 1], [-1, 0]] (3.28); "the master position asymptotically"',
        "p. 39", evaluate_transparency, {"mass_error": 0.1}, "a slave 10 % heavier than assumed",
    ), make_claim(
        "transparent teleoperator: lossless and stable",
        '"Therefore, from the network point of view, this two-port is passive" (norm 1, 3.33);'
        ' "Hence when it is connected to any" strictly "passive load, the system'
        ' stability is ensured."', "p. 39", evaluate_passivity, {"delay": 0.05}, "50 ms each way",
    )),
    make_deterministic_experiment("intervening impedance", measure_intervening_impedance, make_claim(
        "intervenient impedance",
        '"Thus the operator indeed feels the object\'s impedance and an intervenient impedance as'
        ' we expected."', "p. 41, Fig. 3.20", evaluate_intervening_impedance, {"slave_mass": 3.0},
        "a slave three times as heavy as the master",
    )),
    make_deterministic_experiment("force feed-forward error", measure_destabilizing_force_error, make_claim(
        "force feed-forward error of 5 %",
        '"reported an error of only 5% in the force feed forward could drive the system unstable"',
        "p. 43", evaluate_destabilizing_force_error, {"scale": 3.0}, "controllers three times as stiff",
    )),
    make_deterministic_experiment("direct force, extremes", measure_felt_impedance_extremes, make_claim(
        "rate-force structure: extremes",
        '"At these extremes, the operator could only feel some dynamics of the master-slave system;'
        ' it has nothing to do with the dynamics of the task."', "p. 43",
        evaluate_felt_impedance_extremes, {"structure_with_task": 1.0}, "the transparent structure",
    )),
    make_deterministic_experiment("four channels, rate control", measure_rate_transparency, make_claim(
        "transparency under rate control",
        '"Thus we have the same impedance as for position control, which can be interpreted as the'
        ' master impedance plus the task impedance."; "therefore the slave is indeed under rate'
        ' control"', "p. 46, Fig. 3.21", evaluate_rate_transparency, {"slave_mass": 3.0},
        "a slave three times as heavy as the master",
    )),
    make_deterministic_experiment("damping of the master", measure_stability_without_damping, make_claim(
        "rate control: damping of the master",
        '"otherwise, the system can not be stable" (B_mc = 0 in 3.72)', "p. 48",
        evaluate_stability_without_damping, {"damping": 200.0},
        "the masters have damping, although the names of the quantities say \"without damping\"",
    )),
    Experiment("task identification", measure_task_identification, (make_claim(
        "transparency via impedance identification",
        '"On-line recursive least-squares estimation can be used to identify the task impedance'
        ' parameters. In addition, the resetting and forgetting factor technique can be employed to'
        ' deal with a changing environment."', "p. 48, Fig. 3.22", evaluate_task_identification,
        {"forgetting": 1.0, "reset": 1e9}, "neither forgetting nor resetting",
    ),)),
)  # fmt: skip
