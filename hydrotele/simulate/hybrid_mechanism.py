"""Closed-chain MuJoCo model of a hybrid robot.

It has every joint of carriage and legs, the moving platform as a child of the first leg, and five
`connect` constraints that close the other legs.
"""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hydrotele.kinematics.hybrid_robot import (
    LEG_COUNT,
    REVOLUTE,
    HybridRobot,
    PlatformPose,
    UnreachableError,
    frames_at_zero_joints,
    home_pose,
    leg_readings,
)

_CLOSED_TOLERANCE = 1e-12  # m
_PIN_SOLVER = dict(solref=[0.002, 1.0], solimp=[0.9999, 0.9999, 0.001, 0.5, 2.0])  # nearly rigid
_PART_COLOURS = {
    "rail": (0.35, 0.37, 0.40, 1.0), "carriage": (0.85, 0.60, 0.10, 1.0),
    "tube": (0.25, 0.30, 0.38, 1.0), "rod": (0.80, 0.82, 0.84, 1.0),
    "platform": (0.16, 0.45, 0.62, 1.0),
}  # fmt: skip
# Masses of links, tubes, rods and moving platform [kg].
_PART_MASSES = {"prismatic": 400.0, "revolute": 250.0, "tube": 18.0, "rod": 9.0, "platform": 60.0}


def build_hybrid_mechanism(robot: HybridRobot) -> mujoco.MjSpec:
    """Build the closed-chain mechanism of a hybrid robot, carriage at zero, platform at home.

    In this pose all bodies have the axes of frame 0. The carriage joints have the names of the
    robot's joints. Leg 1 has the joints `leg1.roll` and `leg1.pitch` (universal joint at the
    carriage) and `leg1` (the slide, 0 at home); the other legs alike. `ball` is the joint at the
    platform. A position servo drives every carriage joint and every leg slide. In the world, the x
    axis of frame 0 points up, y to the right and z along the rails.

    Args:
        robot: the robot, nominal or as built.

    Returns:
        The specification; `compile()` creates the model.
    """
    spec = mujoco.MjSpec()
    spec.modelname = robot.name
    spec.compiler.degree = False
    spec.option.timestep = 1e-3
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.headlight.ambient = [0.35] * 3
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1600, 1200
    base = spec.worldbody.add_body(name="frame0", pos=[0, 0, 0.3], quat=_world_quaternion())
    _add_rails(base, robot)
    parent, links = base, []
    frames, last = frames_at_zero_joints(robot)
    for i, (name, kind) in enumerate(zip(robot.joints, robot.kinds, strict=True)):
        body = parent.add_body(name=name)
        turning = kind == REVOLUTE
        body.add_joint(
            name=name, pos=frames[i, :3, 3], axis=frames[i, :3, 2],
            type=mujoco.mjtJoint.mjJNT_HINGE if turning else mujoco.mjtJoint.mjJNT_SLIDE,
            damping=2e4 if turning else 1e4,
        )  # fmt: skip
        links.append(body)
        parent = body
    _add_carriage_shapes(links, frames, last, robot)
    home = home_pose(robot, np.zeros(len(robot.joints)))
    lower = robot.universal @ last[:3, :3].T + last[:3, 3]
    upper = robot.spherical @ home.rotation.T + home.position
    _add_legs(spec, links[-1], lower, upper, home, robot)
    for name in robot.joints:
        _add_servo(spec, name, 4e6)
    for leg in range(1, LEG_COUNT + 1):
        _add_servo(spec, f"leg{leg}", 2e6)
    return spec


def _world_quaternion() -> list[float]:
    axes = np.array([[0, 0, 1], [0, -1, 0], [1, 0, 0]], float)  # rows: world x, y, z in frame 0
    return Rotation.from_matrix(axes).as_quat(scalar_first=True).tolist()


def _add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float) -> None:
    spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        gainprm=[stiffness] + [0.0] * 9, biasprm=[0.0, -stiffness, -0.02 * stiffness] + [0.0] * 7,
    )  # fmt: skip


