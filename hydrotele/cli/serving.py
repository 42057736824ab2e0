"""The command `hydrotele haptic-device`; what it does is in `cli.haptic`."""

from typing import Annotated

import typer

HAPTIC_EPILOG = """\b
Examples:  hydrotele haptic-device    # a simulated one, for hydrotele drive --device haptic
           hydrotele haptic-device --kind force-dimension --host 0.0.0.0   # machine elsewhere
           hydrotele haptic-device --kind "haption:192.168.0.5#5000"       # device elsewhere

\b
The server reads the handle and writes forces at 1 kHz and speaks UDP (hydrotele.haptics.device).
It gives no force while no machine answers, and never more than the device may give. Whoever can
send packets to it moves the device: listen on other addresses than this computer's own only in a
network of your own.
"""


def haptic_device(
    kind: Annotated[
        str, typer.Option("--kind", help="simulated, force-dimension, haption.")
    ] = "simulated",
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: a free one.")] = 5610,
    rate: Annotated[float, typer.Option("--rate", min=50, max=4000, help="Periods per s.")] = 1000,
    duration: Annotated[
        float | None, typer.Option("--duration", help="Seconds; default until Ctrl-C.")
    ] = None,
    until_eof: Annotated[
        bool, typer.Option("--until-eof", help="End when the input is closed.", hidden=True)
    ] = False,
    json: Annotated[
        bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")
    ] = False,
) -> None:
    """Connect a haptic device to a machine: poses out, wrenches in, watchdog."""
    from hydrotele.cli.haptic import HapticOptions, serve_device

    serve_device(HapticOptions(kind, host, port, rate, duration, until_eof, json))
