"""Serial robots as files: read from YAML, URDF or MJCF, and written back with corrections.

A YAML file adds what URDF has no words for: where gravity points, and how joints deviate from what
their encoders say.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import yaml

from hydrotele.core.datafile import Facts, Name, Vector, parse, read_yaml, suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder, read_text
from hydrotele.kinematics.serial_robot import GRAVITY, Robot, RobotJoint, frame, rpy_of

ROBOTS = "robots"
"""Folder of the shipped robots, inside the one of the models."""

_BALLS = ("calibrated_ball", "ball", "tcp", "tool", "tip", "ee", "end_effector", "flange", "hand")
_MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}


def shipped_robots() -> list[str]:
    """Names of the robots that come with the package."""
    return sorted(path.stem for path in (models_folder() / ROBOTS).glob("*.yaml"))


def load_robot(name_or_path: str | Path, joints: int | None = None) -> Robot:
    """Read a robot.

    Args:
        name_or_path: a shipped robot, or a file: YAML, URDF or MJCF (.yaml, .urdf, .xml).
        joints: number of moving joints that the chain must have, None for the longest chain.

    Returns:
        The robot.

    Raises:
        InputError: there is no such robot, its file is wrong, or it has another number of joints.
    """
    path = Path(name_or_path)
    if str(name_or_path) in shipped_robots():
        path = models_folder() / ROBOTS / f"{name_or_path}.yaml"
    elif not path.is_file():
        raise InputError(
            f"robot {str(name_or_path)!r}",
            f"is neither a file nor a shipped robot; {suggest(name_or_path, shipped_robots())}",
        )
    if path.suffix in (".yaml", ".yml"):
        robot = _from_yaml(path)
    else:
        root = _xml(path)
        if root.tag == "mujoco":
            robot = _from_mjcf(path, joints)
        elif root.tag == "robot":
            robot = _from_urdf(path, root, joints)
        else:
            raise InputError(path, f"is no robot: its first element is <{root.tag}>")
    if joints is not None and len(robot.joints) != joints:
        raise InputError(
            path, f"has {len(robot.joints)} moving joints, the data have {joints} columns"
        )
    return robot


class _JointFacts(Facts):
    name: str
    type: Literal["revolute", "prismatic"] = "revolute"
    position: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)


class _BallFacts(Facts):
    position: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)


class _RobotFacts(Facts):
    name: Name
    source: str = ""
    gravity: Vector = GRAVITY
    joints: tuple[_JointFacts, ...]
    ball: _BallFacts = _BallFacts()
    corrections: dict[str, float] = {}


def _from_yaml(path: Path) -> Robot:
    data, lines = read_yaml(path)
    facts = parse(_RobotFacts, data, str(path), lines)
    if not facts.joints:
        raise InputError(path, "has no joints")
    joints = tuple(
        RobotJoint(j.name, j.type, frame(j.position, j.rpy), _unit(path, j.name, j.axis))
        for j in facts.joints
    )
    return Robot(
        facts.name, joints, frame(facts.ball.position, facts.ball.rpy), np.array(facts.gravity),
        dict(facts.corrections), str(path),
    )  # fmt: skip


def robot_yaml(robot: Robot, source: str) -> str:
    """A robot as the text of a YAML file that `load_robot` reads.

    Args:
        robot: to be written; numbers keep all their digits.
        source: a sentence that says where the numbers are from.

    Returns:
        The text.
    """
    joints = [
        {"name": j.name, "type": j.kind, "position": _list(j.origin[:3, 3]),
         "rpy": _list(rpy_of(j.origin[:3, :3])), "axis": _list(j.axis)}
        for j in robot.joints
    ]  # fmt: skip
    data = {
        "name": robot.name, "source": source, "gravity": _list(robot.gravity), "joints": joints,
        "ball": {"position": _list(robot.tool[:3, 3]), "rpy": _list(rpy_of(robot.tool[:3, :3]))},
    }  # fmt: skip
    if robot.corrections:
        data["corrections"] = {name: float(v) for name, v in robot.corrections.items()}
    return yaml.safe_dump(data, sort_keys=False, width=100)


def corrected_urdf(robot: Robot, text: str) -> str:
    """A URDF with the origins of a calibrated robot.

    Fixed joints keep their origins; a moving joint takes up what the calibrated chain has in front
    of it. The ball is the child `calibrated_ball` of the last moving link.

    Args:
        robot: calibrated, from that URDF.
        text: the URDF.

    Returns:
        The text of the new URDF, without joint corrections, for which URDF has no words.
    """
    root = ElementTree.fromstring(text)
    found = {joint.get("name"): joint for joint in root.findall("joint")}
    by_child = {_link(joint, "child"): joint for joint in found.values()}
    last = ""
    for joint in robot.joints:
        element = found[joint.name]
        before, link = np.eye(4), _link(element, "parent")
        while link in by_child and by_child[link].get("type") not in _MOVING:
            before = _origin(by_child[link]) @ before
            link = _link(by_child[link], "parent")
        _set_origin(element, np.linalg.inv(before) @ joint.origin)
        last = _link(element, "child")
    ElementTree.SubElement(root, "link", {"name": "calibrated_ball"})
    ball = ElementTree.SubElement(root, "joint", {"name": "calibrated_ball", "type": "fixed"})
    ElementTree.SubElement(ball, "parent", {"link": last})
    ElementTree.SubElement(ball, "child", {"link": "calibrated_ball"})
    _set_origin(ball, robot.tool)
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _from_urdf(path: Path, root: ElementTree.Element, count: int | None) -> Robot:
    joints = root.findall("joint")
    by_child = {_link(joint, "child"): joint for joint in joints}
    parents = {_link(joint, "parent") for joint in joints}
    ways: list[list[ElementTree.Element]] = []
    for link in by_child:
        way, at = [], link
        while at in by_child and len(way) <= len(joints):
            way.insert(0, by_child[at])
            at = _link(by_child[at], "parent")
        if len(way) > len(joints):
            raise InputError(path, f"joints around link {link!r} make a circle")
        ways.append(way)

    def moving(way: list[ElementTree.Element]) -> int:
        return sum(joint.get("type") in _MOVING for joint in way)

    most = max((moving(way) for way in ways), default=0)
    if not most:
        raise InputError(path, "has no moving joint")
    wanted = count if count in {moving(way) for way in ways} else most
    ways = [way for way in ways if moving(way) == wanted]

    def rank(way: list[ElementTree.Element]) -> tuple:
        end = _link(way[-1], "child").lower()
        named = next((k for k, word in enumerate(_BALLS) if word in end), len(_BALLS))
        return named, end in parents, -len(way)

    way = min(ways, key=rank)
    made, back = [], np.eye(4)
    for joint in way:
        back = back @ _origin(joint)
        kind = _MOVING.get(str(joint.get("type")))
        if kind is None:
            continue
        element = joint.find("axis")
        axis = _numbers(path, joint, element, "xyz", (1.0, 0.0, 0.0))
        name = str(joint.get("name"))
        made.append(RobotJoint(name, kind, back, _unit(path, name, axis)))  # type: ignore[arg-type]
        back = np.eye(4)
    return Robot(str(root.get("name") or path.stem), tuple(made), back, source=str(path))


def _from_mjcf(path: Path, count: int | None) -> Robot:
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for unneeded in (*spec.geoms, *spec.meshes, *spec.sensors, *spec.keys, *spec.excludes):
            spec.delete(unneeded)
        for body in spec.bodies[1:]:
            body.explicitinertial, body.mass, body.inertia = True, 1.0, (1.0, 1.0, 1.0)
        model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise InputError(path, f"is not read by MuJoCo: {str(error).strip()}") from None
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
             int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}  # fmt: skip
    ends = [("site", s, int(model.site_bodyid[s])) for s in range(model.nsite)]
    ends += [("body", b, b) for b in range(1, model.nbody)]

    def chain(body: int) -> list[int]:
        joints: list[int] = []
        while body:
            first, many = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            joints = [*range(first, first + many), *joints]
            body = int(model.body_parentid[body])
        return joints

    found = [(kind, k, chain(body)) for kind, k, body in ends]
    found = [one for one in found if all(int(model.jnt_type[j]) in kinds for j in one[2])]
    sizes = {len(joints) for _, _, joints in found} - {0}
    if not sizes:
        raise InputError(path, "has no chain of hinge and slide joints")
    wanted = count if count in sizes else max(sizes)

    def rank(one) -> tuple:
        name = (getattr(model, one[0])(one[1]).name or "").lower()
        return next((k for k, word in enumerate(_BALLS) if word in name), len(_BALLS)), one[1]

    kind, k, joints = min((one for one in found if len(one[2]) == wanted), key=rank)
    made, last = [], np.eye(4)
    for j in joints:
        body = int(model.jnt_bodyid[j])
        world = np.eye(4)
        world[:3, :3] = data.xmat[body].reshape(3, 3)
        world[:3, 3] = data.xanchor[j]
        way = world[:3, :3].T @ data.xaxis[j]
        origin = np.linalg.inv(last) @ world
        name = model.joint(j).name or f"joint{j + 1}"
        made.append(RobotJoint(name, kinds[int(model.jnt_type[j])], origin, way))  # type: ignore[arg-type]
        last = world
    end = np.eye(4)
    place, turn = (data.site_xpos, data.site_xmat) if kind == "site" else (data.xpos, data.xmat)
    end[:3, :3], end[:3, 3] = turn[k].reshape(3, 3), place[k]
    return Robot(
        path.stem, tuple(made), np.linalg.inv(last) @ end, np.array(model.opt.gravity),
        source=str(path),
    )  # fmt: skip


def _xml(path: Path) -> ElementTree.Element:
    text = read_text(path)
    if "<!ENTITY" in text:
        raise InputError(path, "declares XML entities, which are not read")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(path, f"is not valid XML: {error}") from None


def _link(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else str(element.get("link"))


def _origin(joint: ElementTree.Element) -> np.ndarray:
    element = joint.find("origin")
    where = f"joint {joint.get('name')}"
    return frame(
        _numbers(where, joint, element, "xyz", (0.0, 0.0, 0.0)),
        _numbers(where, joint, element, "rpy", (0.0, 0.0, 0.0)),
    )


def _set_origin(joint: ElementTree.Element, matrix: np.ndarray) -> None:
    element = joint.find("origin")
    if element is None:
        element = ElementTree.SubElement(joint, "origin")
    element.set("xyz", " ".join(repr(v) for v in _list(matrix[:3, 3])))
    element.set("rpy", " ".join(repr(v) for v in _list(rpy_of(matrix[:3, :3]))))


def _numbers(where, joint, element, key: str, default: Sequence[float]) -> Sequence[float]:
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


def _unit(where, name: str, axis: Sequence[float]) -> np.ndarray:
    size = float(np.linalg.norm(axis))
    if not size > 0.0:
        raise InputError(where, f"joint {name}: its axis must not be zero")
    return np.asarray(axis, float) / size


def _list(values: np.ndarray) -> list[float]:
    return [float(v) for v in np.asarray(values)]
