"""Files of serial robots: reading of YAML, URDF and MJCF, and writing of calibrated robots as YAML or URDF."""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import yaml

from hydrotele.core.datafile import (
    Name,
    StrictModel,
    Vector,
    read_yaml,
    suggest_valid_name,
    validate_data,
)
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, read_xml
from hydrotele.kinematics.serial_robot import (
    GRAVITY,
    Mimic,
    RobotJoint,
    SerialRobot,
    build_joint_coupling,
    frame_from_rpy,
    rotation_to_rpy,
)

ROBOTS_FOLDER = "robots"
"""Folder of the shipped robots, inside the models folder."""
_BALL_NAMES = (
    "calibrated_ball",
    "ball",
    "tcp",
    "tool",
    "tip",
    "ee",
    "end_effector",
    "flange",
    "hand",
)
_MOVING_JOINT_KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


def shipped_robots() -> list[str]:
    """Return the names of the robots that are part of the package."""
    return sorted(path.stem for path in (models_folder() / ROBOTS_FOLDER).glob("*.yaml"))


def load_robot(name_or_path: str | Path, joints: int | None = None) -> SerialRobot:
    """Read a serial robot: a shipped one by name, or from a YAML, URDF or MJCF file.

    Args:
        name_or_path: a shipped robot, or a file: YAML, URDF or MJCF (.yaml, .urdf, .xml).
        joints: number of columns of the readings; joints that follow others may have none. None
            for any number.

    Returns:
        The robot. The chain of a URDF or MJCF ends at the link, body or site with a usual name of a
        tool, such as `ball`, `tcp` or `flange`, even if its number of joints is not `joints`. If
        there is no such name, the chain ends at the last link of the branch with `joints` joints.
        Without such a branch, it ends at the last link of the branch with the most joints.

    Raises:
        InputError: there is no such robot, its file is invalid, or its number of joints differs.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_robots():
        path = models_folder() / ROBOTS_FOLDER / f"{name_or_path}.yaml"
    elif not path.is_file():
        raise InputError(
            f"robot {str(name_or_path)!r}",
            f"is neither a file nor a shipped robot; {suggest_valid_name(name_or_path, shipped_robots())}",
        )
    if path.suffix in (".yaml", ".yml"):
        robot = _read_yaml_robot(path)
    else:
        root = read_xml(path)
        if root.tag == "mujoco":
            robot = _read_mjcf(path, joints)
        elif root.tag == "robot":
            robot = _read_urdf(path, root, joints)
        else:
            raise InputError(path, f"is not a robot file: its first element is <{root.tag}>")
    names = robot.joint_names
    _check_names(path, names)
    build_joint_coupling(robot)
    if joints is not None and joints not in (len(names), len(robot.independent_joint_names)):
        raise InputError(path, _describe_joint_count(robot, joints))
    return robot


def _check_names(path: Path, names: Sequence[str]) -> None:
    if repeated := next((name for name, count in Counter(names).items() if count > 1), None):
        raise InputError(path, f"has two joints with the name {repeated!r}; give every joint its own name")


def _describe_joint_count(robot: SerialRobot, columns: int) -> str:
    """Return the error message for readings whose number of columns is not the number of the robot's joints."""
    names, independent = robot.joint_names, robot.independent_joint_names
    said = f"has {len(names)} moving joints up to the ball ({', '.join(names)}), but the data have {columns} columns"
    if len(independent) < len(names):
        said += f"; {len(independent)} columns suffice, because the others follow by mimic: {', '.join(independent)}"
    return said


class _MimicSpec(StrictModel):
    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


class _JointSpec(StrictModel):
    name: str
    type: Literal["revolute", "prismatic"] = "revolute"
    position: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    mimic: _MimicSpec | None = None


class _BallSpec(StrictModel):
    position: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)


class _RobotSpec(StrictModel):
    name: Name
    source: str = ""
    gravity: Vector = GRAVITY
    joints: tuple[_JointSpec, ...]
    ball: _BallSpec = _BallSpec()
    corrections: dict[str, float] = {}


def _read_yaml_robot(path: Path) -> SerialRobot:
    data, lines = read_yaml(path)
    facts = validate_data(_RobotSpec, data, str(path), lines)
    if not facts.joints:
        raise InputError(path, "has no joints")
    joints = tuple(
        RobotJoint(
            j.name, j.type, frame_from_rpy(j.position, j.rpy), _unit_vector(path, j.name, j.axis),
            Mimic(j.mimic.joint, j.mimic.multiplier, j.mimic.offset) if j.mimic else None,
        )
        for j in facts.joints
    )  # fmt: skip
    return SerialRobot(
        facts.name, joints, frame_from_rpy(facts.ball.position, facts.ball.rpy), np.array(facts.gravity),
        dict(facts.corrections), str(path),
    )  # fmt: skip


