"""Named tuples of arrays in one contiguous block of memory, which compiled functions receive as a single array.

The call overhead of a compiled function grows with the number of array arguments. Each type of state
has a compiled `unpack_...` function that returns the parts of the array, in their order.
"""

from typing import Any, TypeVar

import numpy as np

from hydrotele.core.compiled import compiled

StateType = TypeVar("StateType", bound=tuple[Any, ...])


def make_contiguous_state(kind: type[StateType], shapes: list[tuple[int, ...]]) -> StateType:
    """Create a named tuple of zero arrays that together are one contiguous block of memory.

    Args:
        kind: NamedTuple type of arrays.
        shapes: shapes of the arrays, in order.

    Returns:
        The tuple; `flat_view` returns its memory as one array.
    """
    sizes = [int(np.prod(shape)) for shape in shapes]
    whole = np.zeros(sum(sizes))
    ends = np.cumsum(sizes)
    return kind(*(
        whole[end - size : end].reshape(shape)
        for end, size, shape in zip(ends, sizes, shapes, strict=True)
    ))  # fmt: skip


def copy_to_contiguous_state(parts: StateType) -> StateType:
    """Copy a named tuple of arrays, as floats, into one contiguous block of memory.

    Returns:
        A tuple of the same type and shapes; `flat_view` returns its memory as one array.
    """
    arrays = [np.asarray(part, float) for part in parts]
    made = make_contiguous_state(type(parts), [array.shape for array in arrays])
    for place, array in zip(made, arrays, strict=True):
        place[...] = array
    return made


def flat_view(parts: tuple[Any, ...]) -> np.ndarray:
    """Return the memory of a tuple of `make_contiguous_state` or `copy_to_contiguous_state` as one 1-D array.

    It is a view: changes of the array change the parts of the tuple.
    """
    base = parts[0].base
    return base if base.ndim == 1 else base.base


@compiled
def split_array(flat, size):
    """Return views of the first `size` elements of an array and of the remaining ones."""
    return flat[:size], flat[size:]
