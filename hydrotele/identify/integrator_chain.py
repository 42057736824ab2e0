"""Smoothing by an integrator chain with unknown input, as compiled dynamic programming.

The signal is the first state of `c_(j+1) = T c_j + b g_j`: m integrators in a row, whose input g is
held from sample to sample. Sought are the states that minimise

    sum_j w_j (d_j - c_j[0])^2 + (1 / r) sum_j g_j^2,                                         (1)

which is also their conditional mean where the noise has the variance 1/w and the input, white and
Gaussian, r in the same unit (the fixed-interval smoother of Rauch, Tung and Striebel). Everything
is dimensionless here: time counts in samples, and the k-th state is `dt^k` times the derivative.
Information matrices run backwards and forwards, so that the start needs no guess.

Source: Trujillo and Busby 1983, J. Math. Anal. Appl. 94, "Investigation of a technique for the
differentiation of empirical data" (dynamic programming); likelihood: the integral of exp(-(1)/2)
over all inputs and, with a flat prior, over the initial state.
"""

import math

import numpy as np

from hydrotele.core.compiled import compiled

_SETTLED = 1.0e-12  # relative change of the information matrix per sample


@compiled
def transition(order):
    """Matrices of the chain: the exact step of m integrators with the input held.

    Args:
        order: number m of integrators [1].

    Returns:
        (T (m, m), its inverse (m, m), b (m,)) [1].

    Source: Trujillo and Busby 1983, with the time in samples.

    >>> transition(3)[0].tolist()
    [[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    """
    forward, back, drive = np.zeros((order, order)), np.zeros((order, order)), np.zeros(order)
    for i in range(order):
        term = 1.0
        for j in range(i, order):
            forward[i, j] = term
            back[i, j] = term if (j - i) % 2 == 0 else -term
            term /= j - i + 1
        drive[i] = term
    return forward, back, drive


@compiled
def _through_input(info, drive, ratio, order, column):
    """Remove the input from an information matrix: R - R b (1/r + b'R b)^-1 b'R, in place.

    Writes the gain (1/r + b'R b)^-1 R b into `column` and returns 1/r + b'R b.
    """
    total = 1.0 / ratio
    for i in range(order):
        column[i] = 0.0
        for j in range(order):
            column[i] += info[i, j] * drive[j]
        total += column[i] * drive[i]
    for i in range(order):
        for j in range(order):
            info[i, j] -= column[i] * column[j] / total
    for i in range(order):
        column[i] /= total
    return total


@compiled
def _congruent(info, matrix, order, work, out):
    """Write M' R M into `out`."""
    for i in range(order):
        for j in range(order):
            work[i, j] = 0.0
            for k in range(order):
                work[i, j] += info[i, k] * matrix[k, j]
    for i in range(order):
        for j in range(i, order):
            value = 0.0
            for k in range(order):
                value += matrix[k, i] * work[k, j]
            out[i, j] = value
            out[j, i] = value


@compiled
def _settled(old, new, order):
    for i in range(order):
        if abs(new[i, i] - old[i, i]) > _SETTLED * abs(new[i, i]):
            return False
    return True


@compiled
def backward_pass(known, ratio, order, infos, gains, totals):
    """Backward recursion of the information: it depends on which samples are known, not on them.

    Args:
        known: (n,) 1 where a sample is known, 0 where it is missing [1].
        ratio: r, variance of the input over that of the noise, scalar [1], > 0.
        order: number m of integrators [1].
        infos: (n, m, m) written: R_j, information of samples j .. n-1 on the state j.
        gains: (n, m) written: R_(j+1) b / totals_j; the best input falls by `gains_j . T c_j`.
        totals: (n,) written: 1/r + b' R_(j+1) b.

    Returns:
        Nothing; the arrays are filled.

    Source: Trujillo and Busby 1983.
    """
    forward, _, drive = transition(order)
    info, work, out = np.zeros((order, order)), np.zeros((order, order)), np.zeros((order, order))
    column = np.zeros(order)
    count = len(known)
    info[0, 0] = known[count - 1]
    infos[count - 1] = info
    settled, total = False, 0.0
    for j in range(count - 2, -1, -1):
        if settled and known[j] == known[j + 1]:
            infos[j], gains[j], totals[j] = infos[j + 1], gains[j + 1], totals[j + 1]
            continue
        total = _through_input(info, drive, ratio, order, column)
        gains[j], totals[j] = column, total
        _congruent(info, forward, order, work, out)
        out[0, 0] += known[j]
        settled = _settled(infos[j + 1], out, order)
        info[:] = out
        infos[j] = out


