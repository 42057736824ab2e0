"""Vectors of three and rotations as tuples of numbers, which compiled code keeps off the heap."""

import math

from hydrotele.core.compiled import lean


@lean
def vector(rows, k):
    """Row k of (n, 3) rows as a tuple (x, y, z)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@lean
def put(rows, k, a):
    """Write a tuple (x, y, z) into row k of (n, 3) rows."""
    rows[k, 0], rows[k, 1], rows[k, 2] = a


@lean
def add(a, b):
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@lean
def less(a, b):
    """Difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@lean
def times(s, a):
    """A vector times a number."""
    return s * a[0], s * a[1], s * a[2]


@lean
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@lean
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@lean
def swept(w, dw, arm):
    """Acceleration `dw x r + w x (w x r)` of a point at an arm r of a turning body."""
    return add(cross(dw, arm), cross(w, cross(w, arm)))


@lean
def rotation(rows, k):
    """Matrix k of (n, 3, 3) as three row vectors."""
    m = rows[k]
    return (
        (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    )  # fmt: skip


@lean
def put_rotation(rows, k, r):
    """Write three row vectors into matrix k of (n, 3, 3)."""
    m = rows[k]
    m[0, 0], m[0, 1], m[0, 2] = r[0]
    m[1, 0], m[1, 1], m[1, 2] = r[1]
    m[2, 0], m[2, 1], m[2, 2] = r[2]


@lean
def turned(r, a):
    """A vector turned by a rotation."""
    return dot(r[0], a), dot(r[1], a), dot(r[2], a)


@lean
def turned_back(r, a):
    """A vector turned by the inverse of a rotation."""
    return add(add(times(a[0], r[0]), times(a[1], r[1])), times(a[2], r[2]))


@lean
def after(r, s):
    """The rotation that first does s, then r."""
    return turned_back(s, r[0]), turned_back(s, r[1]), turned_back(s, r[2])


@lean
def about(axis, angle):
    """Rotation about a unit axis by an angle [rad] (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    d = 1.0 - c
    return (
        (c + x * x * d, x * y * d - z * s, x * z * d + y * s),
        (y * x * d + z * s, c + y * y * d, y * z * d - x * s),
        (z * x * d - y * s, z * y * d + x * s, c + z * z * d),
    )
