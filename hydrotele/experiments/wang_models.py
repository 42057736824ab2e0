"""Wang 2012, chapters 2 and 3: kinematics, counts of parameters, and error models."""

from collections.abc import Sequence

import mujoco
import numpy as np

from hydrotele.calibrate.parameter_count import (
    Chain,
    JointKind,
    Mechanism,
    count_serial_parameters,
    delta_mechanism,
    hexapod_mechanism,
    identifiable_rank,
    serial_mechanism,
)
from hydrotele.experiments.comparison import (
    Changes,
    Claim,
    Evaluation,
    Experiment,
    Panel,
    Sample,
    merge_settings,
)
from hydrotele.experiments.statistical_checks import (
    check_bootstrapped_statistic,
    check_deterministic_value,
    check_mean,
    format_values,
)
from hydrotele.experiments.wang_robots import REQUIRED_ACCURACY
from hydrotele.kinematics.hybrid_error_model import apply_geometry_errors, build_error_model, first_order_carriage_pose
from hydrotele.kinematics.hybrid_robot import (
    PlatformPose,
    build_hybrid,
    carriage_pose,
    forward_kinematics,
    forward_kinematics_by_evolution,
    leg_readings,
    load_hybrid,
    pose_difference,
)
from hydrotele.simulate.hybrid_mechanism import build_hybrid_mechanism, solve_mechanism_pose
from hydrotele.simulate.pose_measurements import sample_manufacturing_errors, sample_poses

MAX_ROUNDING = 1e-9  # [m] or [rad]: below the resolution of any sensor, above rounding errors


def compare_carriage_kinematics(seed: int, changes: Changes) -> Sample:
    """Compare the position of the carriage's end by D-H matrices with the printed formula, Wang 2012, Eq. 7.

    The carriage is the serial part of the robot IWR; 200 random joint positions are tested. The
    parameter errors of carriage and hexapod in the D-H error model are counted as well.

    Args:
        seed: seed of the poses.
        changes: `third_twist`: twist of the third link [rad]; `second_joint`: kind of the second
            joint.

    Returns:
        Largest `difference` of a coordinate [m], and counts of parameter errors of `carriage` and
        `hexapod`.
    """
    settings = merge_settings({"third_twist": 0.5 * np.pi, "second_joint": "prismatic"}, changes)
    robot, rng = load_hybrid("iwr"), np.random.default_rng(seed)
    joints, _ = sample_poses(robot, 200, rng)
    rows = list(robot.specification.carriage)
    rows[1] = rows[1].model_copy(update={"kind": settings["second_joint"]})
    rows[2] = rows[2].model_copy(update={"alpha": settings["third_twist"]})
    robot = build_hybrid(robot.specification.model_copy(update={"carriage": tuple(rows)}))
    d1, d2, q3, q4 = joints.T
    a3, d3, a4 = rows[2].a, rows[2].d, rows[3].a
    c3, s3, c4, s4 = np.cos(q3), np.sin(q3), np.cos(q4), np.sin(q4)
    printed = np.column_stack([
        d3 + a4 * s4, -(d2 + a3 * s3 + a4 * s3 * c4), d1 + a3 * c3 + a4 * c3 * c4,
    ])  # fmt: skip
    model = build_error_model(robot, "dh")
    difference = np.abs(carriage_pose(robot, joints)[:, :3, 3] - printed).max()
    return Sample({
        "difference": float(difference), "carriage": model.carriage_parameter_count,
        "hexapod": len(model.names) - model.carriage_parameter_count,
    })  # fmt: skip


def _evaluate_carriage_kinematics(samples: Sequence[Sample]) -> Evaluation:
    return Evaluation(
        (check_deterministic_value("largest difference of a coordinate", samples[0].values["difference"],
                     (0.0, MAX_ROUNDING), "rounding", unit="m"),),
        note="200 random poses; the minus signs, which the available text does not show, follow from Table 1",
    )  # fmt: skip


