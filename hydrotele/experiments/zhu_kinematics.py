"""Zhu 1994, chapter 2: inverse kinematics, resolved-rate motion, and the workspace boundary."""

import math
from collections.abc import Sequence

import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.experiments.comparison import Changes, Claim, Evaluation, Experiment, Panel, Sample, merge_settings
from hydrotele.experiments.scenario_runs import (
    compute_cylindrical_pose,
    make_random_operator_settings,
    run_shipped_scenario,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_fraction,
    check_mean,
    collect_values,
    format_values,
)
from hydrotele.experiments.zhu_two_port import (
    ROUNDING_RANGE,
    make_claim,
    make_deterministic_experiment,
)
from hydrotele.kinematics.arm_dimensions import feller_geometry
from hydrotele.kinematics.task_space import (
    BASE_HEIGHT,
    BASE_RADIUS,
    BOOM_LENGTH,
    HEAD_RADIUS,
    LATERAL_OFFSET,
    REACHED,
    STICK_LENGTH,
    TOOL_ALONG,
    TOOL_UP,
    compute_tip_pose,
    solve_joint_angles,
)
from hydrotele.machine.machine_file import load_machine

_MACHINE_TOOLS = {"excavator": ("cat215", "bucket"), "feller-buncher": ("cat325", None)}
_POSE_COUNT = 400
_MAX_REPETITIONS = 6  # repetitions of a scenario


def _load_arm(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the geometric parameters (9,) of a machine's arm and the joint ranges (k, 2) [rad].

    The range of the swing is replaced by -pi to pi.

    Args:
        name: `excavator` or `feller-buncher`.
    """
    machine, tool = _MACHINE_TOOLS[name]
    numbers, _, ranges = arm_specification(load_machine(machine, tool) if tool else load_machine(machine))
    ranges = ranges.copy()
    ranges[0] = -math.pi, math.pi
    return numbers, ranges


def _build_link_transform(turn: float, along: float, length: float, twist: float) -> np.ndarray:
    """Return the homogeneous transformation (4, 4) of a link with given Denavit-Hartenberg parameters.

    `turn` is the joint angle [rad], `along` the offset d [m], `length` the link length a [m], and `twist`
    the link twist alpha [rad].
    """
    ct, st, ca, sa = math.cos(turn), math.sin(turn), math.cos(twist), math.sin(twist)
    return np.array([
        [ct, -st * ca, st * sa, length * ct],
        [st, ct * ca, -ct * sa, length * st],
        [0.0, sa, ca, along],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip


def compute_tool_position(g: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Compute the tool position from the Denavit-Hartenberg chains of Zhu 1994, Tables 2.1 and 2.2.

    Args:
        g: (9,) geometric parameters as in `kinematics.task_space.arm_parameters`.
        q: (4,) or (5,) joint angles [rad].

    Returns:
        (3,) position relative to the foot of the swing axis [m].
    """
    whole = _build_link_transform(q[0], g[BASE_HEIGHT], g[BASE_RADIUS], math.pi / 2.0)
    whole = (
        whole
        @ _build_link_transform(q[1], -g[LATERAL_OFFSET], g[BOOM_LENGTH], 0.0)
        @ _build_link_transform(q[2], 0.0, g[STICK_LENGTH], 0.0)
    )
    if len(q) == 4:
        whole = whole @ _build_link_transform(q[3], 0.0, 0.0, 0.0)
        return (whole @ [g[TOOL_ALONG], g[TOOL_UP], 0.0, 1.0])[:3]
    whole = whole @ _build_link_transform(q[3], 0.0, g[TOOL_ALONG], math.pi / 2.0)
    return (whole @ _build_link_transform(q[4], -g[TOOL_UP], g[HEAD_RADIUS], 0.0))[:3, 3]


def measure_inverse_kinematics(changes: Changes) -> Sample:
    """Compare the closed-form forward and inverse kinematics with the published D-H chains.

    The chains are printed in Zhu 1994, Tables 2.1 and 2.2. Random poses in and out of reach are
    tested for both machines.

    Args:
        changes: `stick`: factor of the stick's length in the closed form.

    Returns:
        Per machine: largest coordinate of the position difference between forward kinematics and chain
        (`chain`), and of the position error after inverse kinematics (`back`), infinite if a pose in
        reach is not solved [m]. `agree`: fraction of poses for which inverse kinematics and a search over
        the elbow angle agree whether the pose is in reach.
    """
    given = merge_settings({"stick": 1.0}, changes)
    rng, values = np.random.default_rng(23), {}
    for name in _MACHINE_TOOLS:
        g, ranges = _load_arm(name)
        wrong = g.copy()
        wrong[STICK_LENGTH] *= given["stick"]
        chain, back, agree = 0.0, 0.0, 0
        for _ in range(_POSE_COUNT):
            q, pose, found = rng.uniform(*ranges.T), np.zeros(5), np.zeros(len(ranges))
            compute_tip_pose(g, q, pose)
            place = compute_tool_position(g, q)
            there = np.array([pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1]), pose[2]])
            chain = max(chain, float(np.abs(place - there).max()))
            status = solve_joint_angles(wrong, pose, q[0], found)
            error = np.abs(compute_tool_position(g, found) - place).max() if status == REACHED else np.inf
            back = max(back, float(error))
            pose[0] = rng.uniform(1.5, 1.5 * (g[BOOM_LENGTH] + g[STICK_LENGTH]))
            pose[2] = rng.uniform(-1.0, 1.5) * g[BOOM_LENGTH]
            agree += (solve_joint_angles(wrong, pose, q[0], found) == REACHED) == _is_reachable(g, pose)
        values |= {
            f"chain {name}": chain,
            f"back {name}": back,
            f"agree {name}": agree / _POSE_COUNT,
        }
    return Sample(values)