def _add_legs(spec, platform, lower, upper, home: PlatformPose, robot: HybridRobot) -> None:
    """Add the six legs, the moving platform and the constraints that close the loops to the MJCF.

    The legs are children of `platform`, the last body of the carriage. The moving platform is a
    child of the rod of leg 1; `connect` constraints join it to the rods of the other legs. `lower`
    and `upper` (6, 3) are the joint centres of the legs at carriage and moving platform, in frame 0
    at home [m].
    """
    up = home.rotation[:, 2]
    moving = None
    for leg, (a, b) in enumerate(zip(lower, upper, strict=True), 1):
        along = (b - a) / np.linalg.norm(b - a)
        roll = np.cross(up, along)
        roll = roll / np.linalg.norm(roll)
        pitch = np.cross(along, roll)
        joint = platform.add_body(name=f"leg{leg}_cross")
        joint.add_joint(name=f"leg{leg}.roll", pos=a, axis=roll, damping=20.0)
        joint.mass, joint.inertia, joint.ipos = 3.0, [0.01] * 3, a
        joint.explicitinertial = True
        joint.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=a, size=[0.035, 0, 0], mass=0.0,
                       rgba=_PART_COLOURS["tube"], **_NO_CONTACT)  # fmt: skip
        tube = joint.add_body(name=f"leg{leg}_tube")
        tube.add_joint(name=f"leg{leg}.pitch", pos=a, axis=pitch, damping=20.0)
        length = float(np.linalg.norm(b - a))
        _add_bar(tube, a, a + 0.62 * length * along, 0.032, _PART_MASSES["tube"], "tube")
        rod = tube.add_body(name=f"leg{leg}_rod")
        low, high = robot.leg_range
        reading = length - robot.offsets[leg - 1]
        rod.add_joint(
            name=f"leg{leg}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=along, damping=2e3,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=[low - reading, high - reading],
        )  # fmt: skip
        _add_bar(rod, a + 0.40 * length * along, b, 0.018, _PART_MASSES["rod"], "rod")
        rod.add_site(name=f"leg{leg}_end", pos=b, size=[0.02, 0, 0])
        if leg == 1:
            moving = rod.add_body(name="platform")
            moving.add_joint(name="ball", type=mujoco.mjtJoint.mjJNT_BALL, pos=b, damping=2.0)
            turn = Rotation.from_matrix(home.rotation).as_quat(scalar_first=True)
            moving.add_site(name="frame5", pos=home.position, size=[0.03, 0, 0], quat=turn)
            _add_plate(
                moving,
                home.position,
                home.rotation,
                upper,
                0.03,
                _PART_MASSES["platform"],
                "platform",
            )
        assert moving is not None
        moving.add_site(name=f"b{leg}", pos=b, size=[0.025, 0, 0], rgba=_PART_COLOURS["rod"])
        if leg > 1:
            pin = spec.add_equality(
                name=f"leg{leg}", type=mujoco.mjtEq.mjEQ_CONNECT, name1=f"leg{leg}_end",
                name2=f"b{leg}", objtype=mujoco.mjtObj.mjOBJ_SITE,
            )  # fmt: skip
            pin.solref, pin.solimp = _PIN_SOLVER["solref"], _PIN_SOLVER["solimp"]


_NO_CONTACT = dict(contype=0, conaffinity=0)


def _add_bar(body, start, end, radius: float, mass: float, colour: str) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *end], size=[radius, 0, 0], mass=mass,
        rgba=_PART_COLOURS[colour], **_NO_CONTACT,
    )  # fmt: skip


def _add_plate(body, middle, rotation, points, thickness, mass, colour) -> None:
    radius = float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=middle, size=[radius, 0.5 * thickness, 0],
        quat=Rotation.from_matrix(rotation).as_quat(scalar_first=True), mass=mass,
        rgba=_PART_COLOURS[colour], **_NO_CONTACT,
    )  # fmt: skip


def _add_rails(base, robot: HybridRobot) -> None:
    """Add the geoms of two rails along the range of the first joint, 0.05 m below frame 0, to `base`."""
    low, high = robot.joint_range[0]
    for side in (-0.3, 0.3):
        base.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=[-0.05, side, 0.5 * (low + high)],
            size=[0.04, 0.05, 0.5 * (high - low) + 0.3], rgba=_PART_COLOURS["rail"], **_NO_CONTACT,
        )  # fmt: skip


