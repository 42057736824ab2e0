"""Objects around a machine in MuJoCo: plates, logs, soil, trees and trucks.

Plates are mounted on springs. Trees stand on stiff springs; a spinning saw cuts them with a cutting
torque and a feed force. Logs, and trees once they are held, have contact with the ground only.
A truck is rigid; a touch sensor measures the sum of the normal forces on it.
"""

import math

import mujoco
import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import (
    DumpTruck,
    LogOnGround,
    Plate,
    SoilGround,
    StandingTree,
    SurroundingObject,
)
from hydrotele.simulate.gripping import RELEASED, TAKEN, grip_parameters, grip_step, timber_log_grip_parameters
from hydrotele.simulate.soil_bed import BedInSimulation, SoilBed, machine_bucket

_PLATE_SOLREF = (0.01, 1.0)  # s, 1: firm steel on steel, stiffer than any plate's spring
_CUT_WIDTH = 0.02  # m, width of the saw cut
_GRAVITY = 9.81
_ROOT_STIFFNESS, _ROOT_ROTATION_STIFFNESS = 4.0e6, 6.0e5  # N/m, N m/rad: stiffness of a tree's root
_MIN_CUTTING_SPEED = 30.0  # rad/s: lowest speed at which a saw cuts
_MAX_HEIGHT_ERROR = 0.15  # m: largest difference between the saw's height and that of the cut
_NORMALS = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1)}
_FEED_FORCE_RATIO = 0.3  # feed force per cutting force at the rim of the disc
_STEM_POCKET = (0.325, 0.0, -0.62), (0.325, 0.35, 0.0)  # m, in front of a head, between its arms
_MAX_STEM_ANGLE = math.acos(0.9)  # rad: largest angle between stem and head
_LOG_DAMPING = 30.0  # N s/m and N m s/rad: soil damping; a rolling log stops within half a second
_LOG_PENETRATION = 1.0e-5  # m: static penetration of a log into the soft contact of the ground
_PREFIXES = ("plate_", "tree_", "log_", "truck_")
_WALL = 0.05  # m, half thickness of floor and walls of a truck's bed


def write_surroundings(root, machine: Machine, objects: tuple[SurroundingObject, ...], visuals: bool = True) -> None:
    """Add plates, trees, logs and trucks to an assembled MJCF; soil replaces the contact of bucket and ground.

    Args:
        root: the MJCF document of the machine.
        machine: the machine.
        objects: plates, trees, logs, soil and trucks.
        visuals: whether to add the visual geometry of logs and trucks.

    Raises:
        InputError: the machine does not have the given saw or grab, or the grab has no pocket for
            the log, or there is soil but no bucket.
    """
    for number, thing in enumerate(objects):
        where = f"surroundings.{number}"
        if isinstance(thing, Plate):
            _write_plate(root, f"plate_{number}", thing)
        elif isinstance(thing, StandingTree):
            _write_tree(root, f"tree_{number}", thing, machine, where)
        elif isinstance(thing, SoilGround):
            machine_bucket(machine)
            assert machine.arm  # it has a bucket
            root.contact.add("exclude", name=f"soil_{number}", body1="world", body2=machine.arm.tip.link)
        elif isinstance(thing, DumpTruck):
            _write_truck(root, f"truck_{number}", thing, visuals)
        else:
            body = _add_timber_log(root, f"log_{number}", thing, machine, where)
            if visuals:
                _add_timber_log_visuals(body, f"log_{number}", thing)


def _write_plate(root, name: str, plate: Plate) -> None:
    """Add a plate that slides along its normal on a spring and a damper to the MJCF."""
    normal, thick = np.array(_NORMALS[plate.normal], float), 0.05
    middle = np.array(plate.position) - thick * normal
    body = root.worldbody.add("body", name=name, pos=middle)
    a, b = plate.size
    sides = {2: (a, b, thick), 0: (thick, a, b), 1: (a, thick, b)}[int(np.abs(normal).argmax())]
    body.add("inertial", mass=plate.mass, pos=(0, 0, 0), diaginertia=[plate.mass] * 3)
    body.add(
        "joint", name=name, type="slide", axis=normal, stiffness=plate.stiffness,
        damping=plate.damping, limited="false",
    )  # fmt: skip
    body.gravcomp = 1.0
    body.add(
        "geom", name=name, type="box", size=sides, contype=1, conaffinity=2, mass=0,
        solref=_PLATE_SOLREF, priority=2, rgba=(0.42, 0.44, 0.47, 1),
    )  # fmt: skip