def _evaluate_parameter_error_counts(samples: Sequence[Sample]) -> Evaluation:
    values = samples[0].values
    return Evaluation(tuple(
        check_deterministic_value(f"parameter errors of the {part}", values[part], (float(count), float(count)),
                    "as printed", published=count)
        for part, count in (("carriage", 12), ("hexapod", 42))
    ))  # fmt: skip


_TWO_HINGES: tuple[JointKind, JointKind] = ("revolute", "revolute")
_SLIDE: JointKind = "prismatic"
_BALL: JointKind = "spherical"


def build_iwr_mechanism(straight: bool) -> Mechanism:
    """Build the robot IWR: a measured PPRR carriage in series with a hexapod of six S-P-S legs.

    P, R and S are prismatic, revolute and spherical joints.

    Args:
        straight: whether the slide axes pass through both spherical joints, as in Wang 2012, Eq.
            27.
    """
    carriage = serial_mechanism("", (_SLIDE, _SLIDE, *_TWO_HINGES)).chains[0]
    legs = hexapod_mechanism("", (_BALL, _SLIDE, _BALL), (1, 2) if straight else ())
    chains = tuple(Chain((*carriage.links[:-1], *leg.links), (*carriage.joints, *leg.joints)) for leg in legs.chains)
    return Mechanism("IWR", chains, legs.straight_links)


MECHANISMS = {
    "6-SPS hexapod": hexapod_mechanism("6-SPS", (_BALL, _SLIDE, _BALL)),
    "6-UPS hexapod, universal joints of two hinges": hexapod_mechanism(
        "6-UPS", (*_TWO_HINGES, _SLIDE, _BALL)),
    "6-RRPRRR hexapod": hexapod_mechanism("6-RRPRRR", (*_TWO_HINGES, _SLIDE, *_TWO_HINGES, "revolute")),
    "Delta robot": delta_mechanism(),
    "IWR with 6-SPS hexapod": build_iwr_mechanism(straight=False),
}  # fmt: skip
"""Mechanisms with loops and arbitrary dimensions, for which Eq. 5 is evaluated."""

STRAIGHT_HEXAPOD = hexapod_mechanism("6-SPS", (_BALL, _SLIDE, _BALL), (1, 2))
"""Hexapod of page 34, whose slide axes pass through the centres of both spherical joints."""

_SERIAL_ROBOTS: dict[str, tuple[JointKind, ...]] = {
    "carriage PPRR": (_SLIDE, _SLIDE, *_TWO_HINGES), "SCARA RRPR": (*_TWO_HINGES, _SLIDE, "revolute"),
    "six hinges": (*_TWO_HINGES, *_TWO_HINGES, *_TWO_HINGES),
}  # fmt: skip


def measure_parameter_counts(seed: int, changes: Changes) -> Sample:
    """Compare parameter counts by the formulas of Wang 2012, Eqs 4 and 5, with ranks of identification Jacobians.

    Eq. 4 is for serial robots, Eq. 5 for mechanisms with loops.

    Args:
        seed: seed of dimensions and poses.
        changes: `locked_joints`: number of measured joints that never move; `poses`: number of
            poses.

    Returns:
        `count NAME` by the formula and `rank NAME` of the identification Jacobian of every mechanism.
        `hexapod` and `robot`: ranks of the hexapod and of the robot IWR whose slide axes pass through
        the spherical joints of the legs.
    """
    settings = merge_settings({"locked_joints": 0, "poses": 30}, changes)

    def compute_identifiable_rank(mechanism: Mechanism) -> int:
        measured = [name for name, joint in mechanism.joints.items() if joint.measured]
        locked = frozenset(measured[: settings["locked_joints"]])
        return identifiable_rank(mechanism, np.random.default_rng(seed), settings["poses"], fixed_joints=locked)

    values: dict[str, float] = {"hexapod": compute_identifiable_rank(STRAIGHT_HEXAPOD)}
    values["robot"] = compute_identifiable_rank(build_iwr_mechanism(straight=True))
    for name, kinds in _SERIAL_ROBOTS.items():
        values[f"rank {name}"] = compute_identifiable_rank(serial_mechanism(name, kinds))
        values[f"count {name}"] = count_serial_parameters(kinds.count("revolute"), kinds.count("prismatic"))
    for name, mechanism in MECHANISMS.items():
        values[f"rank {name}"] = compute_identifiable_rank(mechanism)
        values[f"count {name}"] = mechanism.count_parameters()
    return Sample(values)


