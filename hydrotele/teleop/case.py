"""What a teleoperator is analysed with: its two sides, hand, task, gains and delays."""

from dataclasses import dataclass, field, replace

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.teleop.two_port import Block, Gains, Impedance, TwoPort, two_port


@dataclass(frozen=True)
class Case:
    """One axis of a teleoperator, with hand and task, in one scale of lengths and forces.

    Attributes:
        master: what the hand moves.
        slave: what the task feels.
        master_control: damper and spring of the master's controller.
        slave_control: of the slave's.
        hand: the operator's.
        task: impedance of the environment.
        gains: of the channels.
        delay_forward: from the master to the slave [s].
        delay_back: from the slave to the master [s].
    """

    master: Impedance
    slave: Impedance
    master_control: Impedance
    slave_control: Impedance
    hand: Impedance
    task: Impedance
    gains: Gains = field(default_factory=Gains)
    delay_forward: float = 0.0
    delay_back: float = 0.0

    def __post_init__(self) -> None:
        """Refuse controllers that hold a mass: they would need accelerations."""
        if self.master_control.mass or self.slave_control.mass:
            raise InputError("teleoperator", "controllers are dampers and springs, without mass")

    @property
    def delay(self) -> float:
        """Mean of both delays [s]; stability depends on their sum only."""
        return 0.5 * (self.delay_forward + self.delay_back)

    def with_delay(self, delay: float) -> "Case":
        """The same with a delay [s] each way."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def port(self, structure: str, reflected: float = 1.0) -> TwoPort:
        """The two-port of a structure.

        Args:
            structure: as of `two_port`.
            reflected: factor on both channels that come back, C2 and C4, which is the gain of the
                loop through hand and task [1].

        Returns:
            The two-port.

        Raises:
            InputError: as of `two_port`.
        """
        made = two_port(
            structure, self.master, self.slave, self.master_control, self.slave_control,
            self.gains, delay_forward=self.delay_forward, delay_back=self.delay_back,
        )  # fmt: skip
        if reflected == 1.0:
            return made
        return replace(
            made,
            force_back=_scaled(made.force_back, reflected),
            velocity_back=_scaled(made.velocity_back, reflected),
        )


def _scaled(block: Block, factor: float) -> Block:
    def scaled(s: np.ndarray) -> np.ndarray:
        return factor * block(s)

    return scaled