def _write_truck(root, name: str, truck: DumpTruck, visuals: bool) -> None:
    """Add a rigid truck and its touch sensor to the MJCF: bed, cab, and with `visuals` chassis and wheels."""
    turn = (math.cos(truck.direction / 2.0), 0.0, 0.0, math.sin(truck.direction / 2.0))
    body = root.worldbody.add("body", name=name, pos=(*truck.position, 0.0), quat=turn)
    half, side, floor, wall = 0.5 * truck.length, 0.5 * truck.width, truck.floor_height, 0.5 * truck.wall_height
    paint, steel, dark = (0.16, 0.30, 0.48, 1), (0.33, 0.35, 0.38, 1), (0.10, 0.10, 0.11, 1)
    cab_back = half + 2.0 * _WALL + 0.25
    boxes = {
        "floor": ((0.0, 0.0, floor - _WALL), (half, side, _WALL), steel),
        "tailgate": ((-half - _WALL, 0.0, floor + wall), (_WALL, side + 2.0 * _WALL, wall), steel),
        "front": ((half + _WALL, 0.0, floor + wall + 0.1), (_WALL, side + 2.0 * _WALL, wall + 0.1), steel),
        "left": ((0.0, side + _WALL, floor + wall), (half, _WALL, wall), steel),
        "right": ((0.0, -side - _WALL, floor + wall), (half, _WALL, wall), steel),
        "cab": ((cab_back + 0.8, 0.0, 1.8), (0.8, side, 0.95), paint),
    }
    for part, (place, size, colour) in boxes.items():
        body.add(
            "geom", name=f"{name}_{part}", type="box", pos=place, size=size, rgba=colour, mass=0,
            contype=1, conaffinity=2,
        )  # fmt: skip
    body.add("site", name=name, type="box", pos=(0.0, 0.0, 5.0), size=(20.0, 20.0, 10.0), group=4)
    root.sensor.add("touch", name=name, site=name)
    if not visuals:
        return
    looks = {"mass": 0, "contype": 0, "conaffinity": 0, "group": 2}
    body.add("geom", type="box", pos=(0.9, 0.0, 0.95), size=(half + 1.1, 0.42, 0.14), rgba=dark, **looks)
    body.add("geom", type="box", pos=(cab_back + 1.61, 0.0, 2.2), size=(0.01, side - 0.15, 0.4), rgba=dark, **looks)
    for x in (-0.5 * half, cab_back + 0.7):
        for y in (side - 0.15, 0.15 - side):
            body.add(
                "geom", type="cylinder", size=(0.5,), fromto=(x, y - 0.15, 0.5, x, y + 0.15, 0.5), rgba=dark, **looks
            )  # fmt: skip


def _check_axis(machine: Machine, axis: str, where: str) -> None:
    if axis not in machine.axes:
        raise InputError(where, f"the machine has no axis {axis!r}; {suggest_valid_name(axis, machine.axes)}")


def _grab_body(machine: Machine, grab: str) -> str:
    """Return the name of the body to which a grab's jaw is hinged."""
    return machine.links[machine.link_of(machine.axes[grab].joint)].parent


def _write_weld(root, machine: Machine, grab: str, name: str) -> None:
    """Add the weld constraint by which a grab holds an object, initially inactive, to the MJCF."""
    root.equality.add(
        "weld", name=f"{name}_held", body1=_grab_body(machine, grab), body2=name, active=False,
        solref=(0.01, 1.0), solimp=(0.99, 0.999, 0.001, 0.5, 2),
    )  # fmt: skip


def _add_timber_log(root, name: str, log: LogOnGround, machine: Machine, where: str):
    """Add a timber log on the ground to the MJCF and return its body.

    Raises InputError if the axis `log.grab` or its pocket site is missing, or the log is too thick.
    """
    _check_axis(machine, log.grab, f"{where}.grab")
    hand = _grab_body(machine, log.grab)
    pocket = root.find("site", f"{log.grab}_pocket")
    if pocket is None:
        message = f"link {hand!r} needs a box site '{log.grab}_pocket' in the MJCF to hold a log"
        raise InputError(f"{where}.grab", message)
    if log.diameter >= 2.0 * pocket.size[2]:
        message = f"{log.diameter:g} m does not fit between jaws {2.0 * pocket.size[2]:g} m apart"
        raise InputError(f"{where}.diameter", message)
    radius, half, mass = log.diameter / 2.0, log.length / 2.0, log.mass
    turn = (math.cos(log.direction / 2.0), 0.0, 0.0, math.sin(log.direction / 2.0))
    place = (*log.position, radius - _LOG_PENETRATION)
    body = root.worldbody.add("body", name=name, pos=place, quat=turn)
    across = mass * (3.0 * radius**2 + log.length**2) / 12.0
    body.add("inertial", mass=mass, pos=(0, 0, 0), diaginertia=(mass * radius**2 / 2, across, across))
    body.add("joint", name=name, type="free", damping=_LOG_DAMPING, limited="false")
    body.add(
        "geom", name=name, type="capsule", size=(radius,), contype=2, conaffinity=1, mass=0,
        fromto=(radius - half, 0, 0, half - radius, 0, 0), group=3,
    )  # fmt: skip
    _write_weld(root, machine, log.grab, name)
    return body


