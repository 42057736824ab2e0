"""Plot of linear models: natural frequencies and damping per pose, and gains of the axes."""

from collections.abc import Sequence

import numpy as np

from hydrotele.estimate.linear_model import LinearModel
from hydrotele.show.report_html import figure_to_png, open_report_figure

_FREQUENCIES = np.geomspace(0.1, 30.0, 400)  # Hz, of the gains


def draw_modes(models: Sequence[LinearModel]) -> bytes:
    """Draw natural frequencies and damping per pose, and the gain from command to velocity of each axis.

    Args:
        models: linear models of a machine; the gains are those of the first.

    Returns:
        PNG image.
    """
    axes = [name.partition(".")[2] for name in models[0].inputs if name.startswith("command.")]
    owners = list(dict.fromkeys([*axes, *(mode.axis for model in models for mode in model.oscillations)]))
    with open_report_figure(4.2) as figure:
        frequency, damping, gain = figure.subplots(1, 3)
        for k, owner in enumerate(owners):
            found = [(n + 1, m) for n, model in enumerate(models) for m in model.oscillations if m.axis == owner]
            colour = f"C{k % 10}"
            poses = [n for n, _ in found]
            frequency.plot(poses, [m.frequency for _, m in found], "o", color=colour, label=owner)
            damping.plot(poses, [m.damping for _, m in found], "o", color=colour)
        for name in axes:
            if f"velocity.{name}" in models[0].outputs:
                response = models[0].frequency_response(_FREQUENCIES, [f"command.{name}"], [f"velocity.{name}"])
                gain.loglog(_FREQUENCIES, np.abs(response[:, 0, 0]), color=f"C{owners.index(name) % 10}")
        for panel, title in (
            (frequency, "natural frequency [Hz]"),
            (damping, "damping ratio [1]"),
            (gain, "velocity per command, pose 1 [rad/s]"),
        ):
            panel.set_title(title)
        for panel in (frequency, damping):
            panel.set_xlabel("pose")
            panel.set_xticks(range(1, len(models) + 1))
            panel.set_xlim(0.5, len(models) + 0.5)
        frequency.set_yscale("log")
        frequency.yaxis.set_major_formatter("{x:g}")
        frequency.yaxis.set_minor_formatter("{x:g}")
        gain.set_xlabel("frequency [Hz]")
        figure.legend(loc="outside lower center", ncols=min(8, len(owners)))
        return figure_to_png(figure)
