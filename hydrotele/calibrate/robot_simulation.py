"""Simulated calibration measurements of serial robots: robots with errors, balls in sockets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hydrotele.calibrate.sockets import Socket
from hydrotele.core.errors import InputError
from hydrotele.kinematics.serial_robot import (
    Robot,
    corrected_robot,
    joints_for_places,
    robot_chain,
    robot_poses,
)

_TRIES = 200
_REACHED = 1e-9  # m
_IDLE = 0.3  # rad


@dataclass(frozen=True)
class Errors:
    """Standard deviations of a robot's errors, and of what its measurement adds.

    Attributes:
        length: displacements of joint frames [m].
        tilt: rotations of joint frames across the joint's axis [rad].
        offset: joint offsets [rad].
        ball: the ball in the last link [m].
        encoder: noise of a joint's reading [rad] or [m].
        play: of the ball in its socket, each coordinate [m].
    """

    length: float = 3.0e-4
    tilt: float = 1.0e-3
    offset: float = 3.0e-3
    ball: float = 2.0e-3
    encoder: float = 0.0
    play: float = 1.0e-4


def robot_with_errors(
    robot: Robot, errors: Errors, rng: np.random.Generator,
    corrections: Mapping[str, float] | None = None,
) -> tuple[Robot, dict[str, float]]:  # fmt: skip
    """A robot as it might come from the factory.

    Args:
        robot: nominal.
        errors: their sizes.
        rng: random numbers.
        corrections: deviations of its joints, as from `deflection_names`.

    Returns:
        The robot and its true parameters, named as those of `robot_chain`.
    """
    chain = robot_chain(robot)
    values = {}
    for name, nominal in zip(chain.parameters, chain.nominal, strict=True):
        kind, _, joint = name.partition(".")
        size = errors.length if kind[0] == "t" else errors.offset if kind == "rz" else errors.tilt
        if joint == "tool":
            size = errors.ball
        values[name] = float(nominal + size * rng.standard_normal())
    return corrected_robot(robot, values, corrections or {}), values


def simulated_sockets(
    robot: Robot, places: Mapping[str, Sequence[float]], rows: int, errors: Errors,
    rng: np.random.Generator, distance: float = 0.050, limit: float = 2.8,
    idle: int | None = None,
) -> tuple[Socket, ...]:  # fmt: skip
    """Postures of a robot with its ball in two sockets at every place.

    Args:
        robot: true, with errors.
        places: name -> (3,) place of the first socket in the base frame [m]; the second one lies
            beside it in y.
        rows: postures per socket.
        errors: noise of the encoders and play of the ball.
        rng: random numbers.
        distance: of the two sockets [m].
        limit: of the joints' angles to either side [rad].
        idle: column of a joint that stays at 0.3 rad; None for none.

    Returns:
        The sockets.

    Raises:
        InputError: too few postures reach a place.
    """
    made = []
    for place, first in places.items():
        for hole in (0, 1):
            middle = np.asarray(first, float) + [0.0, hole * distance, 0.0]
            joints = _postures(robot, middle, rows, errors, rng, limit, place, idle)
            joints = joints + errors.encoder * rng.standard_normal(joints.shape)
            if idle is not None:
                joints[:, idle] = _IDLE
            path = Path(place) / f"hole_{hole}.csv"
            made.append(Socket(place, hole, path, joints, np.arange(1, rows + 1)))
    return tuple(made)


def save_sockets(sockets: Sequence[Socket], folder: Path) -> None:
    """Write sockets as `PLACE/hole_N.csv`, rows of joint angles [rad]."""
    for socket in sockets:
        path = folder / socket.place / f"hole_{socket.hole}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, socket.joints, delimiter=",", fmt="%.9f")


def _postures(
    robot: Robot, middle: np.ndarray, rows: int, errors: Errors, rng: np.random.Generator,
    limit: float, place: str, idle: int | None,
) -> np.ndarray:  # fmt: skip
    """(rows, k) encoder readings that bring the ball into a socket."""
    found: list[np.ndarray] = []
    for _ in range(_TRIES):
        start = rng.uniform(-limit, limit, (4 * rows, len(robot.joints)))
        if idle is not None:
            start[:, idle] = _IDLE
        near = np.linalg.norm(robot_poses(robot, start).position - middle, axis=1)
        start = start[np.argsort(near)[: 2 * rows]]
        targets = middle + errors.play * rng.standard_normal((len(start), 3))
        reached = joints_for_places(robot, targets, start, idle=idle)
        good = (reached.missed < _REACHED) & (np.abs(reached.joints).max(axis=1) < limit)
        found += list(reached.joints[good])
        if len(found) >= rows:
            return np.array(found[:rows])
    raise InputError(f"place {place}", f"{robot.name} does not reach {middle.round(3).tolist()} m")
