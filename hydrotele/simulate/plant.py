"""The plant: a Machine compiled to MuJoCo with its hydraulics, and its complete states.

Presliding friction: an explicit step is stable only if the bristle stiffness is small enough for
the inertia of the drive. This module writes the inertia at the home position into the model, and
`hydraulics.actuator.bristle_rate` limits the stiffness with it.

End stops: a joint limit of MuJoCo is a soft constraint. Its force solves
`(A + R) f = a_ref - a_0` with the inverse inertia A at the joint. With `R = 1 / (h b)`,
`a_ref = -v / h - k r / (h b)` and `b = c + h k` this is `f = -k r' - c v'` with depth r' and
velocity v' at the end of the step h. It is a spring k and a damper c integrated by the implicit
Euler rule, which is stable for any load and stiffness.
"""

import dataclasses
import functools
from collections.abc import Mapping

import mujoco
import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.hydraulics.actuator_layout import (
    Slot,
    actuator_order,
    actuator_parameters,
    extra_state_names,
    machine_terms_table,
)
from hydrotele.hydraulics.circuit import (
    ACTIVATIONS_PER_AXIS,
    FEED,
    SCRATCH_SIZE,
    make_drive_state,
    solve_state_supplies,
)
from hydrotele.hydraulics.laws import ATMOSPHERE, pressure_with_released_air
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import SurroundingObject
from hydrotele.simulate.actuator_callbacks import install_hydraulics
from hydrotele.simulate.closed_loops import close_loops, holding_forces, independent_dofs, motion_basis
from hydrotele.simulate.mechanism import (
    TIP_SITE,
    Mjcf,
    add_element,
    assemble_mjcf,
    axes_with_transmission,
    compile_mechanism,
    drive_joint_name,
    load_joint_name,
    mjcf_document,
    preload_transmissions,
)
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import COMMAND, FLOW_HEAD, FLOW_ROD, FORCE, sum_terms


def set_bristle_inertias(machine: Machine, model: mujoco.MjModel) -> None:
    """Compute the inertia that each drive with presliding friction moves at home, and write it into a model.

    Args:
        machine: the machine.
        model: its model; `actuator_user` is written for drives with presliding friction.

    Raises:
        InputError: the linkages do not close at home.

    Source: `(J M^-1 J')^-1` with a drive's Jacobian J and the mass matrix M, in independent
        coordinates; the drive side's own inertia where there is a transmission.
    """
    order = actuator_order(machine)
    axes = [machine.axes[name] for name in order]
    if not any(axis.drive.friction.has_presliding for axis in axes):
        return
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    close_loops(machine, model, data, {})
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fullM(model, data, mass)
    basis = motion_basis(machine, model, data)
    yielding = np.linalg.inv(basis.T @ mass @ basis)
    for i, (name, axis) in enumerate(zip(order, axes, strict=True)):
        if axis.drive.friction.has_presliding:
            lever = basis[model.joint(drive_joint_name(machine, name)).dofadr[0]]
            moved = 1.0 / float(lever @ yielding @ lever)
            own = axis.transmission.inertia if axis.transmission else moved
            model.actuator_user[i, Slot.BRISTLE_INERTIA] = own


def copy_bristle_inertias_to_mjcf(root, machine: Machine, model: mujoco.MjModel) -> None:
    """Copy the parameters written by `set_bristle_inertias` from a model to the machine's MJCF."""
    for i, name in enumerate(actuator_order(machine)):
        if machine.axes[name].drive.friction.has_presliding:
            root.find("actuator", name).user = model.actuator_user[i]


_IMPEDANCE = 1.0e-4, 0.9999  # range to which MuJoCo clips the impedance d
_IMPEDANCE_TRANSITION = (
    0.001,
    0.5,
    2.0,
)  # width, midpoint, power of the impedance; unused: d is constant


