"""Number of kinematic parameters of serial and parallel mechanisms: formulas and numerical rank.

The formulas count the parameters that a calibration can identify if the pose of one body is
measured. The numerical rank is an independent check: every link of a mechanism with arbitrary
dimensions gets an error in all six directions, and the rank of the identification Jacobian is the
number of identifiable parameters.

Source: Wang 2012, Eqs 4 and 5 (pages 23 and 24), after Mooring, Roth and Driels 1991 and Vischer
1996; P. Vischer and R. Clavel, Kinematic calibration of the parallel Delta robot, Robotica 16
(1998) 207-218 (the Delta robot's 54 parameters).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

JointKind = Literal["revolute", "prismatic", "spherical"]
MAX_CLOSURE_ERROR = 1e-12  # m and rad: rounding of a product of seven transforms of order 1
MIN_SINGULAR_VALUE = 1e-7  # relative to the largest: far above rounding, far below full rank's
_SUBSPACES = {
    "revolute": np.eye(6)[:, 2:3], "prismatic": np.eye(6)[:, 5:6], "spherical": np.eye(6)[:, :3]
}  # fmt: skip


def count_serial_parameters(revolute: int, prismatic: int, pose: int = 6) -> int:
    """Count the identifiable kinematic parameters of a serial robot: C = 4 R + 2 P + T (Wang 2012, Eq. 4).

    Args:
        revolute: number of revolute joints, R.
        prismatic: number of prismatic joints, P.
        pose: number of measured coordinates of the end effector's pose, T.

    Returns:
        C.

    >>> count_serial_parameters(revolute=6, prismatic=0)
    30
    """
    return 4 * revolute + 2 * prismatic + pose


def count_parallel_parameters(
    *, revolute: int, prismatic: int, spherical_pairs: int, encoders: int, loops: int, frames: int
) -> int:
    """Count the identifiable kinematic parameters of a mechanism with closed loops (Wang 2012, Eq. 5).

    C = 3 R + P + SS + E + 6 L + 6 (F - 1). Without loops, with all joints measured and two frames
    this is `count_serial_parameters` with T = 6.

    Args:
        revolute: number of revolute joints, R.
        prismatic: number of prismatic joints, P.
        spherical_pairs: number of pairs of spherical joints that one rigid link connects, SS.
        encoders: number of measured joints, E.
        loops: number of independent loops, L.
        frames: number of arbitrarily located frames, F: 2 for a frame of the measuring instrument
            and one of the measured body.

    Returns:
        C.

    The Delta robot: three measured revolute joints and six rods between spherical joints.

    >>> count_parallel_parameters(
    ...     revolute=3, prismatic=0, spherical_pairs=6, encoders=3, loops=5, frames=2)
    54
    """
    joints = 3 * revolute + prismatic + spherical_pairs + encoders
    return joints + 6 * loops + 6 * (frames - 1)


class Joint(NamedTuple):
    """A joint of a chain.

    Attributes:
        name: name of the joint; joints with the same name in several chains are one joint.
        kind: kind of the joint.
        measured: whether it has an encoder.
    """

    name: str
    kind: JointKind
    measured: bool = False


class Chain(NamedTuple):
    """Alternating links and joints, from the fixed frame to the frame of the measured body.

    Attributes:
        links: n + 1 names; links with the same name in several chains are one link.
        joints: n joints; joint k is between link k and link k + 1.
    """

    links: tuple[str, ...]
    joints: tuple[Joint, ...]


@dataclass(frozen=True)
class Mechanism:
    """A mechanism whose chains all end at the measured body.

    Attributes:
        name: name of the mechanism, such as `6-UPS`.
        chains: at least one chain.
        straight_links: names of links that place the next joint on the z axis of the joint before, with
            parallel axes; all others have arbitrary dimensions.
    """

    name: str
    chains: tuple[Chain, ...]
    straight_links: frozenset[str] = frozenset()

    @property
    def joints(self) -> dict[str, Joint]:
        """All joints by name."""
        return {joint.name: joint for chain in self.chains for joint in chain.joints}

    def count_parameters(self) -> int:
        """Count the parameters by `count_parallel_parameters`; each chain after the first closes one loop."""
        kinds = [joint.kind for joint in self.joints.values()]
        pairs = {(one.name, two.name) for chain in self.chains
                 for one, two in pairwise(chain.joints)
                 if one.kind == two.kind == "spherical"}  # fmt: skip
        return count_parallel_parameters(
            revolute=kinds.count("revolute"), prismatic=kinds.count("prismatic"),
            spherical_pairs=len(pairs), encoders=sum(j.measured for j in self.joints.values()),
            loops=len(self.chains) - 1, frames=2,
        )  # fmt: skip


def serial_mechanism(name: str, kinds: tuple[JointKind, ...]) -> Mechanism:
    """Build the mechanism of a serial robot from the kinds of its joints, all with an encoder."""
    joints = tuple(Joint(f"joint{k}", kind, True) for k, kind in enumerate(kinds))
    return Mechanism(name, (Chain(tuple(f"link{k}" for k in range(len(kinds) + 1)), joints),))


def hexapod_mechanism(name: str, kinds: tuple[JointKind, ...], straight: tuple[int, ...] = ()) -> Mechanism:
    """Build the mechanism of a hexapod: six equal legs whose prismatic joints have encoders.

    Args:
        name: name of the mechanism.
        kinds: kinds of a leg's joints, from the base to the platform.
        straight: indices of a leg's links that connect two collinear joint axes.

    Returns:
        The mechanism.
    """
    chains = tuple(
        Chain(tuple(f"link{leg}.{k}" for k in range(len(kinds) + 1)),
              tuple(Joint(f"joint{leg}.{k}", kind, kind == "prismatic")
                    for k, kind in enumerate(kinds)))
        for leg in range(6)
    )  # fmt: skip
    return Mechanism(name, chains, frozenset(f"link{leg}.{k}" for leg in range(6) for k in straight))


def delta_mechanism() -> Mechanism:
    """Build the mechanism of a Delta robot: three measured arms, each with two rods between spherical joints."""
    chains = tuple(
        Chain((f"base{arm}", f"arm{arm}.{rod}", f"rod{arm}.{rod}", f"platform{arm}.{rod}"),
              (Joint(f"arm{arm}", "revolute", True), Joint(f"lower{arm}.{rod}", "spherical"),
               Joint(f"upper{arm}.{rod}", "spherical")))
        for arm in range(3) for rod in range(2)
    )  # fmt: skip
    return Mechanism("Delta", chains)


def identifiable_rank(
    mechanism: Mechanism, rng: np.random.Generator, poses: int = 60, motion: float = 0.4,
    fixed_joints: frozenset[str] = frozenset(),
) -> int:  # fmt: skip
    """Compute the number of identifiable parameters as the rank of a Jacobian at random poses.

    At each pose the errors of links x and of passive joints y satisfy P x + Q y = e, six equations
    per chain. Here e are the errors of the measured pose. The columns of y are eliminated. The rank
    of the remaining P, stacked over the poses, is the number of identifiable parameters.

    Args:
        mechanism: mechanism; its links get dimensions of about 1 m.
        rng: random generator of dimensions and poses.
        poses: number of poses.
        motion: maximum random motion of a joint [m] or [rad], before the loops are closed.
        fixed_joints: names of joints that do not move, to test a poor choice of poses.

    Returns:
        The number of parameters that measured poses and encoder readings determine.
    """
    links, state = _arbitrary_geometry(mechanism, rng)
    passive = [name for name, joint in mechanism.joints.items() if not joint.measured]
    blocks = []
    for _ in range(poses):
        moved = _move_joints(mechanism, state, rng, motion, fixed_joints)
        moved = _close_loops(mechanism, links, moved, fixed_joints)
        by_link, by_joint = _end_jacobians(mechanism, links, moved, list(links), passive)
        if passive:
            by_link = null_space(by_joint.T, rcond=MIN_SINGULAR_VALUE).T @ by_link
        blocks.append(by_link)
    singular = np.linalg.svd(np.vstack(blocks), compute_uv=False)
    return int(np.sum(singular > MIN_SINGULAR_VALUE * singular[0]))


def _arbitrary_geometry(
    mechanism: Mechanism, rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Generate random transforms (4, 4) of links and joints, by name, for which all loops are closed."""
    links, state = {}, {}
    for name, joint in mechanism.joints.items():
        state[name] = _pose_from_rotation_and_shift(_SUBSPACES[joint.kind] @ _random_coordinates(rng, joint.kind, 1.0))
    for chain in mechanism.chains:
        for link in chain.links:
            twist = np.r_[rng.uniform(-1.0, 1.0, 3), rng.uniform(-0.5, 0.5, 3)]
            if link in mechanism.straight_links:
                twist = np.array([0, 0, 0, 0, 0, 0.7])
            links.setdefault(link, _pose_from_rotation_and_shift(twist))
    goal = _chain_pose(mechanism.chains[0], links, state)
    for chain in mechanism.chains[1:]:
        end = np.linalg.inv(_chain_pose(chain, links, state)) @ goal
        links[chain.links[-1]] = links[chain.links[-1]] @ end
    return links, state


