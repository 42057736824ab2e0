"""Kinematics of closed chains, for the forward and the inverse problem.

Positions of all joints from some of them, all assemblies, and Jacobians.
"""

from collections.abc import Sequence

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.closures import (
    CLOSURE_TOLERANCE,
    close_loops_from,
    close_loops_near,
    evaluate_loop_residuals,
    find_undetermined_joints,
    make_loop_workspace,
    motion_basis,
)
from hydrotele.multibody.tree_motion import allocate_frames, compute_frames

_ERROR_CONTEXT = "closures"
_MAX_GIVEN_STEP = 0.1  # rad or m, maximum step of the given joints
_MAX_ITERATION_STEP = 1.5  # rad or m, maximum joint step per iteration from a distant position
_ASSEMBLY_TOLERANCE = 1e-6  # m and 1, maximum difference of positions and orientations of equal assemblies
_KINEMATICS_CONTEXT = "kinematics"
_START_SEARCHES = 100  # random starts of the search for assemblies at the first row
_MAX_SHOWN_POSES = 4  # assemblies listed in a message
_OPENING_SEARCHES = 8  # starts of the search for the smallest opening


def find_start_pose(
    chain: Chain, given: Sequence[str], position: np.ndarray, start: np.ndarray | None = None, seed: int = 0
) -> np.ndarray:
    """Return a pose with closed loops from which the motion of the given joints can be followed.

    The function first closes the loops from the start pose by moving all joints, and returns that
    pose. If the loops do not close, or the given joints and the closures do not determine all other
    joints there, it searches for poses (assemblies) that close the loops at the first row of
    `position`. Exactly one of these may determine all joints; it is returned.

    Args:
        chain: the chain.
        given: the k joints with known positions.
        position: (n, k) their positions [rad] or [m].
        start: (v,) start pose; that of the chain by default.
        seed: seed of the search for all assemblies.

    Returns:
        (v,) positions of all joints [rad] or [m].

    Raises:
        InputError: the loops cannot be closed at the first row or in several ways, or the closures
            do not determine the other joints at any of these poses; the message names the closure,
            its opening and the joints.
    """
    columns = np.array([chain.index(name) for name in given], np.int64)
    begin = np.array(chain.start if start is None else start, float)
    q, undetermined = begin.copy(), ()
    if close_loops_from(chain.tree, q, np.arange(len(q)), CLOSURE_TOLERANCE, np.inf) < CLOSURE_TOLERANCE:
        undetermined = find_undetermined_joints(chain, q, columns)
        if not undetermined:
            return q
    if len(chain.closures) and len(position):
        poses = find_assemblies(chain, given, position[0], starts=_START_SEARCHES, seed=seed)
        if not len(poses):
            raise InputError(chain.source or _KINEMATICS_CONTEXT, describe_unclosed_loop(chain, given, position[0], 0))
        regular = [pose for pose in poses if not find_undetermined_joints(chain, pose, columns)]
        if len(regular) == 1:
            return regular[0]
        if regular:
            raise InputError(chain.source or _KINEMATICS_CONTEXT, _describe_ambiguous_assemblies(chain, begin, regular))
    raise InputError(
        chain.source or _ERROR_CONTEXT, f"neither given nor determined by a closure: {', '.join(undetermined)}"
    )


def describe_unclosed_loop(chain: Chain, given: Sequence[str], position: np.ndarray, row: int) -> str:
    """Describe, for an error message, which loop stays open at given joint positions, and by how much.

    Args:
        chain: the chain.
        given: the k joints with known positions.
        position: (k,) their positions [rad] or [m].
        row: index of the row of the log, for the message.

    Returns:
        The message: the row, the closure with the largest opening at the best approximation, the
        opening in mm, and what to do.
    """
    from scipy.optimize import least_squares  # imported here, because it is slow and only errors need it

    columns = np.array([chain.index(name) for name in given], np.int64)
    others = np.setdiff1d(np.arange(len(chain.joints)), columns)
    q, rng = np.array(chain.start, float), np.random.default_rng(0)
    q[columns] = position

    def residual(x: np.ndarray) -> np.ndarray:
        q[others] = x
        return evaluate_loop_residuals(chain.tree, q)[0][:, 0]

    starts = [chain.start[others] + k * rng.uniform(-1.0, 1.0, len(others)) for k in range(_OPENING_SEARCHES)]
    q[others] = min((least_squares(residual, x) for x in starts), key=lambda one: one.cost).x
    closure, opening = _largest_opening(chain, q)
    values = ", ".join(
        f"{name} {value:.4g} {'m' if chain.tree.is_slide[j] else 'rad'}"
        for name, value, j in zip(given, position, columns, strict=True)
    )
    return (
        f"row {row}: the loops of {chain.name} cannot be closed at {values}: {closure} stays"
        f" {1e3 * opening:.3g} mm open. Check the unit and zero of these joints and the points of the"
        " closure (an anchor in an MJCF applies to the reference pose; two sites do not), or"
        " add a <keyframe> with a closed pose"
    )