def end_stop_joints(machine: Machine) -> dict[str, str]:
    """Return for each axis with an end stop the name of the joint whose limits are this end stop."""
    return {name: load_joint_name(machine, name) for name in machine.axes if machine.end_stop(name)}


def set_end_stops(machine: Machine, model: mujoco.MjModel) -> None:
    """Give the joint limits of a model the stiffness and damping of the machine's end stops.

    MuJoCo computes the regularisation `R = (1 - d) / d A_0` from the impedance d and the inverse inertia
    A_0 at the reference pose. From `solref = (-K d^2, -B d)` it computes the reference acceleration
    `a_ref = -B v - K d r` at velocity v and depth r. See the module for the choice of R and a_ref.

    Args:
        machine: the machine.
        model: its model; `jnt_solref` and `jnt_solimp` are written.

    Source: MuJoCo documentation, "Computation", constraint model.
    """
    h = model.opt.timestep
    for axis, name in end_stop_joints(machine).items():
        stop, joint = machine.end_stop(axis), model.joint(name).id
        assert stop
        both = stop.damping + h * stop.stiffness
        weight = model.dof_invweight0[model.jnt_dofadr[joint]]
        d = float(np.clip(weight / (weight + 1.0 / (h * both)), *_IMPEDANCE))
        model.jnt_solref[joint] = -stop.stiffness / (h * both) * d, -d / h
        model.jnt_solimp[joint] = d, d, *_IMPEDANCE_TRANSITION


def copy_end_stops_to_mjcf(root, machine: Machine, model: mujoco.MjModel) -> None:
    """Copy the parameters written by `set_end_stops` from a model to the machine's MJCF."""
    for name in end_stop_joints(machine).values():
        joint, numbers = root.find("joint", name), model.joint(name).id
        joint.solreflimit = model.jnt_solref[numbers]
        joint.solimplimit = model.jnt_solimp[numbers]


REST_PRESSURE = 2.0e6  # Pa, in the unloaded chamber of a machine at rest