def _random_coordinates(rng: np.random.Generator, kind: JointKind, size: float) -> np.ndarray:
    return rng.uniform(-size, size, _SUBSPACES[kind].shape[1])


def _move_joints(mechanism, state, rng, motion, unmoved) -> dict[str, np.ndarray]:
    return {
        name: state[name] if name in unmoved
        else state[name]
        @ _pose_from_rotation_and_shift(_SUBSPACES[joint.kind] @ _random_coordinates(rng, joint.kind, motion))
        for name, joint in mechanism.joints.items()
    }  # fmt: skip


def _close_loops(mechanism, links, state, unmoved) -> dict[str, np.ndarray]:
    """Change all joints except `unmoved` by Gauss-Newton steps until all chains end at the same pose.

    Raises:
        ValueError: the loops do not close within 60 steps.
    """
    free = [name for name in mechanism.joints if name not in unmoved]
    first = mechanism.chains[0]
    for _ in range(60):
        goal = _chain_pose(first, links, state)
        errors = [_pose_error(_chain_pose(chain, links, state), goal)
                  for chain in mechanism.chains[1:]]  # fmt: skip
        if not errors or np.abs(errors).max() < MAX_CLOSURE_ERROR:
            return state
        _, by_joint = _end_jacobians(mechanism, links, state, [], free)
        relative = by_joint[6:] - np.tile(by_joint[:6], (len(mechanism.chains) - 1, 1))
        step = -np.linalg.lstsq(relative, np.concatenate(errors), rcond=1e-9)[0]
        step *= min(1.0, 0.5 / np.abs(step).max())
        state, at = dict(state), 0
        for name in free:
            subspace = _SUBSPACES[mechanism.joints[name].kind]
            size = subspace.shape[1]
            state[name] = state[name] @ _pose_from_rotation_and_shift(subspace @ step[at : at + size])
            at += size
    raise ValueError(f"mechanism {mechanism.name}: the loops do not close: use a smaller motion")