def robot_to_yaml(robot: SerialRobot, source: str) -> str:
    """Return a robot as the text of a YAML file that `load_robot` reads.

    Args:
        robot: the robot; numbers keep all digits.
        source: a sentence on the source of the numbers, for the field `source` of the file.

    Returns:
        The text.
    """
    joints = [
        {"name": j.name, "type": j.kind, "position": _to_floats(j.origin[:3, 3]),
         "rpy": _to_floats(rotation_to_rpy(j.origin[:3, :3])), "axis": _to_floats(j.axis),
         **({"mimic": j.mimic._asdict()} if j.mimic else {})}
        for j in robot.joints
    ]  # fmt: skip
    data = {
        "name": robot.name, "source": source, "gravity": _to_floats(robot.gravity), "joints": joints,
        "ball": {"position": _to_floats(robot.tool[:3, 3]), "rpy": _to_floats(rotation_to_rpy(robot.tool[:3, :3]))},
    }  # fmt: skip
    if robot.corrections:
        data["corrections"] = {name: float(v) for name, v in robot.corrections.items()}
    return yaml.safe_dump(data, sort_keys=False, width=100)


def write_origins_to_urdf(robot: SerialRobot, text: str) -> str:
    """Return the text of a URDF in which joint origins and ball are those of a calibrated robot.

    Fixed joints keep their origins; the errors in front of a moving joint are added to its origin.
    The ball is the child `calibrated_ball` of the last moving link.

    Args:
        robot: calibrated robot, read from this URDF.
        text: the URDF.

    Returns:
        The text of the new URDF, without joint corrections, which URDF cannot express.
    """
    root = ElementTree.fromstring(text)
    found = {joint.get("name"): joint for joint in root.findall("joint")}
    by_child = {_connected_link_name(joint, "child"): joint for joint in found.values()}
    last = ""
    for joint in robot.joints:
        element = found[joint.name]
        before, link = np.eye(4), _connected_link_name(element, "parent")
        while link in by_child and by_child[link].get("type") not in _MOVING_JOINT_KINDS:
            before = _read_origin(robot.source, by_child[link]) @ before
            link = _connected_link_name(by_child[link], "parent")
        _set_origin(element, np.linalg.inv(before) @ joint.origin)
        last = _connected_link_name(element, "child")
    ElementTree.SubElement(root, "link", {"name": "calibrated_ball"})
    ball = ElementTree.SubElement(root, "joint", {"name": "calibrated_ball", "type": "fixed"})
    ElementTree.SubElement(ball, "parent", {"link": last})
    ElementTree.SubElement(ball, "child", {"link": "calibrated_ball"})
    _set_origin(ball, robot.tool)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


class _End(NamedTuple):
    """A possible end of a robot's chain: a link of a URDF, or a body or site of an MJCF.

    `name` is the name of this link, body or site. `count` is the number of joints between it and
    the base. `is_last` tells that nothing is attached beyond it. `way` is the list of joints from
    the base (URDF), or the tuple (kind, index, joint indices) of an MJCF.
    """

    name: str
    count: int
    is_last: bool
    way: Any


def _choose_end(path: Path, ends: Sequence[_End], columns: int | None) -> _End:
    """Choose the end of a robot's chain by its name, then by the number of joints.

    Ends without a moving joint are ignored. If names contain a word of `_BALL_NAMES`, only the ends
    with the best rank are considered, otherwise only ends with `is_last`. Of these, ends with as
    many joints as `columns` are preferred, then the one with the most joints.

    Args:
        path: file of the robot.
        ends: all links of a URDF, or all bodies and sites of an MJCF.
        columns: number of columns of the readings, or None.

    Returns:
        The chosen end. Of several with equally many joints, one with `is_last` is preferred, then in
        a URDF the one with the most fixed joints, then the first.

    Raises:
        InputError: no end has a moving joint.
    """
    ends = [end for end in ends if end.count]
    if not ends:
        raise InputError(path, "has no moving joint")
    ranks = [_rank_ball_name(end.name) for end in ends]
    if min(ranks) < len(_BALL_NAMES):
        ends = [end for end, rank in zip(ends, ranks, strict=True) if rank == min(ranks)]
    else:
        ends = [end for end in ends if end.is_last]
    fitting = [end for end in ends if end.count == columns]
    return max(fitting or ends, key=lambda end: (end.count, end.is_last, len(end.way)))


def _rank_ball_name(name: str) -> int:
    """Return how well a name denotes the tool end: index of the first word of `_BALL_NAMES` that it contains.

    A smaller rank is better; the number of words is returned if it contains none.
    """
    words = (rf"(?<![a-z]){word}(?![a-z])" for word in _BALL_NAMES)
    return next((k for k, word in enumerate(words) if re.search(word, name.lower())), len(_BALL_NAMES))


