"""The pictures of an identification report: forces on the held-out run, and the parameters."""

import numpy as np

from hydrotele.identify.result import Forces, HeldOut
from hydrotele.show.report_figure import drawing, png

MEASURED, NOMINAL, IDENTIFIED = "#262b33", "#e07b00", "#1769aa"


def draw_forces(forces: Forces, drive: str, judged: HeldOut) -> bytes:
    """Measured and predicted force of a drive, and their difference with the noise's band.

    Args:
        forces: of the held-out run.
        drive: which one.
        judged: how well it is predicted.

    Returns:
        A PNG.
    """
    k = forces.drives.index(drive)
    unit, factor = ("k" + judged.unit, 1e-3) if np.nanmax(
        np.abs(forces.measured[:, k])) >= 2e3 else (judged.unit, 1.0)  # fmt: skip
    measured = factor * forces.measured[:, k]
    lines = [
        ("machine as given", NOMINAL, factor * forces.nominal[:, k]),
        ("identified machine", IDENTIFIED, factor * forces.predicted[:, k]),
    ]
    with drawing(3.2) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.6, 1.0))
        upper.plot(forces.time, measured, color=MEASURED, lw=2.2, alpha=0.5, label="measured")
        for name, colour, values in lines:
            upper.plot(forces.time, values, color=colour, lw=0.9, label=name)
            lower.plot(forces.time, measured - values, color=colour, lw=0.9)
        if np.isfinite(judged.noise_rms):
            reach = 2.0 * factor * judged.noise_rms
            lower.axhspan(-reach, reach, color="0.5", alpha=0.15, lw=0)
        own = np.nanmax(np.abs(measured - lines[1][2]))
        lower.set_ylim(-3.0 * own, 3.0 * own)
        upper.set_title(drive.replace("_", " "))
        upper.set_ylabel(unit)
        lower.set_ylabel(f"measured -\npredicted\n[{unit}]")
        lower.set_xlabel("time [s]")
        lower.set_xlim(forces.time[0], forces.time[-1])
        upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False,
                     borderaxespad=0.1, fontsize=8.5)  # fmt: skip
        figure.align_ylabels()
        return png(figure)
