"""Zhu 1994, chapters 1 to 5: all rows, and the figures that show no result."""

from hydrotele.experiments import zhu_transparency, zhu_two_port
from hydrotele.experiments.comparison import Comparison, Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    *zhu_two_port.EXPERIMENTS,
    *zhu_transparency.EXPERIMENTS,
)

UNAVAILABLE: tuple[Comparison, ...] = ()

DRAWINGS: dict[str, str] = {
    "Figure 1.1": "sketch of a kinematically similar master and slave",
    "Figure 1.2": "sketch of a kinematically dissimilar master and slave",
    "Figure 1.3": "drawing of an excavator",
    "Figure 1.4": "photograph",
    "Figure 1.5": "drawing of a feller-buncher",
    "Figure 1.6": "photograph",
    "Figure 3.10": "sketch of an ideal teleoperator",
    "Figure 3.11": "block diagram of a one-port and a two-port",
    "Figure 3.12": "block diagram of operator, teleoperator and task",
}
