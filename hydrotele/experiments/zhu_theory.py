"""Collect the experiments of Zhu 1994, chapters 1 to 5, and the figures without a result."""

from hydrotele.experiments import zhu_kinematics, zhu_stiffness, zhu_transparency, zhu_two_port
from hydrotele.experiments.comparison import Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    *zhu_kinematics.EXPERIMENTS,
    *zhu_two_port.EXPERIMENTS,
    *zhu_transparency.EXPERIMENTS,
    *zhu_stiffness.EXPERIMENTS,
)

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
    "Figure 4.23": "block diagrams of direct force and stiffness feedback",
    "Figure 4.25": "block diagram of stiffness feedback",
    "Figure 5.30": "block diagram of the whole system",
    "Figure 5.33": "frames of the joystick; the document has no result with them",
    "Figure 5.34": "block diagram of the computers",
}
