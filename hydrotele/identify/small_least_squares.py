"""Least squares of a few columns without memory of its own, for row after row of a log."""

import math

from hydrotele.core.compiled import lean

_STIFF = 1e-7  # least ratio of a column's own part to the largest column; below, rank is lacking


@lean
def factor(matrix, columns, q, r):
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


@lean
def least(q, r, count, right, column, answer, k):
    """Least squares after `_factor`, of one column of the right side into one of the answer."""
    for j in range(count - 1, -1, -1):
        total = 0.0
        for m in range(len(right)):
            total += q[m, j] * right[m, column]
        for i in range(j + 1, count):
            total -= r[j, i] * answer[i, k]
        answer[j, k] = total / r[j, j]