@compiled
def smooth_states(samples, known, ratio, order, infos, gains, totals, states):
    """States that minimise (1), the minimum, and the log determinant of the likelihood.

    Args:
        samples: (n,) samples over the noise's standard deviation [1]; anything where missing.
        known: (n,) 1 where a sample is known, 0 where it is missing [1].
        ratio: r, scalar [1].
        order: number m of integrators [1].
        infos: (n, m, m) work space.
        gains: (n, m) work space.
        totals: (n,) work space.
        states: (n, m) written: the smoothed states [1].

    Returns:
        (squared residuals, squared inputs over r, log determinant) [1]; minus twice the log
        likelihood is their sum, apart from a constant.

    Source: Trujillo and Busby 1983.
    """
    backward_pass(known, ratio, order, infos, gains, totals)
    forward, _, drive = transition(order)
    count = len(samples)
    pulls = np.zeros((count, order))  # R_j c is pulled towards this vector
    pulls[count - 1, 0] = known[count - 1] * samples[count - 1]
    rest = np.zeros(order)
    for j in range(count - 2, -1, -1):
        push = 0.0
        for i in range(order):
            push += drive[i] * pulls[j + 1, i]
        for i in range(order):
            rest[i] = pulls[j + 1, i] - gains[j, i] * push
        for i in range(order):
            for k in range(i + 1):
                pulls[j, i] += forward[k, i] * rest[k]
        pulls[j, 0] += known[j] * samples[j]
    states[0] = np.linalg.solve(infos[0], pulls[0])
    inputs, logs = 0.0, 0.0
    for j in range(count - 1):
        value = 0.0
        for i in range(order):
            rest[i] = 0.0
            for k in range(i, order):
                rest[i] += forward[i, k] * states[j, k]
            value -= gains[j, i] * rest[i]
        for i in range(order):
            value += drive[i] * pulls[j + 1, i] / totals[j]
        for i in range(order):
            states[j + 1, i] = rest[i] + drive[i] * value
        inputs += value * value / ratio
        logs += math.log(totals[j] * ratio)
    residuals = 0.0
    for j in range(count):
        if known[j] > 0.0:
            residuals += (samples[j] - states[j, 0]) ** 2
    _, log_start = np.linalg.slogdet(infos[0])
    return residuals, inputs, logs + log_start


@compiled
def state_variances(known, ratio, order, infos, variances):
    """Variances of the smoothed states, over that of the noise.

    The information of the samples before j runs forwards and adds to that of j .. n-1.

    Args:
        known: (n,) 1 where a sample is known, 0 where it is missing [1].
        ratio: r, scalar [1].
        order: number m of integrators [1].
        infos: (n, m, m) as `backward_pass` writes them.
        variances: (n, m) written [1].

    Returns:
        Nothing; `variances` is filled.

    Source: two-filter form of the fixed-interval smoother.
    """
    _, back, drive = transition(order)
    against = back @ drive
    info, work, out = np.zeros((order, order)), np.zeros((order, order)), np.zeros((order, order))
    column, old, settled = np.zeros(order), np.zeros((order, order)), False
    for j in range(len(known)):
        if not (settled and j > 0 and _settled(infos[j - 1], infos[j], order)):
            inverse = np.linalg.inv(info + infos[j])
            for i in range(order):
                variances[j, i] = inverse[i, i]
        else:
            variances[j] = variances[j - 1]
        if settled and j > 0 and known[j] == known[j - 1]:
            continue
        old[:] = info
        info[0, 0] += known[j]
        _through_input(info, against, ratio, order, column)
        _congruent(info, back, order, work, out)
        settled = _settled(old, out, order)
        info[:] = out