def _largest_opening(chain: Chain, q: np.ndarray) -> tuple[str, float]:
    """Return the name of the closure whose points are farthest apart at a pose, and their distance [m]."""
    left = evaluate_loop_residuals(chain.tree, q)[0][:, 0]
    openings = [float(np.linalg.norm(left[first : first + 3])) for first in chain.tree.first_equation[:-1]]
    worst = int(np.argmax(openings))
    return chain.closures[worst], openings[worst]


def _describe_ambiguous_assemblies(chain: Chain, start: np.ndarray, poses: Sequence[np.ndarray]) -> str:
    """Describe, for an error message, that the loops can be closed in several ways and list these poses."""
    closure, opening = _largest_opening(chain, start)
    state = f"{closure} is {1e3 * opening:.3g} mm open" if opening > CLOSURE_TOLERANCE else "the pose is singular"
    shown = "; or ".join(
        ", ".join(f"{name} {value:.4g}" for name, value in zip(chain.joints, pose, strict=True))
        for pose in poses[:_MAX_SHOWN_POSES]
    )
    return (
        f"at the start pose of {chain.name} {state}, and its loops can be closed in {len(poses)} ways at the first"
        f' row: {shown}. Add the correct one as <keyframe><key qpos="..."/></keyframe>'
    )


