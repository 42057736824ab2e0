"""Pictures of a calibration: errors per pose before and after, posteriors in 1-D and 2-D."""

from collections.abc import Mapping, Sequence

import numpy as np

from hydrotele.show.report_html import drawing, png

_BEFORE, _AFTER, _MARK = "#b9bfc7", "#1769aa", "#e07b00"
_MOST = 3000  # points of a scatter plot
_LEVELS = (0.39, 0.86)  # share inside one and two standard deviations of a normal in two dimensions


def error_bars(errors: Mapping[str, tuple[np.ndarray, np.ndarray]], what: str) -> bytes:
    """Errors of every pose before and after calibration, on a logarithmic scale.

    Args:
        errors: title with unit -> (before (n,), after (n,)).
        what: which poses these are.

    Returns:
        A PNG.
    """
    with drawing(0.3 + 1.9 * len(errors)) as figure:
        axes = figure.subplots(len(errors), 1, squeeze=False)[:, 0]
        for place, (title, (before, after)) in zip(axes, errors.items(), strict=True):
            at = np.arange(1, len(before) + 1)
            place.bar(at - 0.2, before, 0.4, color=_BEFORE, label="nominal")
            place.bar(at + 0.2, after, 0.4, color=_AFTER, label="calibrated")
            place.set_yscale("log")
            place.set_title(f"{title}, {len(before)} {what}")
            place.margins(x=0.01)
            place.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        axes[-1].set_xlabel("pose")
        return png(figure)


def corner(
    sample: np.ndarray, names: Sequence[str], mark: np.ndarray | None = None,
    mark_label: str = "", unit: str = "mm or mrad",
) -> bytes:  # fmt: skip
    """Marginal posteriors: histograms on the diagonal, pairs of parameters below it.

    Args:
        sample: (n, p) draws [unit].
        names: the p parameters.
        mark: (p,) a point to show, such as the truth [unit].
        mark_label: what it is.
        unit: of all.

    Returns:
        A PNG.
    """
    p = len(names)
    thin = sample[:: max(1, len(sample) // _MOST)]
    with drawing(1.5 * p) as figure:
        axes = figure.subplots(p, p, squeeze=False, sharex="col")
        for row in range(p):
            for column in range(p):
                place = axes[row, column]
                if column > row:
                    place.axis("off")
                    continue
                if row == column:
                    place.hist(sample[:, row], 40, density=True, color=_AFTER, alpha=0.8)
                    place.set_yticks([])
                else:
                    place.plot(thin[:, column], thin[:, row], ".", ms=1.5, alpha=0.3, color=_AFTER)
                    _contours(place, sample[:, column], sample[:, row])
                    share = np.corrcoef(sample[:, column], sample[:, row])[0, 1]
                    place.text(0.04, 0.96, f"{share:+.2f}", transform=place.transAxes, va="top",
                               fontsize=7)  # fmt: skip
                if mark is not None:
                    place.axvline(mark[column], color=_MARK, lw=1.0)
                    if row != column:
                        place.axhline(mark[row], color=_MARK, lw=1.0)
                if row == p - 1:
                    place.set_xlabel(f"{names[column]}")
                if column == 0 and row > 0:
                    place.set_ylabel(f"{names[row]}")
                elif column > 0:
                    place.set_yticklabels([])
        label = f"{unit}; lines: {mark_label}" if mark is not None else unit
        figure.suptitle(f"Posterior [{label}]; numbers: correlation", fontsize=9)
        return png(figure)


def _contours(place, x: np.ndarray, y: np.ndarray) -> None:
    """Contours that hold 39 and 86 % of the draws."""
    counts, xs, ys = np.histogram2d(x, y, 30)
    order = np.sort(counts.ravel())[::-1]
    share = np.cumsum(order) / order.sum()
    levels = sorted({float(order[np.searchsorted(share, level)]) for level in _LEVELS})
    middle = [0.5 * (edge[1:] + edge[:-1]) for edge in (xs, ys)]
    place.contour(*middle, counts.T, levels=levels, colors="#0d3f66", linewidths=0.8)