def _make_count_evaluation(names: Sequence[str], note: str):
    def evaluate_counts(samples: Sequence[Sample]) -> Evaluation:
        values = samples[0].values
        return Evaluation(tuple(
            check_deterministic_value(f"independent parameters of the {name}", values[f"rank {name}"],
                        (values[f"count {name}"], values[f"count {name}"]), "the formula",
                        published=values[f"count {name}"])
            for name in names
        ), note=note)  # fmt: skip

    return evaluate_counts


def _evaluate_hexapod(samples: Sequence[Sample]) -> Evaluation:
    values = samples[0].values
    return Evaluation(
        (check_deterministic_value("independent parameters", values["hexapod"], (42, 42),
                     "as many as the error model has: complete and minimal, page 23",
                     published=42),),
        note=f"Eq. 5 counts {MECHANISMS['6-SPS hexapod'].count_parameters()}, with one additional"
        " offset per leg between slide axis and joints; if this offset is zero, its derivative is"
        f" zero. The IWR with such legs has {values['robot']:.0f} independent parameters",
    )  # fmt: skip


def measure_first_order(seed: int, changes: Changes) -> Sample:
    """Compute the position error of the carriage's end that a first-order error model leaves.

    The carriage is the serial part of the robot IWR. Three cases are compared: `usual`, manufacturing
    errors times `growth` (`errors`), and lengths and travels times `growth` (`structure`).

    Args:
        seed: seed of errors and poses.
        changes: `error_size`: factor of the manufacturing errors in all cases; `growth`: factor in the
            cases `errors` and `structure`.

    Returns:
        Largest distance from the true position over 100 poses [m] in each case, of the first-order model
        (`omitted CASE`) and of the model without errors (`moved CASE`).
    """
    settings = merge_settings({"error_size": 1.0, "growth": 2.0}, changes)
    nominal, rng = load_hybrid("iwr"), np.random.default_rng(seed)
    joints, _ = sample_poses(nominal, 100, rng)
    errors = sample_manufacturing_errors(build_error_model(nominal, "dh"), rng) * settings["error_size"]
    growth = settings["growth"]
    rows = tuple(row.model_copy(update={"a": growth * row.a, "d": growth * row.d})
                 for row in nominal.specification.carriage)  # fmt: skip
    larger = build_hybrid(nominal.specification.model_copy(update={"carriage": rows}))
    stretched = joints * np.where(nominal.kinds == 0, growth, 1.0)
    values = {}
    for name, robot, planted, at in (
        ("usual", nominal, errors, joints), ("errors", nominal, growth * errors, joints),
        ("structure", larger, errors, stretched),
    ):  # fmt: skip
        model = build_error_model(robot, "dh")
        true = carriage_pose(apply_geometry_errors(model, planted), at)[:, :3, 3]
        linear = first_order_carriage_pose(robot, planted[: model.carriage_parameter_count], at)[:, :3, 3]
        unchanged = carriage_pose(robot, at)[:, :3, 3]
        values[f"omitted {name}"] = float(np.linalg.norm(linear - true, axis=1).max())
        values[f"moved {name}"] = float(np.linalg.norm(unchanged - true, axis=1).max())
    return Sample(values)


