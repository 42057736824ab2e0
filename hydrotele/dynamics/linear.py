"""Cholesky for the few unknowns of a machine: quicker than a library call at this size."""

import math

from hydrotele.core.compiled import lean


@lean
def factorise(matrix):
    """Replace a symmetric positive definite matrix by its lower Cholesky factor.

    Args:
        matrix: (>= n, n), overwritten in its lower triangle; further rows are left alone.

    Returns:
        Nothing.

    Source: Golub and Van Loan, Matrix Computations, Algorithm 4.2.1.
    """
    for i in range(matrix.shape[1]):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]


@lean
def solve(factor, right):
    """Solve with a Cholesky factor, in place.

    Args:
        factor: (>= n, n) result of `factorise`.
        right: (n,) right-hand side, overwritten by the solution.

    Returns:
        Nothing.

    Source: Golub and Van Loan, Matrix Computations, section 3.1.
    """
    n = len(right)
    for i in range(n):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]
