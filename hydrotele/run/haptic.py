"""A haptic device at the place of the joystick: what it asks for, and what the line has seen."""

from hydrotele.core.errors import InputError
from hydrotele.haptics.link import Link
from hydrotele.haptics.server import PORT
from hydrotele.run.devices import Reading, Switches
from hydrotele.run.session import Session

HAPTIC = "haptic"
_ENGAGED = "the haptic device moves the machine"
LOCAL = "127.0.0.1"
RATE = 1000.0  # Hz of the machine's control beside a device; one physics step per tick


def haptic_address(device: str) -> tuple[str, int]:
    """Host and port of `haptic`, `haptic:HOST` or `haptic:HOST:PORT`.

    Args:
        device: as the command line has it.

    Returns:
        Host and port; this computer and the usual port where they are left out.

    Raises:
        InputError: it is none of these.

    >>> haptic_address("haptic:10.0.0.7")
    ('10.0.0.7', 5610)
    """
    parts = device.split(":")
    host = parts[1] if len(parts) > 1 else LOCAL
    port = parts[2] if len(parts) > 2 else str(PORT)
    right = parts[0] == HAPTIC and len(parts) <= 3 and host and port.isdecimal()
    if not right or not 0 < int(port) < 65536:
        raise InputError(f"--device {device}", "must be haptic, haptic:HOST or haptic:HOST:PORT")
    return host, int(port)


class HapticHandle:
    """The handle of a haptic device whose server runs elsewhere.

    Its buttons switch the axes that the joystick does not move, as those of a SpaceMouse do.

    Attributes:
        link: the line to the server.
    """

    def __init__(self, host: str, port: int, further: int) -> None:
        """Open the line.

        Args:
            host: of the server.
            port: of the server.
            further: number of axes that the joystick does not move.

        Raises:
            InputError: there is no such host.
        """
        self.link, self._switches = Link(host, port), Switches(further)
        self._count, self._held, self._state = further, 0, "new"

    def attach(self, session: Session) -> None:
        """Take the place of the simulated joystick of a session."""
        assert session.station
        station = session.station
        self.link.start(station.numbers, station.master_state, station.packet.shape)
        station.attach(self.link.exchange)

    def read(self, time: float) -> Reading:
        """What the buttons ask for, and whether the device has come or gone."""
        pose = self.link.pose()
        said = self._news(pose is not None, self.link.engaged)
        if pose:
            pressed, self._held = pose.buttons & ~self._held, pose.buttons
            for number in range(self._count):
                if pressed >> number & 1:
                    self._switches.turn(number)
        return Reading(commands=tuple(self._switches.commands), said=said)

    def _news(self, there: bool, engaged: bool) -> str:
        """What has changed, in a sentence; nothing where nothing has."""
        before, self._state = self._state, "gone" if not there else "moves" if engaged else "waits"
        if self._state == before:
            return ""
        if there:
            return _ENGAGED if engaged else "a haptic device is there: centre its handle to begin"
        if before == "new":
            return "no haptic device answers yet: start hydrotele haptic-device"
        self._switches.off()
        return "the haptic device is silent: the machine has no command"

    def close(self) -> None:
        """Close the line; the device then goes limp."""
        self.link.close()