def _is_reachable(g: np.ndarray, pose: np.ndarray) -> bool:
    """Return whether the arm can reach a pose, by a search over the elbow angle.

    Args:
        g: (9,) geometric parameters of the arm.
        pose: (5,) r [m], theta [rad], z [m], attitude and head angle [rad].
    """
    head, attitude = pose[4], pose[3]
    ahead = math.sqrt(pose[0] ** 2 - (g[LATERAL_OFFSET] - g[HEAD_RADIUS] * math.sin(head)) ** 2) - g[BASE_RADIUS]
    bar, rise = g[TOOL_ALONG] + g[HEAD_RADIUS] * math.cos(head), g[TOOL_UP]
    ahead -= bar * math.cos(attitude) - rise * math.sin(attitude)
    up = pose[2] - g[BASE_HEIGHT] - bar * math.sin(attitude) - rise * math.cos(attitude)
    elbow = np.linspace(0.0, math.pi, 2001)
    reach = np.abs(g[BOOM_LENGTH] + g[STICK_LENGTH] * np.exp(1j * elbow))
    return bool(reach.min() <= math.hypot(ahead, up) <= reach.max())


def evaluate_forward_kinematics(samples: Sequence[Sample]) -> Evaluation:
    """Check that the closed-form forward kinematics agrees with the chains of Zhu 1994, Tables 2.1 and 2.2."""
    return Evaluation(tuple(
        check_deterministic_value(f"largest difference of position, {name}", samples[0].values[f"chain {name}"],
                    ROUNDING_RANGE, "rounding", unit="m") for name in _MACHINE_TOOLS
    ))  # fmt: skip


def evaluate_inverse_kinematics(samples: Sequence[Sample]) -> Evaluation:
    """Check that the closed-form inverse kinematics solves all random poses in reach, to 1e-6 m."""
    return Evaluation(tuple(
        check_deterministic_value(
            f"largest position error of the closed-form solution among {_POSE_COUNT} reachable poses, "
            f"{name}",
            samples[0].values[f"back {name}"], (0.0, 1e-6),
            "rounding only; it increases at a straight elbow", unit="m") for name in _MACHINE_TOOLS
    ))  # fmt: skip


def evaluate_reachability(samples: Sequence[Sample]) -> Evaluation:
    """Check that inverse kinematics finds a solution if and only if the pose is in reach.

    Whether a pose is in reach is found by a search over the elbow angle.
    """
    return Evaluation(tuple(
        check_deterministic_value(
            f"fraction of {_POSE_COUNT} poses, many of them out of reach, for which the closed form and "
                "a numerical search over the elbow angle agree whether a solution exists, "
                f"{name}",
                    samples[0].values[f"agree {name}"], (1.0, 1.0), "agreement for all poses")
        for name in _MACHINE_TOOLS
    ))  # fmt: skip