def _evaluate_first_order(samples: Sequence[Sample]) -> Evaluation:
    omitted = [1e3 * sample.values["omitted usual"] for sample in samples]
    return Evaluation(
        (check_mean("largest position error of the first-order model, mean over robots",
                    np.array(omitted), (-np.inf, 1e3 * REQUIRED_ACCURACY),
                    "the required accuracy, page 19", unit="mm"),),
        note=f"errors of 1 mm and 1 mrad move the carriage's end by"
        f" {format_values(samples, 'moved usual', 1e3)} mm",
    )  # fmt: skip


def _evaluate_error_growth(samples: Sequence[Sample]) -> Evaluation:
    checks = []
    for name, words in (("errors", "errors"), ("structure", "lengths and travels")):
        pairs = np.array([(s.values[f"omitted {name}"], s.values["omitted usual"]) for s in samples])
        checks.append(check_bootstrapped_statistic(
            f"second-order error with doubled {words} over the usual one", pairs,
            lambda rows: float(np.sqrt(np.mean(rows[:, 0] ** 2) / np.mean(rows[:, 1] ** 2))),
            (1.0, np.inf), "above 1: increases",
        ))  # fmt: skip
    return Evaluation(tuple(checks))


def measure_proportionality(seed: int, changes: Changes) -> Sample:
    """Compute how much the D-H and POE parameters change when the second of two axes is tilted.

    A model is proportional if a small tilt changes its parameters by a proportional amount. For D-H the
    parameter is the offset d along the first axis [m], for POE the direction and moment of the second
    axis.

    Args:
        seed: seed of the geometry.
        changes: `parallel`: whether the axes are parallel before the tilt, else perpendicular.

    Returns:
        `dh` and `poe`: exponents of the change as a power of the tilt, from 0.1 to 10 mrad; 1 is
        proportional. `dh at 1 mrad`: change of d at a tilt of 1 mrad [m].
    """
    settings = merge_settings({"parallel": True}, changes)
    rng = np.random.default_rng(seed)
    distance, direction = rng.uniform(0.2, 0.5), rng.uniform(0.0, 2.0 * np.pi)
    point = np.array([distance, 0.0, 0.0])
    axis = np.array([0.0, 0.0, 1.0]) if settings["parallel"] else np.array([0.0, 1.0, 0.0])
    across = np.cross(axis, [1.0, 0.0, 0.0])
    tilt = np.cos(direction) * np.array([1.0, 0.0, 0.0]) + np.sin(direction) * across
    angles = np.geomspace(1e-4, 1e-2, 9)
    changed: dict[str, list[float]] = {"dh": [], "poe": []}
    for angle in angles:
        tilted = np.cos(angle) * axis + np.sin(angle) * tilt
        common = np.cross([0.0, 0.0, 1.0], tilted)  # D-H: the common normal with the z axis
        changed["dh"].append(abs(float(np.cross(point, tilted) @ common / (common @ common))))
        moment = np.cross(point, tilted - axis)
        changed["poe"].append(float(np.linalg.norm(np.r_[tilted - axis, moment])))
    curves = {name: np.array(change) for name, change in changed.items()}
    slopes = {name: float(np.polyfit(np.log(angles), np.log(change), 1)[0])
              for name, change in curves.items()}  # fmt: skip
    panel = Panel(
        "change of the parameters [m or 1]", 1e3 * angles,
        {"D-H: offset d along the first axis": curves["dh"],
         "POE: direction and moment of the second axis": curves["poe"]},
        "tilt of the second axis [mrad]", log=True, discrete=True,
    )  # fmt: skip
    return Sample({**slopes, "dh at 1 mrad": float(curves["dh"][4])}, (panel,))


