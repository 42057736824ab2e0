"""Kinematics of a closed chain: all joints from some of them, all assemblies, Jacobians.

Which way is forward is the caller's choice: positions of drives give those of a platform, the six
coordinates of a platform give those of its drives.
"""

from collections.abc import Sequence

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.multibody.chain import Chain
from hydrotele.multibody.closures import (
    CLOSED,
    check_determined,
    close_from,
    close_near,
    loop_space,
    motion_basis,
)
from hydrotele.multibody.tree_motion import move_tree, new_frames

_STRIDE = 0.1  # rad or m, to which the given joints move at once
_LONGEST = 1.5  # rad or m, that a joint moves in one round of a search from far off
_SAME = 1e-6  # m and 1, by which places and orientations of one assembly differ at most
_WHERE = "kinematics"


def joint_positions(
    chain: Chain, given: Sequence[str], position: np.ndarray, start: np.ndarray | None = None,
    seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Positions of all joints along a motion of some.

    Newton's method from the row before; where that fails, that one of all assemblies which is
    nearest to the row before.

    Args:
        chain: the chain.
        given: the k joints whose positions are known; the closures must determine the others.
        position: (n, k) [rad] or [m].
        start: (v,) positions from which to go to the first row; the chain's by default.
        seed: of the search for all assemblies.

    Returns:
        (n, v) [rad] or [m].

    Raises:
        InputError: shapes do not fit, a value is missing, the closures do not determine the other
            joints, or a row cannot be reached.

    Source: Merlet 2006, Parallel robots, 4.5; Abdellatif 2008, section 4.1.
    """
    columns = np.array([chain.index(name) for name in given], np.int64)
    table = np.ascontiguousarray(position, np.float64)
    if table.ndim != 2 or table.shape[1] != len(columns):
        raise InputError(_WHERE, f"positions must be (n, {len(columns)}), got {table.shape}")
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0, 0])
        raise InputError(_WHERE, f"row {row} has no position of every given joint")
    others = np.setdiff1d(np.arange(len(chain.joints)), columns)
    q = np.array(chain.start if start is None else start, float)
    if not close_from(chain.tree, q, np.arange(len(q)), CLOSED, np.inf) < CLOSED:
        raise InputError(
            _WHERE, f"the loops of {chain.name} cannot be closed from where they start"
        )
    check_determined(chain, q, columns)
    out, first = np.empty((len(table), len(q))), 0
    while first < len(table):
        failed = _follow(chain.tree, columns, table[first:], others, q, out[first:])
        if failed < 0:
            break
        first += failed
        last = out[first - 1] if first else np.array(chain.start, float)
        found = assemblies(chain, given, table[first], seed=seed)
        if not len(found):
            raise InputError(
                _WHERE, f"row {first}: the loops of {chain.name} cannot be closed there"
            )
        q = found[np.argmin(np.linalg.norm(found - last, axis=1))].copy()
        out[first] = q
        first += 1
    return out


@compiled
def _follow(tree, given, position, others, q, out):
    """Fill joint positions row by row; the row that failed, or -1."""
    space = loop_space(tree, len(others), 1)
    for row in range(len(position)):
        far = 0.0
        for i in range(len(given)):
            far = max(far, abs(position[row, i] - q[given[i]]))
        steps = max(1, int(np.ceil(far / _STRIDE)))
        for step in range(steps, 0, -1):
            for i in range(len(given)):
                q[given[i]] += (position[row, i] - q[given[i]]) / step
            if not close_near(tree, q, others, space):
                return row
        out[row] = q
    return -1


def assemblies(
    chain: Chain, given: Sequence[str], position: np.ndarray, *, body: str | None = None,
    starts: int = 400, seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """All ways to assemble a chain in which some joints have given positions.

    Newton's method from random positions: what is found exists, but nothing proves that there is
    no more. A Stewart-Gough platform has up to 40.

    Args:
        chain: the chain.
        given: the k joints whose positions are known.
        position: (k,) [rad] or [m].
        body: assemblies that differ in the pose of this body only count; all bodies' by default.
        starts: random positions from which to search.
        seed: of these.

    Returns:
        (s, v) joint positions, hinges within -pi .. pi of the chain's start; nearest to it first.

    Source: Merlet 2006, Parallel robots, 4.1 (number of solutions).
    """
    columns = np.array([chain.index(name) for name in given], np.int64)
    others = np.setdiff1d(np.arange(len(chain.joints)), columns)
    slides, rng = chain.tree.slides, np.random.default_rng(seed)
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
        if not close_from(chain.tree, q, others, CLOSED, _LONGEST) < CLOSED:
            continue
        q = np.where(slides, q, (q - chain.start + np.pi) % (2.0 * np.pi) - np.pi + chain.start)
        shape = _shape(chain, q, body)
        if all(np.abs(shape - other).max() > _SAME for other in shapes):
            shapes.append(shape)
            found.append(q)
    found.sort(key=lambda q: float(np.linalg.norm(q - chain.start)))
    return np.array(found).reshape(-1, len(chain.joints))


def _shape(chain: Chain, q: np.ndarray, body: str | None) -> np.ndarray:
    """Places and orientations of bodies as one vector."""
    frames, still = new_frames(chain.tree), np.zeros(len(q))
    move_tree(chain.tree, q, still, still, np.zeros(3), frames)
    some = slice(1, None) if body is None else chain.bodies.index(body) + 1
    return np.concatenate([frames.place[some].ravel(), frames.turn[some].ravel()])


def jacobian(
    chain: Chain, q: np.ndarray, outputs: Sequence[str], inputs: Sequence[str]
) -> np.ndarray:
    """Rates of some joints per unit rate of others.

    Args:
        chain: the chain.
        q: (v,) positions in which its loops are closed [rad] or [m].
        outputs: the m joints whose rates are asked for.
        inputs: the n independent joints.

    Returns:
        (m, n), with `rates[outputs] = J rates[inputs]`.

    Source: Merlet 2006, Parallel robots, 5.1.
    """
    places = np.array([chain.index(name) for name in inputs], np.int64)
    return motion_basis(chain, q, places)[[chain.index(name) for name in outputs]]