def count_inverse_kinematics_solutions(changes: Changes) -> Sample:
    """Count the inverse kinematics solutions of the feller-buncher by both approaches of Zhu 1994.

    A candidate is extraneous if the end of the tilt link lies behind the swing axis. Its azimuth
    is then not that of the arm plane (2.14, 2.32).

    Args:
        changes: `check`: 0 to count extraneous candidates as solutions.

    Returns:
        Over random poses, largest numbers of solutions by the approaches (`first`, `second`), and mean
        numbers of extraneous candidates (`extra_first`, `extra_second`).
    """
    given = merge_settings({"check": 1.0}, changes)
    g, (numbers, ranges) = feller_geometry(load_machine("cat325")), _load_arm("feller-buncher")
    rng = np.random.default_rng(24)
    counts = {"first": [], "second": [], "extra_first": [], "extra_second": []}
    for _ in range(_POSE_COUNT):
        q, pose = rng.uniform(*ranges.T), np.zeros(5)
        compute_tip_pose(numbers, q, pose)
        x, y = pose[0] * math.cos(pose[1]), pose[0] * math.sin(pose[1])
        depth, radius = g.head_depth, g.head_radius
        ahead = radius * math.cos(pose[4]) * math.cos(pose[3]) + depth * math.sin(pose[3])
        aside = radius * math.sin(pose[4])
        base = math.atan2(x, -y)
        turn = math.atan2(math.sqrt(max(x * x + y * y - aside * aside, 0.0)), aside)
        radii = [x * math.cos(phi) + y * math.sin(phi) - ahead for phi in (base + turn, base - turn)]
        kept = sum(r > 0.0 for r in radii) if given["check"] else len(radii)
        counts["first"].append(kept)
        counts["extra_first"].append(len(radii) - kept)
        swing, out = q[0], math.cos(pose[4]) * math.cos(pose[3])
        across = math.sin(pose[4])
        m = np.array([out * math.cos(swing) + across * math.sin(swing),
                      out * math.sin(swing) - across * math.cos(swing),
                      math.cos(pose[4]) * math.sin(pose[3])])  # fmt: skip
        px, py = x - radius * m[0], y - radius * m[1]
        radii = []
        for phi in (math.atan2(py, px), math.atan2(py, px) + math.pi):
            forward = m[0] * math.cos(phi) + m[1] * math.sin(phi)
            for side in (1.0, -1.0):
                attitude = math.atan2(side * m[2], side * forward)
                radii.append(px * math.cos(phi) + py * math.sin(phi) - depth * math.sin(attitude))
        kept = sum(r > 0.0 for r in radii) if given["check"] else len(radii)
        counts["second"].append(kept)
        counts["extra_second"].append(len(radii) - kept)
    return Sample({
        "first": float(max(counts["first"])), "second": float(max(counts["second"])),
        "extra_first": float(np.mean(counts["extra_first"])),
        "extra_second": float(np.mean(counts["extra_second"])),
    })  # fmt: skip


def evaluate_solution_counts(samples: Sequence[Sample]) -> Evaluation:
    """Check that the approaches give at most two and four solutions of the inverse kinematics.

    Approach 1 must have fewer extraneous candidates than approach 2 (Zhu 1994, p. 24).
    """
    v = samples[0].values
    return Evaluation((
        check_deterministic_value("largest number of solutions with approach 1", v["first"], (1.0, 2.0),
                    "at most two"),
        check_deterministic_value("largest number of solutions with approach 2", v["second"], (1.0, 4.0),
                    "at most four"),
        check_deterministic_value("extraneous candidates per pose of approach 1, minus those of approach 2",
                    v["extra_first"] - v["extra_second"], (-np.inf, -1e-9), "fewer"),
    ), note=f"extraneous candidates per pose: {v['extra_first']:.2f} of 2 with approach 1, "
                f"{v['extra_second']:.2f} of 4 with approach 2")  # fmt: skip