def _add_timber_log_visuals(body, name: str, log: LogOnGround) -> None:
    """Add the visual geometry (bark and wood) of a timber log to its body."""
    radius, half = log.diameter / 2.0, log.length / 2.0
    for part, size, reach, colour in (
        ("bark", radius, half - 0.01, (0.36, 0.26, 0.17, 1)),
        ("wood", 0.96 * radius, half, (0.76, 0.60, 0.40, 1)),
    ):
        body.add(
            "geom", name=f"{name}_{part}", type="cylinder", size=(size,), rgba=colour, mass=0,
            fromto=(-reach, 0, 0, reach, 0, 0), contype=0, conaffinity=0, group=2,
        )  # fmt: skip


def _write_tree(root, name: str, tree: StandingTree, machine: Machine, where: str) -> None:
    """Add a tree to the MJCF: stump, stem, crown, root springs and the weld by which a grab holds it.

    Raise InputError if the machine does not have the tree's saw or grab axis.
    """
    for part in ("saw", "grab"):
        _check_axis(machine, getattr(tree, part), f"{where}.{part}")
    x, y = tree.position
    radius, half = tree.diameter / 2.0, tree.height / 2.0
    mass = tree.density * math.pi * radius**2 * tree.height
    bark = {"rgba": (0.36, 0.27, 0.18, 1), "mass": 0}
    root.worldbody.add(
        "geom", name=f"{name}_stump", type="cylinder", size=(radius * 1.05, tree.cut_height / 2.0),
        pos=(x, y, tree.cut_height / 2.0), contype=1, conaffinity=2, **bark,
    )  # fmt: skip
    body = root.worldbody.add("body", name=name, pos=(x, y, tree.cut_height + _CUT_WIDTH))
    across = mass * (3.0 * radius**2 + tree.height**2) / 12.0
    body.add("inertial", mass=mass, pos=(0, 0, half), diaginertia=(across, across, mass * radius**2 / 2))
    for axis, way in zip("xyz", np.eye(3), strict=True):
        sag = mass * _GRAVITY / _ROOT_STIFFNESS if axis == "z" else 0.0  # springref cancels the tree's weight
        body.add(
            "joint", name=f"{name}_{axis}", type="slide", axis=way, stiffness=_ROOT_STIFFNESS,
            damping=0.05 * _ROOT_STIFFNESS, limited="false", springref=sag,
        )  # fmt: skip
    body.add(
        "joint", name=f"{name}_turn", type="ball", stiffness=_ROOT_ROTATION_STIFFNESS,
        damping=0.05 * _ROOT_ROTATION_STIFFNESS,
        limited="false",
    )  # fmt: skip
    body.add(
        "geom", name=name, type="cylinder", size=(radius, half), pos=(0, 0, half),
        contype=3, conaffinity=3, **bark,
    )  # fmt: skip
    body.add(
        "geom", name=f"{name}_crown", type="ellipsoid", size=(0.9, 0.9, 0.28 * tree.height),
        pos=(0, 0, 0.86 * tree.height), contype=0, conaffinity=0, mass=0,
        rgba=(0.16, 0.33, 0.15, 1),
    )  # fmt: skip
    _write_weld(root, machine, tree.grab, name)


