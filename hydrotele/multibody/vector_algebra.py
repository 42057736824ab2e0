"""Vectors, rotations and small least-squares problems for compiled code without allocation.

Three-component vectors and rotations are tuples; the QR least squares of a few columns works in
given arrays.
"""

import math

from hydrotele.core.compiled import compile_without_allocation


@compile_without_allocation
def get_vector(rows, k):
    """Return row k of an (n, 3) array as a tuple (x, y, z)."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@compile_without_allocation
def set_vector(rows, k, a):
    """Write a tuple (x, y, z) into row k of an (n, 3) array."""
    rows[k, 0], rows[k, 1], rows[k, 2] = a


@compile_without_allocation
def add_vectors(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compile_without_allocation
def subtract_vectors(a, b):
    """Return the difference a - b of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compile_without_allocation
def scale_vector(s, a):
    """Return a vector times a scalar."""
    return s * a[0], s * a[1], s * a[2]


@compile_without_allocation
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compile_without_allocation
def cross(a, b):
    """Return the cross product a x b of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compile_without_allocation
def point_acceleration(w, dw, arm):
    """Return the acceleration `dw x r + w x (w x r)` of a body's point relative to the body's origin.

    r = `arm` is the vector from origin to point [m]. w and dw are angular velocity [rad/s] and
    angular acceleration [rad/s^2].
    """
    return add_vectors(cross(dw, arm), cross(w, cross(w, arm)))


@compile_without_allocation
def get_rotation(rows, k):
    """Return matrix k of an (n, 3, 3) array as three row vectors."""
    m = rows[k]
    return (
        (m[0, 0], m[0, 1], m[0, 2]), (m[1, 0], m[1, 1], m[1, 2]), (m[2, 0], m[2, 1], m[2, 2])
    )  # fmt: skip


@compile_without_allocation
def set_rotation(rows, k, r):
    """Write three row vectors into matrix k of an (n, 3, 3) array."""
    m = rows[k]
    m[0, 0], m[0, 1], m[0, 2] = r[0]
    m[1, 0], m[1, 1], m[1, 2] = r[1]
    m[2, 0], m[2, 1], m[2, 2] = r[2]


@compile_without_allocation
def rotate_vector(r, a):
    """Return the vector a, rotated by the rotation matrix r (three row vectors)."""
    return dot(r[0], a), dot(r[1], a), dot(r[2], a)


@compile_without_allocation
def rotate_vector_back(r, a):
    """Return the vector a, rotated by the inverse (transpose) of the rotation matrix r."""
    return add_vectors(add_vectors(scale_vector(a[0], r[0]), scale_vector(a[1], r[1])), scale_vector(a[2], r[2]))


@compile_without_allocation
def compose_rotations(r, s):
    """Return the rotation r s, which applies s first and then r."""
    return rotate_vector_back(s, r[0]), rotate_vector_back(s, r[1]), rotate_vector_back(s, r[2])


@compile_without_allocation
def axis_rotation(axis, angle):
    """Return the rotation matrix (three row vectors) about a unit axis by an angle [rad] (Rodrigues)."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    d = 1.0 - c
    return (
        (c + x * x * d, x * y * d - z * s, x * z * d + y * s),
        (y * x * d + z * s, c + y * y * d, y * z * d - x * s),
        (z * x * d - y * s, z * y * d + x * s, c + z * z * d),
    )


_MIN_RANK_RATIO = 1e-7  # minimum ratio of an orthogonalised column to the largest one for full rank


@compile_without_allocation
def qr_factor(matrix, columns, q, r):
    """Compute the QR factorisation of the columns `columns` of a matrix, by modified Gram-Schmidt done twice.

    `q` (rows, count) and the upper triangle of `r` (count, count) are written, incompletely if the
    factorisation fails.

    Returns:
        Whether the columns are linearly independent; otherwise the factorisation fails.
    """
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
        if not r[j, j] > _MIN_RANK_RATIO * size:
            return False
        for m in range(rows):
            q[m, j] /= r[j, j]
    return True


@compile_without_allocation
def qr_solve(q, r, count, right, column, answer, k):
    """Solve a least-squares problem with the factors q and r of `qr_factor` for `count` unknowns.

    The right-hand side is column `column` of `right`; the solution is written to column k of `answer`.
    """
    for j in range(count - 1, -1, -1):
        total = 0.0
        for m in range(len(right)):
            total += q[m, j] * right[m, column]
        for i in range(j + 1, count):
            total -= r[j, i] * answer[i, k]
        answer[j, k] = total / r[j, j]