def _evaluate_parameter_change_with_tilt(samples: Sequence[Sample]) -> Evaluation:
    exponents = {name: np.array([s.values[name] for s in samples]) for name in ("dh", "poe")}
    return Evaluation(
        (check_mean("exponent of the change of d (D-H) with the tilt", exponents["dh"],
                    (-np.inf, 0.0), "proportional would be 1; at 0 or below, d does not become small with the tilt"),
         check_mean("exponent of the change of the axis (POE) with the tilt", exponents["poe"],
                    (0.99, 1.01), "1: proportional, except for second-order terms of 10 mrad")),
        note="two parallel hinges 0.2 to 0.5 m apart, tilts of 0.1 to 10 mrad; a tilt of 1 mrad"
        f" changes d by {format_values(samples, 'dh at 1 mrad', 1.0, 0)} m",
    )  # fmt: skip


def measure_forward_kinematics(seed: int, changes: Changes) -> Sample:
    """Compare solutions of the forward kinematics by DE, Newton's method and the MuJoCo mechanism.

    DE is differential evolution. One random pose of the robot IWR is solved from its joint positions and
    leg readings.

    Args:
        seed: seed of pose and search.
        changes: `reach`: half the width of DE's search region [m].

    Returns:
        Largest difference of a pose coordinate by DE (`evolution`) and by MuJoCo (`mechanism`) from that
        by Newton's method [m] or [rad]. `inverse`: largest difference of the leg readings that the
        inverse kinematics gives for Newton's pose from the given ones [m].
    """
    settings = merge_settings({"reach": 0.35}, changes)
    robot, rng = load_hybrid("iwr"), np.random.default_rng(seed)
    joints, legs = sample_poses(robot, 1, rng)
    pose = forward_kinematics(robot, joints, legs)
    newton = PlatformPose(pose.rotation[0], pose.position[0])
    evolved = forward_kinematics_by_evolution(robot, joints[0], legs[0], seed=seed, reach=settings["reach"])
    model = build_hybrid_mechanism(robot).compile()
    closed = solve_mechanism_pose(model, mujoco.MjData(model), robot, joints[0], legs[0])
    return Sample({
        "evolution": float(np.abs(pose_difference(evolved, newton)).max()),
        "mechanism": float(np.abs(pose_difference(closed, newton)).max()),
        "inverse": float(np.abs(leg_readings(robot, joints, pose) - legs).max()),
    })  # fmt: skip


def _evaluate_forward_kinematics(samples: Sequence[Sample]) -> Evaluation:
    values = np.array([1e3 * sample.values["evolution"] for sample in samples])
    largest = {name: max(s.values[name] for s in samples) for name in ("mechanism", "inverse")}
    return Evaluation(
        (check_mean("largest error of a coordinate by DE", values,
                    (-np.inf, 1e1 * REQUIRED_ACCURACY),
                    "a hundredth of the required accuracy, page 19", unit="mm or mrad"),),
        note=f"against Newton's method at {len(samples)} random poses; the closed-chain"
        f" MuJoCo model differs by {largest['mechanism']:.1e} m or rad, and the inverse kinematics"
        f" returns the leg lengths to within {largest['inverse']:.1e} m",
    )  # fmt: skip


KINEMATICS = Experiment(
    "kinematics of the carriage", compare_carriage_kinematics,
    (
        Claim(
            "carriage: forward kinematics",
            "The product of the four D-H matrices of Table 1 is Eq. 7; its last column is (d3 + a4"
            " s4, d2 + a3 s3 + a4 s3 c4, d1 + a3 c3 + a4 c3 c4).",
            "Table 1, Eq. 7 (p. 29)", "input", _evaluate_carriage_kinematics, {"third_twist": -0.5 * np.pi},
            "the third link is twisted by -90 instead of 90 deg",
        ),
        Claim(
            "size of the error model",
            '"the number of parameter errors for the serial part is 12"; "the number of parameter'
            ' errors for the Hexa-WH is 42"', "section 3.1.2 (p. 34)", "input", _evaluate_parameter_error_counts,
            {"second_joint": "revolute"}, "the second joint of the carriage is a hinge instead of a slide",
        ),
    ),
    fixed_repetitions=1,
)  # fmt: skip