def _read_urdf(path: Path, root: ElementTree.Element, columns: int | None) -> SerialRobot:
    joints = root.findall("joint")
    _check_names(path, [str(joint.get("name")) for joint in joints])
    by_child: dict[str, ElementTree.Element] = {}
    for joint in joints:
        first = by_child.setdefault(_connected_link_name(joint, "child"), joint)
        if first is not joint:
            name, other = first.get("name"), joint.get("name")
            message = f"link {_connected_link_name(joint, 'child')!r} is the child of two joints, {name} and {other}"
            raise InputError(path, f"{message}; a URDF is a tree")
    parents = {_connected_link_name(joint, "parent") for joint in joints}
    ends: list[_End] = []
    for link in by_child:
        way, at = [], link
        while at in by_child and len(way) <= len(joints):
            way.insert(0, by_child[at])
            at = _connected_link_name(by_child[at], "parent")
        if len(way) > len(joints):
            raise InputError(path, f"joints around link {link!r} form a closed loop")
        ends.append(_End(link, sum(joint.get("type") != "fixed" for joint in way), link not in parents, way))
    way = _choose_end(path, ends, columns).way
    made, back = [], np.eye(4)
    for joint in way:
        back = back @ _read_origin(path, joint)
        stated, name = joint.get("type"), str(joint.get("name"))
        if stated == "fixed":
            continue
        kind = _MOVING_JOINT_KINDS.get(str(stated))
        if kind is None:
            valid = ", ".join(("fixed", *_MOVING_JOINT_KINDS))
            raise InputError(path, f"joint {name}: the type {stated!r} is not supported; valid: {valid}")
        element = joint.find("axis")
        axis = _read_numbers(path, joint, element, "xyz", (1.0, 0.0, 0.0))
        mimic = _read_mimic(path, joint)
        made.append(RobotJoint(name, kind, back, _unit_vector(path, name, axis), mimic))  # type: ignore[arg-type]
        back = np.eye(4)
    return SerialRobot(str(root.get("name") or path.stem), tuple(made), back, source=str(path))


def _read_mimic(path: Path, joint: ElementTree.Element) -> Mimic | None:
    """Read the `mimic` element of a URDF joint: followed joint, multiplier and offset. None without the element.

    Raises InputError if multiplier or offset is not a finite number.
    """
    element = joint.find("mimic")
    if element is None:
        return None
    numbers = []
    for key, default in (("multiplier", "1"), ("offset", "0")):
        said = element.get(key, default)
        try:
            numbers.append(float(said))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise InputError(path, f"joint {joint.get('name')}: mimic {key}={said!r} must be a number")
    return Mimic(element.get("joint", ""), *numbers)


def _read_mjcf(path: Path, columns: int | None) -> SerialRobot:
    import mujoco

    from hydrotele.core.mjcf import read_mjcf

    document = read_mjcf(path)
    spec = document.load_spec()
    for unneeded in (*spec.geoms, *spec.meshes, *spec.sensors, *spec.keys, *spec.excludes):
        spec.delete(unneeded)
    for body in spec.bodies[1:]:
        body.explicitinertial, body.mass, body.inertia = True, 1.0, (1.0, 1.0, 1.0)
    model = document.compile(spec)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
             int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}  # fmt: skip
    ends = [("site", s, int(model.site_bodyid[s])) for s in range(model.nsite)]
    ends += [("body", b, b) for b in range(1, model.nbody)]

    def list_joints_to_body(body: int) -> list[int]:
        joints: list[int] = []
        while body:
            first, many = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            joints = [*range(first, first + many), *joints]
            body = int(model.body_parentid[body])
        return joints

    parents = set(model.body_parentid.tolist())
    found = [
        _End(
            getattr(model, kind)(k).name or "",
            len(list_joints_to_body(body)),
            body not in parents,
            (kind, k, list_joints_to_body(body)),
        )
        for kind, k, body in ends
        if all(int(model.jnt_type[j]) in kinds for j in list_joints_to_body(body))
    ]
    kind, k, joints = _choose_end(path, found, columns).way
    mimics = _read_joint_equalities(path, model, joints)
    made, last = [], np.eye(4)
    for j in joints:
        body = int(model.jnt_bodyid[j])
        world = np.eye(4)
        world[:3, :3] = data.xmat[body].reshape(3, 3)
        world[:3, 3] = data.xanchor[j]
        way = world[:3, :3].T @ data.xaxis[j]
        origin = np.linalg.inv(last) @ world
        name = _mjcf_joint_name(model, j)
        made.append(RobotJoint(name, kinds[int(model.jnt_type[j])], origin, way, mimics.get(j)))  # type: ignore[arg-type]
        last = world
    end = np.eye(4)
    place, turn = (data.site_xpos, data.site_xmat) if kind == "site" else (data.xpos, data.xmat)
    end[:3, :3], end[:3, 3] = turn[k].reshape(3, 3), place[k]
    return SerialRobot(
        path.stem, tuple(made), np.linalg.inv(last) @ end, np.array(model.opt.gravity),
        source=str(path),
    )  # fmt: skip