_CYCLE_CHANGES = {
    "duration": "22.0",
    "pilot.operator.time":
        "[0, 1, 1.5, 4.5, 5, 6, 6.5, 9.5, 10, 11, 11.5, 14.5, 15, 16, 16.5, 19.5, 20, 22]",
    "pilot.operator.path": "{z: [0, 0, 0.004, 0.004, 0, 0, -0.004, -0.004, 0, 0, 0.004, 0.004, 0,"
                           " 0, -0.004, -0.004, 0, 0]}",
}  # fmt: skip
"""Scenario changes for two cycles up and down, with a travel of 1.4 m."""
_METHOD_CHANGES = {
    "kinematics": {},
    "jacobian": {"pilot.resolved_motion": "inverse_jacobian"},
    "rates": {"pilot.resolved_motion": "inverse_jacobian", "servo.position_gain": "0.0"},
    "open": {"servo.position_gain": "0.0"},
}


def measure_motion_methods(seed: int, changes: Changes) -> Sample:
    """Simulate the excavator's bucket moving up and down twice, with inverse kinematics and inverse Jacobian.

    Each method is simulated with closed and with open joint loops: `kinematics` and `open` by inverse
    kinematics, `jacobian` and `rates` by the inverse Jacobian. The radius should stay constant.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys, applied after those of the method.

    Returns:
        Per method, the largest deviation of the true radius from its start (`stray`), and the deviation
        of the reference radius after one (`once`) and two cycles (`twice`) [m].
    """
    values, radius, time = {}, {}, np.zeros(0)
    for name, keys in _METHOD_CHANGES.items():
        _, run = run_shipped_scenario(
            "joystick_up", make_random_operator_settings(seed) | _CYCLE_CHANGES | keys | dict(changes)
        )
        pose, time = compute_cylindrical_pose(run), run.truth.time
        radius[name] = 1e3 * (pose["r"] - pose["r"][0])
        reference = run.measured["tip_reference.r"]
        once, twice = np.searchsorted(run.measured.time, (10.9, 21.9))
        values |= {
            f"stray {name}": 1e-3 * float(np.abs(radius[name]).max()),
            f"once {name}": float(abs(reference[once] - reference[0])),
            f"twice {name}": float(abs(reference[twice] - reference[0])),
        }
    words = {"kinematics": "inverse kinematics", "jacobian": "inverse Jacobian",
             "rates": "inverse Jacobian, open joint loops",
             "open": "inverse kinematics, open joint loops"}  # fmt: skip
    return Sample(values, (
        Panel("deviation of the radius, joint loops closed [mm]", time,
              {words[name]: radius[name] for name in ("kinematics", "jacobian")}),
        Panel("deviation of the radius, joint loops open [mm]", time,
              {words[name]: radius[name] for name in ("open", "rates")}),
    ))  # fmt: skip


def _compute_ratio_of_means(rows: np.ndarray) -> float:
    return float(rows[:, 0].mean() / max(rows[:, 1].mean(), 1e-12))


def _collect_pairs(samples: Sequence[Sample], first: str, second: str) -> np.ndarray:
    return np.column_stack([collect_values(samples, first), collect_values(samples, second)])


def evaluate_accumulation(samples: Sequence[Sample]) -> Evaluation:
    """Check that position errors of the inverse Jacobian method accumulate from cycle to cycle.

    The error of the reference radius must be larger after two cycles than after one. The radius of the
    bucket must also deviate at least twice as much as with inverse kinematics. Joint loops are closed.
    """
    return Evaluation(
        (
            check_bootstrapped_statistic(
                "radius error of the commanded path after two cycles over that after one cycle",
                            _collect_pairs(samples, "twice jacobian", "once jacobian"), _compute_ratio_of_means,
                            (1.0, np.inf), "it accumulates"),
            check_bootstrapped_statistic(
                "largest radius deviation of the bucket with the inverse Jacobian over that with inverse "
                "kinematics",
                            _collect_pairs(samples, "stray jacobian", "stray kinematics"),
                            _compute_ratio_of_means, (2.0, np.inf),
                            "\"low accuracy\": at least twice the deviation; no size is published"),
        ),
        explanation="the integrated rates are the references of closed joint loops. These references deviate "
                f"by only {format_values(samples, 'twice jacobian', 1e3, 2)} mm in two cycles, because the "
                "Jacobian is evaluated at delayed measured angles. The machine itself deviates by "
                f"{format_values(samples, 'stray kinematics', 1e3)} mm even with inverse kinematics. "
                "Deviations are large only with open joint loops: "
                f"{format_values(samples, 'stray rates', 1e3, 0)} mm",
        note=f"largest deviation {format_values(samples, 'stray jacobian', 1e3)} mm with the inverse Jacobian,"
        f" {format_values(samples, 'stray kinematics', 1e3)} mm with inverse kinematics",
    )  # fmt: skip