def _chain_pose(chain: Chain, links: Mapping, state: Mapping) -> np.ndarray:
    pose = links[chain.links[0]]
    for joint, link in zip(chain.joints, chain.links[1:], strict=True):
        pose = pose @ state[joint.name] @ links[link]
    return pose


def _end_jacobians(
    mechanism: Mechanism, links: Mapping, state: Mapping, link_names: list[str],
    joint_names: list[str],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Compute the derivatives of each chain's end pose by link errors and joint coordinates.

    Returns:
        ((6 chains, 6 links), (6 chains, joint coordinates)): six rows per chain, a twist (rotation,
        translation) in the fixed frame. An error of a link is a twist in the frame at its end.
    """
    joints = mechanism.joints
    sizes = [_SUBSPACES[joints[name].kind].shape[1] for name in joint_names]
    start = dict(zip(joint_names, np.cumsum(sizes) - sizes, strict=True))
    by_link = np.zeros((6 * len(mechanism.chains), 6 * len(link_names)))
    by_joint = np.zeros((6 * len(mechanism.chains), sum(sizes)))
    for number, chain in enumerate(mechanism.chains):
        rows, pose = slice(6 * number, 6 * number + 6), np.eye(4)
        for link, joint in zip(chain.links, (*chain.joints, None), strict=True):
            pose = pose @ links[link]
            if link in link_names:
                at = 6 * link_names.index(link)
                by_link[rows, at : at + 6] = _adjoint(pose)
            if joint is None:
                continue
            pose = pose @ state[joint.name]
            if joint.name in start:
                columns = _adjoint(pose) @ _SUBSPACES[joint.kind]
                at = start[joint.name]
                by_joint[rows, at : at + columns.shape[1]] = columns
    return by_link, by_joint


def _pose_error(pose: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the twist in the fixed frame that moves `goal` to `pose`, to first order."""
    away = pose @ np.linalg.inv(goal)
    return np.r_[Rotation.from_matrix(away[:3, :3]).as_rotvec(), away[:3, 3]]


def _adjoint(pose: np.ndarray) -> np.ndarray:
    """Return the (6, 6) transform of twists (rotation, translation) from body to fixed frame."""
    x, y, z = pose[:3, 3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = pose[:3, :3]
    result[3:, :3] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pose[:3, :3]
    return result


def _pose_from_rotation_and_shift(twist: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) with the rotation vector `twist[:3]` and the translation `twist[3:]`."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    pose[:3, 3] = twist[3:]
    return pose
