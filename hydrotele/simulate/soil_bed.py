"""A strip of soil in which the bucket of a machine digs, in the vertical plane of the arm.

`SoilBed` holds the profile of the strip and the soil in the bucket. The strip lies along the azimuth
of the bucket at the first step. A bucket that is swung out of the strip meets no soil.
"""

import math

import mujoco
import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.scenario.surrounding_objects import SoilGround
from hydrotele.soil.parameters import (
    CAT215,
    CELL_LENGTH,
    DEPTH,
    FACE,
    FLOOR,
    FORCE_R,
    FORCE_Z,
    HEEL,
    IS_INITIALISED,
    MASS,
    MOMENT,
    PROFILE_START,
    RESULT_SIZE,
    SLIDE,
    SOILS,
    TIP,
    WIDTH,
    Bucket,
    make_bucket_state,
    make_level_profile,
    pack_soil_parameters,
)
from hydrotele.soil.step import EdgeMotion, compute_bucket_wrench, step_soil

_STRIP_START, _STRIP_END, _CELL_LENGTH = 1.0, 11.0, 0.05  # m, radii from the swing axis


def machine_bucket(machine: Machine) -> Bucket:
    """Return the digging bucket of a machine: that of the CAT 215, scaled to the machine's bucket.

    The scale is the ratio of the distances from pin to edge of both buckets.

    Raises:
        InputError: the machine has no bucket.
    """
    arm = machine.arm
    if arm is None or arm.tool is None or arm.head is not None:
        message = f"{machine.name} with tool {machine.tool} has no bucket to dig with: choose cat215 with tool bucket"
        raise InputError("surroundings: soil", message)
    scale = float(np.linalg.norm(arm.tip.position)) / CAT215.outline[0][0]
    return Bucket(
        outline=tuple((scale * x, scale * z) for x, z in CAT215.outline),
        heel=(scale * CAT215.heel[0], scale * CAT215.heel[1]),
        floor_angle=CAT215.floor_angle,
        floor_length=scale * CAT215.floor_length,
        width=scale * CAT215.width,
        inner_width=scale * CAT215.inner_width,
        edge=scale * CAT215.edge,
    )


class SoilBed:
    """Profile of a strip of soil, and the soil in the bucket.

    Attributes:
        bucket: side view of the bucket.
        parameters: parameters of soil, bucket and profile; see `soil.parameters`.
        surface: (m,) height of the profile [m].
        loose: (m,) thickness of the loose soil on top [m].
        state: state of the bucket; see `soil.parameters`.
        result: result of the last step; see `soil.parameters`.
        azimuth: horizontal direction of the strip from the swing axis [rad]; NaN before the first
            step.
    """

    def __init__(self, machine: Machine, ground: SoilGround) -> None:
        """Create level ground at height 0 and an empty bucket.

        Args:
            machine: machine with a bucket.
            ground: the soil.

        Raises:
            InputError: the machine has no bucket.
        """
        self.bucket = machine_bucket(machine)
        self.parameters = pack_soil_parameters(SOILS[ground.soil], self.bucket, _STRIP_START, _CELL_LENGTH)
        self.surface, self.loose = make_level_profile(round((_STRIP_END - _STRIP_START) / _CELL_LENGTH))
        self.state, self.result, self.azimuth = make_bucket_state(), np.zeros(RESULT_SIZE), math.nan

    @property
    def cell_radii(self) -> np.ndarray:
        """Radii (m,) of the centres of the m cells of the profile, from the swing axis [m]."""
        start, length = self.parameters[PROFILE_START], self.parameters[CELL_LENGTH]
        return start + length * (np.arange(len(self.surface)) + 0.5)

    @property
    def carried_mass(self) -> float:
        """Mass of the soil in the bucket [kg]."""
        return float(self.result[MASS])

    @property
    def force(self) -> np.ndarray:
        """Force (3,) of the ground on the bucket in the world frame [N]; 0 before the first step.

        It does not contain the weight of the soil in the bucket.
        """
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        force = np.array([c * self.result[FORCE_R], s * self.result[FORCE_R], self.result[FORCE_Z]])
        return np.nan_to_num(force)

    def step(self, edge: np.ndarray, velocity: np.ndarray, ahead: np.ndarray, period: float) -> None:
        """Advance the soil while the bucket's edge moves through it.

        Profile, bucket state and result are updated. The first call sets the azimuth of the strip.
        If the edge is further from the strip's middle than the width of the bucket, the force is set to
        0 and the position of the bucket is forgotten; profile and soil in the bucket stay.

        Args:
            edge: (3,) position of the edge in the world [m].
            velocity: (3,) velocity of the edge [m/s].
            ahead: (3,) direction from the bucket's pin to its edge, unit vector.
            period: time since the previous step [s].
        """
        if math.isnan(self.azimuth):
            self.azimuth = math.atan2(edge[1], edge[0])
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        if abs(c * edge[1] - s * edge[0]) > self.parameters[WIDTH]:  # swung out of the strip
            self.result[[FORCE_R, FORCE_Z, MOMENT]] = 0.0
            # a return must not cut the soil between the places where the bucket left and entered the strip
            self.state[[IS_INITIALISED, FACE, TIP, FLOOR, HEEL, SLIDE, DEPTH]] = 0.0
            return
        motion = EdgeMotion(
            c * edge[0] + s * edge[1], edge[2], c * velocity[0] + s * velocity[1], velocity[2],
            math.atan2(ahead[2], c * ahead[0] + s * ahead[1]),
        )  # fmt: skip
        step_soil(self.parameters, self.surface, self.loose, self.state, motion, period, self.result)


class BedInSimulation:
    """A strip of soil that acts on the bucket of a simulated machine."""

    def __init__(self, machine: Machine, model: mujoco.MjModel, ground: SoilGround) -> None:
        """Find the bucket in the model.

        Args:
            machine: machine with a bucket.
            model: its MuJoCo model.
            ground: the soil.

        Raises:
            InputError: the machine has no bucket.
        """
        self.bed, self._model = SoilBed(machine, ground), model
        assert machine.arm  # it has a bucket
        self._body = model.body(machine.arm.tip.link).id
        self._edge = np.array(machine.arm.tip.position)
        self._motion = np.zeros(6)

    def update(self, data: mujoco.MjData, period: float) -> None:
        """Advance the soil with the bucket's motion and apply the soil's force to the bucket.

        The force acts until the next call.

        Args:
            data: state of the machine; the wrench applied to the bucket is written.
            period: time since the last call [s].
        """
        body = self._body
        arm = data.xmat[body].reshape(3, 3) @ self._edge
        edge = data.xpos[body] + arm
        mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_XBODY, body, self._motion, 0)
        velocity = self._motion[3:] + np.cross(self._motion[:3], arm)
        self.bed.step(edge, velocity, arm / np.linalg.norm(arm), period)
        azimuth, wrench = math.atan2(edge[1], edge[0]), data.xfrc_applied[body]
        compute_bucket_wrench(self.bed.result, edge, azimuth, data.xipos[body], wrench)