def evaluate_motion_accuracy(samples: Sequence[Sample]) -> Evaluation:
    """Check that inverse kinematics with closed joint loops is at least twice as accurate as joint rates alone.

    The joint rates are those of the inverse Jacobian with open joint loops.
    """
    return Evaluation(
        (check_bootstrapped_statistic(
            "largest radius deviation with joint rates of the inverse Jacobian and open joint loops, "
                "over that with inverse kinematics and closed joint loops",
                         _collect_pairs(samples, "stray rates", "stray kinematics"), _compute_ratio_of_means,
                         (2.0, np.inf), "\"high accuracy\": at most half of the deviation; no size is published"),),
        explanation="the closed joint loops determine the accuracy: the deviation of inverse"
        " kinematics with open loops is"
        f" {format_values(samples, 'stray open', 1e3, 0)} mm, that of the"
        f" inverse Jacobian with closed loops {format_values(samples, 'stray jacobian', 1e3)} mm",
        note=f"largest deviation {format_values(samples, 'stray kinematics', 1e3)} mm with closed loops,"
        f" {format_values(samples, 'stray rates', 1e3, 0)} mm with open loops, in a travel of 1.4 m",
    )  # fmt: skip


_EDGE_CHANGES = {
    "duration": "18.0",
    "pilot.operator": "{kind: follow, time: [0, 1, 1.5, 13, 13.5, 17, 17.5],"
                      " path: {x: [0, 0, 0.004, 0.004, -0.004, -0.004, 0]}}",
}  # fmt: skip
_EDGE_TIME, _REVERSAL_START, _REVERSAL_END = (
    10.5,
    13.0,
    13.5,
)  # s: edge reached, end of outward command, reversed


def simulate_workspace_edge(seed: int, changes: Changes) -> Sample:
    """Simulate the feller-buncher's head commanded beyond the edge of the workspace and back.

    Args:
        seed: seed of operator and sensor noise.
        changes: scenario keys.

    Returns:
        `edge`: radius at which the references stop [m]; `beyond`: largest distance of the head
        beyond it [m]; `height`: largest height deviation until the command reverses [m]; `back`:
        time from the reversal until the references leave the edge [s]; `speed`: largest joint
        rate [rad/s]; `stick`: angle of the stick from straight at the edge [deg].
    """
    _, run = run_shipped_scenario("feller_steps", make_random_operator_settings(seed) | _EDGE_CHANGES | dict(changes))
    pose, time, m = compute_cylindrical_pose(run), run.truth.time, run.measured
    reference = m["tip_reference.r"]
    edge = float(reference[np.searchsorted(m.time, _REVERSAL_START)])
    left = m.time[(m.time > _REVERSAL_START) & (reference < edge - 1e-3)]
    before = time < _REVERSAL_START
    rates = [np.abs(np.gradient(run.truth.columns[f"angle.{axis}"], time)).max()
             for axis in ("boom", "stick", "tilt")]  # fmt: skip
    stick = run.truth.columns["angle.stick"][np.searchsorted(time, _REVERSAL_START)]
    held = (m.time > _EDGE_TIME) & (m.time < _REVERSAL_START)
    return Sample({
        "beyond": float(pose["r"].max() - edge), "edge": edge,
        "moved": float(np.ptp(reference[held])),
        "height": float(np.abs(pose["z"][before] - pose["z"][0]).max()),
        "back": float(left[0] - _REVERSAL_START) if len(left) else np.inf,
        "speed": float(max(rates)), "stick": float(abs(np.degrees(stick))),
    }, (
        Panel("head [m]", m.time, {
            "r, reference": reference, "r": np.interp(m.time, time, pose["r"]),
            "z": np.interp(m.time, time, pose["z"])}),
    ))  # fmt: skip