def object_joints(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Return (joint id, first index of the joint in `qpos`) for all joints of plates, trees and logs."""
    return [(j, int(model.jnt_qposadr[j])) for j in range(model.njnt) if is_surrounding_object(model.joint(j).name)]


def is_surrounding_object(name: str) -> bool:
    """Return whether a body or joint of this name belongs to a plate, tree, log or truck."""
    return name.startswith(_PREFIXES)


class Surroundings:
    """Trees, logs and soil of a run, and their cutting, gripping, release and digging.

    Attributes:
        events: list of (time [s], description of the event).
    """

    def __init__(self, machine: Machine, model: mujoco.MjModel, things: tuple[SurroundingObject, ...]) -> None:
        """Find the objects in the model.

        Args:
            machine: the machine.
            model: its MuJoCo model with these surroundings.
            things: surrounding objects of the scenario.
        """
        self.events: list[tuple[float, str]] = []
        self._model = model
        self._trees = [
            _TreeState(machine, model, f"tree_{n}", thing)
            for n, thing in enumerate(things)
            if isinstance(thing, StandingTree)
        ]
        self._logs = [
            _Gripper(machine, model, f"log_{n}", thing.grab, timber_log_grip_parameters(model, thing))
            for n, thing in enumerate(things)
            if isinstance(thing, LogOnGround)
        ]
        self._beds = [BedInSimulation(machine, model, thing) for thing in things if isinstance(thing, SoilGround)]

    @property
    def needs_update(self) -> bool:
        """Whether there is any tree, log or soil, so that `update` must be called."""
        return bool(self._trees or self._logs or self._beds)

    @property
    def soil(self) -> SoilBed | None:
        """The soil that the bucket digs, or None."""
        return self._beds[0].bed if self._beds else None

    @property
    def soil_force(self) -> np.ndarray:
        """Force (3,) of the soil on the bucket until the next update, in the world frame [N].

        It does not contain the weight of the soil in the bucket.
        """
        return sum((one.bed.force for one in self._beds), np.zeros(3))

    @property
    def soil_load(self) -> float:
        """Mass of the soil in the bucket [kg]."""
        return sum(one.bed.carried_mass for one in self._beds)

    def update(self, time: float, data: mujoco.MjData, period: float) -> None:
        """Update cutting of trees, gripping of objects and digging; call it once per control period.

        Args:
            time: current time [s].
            data: the plant's state; applied forces and welds are written.
            period: time since the last call [s].
        """
        for tree in self._trees:
            self.events += [(time, said) for said in tree.update(data, period)]
        for log in self._logs:
            change = log.update(data)
            if change == TAKEN:
                self.events.append((time, "the grapple holds the log"))
            elif change == RELEASED:
                self.events.append((time, "the grapple lets the log go"))
        for one in self._beds:
            one.update(data, period)

    def restore_model(self) -> None:
        """Undo the changes that cutting and gripping of trees made to the MuJoCo model."""
        for tree in self._trees:
            tree.restore_model()


class _Gripper:
    """A grab and one object that it can hold."""

    def __init__(self, machine: Machine, model: mujoco.MjModel, name: str, grab: str, grip) -> None:
        self._hand, self._thing = model.body(_grab_body(machine, grab)).id, model.body(name).id
        self._jaw = int(model.joint(machine.axes[grab].joint).qposadr[0])
        self._weld, self._rows, self._grip = model.equality(f"{name}_held").id, model.eq_data, grip

    def update(self, data: mujoco.MjData) -> int:
        """Activate or deactivate the weld that holds the object, as `grip_step` decides.

        Return TAKEN, RELEASED or UNCHANGED.
        """
        hand, thing, weld = self._hand, self._thing, self._weld
        change = grip_step(
            self._grip, data.xpos[hand], data.xquat[hand], data.xpos[thing], data.xquat[thing],
            data.qpos[self._jaw], bool(data.eq_active[weld]), self._rows[weld],
        )  # fmt: skip
        if change:
            data.eq_active[weld] = change == TAKEN
        return change


class _TreeState:
    """State of one tree during a run: depth of its cut, and whether it is cut off and held."""

    def __init__(self, machine: Machine, model: mujoco.MjModel, name: str, tree: StandingTree) -> None:
        self._model, self._tree, self.name = model, tree, name
        saw = machine.link_of(machine.axes[tree.saw].joint)
        grip = grip_parameters(tree.closed_angle, tree.closed_angle, 2, _MAX_STEM_ANGLE, *_STEM_POCKET, 2)
        self._grip = _Gripper(machine, model, name, tree.grab, grip)
        self._saw = model.body(saw).id
        self._spin = model.joint(machine.axes[tree.saw].joint).dofadr[0]
        self._body = model.body(name).id
        self._stem = model.geom(name).id
        disc = [g for g in range(model.ngeom) if model.geom_bodyid[g] == self._saw
                and model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER]  # fmt: skip
        solid = [g for g in disc if model.geom_contype[g]] or disc
        if not solid:
            raise InputError(f"axis {tree.saw}", "its link has no disc (a cylinder) to cut with")
        self._disc, self._radius = solid[0], float(model.geom_size[solid[0], 0])
        joints = [model.joint(f"{name}_{part}") for part in ("x", "y", "z", "turn")]
        self._joints = np.array([j.id for j in joints])
        self._dofs = np.arange(joints[0].dofadr[0], joints[0].dofadr[0] + 6)
        self._solid = (model.geom_contype[self._disc], model.geom_conaffinity[self._disc])
        self._stiffness = model.jnt_stiffness[self._joints].copy()
        self._damping = model.dof_damping[self._dofs].copy()
        self.depth, self.cut = 0.0, False

    def restore_model(self) -> None:
        """Restore root stiffness, damping and contacts, which cutting and gripping of the tree changed."""
        self._model.jnt_stiffness[self._joints] = self._stiffness
        self._model.dof_damping[self._dofs] = self._damping
        self._set_disc_contacts(True)
        self._model.geom_contype[self._stem] = self._model.geom_conaffinity[self._stem] = 3

    def _set_disc_contacts(self, on: bool) -> None:
        """Enable or disable the contacts of the saw disc."""
        model = self._model
        model.geom_contype[self._disc], model.geom_conaffinity[self._disc] = self._solid if on else (0, 0)

    def update(self, data: mujoco.MjData, period: float) -> list[str]:
        """Update cutting and gripping of the tree; return texts that describe new events.

        The tree counts as cut when the cut is as deep as 98 % of its diameter. `period` is the time
        since the last call [s].
        """
        said: list[str] = []
        spin = abs(float(data.qvel[self._spin]))
        data.xfrc_applied[self._saw] = 0.0
        self._set_disc_contacts(spin < _MIN_CUTTING_SPEED)
        if not self.cut and spin >= _MIN_CUTTING_SPEED:
            self._advance_cut(data, period, spin)
            if self.depth >= 0.98 * self._tree.diameter:
                self._release_root()
                said.append("the tree is cut")
        change = self._grip.update(data)
        if change == TAKEN:
            self._model.geom_contype[self._stem] = 2  # the ground only: head and stem are one
            self._model.geom_conaffinity[self._stem] = 1
            said.append("the grab holds the tree")
        elif change == RELEASED:
            said.append("the grab lets the tree go")
        return said

    def _advance_cut(self, data: mujoco.MjData, period: float, spin: float) -> None:
        """Deepen the cut up to the edge of the saw disc, and apply cutting torque and feed force to the saw.

        Nothing happens if the disc is not at the height of the cut. `spin` is the disc's speed
        [rad/s], > 0.
        """
        stem, saw = data.xpos[self._body], data.xpos[self._saw]
        axis = data.xmat[self._saw].reshape(3, 3)[:, 2]
        height = saw[2] - (axis[:2] @ (stem[:2] - saw[:2])) / max(abs(axis[2]), 0.3)
        if abs(height - self._tree.cut_height) > _MAX_HEIGHT_ERROR:
            return
        way = stem[:2] - saw[:2]
        far = float(np.hypot(*way))
        if abs(float(saw[2]) - self._tree.cut_height) > 2.0 * _MAX_HEIGHT_ERROR + self._radius:
            return
        reach = self._radius - (far - self._tree.diameter / 2.0)
        fresh = min(reach, self._tree.diameter) - self.depth
        if fresh <= 0.0:
            return
        self.depth += fresh
        radius = self._tree.diameter / 2.0
        chord = 2.0 * math.sqrt(max(radius**2 - (radius - self.depth) ** 2, 0.0))
        power = self._tree.cutting_energy * _CUT_WIDTH * chord * fresh / period
        torque = power / spin
        direction = -math.copysign(1.0, float(data.qvel[self._spin]))
        feed = _FEED_FORCE_RATIO * torque / self._radius
        data.xfrc_applied[self._saw, :2] = -feed * way / max(far, 1e-9)
        data.xfrc_applied[self._saw, 3:] = direction * torque * axis

    def _release_root(self) -> None:
        """Remove the stiffness of the tree's root and most of its damping, so that the tree can fall."""
        self._model.jnt_stiffness[self._joints] = 0.0
        self._model.dof_damping[self._dofs] = (5.0, 5.0, 5.0, 50.0, 50.0, 50.0)
        self.cut = True
