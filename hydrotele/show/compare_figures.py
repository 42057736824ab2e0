"""The picture of a comparison: what was measured, and free runs of every model beside it."""

from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.core.units import customary
from hydrotele.show.report_html import drawing, png

MEASURED = "#262b33"
_COLOURS = ("#e07b00", "#1769aa", "#2e8b57", "#b5281c", "#7b4fa3", "#8c6d31")
_HEIGHT = 1.6  # inch per channel
_ROOM = 0.15  # of the readings' range, shown above and below it


def draw_free_runs(
    time: np.ndarray, measured: np.ndarray, predicted: Mapping[str, np.ndarray],
    channels: Sequence[str], units: Sequence[str], title: str,
) -> bytes:  # fmt: skip
    """Measured and predicted readings over time, one plot per channel.

    Args:
        time: (n,) [s].
        measured: (n, c) readings, NaN where missing [channel's unit].
        predicted: name of a model -> (n, c) its free runs, NaN where there is none.
        channels: names of the channels.
        units: SI unit of each.
        title: of the picture.

    Returns:
        A PNG.
    """
    with drawing(0.7 + _HEIGHT * len(channels)) as figure:
        plots = figure.subplots(len(channels), 1, sharex=True, squeeze=False)[:, 0]
        for c, (plot, channel, unit) in enumerate(zip(plots, channels, units, strict=True)):
            known = measured[:, c][np.isfinite(measured[:, c])]
            low, high = (known.min(), known.max()) if len(known) else (0.0, 1.0)
            shown, factor = customary(unit, max(abs(low), abs(high)))
            plot.plot(time, factor * measured[:, c], color=MEASURED, lw=2.2, alpha=0.5,
                      label="measured")  # fmt: skip
            for k, (name, values) in enumerate(predicted.items()):
                plot.plot(time, factor * values[:, c], color=_COLOURS[k % len(_COLOURS)], lw=0.9,
                          ls="-" if k < len(_COLOURS) else "--", label=name)  # fmt: skip
            room = _ROOM * (high - low) or 1.0
            plot.set_ylim(factor * (low - room), factor * (high + room))
            plot.set_ylabel(channel.replace(".", "\n") + f" [{shown}]")
        plots[0].set_title(title)
        plots[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8.5,
                        ncols=min(4, 1 + len(predicted)), borderaxespad=0.1)  # fmt: skip
        plots[-1].set_xlabel("time [s]")
        plots[-1].set_xlim(time[0], time[-1])
        figure.align_ylabels()
        return png(figure)