def evaluate_workspace_edge(samples: Sequence[Sample]) -> Evaluation:
    """Check that the head stops at the edge of the workspace, keeps its height, and leaves the edge on command.

    The head may move 0.058 m beyond the edge and change its height by as much. For more than half of the
    operators, the references must stop at the edge and leave it within 0.5 s of the reversal.
    """
    way = "2 % of the travel of 2.9 m, as in the rows of straight lines"
    turned = _REVERSAL_END - _REVERSAL_START
    return Evaluation((
        check_mean("distance of the head beyond the edge", collect_values(samples, "beyond"),
                   (-np.inf, 0.058), way, unit="m"),
        check_mean("deviation of the height", collect_values(samples, "height"), (-np.inf, 0.058), way,
                   unit="m"),
        check_fraction("operators whose references stop at the edge and leave it within"
                       f" {turned:g} s, before the handle is fully reversed",
                       [s.values["back"] < turned and s.values["moved"] < 1e-3 for s in samples]),
    ), note=f"edge at r = {format_values(samples, 'edge', 1.0, 2)} m, where the stick's range ends"
       f" {format_values(samples, 'stick', 1.0, 0)} deg from straight; largest joint rate"
       f" {format_values(samples, 'speed', 1.0, 2)} rad/s")  # fmt: skip


EXPERIMENTS: tuple[Experiment, ...] = (
    make_deterministic_experiment("inverse kinematics", measure_inverse_kinematics, make_claim(
        "links: Denavit-Hartenberg parameters",
        "the chains of Tables 2.1 and 2.2 are those of the arms", "p. 13, Tables 2.1, 2.2,"
        " Figs 2.7, 2.9", evaluate_forward_kinematics, None, "", "input",
    ), make_claim(
        "inverse kinematics in closed form",
        '"In this chapter, closed-form inverse kinematics solutions are provided for typical'
        ' hydraulic mobile machines, excavators and feller-bunchers"', "p. 10, Fig. 2.8",
        evaluate_inverse_kinematics, {"stick": 1.01}, "the closed form assumes a stick that is 1 % too long",
    ), make_claim(
        "no solution out of reach",
        '"assuming the specified endpoint frame is within the manipulator\'s work space; Otherwise,'
        ' solution does not exist."', "p. 15", evaluate_reachability, {"stick": 1.1},
        "the closed form assumes a stick that is 10 % too long",
    )),
    make_deterministic_experiment("number of solutions", count_inverse_kinematics_solutions, make_claim(
        "feller-buncher: number of solutions",
        '"We can see there are at most two" (approach 1); "there are at most four solutions to this'
        ' problem" (approach 2); "approach 1 is easier than approach 2, and introduces fewer'
        ' extraneous solutions"', "p. 24, Fig. 2.9", evaluate_solution_counts, {"check": 0.0},
        "extraneous candidates are not rejected",
    )),
    Experiment("methods of resolved motion", measure_motion_methods, (make_claim(
        "inverse Jacobian: error accumulates",
        '"Since position error can accumulate, the inverse Jacobian method suffers from low'
        ' accuracy."', "p. 10, Eq. 2.1", evaluate_accumulation,
        {"pilot.resolved_motion": "inverse_kinematics"}, "inverse kinematics in both runs",
    ), make_claim(
        "inverse kinematics and closed joint loops: accuracy",
        '"It is clear from these plots that the motion accuracy is high due to the fact inverse'
        " kinematics instead of Jacobian transformations were used and the joint angles of the"
        ' excavator were under closed-loop control."', "p. 91", evaluate_motion_accuracy,
        {"servo.position_gain": "0.0"}, "open joint loops everywhere",
    )), _MAX_REPETITIONS),
    Experiment("edge of the workspace", simulate_workspace_edge, (Claim(
        "feller-buncher: edge of the workspace",
        'if commanded beyond the edge, the references stop there, height and attitude stay'
        ' constant, and the head leaves when the command is reversed; the document says "Resolved'
        ' motion control of the feller-buncher near the edge of workspace needs further study."',
        "additional to p. 112", "additional", evaluate_workspace_edge, {"servo.axis_gains": "{stick: 0.0}"},
        "no position loop of the stick",
    ),), _MAX_REPETITIONS),
)  # fmt: skip
