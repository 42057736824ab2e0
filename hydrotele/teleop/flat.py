"""Named tuples of arrays that lie one after the other in memory.

So a state can be logged in one go, and handed to a compiled function as one array: what a call of a
compiled function costs grows with the number of arrays that it is given. Next to each such type is
a compiled `unpack_...` that shows the parts of the one array again.
"""

from typing import Any, TypeVar

import numpy as np

Kind = TypeVar("Kind", bound=tuple[Any, ...])


def flat_state(kind: type[Kind], shapes: list[tuple[int, ...]]) -> Kind:
    """A named tuple of zero arrays that are neighbours in memory.

    Args:
        kind: a NamedTuple type of arrays.
        shapes: theirs, in order.

    Returns:
        The tuple; `flat_view` shows it as one array.
    """
    sizes = [int(np.prod(shape)) for shape in shapes]
    whole = np.zeros(sum(sizes))
    ends = np.cumsum(sizes)
    return kind(*(
        whole[end - size : end].reshape(shape)
        for end, size, shape in zip(ends, sizes, shapes, strict=True)
    ))  # fmt: skip


def flattened(parts: Kind) -> Kind:
    """The same tuple with copies of its arrays as neighbours in memory, as floats."""
    arrays = [np.asarray(part, float) for part in parts]
    made = flat_state(type(parts), [array.shape for array in arrays])
    for place, array in zip(made, arrays, strict=True):
        place[...] = array
    return made


def flat_view(parts: tuple[Any, ...]) -> np.ndarray:
    """The memory of a `flat_state` as one array."""
    base = parts[0].base
    return base if base.ndim == 1 else base.base
