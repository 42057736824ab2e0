"""Energy at a port: whether what is connected there is passive as seen by the one who holds it."""

from dataclasses import dataclass


@dataclass
class PassivityObserver:
    """Energy that has gone into a port.

    A passive system never gives back more than it was given, plus what it had at the start.

    Attributes:
        stored: what it may have had at the start [J].
        energy: gone into it since [J]; negative where it has given.
        least: the smallest that `energy` has been [J].
    """

    stored: float = 0.0
    energy: float = 0.0
    least: float = 0.0

    def add(self, force: float, velocity: float, period: float) -> float:
        """Count one step.

        Args:
            force: on the port [N] or [N m].
            velocity: in its direction [m/s] or [rad/s].
            period: of the step [s].

        Returns:
            The energy so far [J].

        Source: Hannaford and Ryu 2002, IEEE Trans. Robotics and Automation 18(1).
        """
        self.energy += force * velocity * period
        self.least = min(self.least, self.energy)
        return self.energy

    @property
    def passive(self) -> bool:
        """Whether no more has come out than went in and was stored."""
        return self.least >= -self.stored