def _mjcf_joint_name(model: Any, joint: int) -> str:
    return model.joint(joint).name or f"joint{joint + 1}"


def _read_joint_equalities(path: Path, model: Any, chain: Sequence[int]) -> dict[int, Mimic]:
    """Read the linear joint couplings of an MJCF that determine joints of a robot's chain.

    A `joint` constraint is q1 - r1 = a0 + a1 (q2 - r2) + ..., with the reference positions r.

    Args:
        path: the MJCF.
        model: the compiled model.
        chain: indices of the robot's joints.

    Returns:
        Index of a joint of the chain -> its coupling to the joint that it follows.

    Raises:
        InputError: another active equality constraint determines a joint of the chain.
    """
    import mujoco

    def list_joints_moving_body(body: int) -> set[int]:
        return {j for j in range(model.njnt) if _is_ancestor(model, int(model.jnt_bodyid[j]), body)}

    def constrained_joints(e: int) -> set[int]:
        first, second, kind = int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), mujoco.mjtEq(int(model.eq_type[e]))
        if kind == mujoco.mjtEq.mjEQ_JOINT:
            return {first}
        if kind == mujoco.mjtEq.mjEQ_TENDON:
            steps = range(model.tendon_adr[first], model.tendon_adr[first] + model.tendon_num[first])
            return {int(model.wrap_objid[w]) for w in steps if model.wrap_type[w] == mujoco.mjtWrap.mjWRAP_JOINT}
        if kind not in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
            return set()
        if model.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            first, second = int(model.site_bodyid[first]), int(model.site_bodyid[second])
        return list_joints_moving_body(first) ^ list_joints_moving_body(second)

    mimics: dict[int, Mimic] = {}
    for e in range(model.neq):
        concerned = constrained_joints(e) & set(chain)
        if not model.eq_active0[e] or not concerned:
            continue
        first, second, values = int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e]
        if model.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT or second < 0 or np.any(values[2:5]) or first in mimics:
            names = ", ".join(_mjcf_joint_name(model, j) for j in sorted(concerned))
            message = f"the equality constraint {model.equality(e).name or e} determines the joints {names}"
            raise InputError(path, f"{message}; only a linear <joint> constraint with joint2 is supported")
        rest = model.qpos0[model.jnt_qposadr[[first, second]]]
        offset = rest[0] + values[0] - values[1] * rest[1]
        mimics[first] = Mimic(_mjcf_joint_name(model, second), float(values[1]), float(offset))
    return mimics


def _is_ancestor(model: Any, ancestor: int, body: int) -> bool:
    """Return whether body `ancestor` is `body` itself or one of its parents up to the world."""
    while body and body != ancestor:
        body = int(model.body_parentid[body])
    return body == ancestor


def _connected_link_name(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else str(element.get("link"))


def _read_origin(where: str | Path, joint: ElementTree.Element) -> np.ndarray:
    element = joint.find("origin")
    return frame_from_rpy(
        _read_numbers(where, joint, element, "xyz", (0.0, 0.0, 0.0)),
        _read_numbers(where, joint, element, "rpy", (0.0, 0.0, 0.0)),
    )


def _set_origin(joint: ElementTree.Element, matrix: np.ndarray) -> None:
    element = joint.find("origin")
    if element is None:
        element = ElementTree.SubElement(joint, "origin")
    element.set("xyz", " ".join(repr(v) for v in _to_floats(matrix[:3, 3])))
    element.set("rpy", " ".join(repr(v) for v in _to_floats(rotation_to_rpy(matrix[:3, :3]))))


def _read_numbers(where, joint, element, key: str, default: Sequence[float]) -> Sequence[float]:
    said = None if element is None else element.get(key)
    if said is None:
        return default
    try:
        numbers = [float(word) for word in said.split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise InputError(where, f"joint {joint.get('name')}: {key}={said!r} must be three numbers")
    return numbers


def _unit_vector(where, name: str, axis: Sequence[float]) -> np.ndarray:
    size = float(np.linalg.norm(axis))
    if not size > 0.0:
        raise InputError(where, f"joint {name}: its axis must not be zero")
    return np.asarray(axis, float) / size


def _to_floats(values: np.ndarray) -> list[float]:
    return [float(v) for v in np.asarray(values)]