PARAMETER_COUNTS = Experiment(
    "numbers of parameters", measure_parameter_counts,
    (
        Claim(
            "number of parameters of serial robots",
            '"for the serial robot, the minimum number of geometrical parameters is given by'
            ' Mooring et al." C = 4R + 2P + T', "Eq. 4 (p. 23)", "document",
            _make_count_evaluation(tuple(_SERIAL_ROBOTS), "every link has errors in all six directions; T = 6"),
            {"locked_joints": 1}, "the first joint never moves",
        ),
        Claim(
            "number of parameters of mechanisms with loops",
            '"For multi-loop parallel robots, the number of independent parameters can be'
            ' calculated by using the formula proposed by Vischer" C = 3R + P + SS + E + 6L +'
            " 6(F-1)", "Eq. 5 (p. 24)", "document",
            _make_count_evaluation(
                tuple(MECHANISMS), "every link has errors in all six directions and arbitrary"
                " dimensions; F = 2; SS counts rigid links between spherical joints. For the Delta"
                " robot Vischer and Clavel 1998 also give 54; six legs with the 22 parameters of"
                " page 34 have 132, and 6 parameters of one of the two frames give 138"),
            {"locked_joints": 1}, "one measured joint never moves",
        ),
        Claim(
            "hexapod: 42 parameters are complete and minimal",
            '"the universal joint and the spherical joint can be simplified as a coordinate'
            ' point"; "the number of parameter errors for the Hexa-WH is 42"',
            "Eq. 27, section 3.1.2 (p. 34)", "document", _evaluate_hexapod,
            {"poses": 6}, "six poses are measured, which give 36 equations",
        ),
    ),
    fixed_repetitions=1,
)  # fmt: skip

FIRST_ORDER = Experiment(
    "first-order error model", measure_first_order,
    (
        Claim(
            "first-order error model",
            '"the first-order model is sufficiently accurate for most applications"',
            "Eqs 12 to 26 (p. 31 to 33)", "document", _evaluate_first_order, {"error_size": 10.0},
            "manufacturing errors of 10 mm and 10 mrad instead of 1 mm and 1 mrad",
        ),
        Claim(
            "second-order errors grow with size and errors",
            '"As the size of the manipulator structure or the size of the input kinematic errors'
            ' increases, the effect of the second-order error terms increases."',
            "section 3.1.2 (p. 33)", "document", _evaluate_error_growth, {"growth": 0.5},
            "errors and structure are halved instead of doubled",
        ),
    ),
)  # fmt: skip

PROPORTIONALITY = Experiment(
    "nearly parallel axes", measure_proportionality,
    (
        Claim(
            "proportionality of D-H and POE models",
            'the D-H model "fails to be proportional when the two consecutive joint axes are'
            ' parallel or nearly parallel"; "the POE model can perfectly meet the proportionality'
            ' properties"', "section 2.1 (p. 24)", "document", _evaluate_parameter_change_with_tilt,
            {"parallel": False}, "the axes are perpendicular instead of nearly parallel",
        ),
    ),
)  # fmt: skip

FORWARD_KINEMATICS = Experiment(
    "forward kinematics by DE", measure_forward_kinematics,
    (
        Claim(
            "hexapod: forward kinematics by DE",
            '"the DE algorithm was employed in Publications 1, 5 and 7 to identify parameter errors'
            ' and to find numerical solutions for the robot forward kinematics"',
            "section 2.2 (p. 26), Eqs 8 and 11", "document", _evaluate_forward_kinematics,
            {"reach": 0.005}, "DE searches only within 5 mm of the home pose",
        ),
    ),
    max_repetitions=10,
)  # fmt: skip

EXPERIMENTS = (
    KINEMATICS, PARAMETER_COUNTS, FIRST_ORDER, PROPORTIONALITY, FORWARD_KINEMATICS
)  # fmt: skip
"""Experiments in the order of the document."""