def solve_joint_positions(
    chain: Chain, given: Sequence[str], position: np.ndarray, start: np.ndarray | None = None,
    seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Compute the positions of all joints along a given motion of some joints.

    Newton's method starts from the previous row. If it fails, the assembly closest to the previous
    row is used.

    Args:
        chain: the chain.
        given: the k joints with known positions; the closures must determine the others.
        position: (n, k) their positions [rad] or [m].
        start: (v,) initial positions before the first row; those of the chain by default.
        seed: seed of the search for all assemblies.

    Returns:
        (n, v) positions of all joints [rad] or [m].

    Raises:
        InputError: a shape is wrong, a value is missing, the closures do not determine the other
            joints, or a row cannot be reached.

    Source: Merlet 2006, Parallel robots, 4.5; Abdellatif 2008, section 4.1.
    """
    columns = np.array([chain.index(name) for name in given], np.int64)
    table = np.ascontiguousarray(position, np.float64)
    if table.ndim != 2 or table.shape[1] != len(columns):
        raise InputError(_KINEMATICS_CONTEXT, f"positions must be (n, {len(columns)}), got {table.shape}")
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise InputError(_KINEMATICS_CONTEXT, f"row {row} has missing positions of the given joints")
    others = np.setdiff1d(np.arange(len(chain.joints)), columns)
    q = find_start_pose(chain, given, table, start, seed)
    out, first = np.empty((len(table), len(q))), 0
    while first < len(table):
        failed = _close_loops_along_rows(chain.tree, columns, table[first:], others, q, out[first:])
        if failed < 0:
            break
        first += failed
        last = out[first - 1] if first else np.array(chain.start, float)
        found = find_assemblies(chain, given, table[first], seed=seed)
        if not len(found):
            raise InputError(
                chain.source or _KINEMATICS_CONTEXT, describe_unclosed_loop(chain, given, table[first], first)
            )
        q = found[np.argmin(np.linalg.norm(found - last, axis=1))].copy()
        out[first] = q
        first += 1
    return out


@compiled
def _close_loops_along_rows(tree, given, position, others, q, out):
    """Close the loops row by row along given joint positions, each row from the previous one.

    Args:
        tree: Tree.
        given: (k,) indices of the joints with known positions.
        position: (n, k) these positions [rad] or [m].
        others: (v - k,) indices of the joints that may move.
        q: (v,) closed positions before the first row, updated.
        out: (n, v) written: positions of all joints.

    Returns:
        Index of the first row where this fails, or -1.
    """
    space = make_loop_workspace(tree, len(others), 1)
    for row in range(len(position)):
        far = 0.0
        for i in range(len(given)):
            far = max(far, abs(position[row, i] - q[given[i]]))
        steps = max(1, int(np.ceil(far / _MAX_GIVEN_STEP)))
        for step in range(steps, 0, -1):
            for i in range(len(given)):
                q[given[i]] += (position[row, i] - q[given[i]]) / step
            if not close_loops_near(tree, q, others, space):
                return row
        out[row] = q
    return -1


def find_assemblies(
    chain: Chain, given: Sequence[str], position: np.ndarray, *, body: str | None = None,
    starts: int = 400, seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Find all assemblies (poses with closed loops) of a chain for given positions of some joints.

    Newton's method starts from random positions. All returned assemblies exist, but there is no
    proof that the list is complete. A Stewart-Gough platform has up to 40 assemblies.

    Args:
        chain: the chain.
        given: the k joints with known positions.
        position: (k,) their positions [rad] or [m].
        body: only assemblies in which this body has different poses are listed separately; by
            default any body counts.
        starts: number of random start positions.
        seed: seed of the start positions.

    Returns:
        (s, v) joint positions, hinges within -pi .. pi of the start of the chain, sorted by
        distance from it.

    Source: Merlet 2006, Parallel robots, 4.1 (number of solutions).
    """
    columns = np.array([chain.index(name) for name in given], np.int64)
    others = np.setdiff1d(np.arange(len(chain.joints)), columns)
    slides, rng = chain.tree.is_slide, np.random.default_rng(seed)
    reach = float(np.abs(chain.tree.offset).sum(axis=1).max() + np.abs(chain.start[slides]).max(
        initial=0.0))  # fmt: skip
    found: list[np.ndarray] = []
    shapes: list[np.ndarray] = []
    for attempt in range(starts):
        wide = 0.0 if attempt == 0 else (attempt % 4 + 1) / 4.0
        q = np.array(chain.start, float)
        away = rng.uniform(-1.0, 1.0, len(q)) * np.where(slides, reach, np.pi) * wide
        q[others] += away[others]
        q[columns] = position
        if not close_loops_from(chain.tree, q, others, CLOSURE_TOLERANCE, _MAX_ITERATION_STEP) < CLOSURE_TOLERANCE:
            continue
        q = np.where(slides, q, (q - chain.start + np.pi) % (2.0 * np.pi) - np.pi + chain.start)
        shape = _flatten_frames(chain, q, body)
        if all(np.abs(shape - other).max() > _ASSEMBLY_TOLERANCE for other in shapes):
            shapes.append(shape)
            found.append(q)
    found.sort(key=lambda q: float(np.linalg.norm(q - chain.start)))
    return np.array(found).reshape(-1, len(chain.joints))


def _flatten_frames(chain: Chain, q: np.ndarray, body: str | None) -> np.ndarray:
    """Return position [m] and rotation matrix of a body at joint positions q, flattened to one vector.

    If `body` is None, the vector contains all bodies.
    """
    frames, still = allocate_frames(chain.tree), np.zeros(len(q))
    compute_frames(chain.tree, q, still, still, np.zeros(3), frames)
    some = slice(1, None) if body is None else chain.bodies.index(body) + 1
    return np.concatenate([frames.origin[some].ravel(), frames.rotation[some].ravel()])


def joint_jacobian(chain: Chain, q: np.ndarray, outputs: Sequence[str], inputs: Sequence[str]) -> np.ndarray:
    """Return the Jacobian of some joints of a closed chain: their rates per unit rate of the input joints.

    Args:
        chain: the chain.
        q: (v,) positions with closed loops [rad] or [m].
        outputs: the m joints whose rates are returned.
        inputs: the n independent joints.

    Returns:
        (m, n), with `rates[outputs] = J rates[inputs]`.

    Source: Merlet 2006, Parallel robots, 5.1.
    """
    places = np.array([chain.index(name) for name in inputs], np.int64)
    return motion_basis(chain, q, places)[[chain.index(name) for name in outputs]]
