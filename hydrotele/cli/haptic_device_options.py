"""Define the options of `hydrotele haptic-device`; `cli.haptic_device_command` implements the command."""

from typing import Annotated

import typer

HAPTIC_EPILOG = """\b
Examples:  hydrotele haptic-device    # simulated device, for hydrotele drive --device haptic
           hydrotele haptic-device --kind force-dimension --host 0.0.0.0   # machine on another PC
           hydrotele haptic-device --kind "haption:192.168.0.5#5000"       # the vendor's service runs on another PC

\b
The server reads the handle pose and writes forces at 1 kHz. It communicates by UDP; the protocol is
described in hydrotele.haptics.device. It commands no force if no machine answers, and never more
than the limit of the device. Anyone who can send packets to the server can move the device:
listen on addresses other than 127.0.0.1 only in a private network.
"""


def haptic_device(
    kind: Annotated[
        str,
        typer.Option(
            "--kind",
            help="Kind of device: simulated, force-dimension, haption, or haption:HOST#PORT if the vendor's service"
            " runs on another computer.",
        ),
    ] = "simulated",
    host: Annotated[str, typer.Option("--host", help="Network address on which the server listens.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="UDP port; 0 means any free port.")] = 5610,
    rate: Annotated[float, typer.Option("--rate", min=50, max=4000, help="Rate of the force loop [Hz].")] = 1000,
    duration: Annotated[
        float | None, typer.Option("--duration", min=1e-3, help="Duration [s]. Default: until Ctrl-C.")
    ] = None,
    until_eof: Annotated[
        bool, typer.Option("--until-eof", help="Stop when standard input is closed.", hidden=True)
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")] = False,
) -> None:
    """Connect a haptic device to `hydrotele drive` over UDP: send its pose, apply forces."""
    from hydrotele.cli.haptic_device_command import HapticOptions, serve_device

    serve_device(HapticOptions(kind, host, port, rate, duration, until_eof, json))
