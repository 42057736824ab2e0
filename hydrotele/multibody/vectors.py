"""Vectors of three and rotations as tuples of numbers, and least squares of a few columns.

Tuples keep compiled code off the heap; the least squares need no memory of their own, so that both
serve row after row of a log.
"""

import math

from hydrotele.core.compiled import allocation_free


@allocation_free
def vector(rows, k):
    """Row k of (n, 3) rows as a tuple (x, y, z)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@allocation_free
def store(rows, k, a):
    """Write a tuple (x, y, z) into row k of (n, 3) rows."""
    rows[k, 0], rows[k, 1], rows[k, 2] = a


@allocation_free
def add(a, b):
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@allocation_free
def subtract(a, b):
    """Difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@allocation_free
def scaled(s, a):
    """A vector times a number."""
    return s * a[0], s * a[1], s * a[2]


@allocation_free
def dot(a, b):
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@allocation_free
def cross(a, b):
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@allocation_free
def rotating_acceleration(w, dw, arm):
    """Acceleration `dw x r + w x (w x r)` of a point at an arm r of a turning body."""
    return add(cross(dw, arm), cross(w, cross(w, arm)))


@allocation_free
def rotation(rows, k):
    """Matrix k of (n, 3, 3) as three row vectors."""
    m = rows[k]
    return (
        (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    )  # fmt: skip


@allocation_free
def store_rotation(rows, k, r):
    """Write three row vectors into matrix k of (n, 3, 3)."""
    m = rows[k]
    m[0, 0], m[0, 1], m[0, 2] = r[0]
    m[1, 0], m[1, 1], m[1, 2] = r[1]
    m[2, 0], m[2, 1], m[2, 2] = r[2]


@allocation_free
def rotated(r, a):
    """A vector turned by a rotation."""
    return dot(r[0], a), dot(r[1], a), dot(r[2], a)


@allocation_free
def rotated_back(r, a):
    """A vector turned by the inverse of a rotation."""
    return add(add(scaled(a[0], r[0]), scaled(a[1], r[1])), scaled(a[2], r[2]))


@allocation_free
def composed(r, s):
    """The rotation that first does s, then r."""
    return rotated_back(s, r[0]), rotated_back(s, r[1]), rotated_back(s, r[2])


@allocation_free
def axis_rotation(axis, angle):
    """Rotation about a unit axis by an angle [rad] (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    d = 1.0 - c
    return (
        (c + x * x * d, x * y * d - z * s, x * z * d + y * s),
        (y * x * d + z * s, c + y * y * d, y * z * d - x * s),
        (z * x * d - y * s, z * y * d + x * s, c + z * z * d),
    )


_STIFF = 1e-7  # least ratio of a column's own part to the largest column; below, rank is lacking


@allocation_free
def qr_factor(matrix, columns, q, r):
    """QR of chosen columns by modified Gram-Schmidt, twice; False if they lack rank."""
    rows, count, size = len(matrix), len(columns), 0.0
    for j in range(count):
        total = 0.0
        for m in range(rows):
            q[m, j] = matrix[m, columns[j]]
            total += q[m, j] ** 2
        size = max(size, math.sqrt(total))
    for j in range(count):
        for i in range(j):
            r[i, j] = 0.0
        for _ in range(2):
            for i in range(j):
                along = 0.0
                for m in range(rows):
                    along += q[m, i] * q[m, j]
                r[i, j] += along
                for m in range(rows):
                    q[m, j] -= along * q[m, i]
        total = 0.0
        for m in range(rows):
            total += q[m, j] ** 2
        r[j, j] = math.sqrt(total)
        if not r[j, j] > _STIFF * size:
            return False
        for m in range(rows):
            q[m, j] /= r[j, j]
    return True


@allocation_free
def qr_solve(q, r, count, right, column, answer, k):
    """Least squares after `_factor`, of one column of the right side into one of the answer."""
    for j in range(count - 1, -1, -1):
        total = 0.0
        for m in range(len(right)):
            total += q[m, j] * right[m, column]
        for i in range(j + 1, count):
            total -= r[j, i] * answer[i, k]
        answer[j, k] = total / r[j, j]
