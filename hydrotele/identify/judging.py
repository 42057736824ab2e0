"""How well identified parameters predict a run that was not fitted, and what to say about it."""

import numpy as np

from hydrotele.identify.equations import Equations
from hydrotele.identify.regressor import Regressor
from hydrotele.identify.result import Forces, HeldOut
from hydrotele.identify.setup import Setup

_WORSE = 1.5  # times the noise; beyond it the model lacks something
_FOREIGN = 3.0  # times the fitted runs' residuals; beyond it they tell too little


def heldout_errors(
    judged: Equations, table: Regressor, value: np.ndarray, columns: list[int], setup: Setup
) -> dict[str, HeldOut]:
    """Drive -> prediction of the held-out run, of the drives at `columns` with known forces."""
    noise = judged.noise_of(value)
    out = {}
    for k in columns:
        force = judged.force[:, k]
        known = np.isfinite(force)
        if not known.any():
            continue
        sizes = [
            float(np.sqrt(np.mean((force - judged.matrix[:, k] @ p)[known] ** 2)))
            for p in (value, table.nominal)
        ]
        whole = float(np.sqrt(np.mean(force[known] ** 2)))
        unit = "N" if setup.chain.tree.slides[setup.chain.index(table.drives[k])] else "N m"
        out[table.drives[k]] = HeldOut(
            sizes[0], unit, float(noise[k]), sizes[0] / max(whole, 1e-300), sizes[1]
        )
    return out


def heldout_forces(judged: Equations, table: Regressor, value: np.ndarray) -> Forces:
    """Measured and predicted forces of the held-out run."""
    return Forces(
        judged.name, table.drives, judged.time, judged.force, judged.matrix @ value,
        judged.matrix @ table.nominal,
    )  # fmt: skip


def whiteness(residual: np.ndarray) -> np.ndarray:
    """Correlation (k,) of residuals (n, k) with those before them."""
    error = residual - residual.mean(axis=0)
    return np.sum(error[1:] * error[:-1], axis=0) / np.sum(error**2, axis=0)


def status_of(
    heldout: dict[str, HeldOut], fitted: dict[str, float], still: np.ndarray, setup: Setup
) -> str:
    """`ok`, or what is wrong and what to do about it.

    Args:
        heldout: prediction of the held-out run.
        fitted: drive -> RMS of the residuals of the runs to fit [N] or [N m].
        still: (k,) whether a given joint stood still in all runs to fit.
        setup: of the regressor.

    Returns:
        A sentence.
    """
    if still.any():
        names = ", ".join(j for j, stands in zip(setup.given, still, strict=True) if stands)
        return (
            f"{names} stood still: what shows only in motion of it is not told, and kept as given;"
            " log a motion of all axes, fast and in many poses"
        )
    if not heldout:
        return "the held-out run has no known force: nothing was judged; hold out another one"
    worse = [d for d, h in heldout.items() if h.rms > _WORSE * h.noise_rms]
    if worse:
        return (
            f"on the held-out run the force of {', '.join(worse)} differs by more than the sensors"
            " explain: the model lacks something there; look for it with `hydrotele gap`"
        )
    worse = [d for d, h in heldout.items() if h.rms > _FOREIGN * fitted[d]]
    if worse:
        return (
            f"on the held-out run the force of {', '.join(worse)} differs by more than"
            f" {_FOREIGN:g} times as much as on the fitted ones: they do not tell what happens"
            " there; fit runs like it, too"
        )
    return "ok"