@dataclasses.dataclass(frozen=True)
class Plant:
    """A compiled machine.

    Attributes:
        machine: the machine.
        model: its MuJoCo model; can be stepped with `mj_step`, `mujoco.rollout` and
            `mujoco.batch`.
        ground: whether the ground can be touched.
        surroundings: objects around the machine.
        axes: axis names in actuator order.
        qpos: (nu,) index of each axis' joint in `qpos`.
        dof: (nu,) index of each axis' joint in `qvel`.
        drive_qpos: (nu,) index in `qpos` of the coordinate that each actuator moves: the drive side
            of a transmission, else the piston displacement of a cylinder, else the joint.
        drive_dof: (nu,) index of the same coordinates in `qvel`.
        rod_qpos: (nu,) `drive_qpos` of the axes with a cylinder, -1 for the others.
        hydraulic: number of hydraulic axes, which come first; axis i has activations 4 i .. 4 i+3.
        extra_states: name of each additional state (`actuator_layout.extra_state_names`) -> its
            index in `act`.

    Examples:
        >>> import mujoco
        >>> import hydrotele as ht
        >>> plant = ht.build_plant(ht.load_machine("rig"))
        >>> data = ht.rest_state(plant)
        >>> data.ctrl[0] = 0.5  # half opening of the valve of `slide`
        >>> mujoco.mj_step(plant.model, data, nstep=500)  # 0.5 s
        >>> float(plant.spools(data)[0].round(3))
        0.5
        >>> (plant.pressures(data)[0] / 1e5).round(1)  # bar, head and rod side
        array([28.7, 43.3])
    """

    machine: Machine
    model: mujoco.MjModel
    ground: bool
    surroundings: tuple[SurroundingObject, ...]
    axes: tuple[str, ...]
    qpos: np.ndarray
    dof: np.ndarray
    drive_qpos: np.ndarray
    drive_dof: np.ndarray
    rod_qpos: np.ndarray
    hydraulic: int
    extra_states: Mapping[str, int] = dataclasses.field(default_factory=dict)

    def spools(self, data: mujoco.MjData) -> np.ndarray:
        """Return the spool positions (h,) of the h hydraulic axes, -1 to 1, in the order of `axes`.

        For a drive with its own pump the value is the pump speed [rad/s]. See `docs/api.md` for the
        layout of `data.act`.
        """
        return self._activations(data)[:, 0]

    def pressures(self, data: mujoco.MjData) -> np.ndarray:
        """Return the head- and rod-side pressures (h, 2) of the h hydraulic axes, in the order of `axes` [Pa].

        For a motor they are the pressures of its two ports.
        """
        return self._activations(data)[:, 2:]

    def _activations(self, data: mujoco.MjData) -> np.ndarray:
        """Return the activations (h, 4) of the h hydraulic axes: spool, spool rate, two pressures."""
        count = ACTIVATIONS_PER_AXIS * self.hydraulic
        return np.array(data.act[:count]).reshape(self.hydraulic, ACTIVATIONS_PER_AXIS)

    def tip(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose of the arm's tip.

        Args:
            data: state after `mj_kinematics` or a step; after `mj_step` the position is that at
                the start of the last step.

        Returns:
            (3,) position in the world [m] and (3, 3) rotation from the tip's frame to the world.

        Raises:
            InputError: the machine has no arm.
        """
        if not self.machine.arm:
            raise InputError(f"machine {self.machine.name}", "has no arm and therefore no tip")
        site = data.site(TIP_SITE)
        return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

    @property
    def mjcf(self) -> str:
        """The complete MJCF as text."""
        return self.document.text

    @functools.cached_property
    def document(self) -> Mjcf:
        """The complete MJCF with visual geometry and the `home` keyframe; built on first access."""
        root = assemble_mjcf(self.machine, self.model.opt.timestep, self.ground, surroundings=self.surroundings)
        copy_end_stops_to_mjcf(root, self.machine, self.model)
        copy_bristle_inertias_to_mjcf(root, self.machine, self.model)
        home = rest_state(self)
        pressures = {"act": home.act} if self.model.na else {}
        add_element(root.keyframe, "key", name="home", qpos=home.qpos, **pressures)
        note = (
            "Without hydrotele's native hydraulics the actuators of this file give no force: call"
            " hydrotele.simulate.actuator_callbacks.install_hydraulics() before stepping it."
        )
        if any(axis.command_delay for axis in self.machine.axes.values()):
            note += " Commands act in it without the delays that hydrotele run and replay apply."
        made = mjcf_document(root)
        return made._replace(text=made.text.replace(">", f">\n  <!-- {note} -->", 1))


def build_plant(
    machine: Machine, timestep: float = 1.0e-3, ground: bool = True,
    surroundings: tuple[SurroundingObject, ...] = (),
) -> Plant:  # fmt: skip
    """Compile a machine to a MuJoCo model and install the native hydraulics in this process.

    Args:
        machine: the machine.
        timestep: physics step [s].
        ground: whether the ground can be touched.
        surroundings: objects around the machine.

    Returns:
        The plant.

    Raises:
        InputError: the MJCF cannot be assembled.
        RuntimeError: the native hydraulics cannot run with this MuJoCo.

    Examples:
        The model is a plain MuJoCo model, with tube and rod of every cylinder as bodies.

        >>> import hydrotele as ht
        >>> plant = ht.build_plant(ht.load_machine("cat215", "bucket"))
        >>> plant.axes, plant.model.nu, plant.model.na  # four activations per hydraulic axis
        (('swing', 'boom', 'stick', 'bucket'), 4, 16)
        >>> plant.model.opt.timestep, plant.model.body("boom_rod").name
        (0.001, 'boom_rod')
    """
    install_hydraulics()
    model = compile_mechanism(machine, timestep, ground, visuals=False, surroundings=surroundings)
    set_end_stops(machine, model)
    set_bristle_inertias(machine, model)
    if not _can_have_contacts(model):  # saves the contact search, a tenth of a step
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    axes = tuple(actuator_order(machine))
    joints = [model.joint(machine.axes[name].joint) for name in axes]
    drives = [model.joint(drive_joint_name(machine, name)) for name in axes]
    places = np.array([joint.qposadr[0] for joint in drives], dtype=int)
    piston = np.array([machine.axes[name].cylinder is not None for name in axes])
    return Plant(
        machine=machine,
        model=model,
        ground=ground,
        surroundings=surroundings,
        axes=axes,
        qpos=np.array([j.qposadr[0] for j in joints], dtype=int),
        dof=np.array([j.dofadr[0] for j in joints], dtype=int),
        drive_qpos=places,
        drive_dof=np.array([joint.dofadr[0] for joint in drives], dtype=int),
        rod_qpos=np.where(piston, places, -1),
        hydraulic=len(machine.hydraulic_axes),
        extra_states=_extra_state_indices(machine, model),
    )


def _extra_state_indices(machine: Machine, model: mujoco.MjModel) -> dict[str, int]:
    """Return for each additional state (`extra_state_names`) its index in `act`.

    The bristle state of a force drive is the first activation of that drive's actuator. All other
    states follow after the four activations of each hydraulic axis.
    """
    places, first = {}, ACTIVATIONS_PER_AXIS * len(machine.hydraulic_axes)
    for k, name in enumerate(extra_state_names(machine)):
        axis = machine.axes.get(name.partition(".")[2]) if name.startswith("bristle.") else None
        force = axis is not None and axis.force is not None
        places[name] = int(model.actuator(name[8:]).actadr[0]) if force else first + k
    return places


def _can_have_contacts(model: mujoco.MjModel) -> bool:
    """Return whether any two geoms of different bodies, or an explicit pair, can have a contact."""
    makes, takes = model.geom_contype, model.geom_conaffinity
    meet = (makes[:, None] & takes[None, :]) | (takes[:, None] & makes[None, :])
    apart = model.geom_bodyid[:, None] != model.geom_bodyid[None, :]
    return bool((meet.astype(bool) & apart).any() or model.npair)


def rest_state(plant: Plant, joints: Mapping[str, float] | None = None) -> mujoco.MjData:
    """Return the state at rest: closed loops, closed valves, pressures that carry the load.

    Args:
        plant: the plant.
        joints: joint name -> angle [rad] or position [m]; others at home.

    Returns:
        A new MjData. The unloaded chamber of each hydraulic axis is at REST_PRESSURE, 2 MPa (at the
        accumulator's pressure for an axis with its own pump). The other chamber carries the static
        load, and transmissions are deflected by it. `ctrl` of force drives holds the static load.

    Raises:
        InputError: the linkages do not close at this position.

    Examples:
        The head pressure of the boom cylinders carries the arm; stretching the arm raises it.

        >>> import hydrotele as ht
        >>> plant = ht.build_plant(ht.load_machine("cat215", "bucket"))
        >>> boom = plant.axes.index("boom")
        >>> for stick in -2.4, -0.6:
        ...     data = ht.rest_state(plant, {"stick": stick})
        ...     reach = plant.tip(data)[0][0]
        ...     print(f"tip {reach:.1f} m ahead: {plant.pressures(data)[boom, 0] / 1e5:.0f} bar")
        tip 3.0 m ahead: 111 bar
        tip 7.1 m ahead: 143 bar
    """
    data = mujoco.MjData(plant.model)
    close_loops(plant.machine, plant.model, data, dict(joints or {}))
    forces = holding_forces(plant.machine, plant.model, data)
    preload_transmissions(plant.machine, plant.model, data, dict(zip(plant.axes, forces, strict=True)))
    forces = forces - term_forces_at_rest(plant.machine, data, plant.drive_qpos, forces)
    for i, name in enumerate(plant.axes[: plant.hydraulic]):
        axis = plant.machine.axes[name]
        head, rod = axis.hydraulic_drive.effective_areas
        rest = axis.pump.accumulator.pressure if axis.pump else REST_PRESSURE
        p_head, p_rod = (forces[i] + rod * rest) / head, rest
        if p_head < rest:
            p_head, p_rod = rest, (head * rest - forces[i]) / rod
        data.act[ACTIVATIONS_PER_AXIS * i + 2 : ACTIVATIONS_PER_AXIS * i + 4] = p_head, p_rod
    for i in range(plant.hydraulic, len(plant.axes)):
        drive = plant.machine.axes[plant.axes[i]].force
        assert drive
        data.ctrl[i] = (forces[i] + drive.offset) / drive.gain
    return data


def initial_state(plant: Plant, state: Mapping) -> mujoco.MjData:
    """Create a complete state from the `initial_state` of a log.

    Args:
        plant: the plant.
        state: `order` (axis names) and, in that order, `angle` [rad] or [m], `velocity`, `spool`,
            `spool_rate`, `pressure_head`, `pressure_rod`. All but `order` and `angle` are optional
            and have their values at rest by default. `bristle` (axis -> fraction of the breakaway
            force that the bristles carry), `delivery` and `added_delivery` (pump -> fraction
            of the maximum flow that a pump with a time constant delivers, and that terms add) are 0
            by default. `joints` (name -> value) sets undriven joints; `drive` and `drive_velocity`
            (axis -> value) set the drive sides of transmissions.

    Returns:
        A new MjData.

    Raises:
        InputError: the linkages do not close at this position.

    Examples:
        The state at the start of a logged run:

        >>> import json
        >>> import hydrotele as ht
        >>> run = ht.run_scenario(ht.load_scenario("rig_steps", {"duration": "0.5"}))
        >>> start = json.loads(run.truth.metadata["initial_state"])
        >>> start["order"], start["angle"]
        (['slide'], [0.1])
        >>> plant = ht.build_plant(ht.load_machine("rig"))
        >>> data = ht.initial_state(plant, start)
        >>> (plant.pressures(data)[0] / 1e5).round(1)  # bar
        array([20. , 32.8])
    """
    order = list(state["order"])
    joints = {plant.machine.axes[n].joint: v for n, v in zip(order, state["angle"], strict=True)}
    data = rest_state(plant, {**joints, **state.get("joints", {})})
    if "velocity" in state:
        data.qvel[[plant.dof[plant.axes.index(n)] for n in order]] = state["velocity"]
        basis = motion_basis(plant.machine, plant.model, data)
        data.qvel[:] = basis @ data.qvel[independent_dofs(plant.machine, plant.model)]
    for name in axes_with_transmission(plant.machine):
        i = plant.axes.index(name)
        place, dof = plant.drive_qpos[i], plant.drive_dof[i]
        data.qpos[place] = state.get("drive", {}).get(name, data.qpos[place])
        data.qvel[dof] = state.get("drive_velocity", {}).get(name, data.qvel[dof])
    for column, key in enumerate(("spool", "spool_rate", "pressure_head", "pressure_rod")):
        for name, value in zip(order, state.get(key, ()), strict=False):
            i = plant.axes.index(name)
            if i < plant.hydraulic:
                if key.startswith("pressure") and value <= -ATMOSPHERE:  # of oil without free air
                    value = pressure_with_released_air(value, plant.model.actuator_user[i, Slot.AIR_RELEASE])
                data.act[ACTIVATIONS_PER_AXIS * i + column] = value
    for name, place in plant.extra_states.items():
        kind, _, owner = name.partition(".")
        data.act[place] = state.get(kind, {}).get(owner, 0.0)
    return data


def evaluate_terms(
    machine: Machine, time: np.ndarray, act: np.ndarray, x: np.ndarray, v: np.ndarray,
    command: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Compute the forces and flows that a machine's terms (additional laws) add in n states of nu drives.

    Args:
        machine: the machine.
        time: (n,) time [s].
        act: (n, na) activations.
        x: (n, nu) drive positions [m] or [rad].
        v: (n, nu) drive velocities [m/s] or [rad/s].
        command: (n, nu) commands after their delay [1] or [V].

    Returns:
        (n, nu, 3): force [N] or [N m], including the effect of command terms of force drives; flows
        into the head-side and the rod-side chamber [m^3/s].
    """
    out = np.zeros((len(time), len(machine.axes), 3))
    if machine.terms:
        order = actuator_order(machine)
        drives = [machine.axes[name].force for name in order]
        _evaluate_term_rows(
            np.concatenate(list(actuator_parameters(machine).values())),
            machine_terms_table(machine), len(machine.hydraulic_axes),
            np.array([drive.gain if drive else 0.0 for drive in drives]),
            np.ascontiguousarray(time, float), np.ascontiguousarray(act, float),
            np.ascontiguousarray(x, float), np.ascontiguousarray(v, float),
            np.ascontiguousarray(command, float), out,
        )  # fmt: skip
    return out


@compiled
def _evaluate_term_rows(user, terms, count, gain, time, act, x, v, command, out):
    """Compute the forces and flows of terms for all rows and write them to `out` (n, nu, 3).

    `user` are the parameters of all actuators, `terms` the table of terms, `count` the number of
    hydraulic axes and `gain` (nu,) the force per unit of command of force drives, 0 for others. All
    other arguments and the columns of `out` are those of `evaluate_terms`.
    """
    scratch = np.zeros(SCRATCH_SIZE)
    for row in range(len(time)):
        if count > 0:
            solve_state_supplies(user, 0, count, act[row], scratch)
        drives = Drives(count, act[row], x[row], v[row], command[row])
        for i in range(len(gain)):
            supply = scratch[FEED + min(i, count - 1)] if count > 0 else 0.0
            s = make_drive_state(
                user, i, count, act[row], supply, time[row], x[row, i], v[row, i], command[row, i],
                gain[i],
            )  # fmt: skip
            out[row, i, 0] = sum_terms(terms, FORCE, i, s, drives)
            if i >= count:
                out[row, i, 0] += gain[i] * sum_terms(terms, COMMAND, i, s, drives)
            out[row, i, 1] = sum_terms(terms, FLOW_HEAD, i, s, drives)
            out[row, i, 2] = sum_terms(terms, FLOW_ROD, i, s, drives)


def term_forces_at_rest(
    machine: Machine, data: mujoco.MjData, drive_qpos: np.ndarray, forces: np.ndarray
) -> np.ndarray:
    """Compute the forces that terms add to drives at rest, at time 0 and with zero commands.

    Args:
        machine: the machine.
        data: state at rest.
        drive_qpos: (nu,) indices of the drives in `qpos`.
        forces: (nu,) drive forces that hold the machine [N] or [N m]. For terms that depend on
            pressures, the head-side pressure alone is assumed to produce them.

    Returns:
        (nu,) forces that the terms add [N] or [N m]; 0 without terms.
    """
    if not machine.terms:
        return np.zeros(len(forces))
    act = np.zeros((1, ACTIVATIONS_PER_AXIS * len(machine.hydraulic_axes) + len(extra_state_names(machine))))
    for i, axis in enumerate(machine.hydraulic_axes.values()):
        act[0, ACTIVATIONS_PER_AXIS * i + 2] = forces[i] / axis.hydraulic_drive.effective_areas[0]
    still = np.zeros((1, len(forces)))
    x = data.qpos[drive_qpos][None, :]
    return evaluate_terms(machine, np.zeros(1), act, x, still, still)[0, :, 0]
