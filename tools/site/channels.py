"""Page that lists every log channel."""

from hydrotele.core.units import UNITS
from hydrotele.machine.log_channels import MEASURED_KINDS, TRUTH_KINDS, ChannelKind

ENDINGS = {"free": ".AXIS", "xyz": ".x, .y, .z", "none": "", "optional": " or .PUMP"}


def format_page() -> str:
    """Return the page of the log channels."""
    units = "\n".join(f"| {unit} | {si} | {factor:.6g} |" for unit, (si, factor) in UNITS.items())
    return f"""# Log channels

A channel is one column of a log. This page lists all channels that hydrotele writes or reads, and the units that a
file may state. Your own log needs only some of them; [Logs of a real machine](../logs.md) says which.

The name of a channel is its kind and an axis, such as `angle.boom` (`AXIS` below), or a kind alone, such as `time`.
Values are floating-point numbers in the SI unit of the table. Where a row has several units, the axis decides:
rad and N m for rotary, m and N for linear axes. `PUMP` is the name of a pump of a machine with several pumps.

## Measured channels

Sensor readings, signals of the controller, and estimates, in `measured.parquet` of a simulated run and in logs of real
machines. hydrotele computes the estimates `tip_force`, `contact` and `load`; you need not supply them. To exclude rows
of your own log, add a column `valid`.

{_format_table(MEASURED_KINDS, "")}

## True values

Exact values without sensor errors, which only a simulator knows, in `truth.parquet` of a simulated run. `gap` and
`identify` do not use them.

{_format_table(TRUTH_KINDS, "truth.")}

## Units that files may state

A file may state one of these units for a column, for example `angle.boom [deg]`. Values are multiplied by the factor.

| unit | SI unit | factor |
| --- | --- | ---: |
{units}
"""


def _format_table(kinds, prefix: str) -> str:
    rows = [f"| {_format_name(prefix + name, kind)} | {' or '.join(kind.units)} | {kind.description} |"
            for name, kind in kinds.items()]  # fmt: skip
    return "\n".join(["| channel | unit | meaning |", "| --- | --- | --- |", *rows])


def _format_name(name: str, kind: ChannelKind) -> str:
    if kind.axes == "xyz":
        return ", ".join(f"`{name}.{c}`" for c in "xyz")
    return {"free": f"`{name}.AXIS`", "none": f"`{name}`", "optional": f"`{name}`, `{name}.PUMP`"}[kind.axes]


def list_pages() -> dict[str, str]:
    """Return {path of the page: its text}."""
    return {"channels.md": format_page()}
