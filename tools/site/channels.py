"""Page that lists every log channel."""

from hydrotele.core.units import UNITS
from hydrotele.machine.log_channels import MEASURED_KINDS, TRUTH_KINDS, ChannelKind

ENDINGS = {"free": ".AXIS", "xyz": ".x, .y, .z", "none": "", "optional": " or .PUMP"}


def format_page() -> str:
    """Return the page of the log channels."""
    units = "\n".join(f"| {unit} | {si} | {factor:.6g} |" for unit, (si, factor) in UNITS.items())
    return f"""# Log channels

A channel is one column of a log. Its name is `kind.axis`, such as `angle.boom`, or a kind alone, such as `time`.
Each value is a float64 in the SI unit of the table; where two units are listed, the first is that of rotary axes.
[Logs of a real machine](../logs.md) describes files.

## Measured channels

Sensor readings and signals of the controller.

{_format_table(MEASURED_KINDS, "")}

## True values

Quantities that only a simulator knows, in `truth.parquet` of a run.

{_format_table(TRUTH_KINDS, "truth.")}

## Units that files may state

A column with one of these units is converted to the SI unit.

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