def _add_carriage_shapes(links, frames, last, robot: HybridRobot) -> None:
    """Add geoms with mass to the carriage's bodies.

    Each body gets a bar between its joint and the next, or a block if these are closer than 0.05 m.
    The last body also gets the plate below the legs. `frames` are the joint frames, and `last` that
    of the connecting platform, at zero joint positions.
    """
    places = [*frames[:, :3, 3], last[:3, 3]]
    for i, (body, kind) in enumerate(zip(links, robot.kinds, strict=True)):
        mass = _PART_MASSES["revolute"] if kind == REVOLUTE else _PART_MASSES["prismatic"]
        start, end = places[i], places[i + 1]
        if np.linalg.norm(end - start) > 0.05:
            _add_bar(body, start, end, 0.075, mass, "carriage")
        else:
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX, pos=start, size=[0.05 + 0.02 * i, 0.3 - 0.12 * i,
                0.22], mass=mass, rgba=_PART_COLOURS["carriage"], **_NO_CONTACT,
            )  # fmt: skip
    points = robot.universal @ last[:3, :3].T + last[:3, 3]
    _add_plate(links[-1], last[:3, 3] - 0.03 * last[:3, 2], last[:3, :3], points, 0.05, 80.0, "carriage")


def solve_mechanism_pose(
    model: mujoco.MjModel, data: mujoco.MjData, robot: HybridRobot, joints: np.ndarray,
    legs: np.ndarray,
) -> PlatformPose:  # fmt: skip
    """Compute the platform pose of the MuJoCo model for given carriage positions and leg readings.

    Carriage and legs move to their positions in steps; at each step, the loops are closed. Newton's
    method on MuJoCo's positions closes the loops. `multibody.chain` is not used, because it does
    not support the damped ball joints, and because MuJoCo's kinematics are to be tested.

    Args:
        model: model of `build_hybrid_mechanism(robot)`.
        data: its data; its configuration is the start value and is replaced by the result.
        robot: the robot.
        joints: (n,) carriage positions [m] or [rad].
        legs: (6,) leg readings [m].

    Returns:
        The pose of the site `frame5` in frame 0.

    Raises:
        UnreachableError: the loops do not close.
    """
    zero = leg_readings(robot, np.zeros(len(robot.joints)), home_pose(robot, np.zeros(len(joints))))
    driven = [*robot.joints, *(f"leg{k}" for k in range(1, LEG_COUNT + 1))]
    goal = np.concatenate([joints, legs - zero])
    at = np.array([model.joint(name).qposadr[0] for name in driven])
    begin = data.qpos[at].copy()
    moving = np.setdiff1d(np.arange(model.nv), [model.joint(n).dofadr[0] for n in driven])
    parts = 1 + int(np.max(np.abs(goal - begin)) / 0.1)
    error = np.array([np.inf])
    for part in range(1, parts + 1):
        data.qpos[at] = begin + (goal - begin) * part / parts
        for _ in range(30):
            error, jacobian = _loop_errors(model, data)
            if np.abs(error).max() < _CLOSED_TOLERANCE:
                break
            step = np.zeros(model.nv)
            step[moving] = -np.linalg.lstsq(jacobian[:, moving], error, rcond=None)[0]
            mujoco.mj_integratePos(model, data.qpos, step, 1.0)
    if np.abs(error).max() > 1e-9:
        raise UnreachableError("the mechanism's loops do not close at these lengths")
    return platform_pose(data)


def _loop_errors(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Compute the loop closure errors (3 p,) [m] of p `connect` constraints and their Jacobian (3 p, nv).

    An error is the vector between the two sites that the constraint makes coincide.
    """
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    errors, slopes = [], []
    for one, two in zip(model.eq_obj1id, model.eq_obj2id, strict=True):
        ends = []
        for site in (one, two):
            slope = np.zeros((3, model.nv))
            mujoco.mj_jacSite(model, data, slope, None, site)
            ends.append(slope)
        errors.append(data.site_xpos[one] - data.site_xpos[two])
        slopes.append(ends[0] - ends[1])
    return np.concatenate(errors), np.vstack(slopes)


def platform_pose(data: mujoco.MjData) -> PlatformPose:
    """Return the pose of the site `frame5` in frame 0 from the current kinematics in `data`."""
    base, site = data.body("frame0"), data.site("frame5")
    turned = base.xmat.reshape(3, 3)
    return PlatformPose(turned.T @ site.xmat.reshape(3, 3), turned.T @ (site.xpos - base.xpos))
