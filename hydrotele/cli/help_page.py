"""The help of a group of commands, drawn as typer draws it, but without importing rich.

To import rich, with markdown and tracebacks, takes longer than all else that `--help` does. Where
a setting asks for what is not drawn here, and in narrow terminals, typer draws.
"""

import os
import re
import sys
from textwrap import wrap
from typing import NamedTuple

import typer
from typer.core import TyperArgument, TyperGroup, TyperOption

# Each changes what rich takes for a terminal, or how typer draws.
SETTINGS = ("FORCE_COLOR", "NO_COLOR", "PY_COLORS", "GITHUB_ACTIONS", "TERMINAL_WIDTH",
            "TTY_COMPATIBLE", "TYPER_USE_RICH", "_TYPER_FORCE_DISABLE_TERMINAL")  # fmt: skip

# typer's styles as the codes of ANSI's `select graphic rendition`.
_BOLD, _DIM, _NAME, _SWITCH, _TYPE, _USAGE = "1", "2", "1;36", "1;32", "1;33", "1;33"


class Cell(NamedTuple):
    """Text of one style in a table."""

    text: str
    style: str = ""


class HelpGroup(TyperGroup):
    """A group whose help is drawn here where that is the same as typer's."""

    def format_help(self, ctx, formatter) -> None:
        """Print the help, as typer does, instead of writing it into the formatter."""
        width = None if any(name in os.environ for name in SETTINGS) else _width_of_terminal()
        if width and "utf" in (getattr(sys.stdout, "encoding", None) or "").lower():
            if page := help_page(self, ctx, width):
                typer.echo(page, nl=False)  # takes the styles out where there is no terminal
                return
        super().format_help(ctx, formatter)


def _width_of_terminal() -> int | None:
    """Width as rich finds it; None in a terminal without control sequences."""
    if os.environ.get("TERM", "").lower() in ("dumb", "unknown"):
        return None
    if (columns := os.environ.get("COLUMNS", "")).isdigit() and int(columns):
        return int(columns)
    for descriptor in range(3):
        try:
            return os.get_terminal_size(descriptor).columns or 80
        except OSError:
            continue
    return 80


def help_page(group: TyperGroup, ctx, width: int) -> str | None:
    """Page of a group's help with styles for a terminal of a width [characters].

    Returns:
        The page; None where it is narrow, or has arguments or paragraphs, which typer draws.
    """
    parameters = [p for p in group.get_params(ctx) if not getattr(p, "hidden", False)]
    said = group.help or ""
    if group.epilog or "\n\n" in said or any(isinstance(p, TyperArgument) for p in parameters):
        return None
    options = [_option_row(p, ctx) for p in parameters if isinstance(p, TyperOption)]
    named = [(name, group.get_command(ctx, name)) for name in group.list_commands(ctx)]
    commands = [
        [Cell(name, _NAME), Cell(_first_paragraph(c.short_help or c.help or ""))]
        for name, c in named
        if c and not c.hidden
    ]
    of_options = _option_widths(options, width - 4)
    if of_options is None:
        return None
    first = max(len(row[0].text) for row in commands)
    usage = _paragraph(" ".join(group.get_usage(ctx).split()), width, _BOLD)
    usage[0] = usage[0].replace("Usage:", f"{_code(_USAGE)}Usage:{_code(_BOLD)}", 1)
    lines = [" " * width, *usage, " " * width]
    lines += [*_paragraph(said, width), " " * width]
    lines += _panel("Options", options, of_options, width)
    lines += _panel("Commands", commands, [first + 1, width - 5 - first], width)
    return "\n".join(lines) + "\n"


def _first_paragraph(text: str) -> str:
    return " ".join(text.partition("\n\n")[0].split())


def _option_row(option: TyperOption, ctx) -> list[Cell]:
    """Long names, short names, two columns for names of the opposite, type, help."""
    names = {long: [o for o in option.opts if ("--" in o) is long] for long in (True, False)}
    return [
        Cell(",".join(names[True]), _NAME), Cell(",".join(names[False]), _SWITCH), Cell(""),
        Cell(""), Cell(option.display_type_rich(ctx=ctx) or "", _TYPE), Cell(option.help or ""),
    ]  # fmt: skip


def _option_widths(rows: list[list[Cell]], width: int) -> list[int] | None:
    """Widths of the columns with their share of the gaps; None where there is too little room."""
    last = len(rows[0]) - 1
    widths = [max(len(row[k].text) for row in rows) + (2 if k else 1) for k in range(last)]
    rest = width - sum(widths)
    return [*widths, rest] if rest >= max(widths) else None


def _paragraph(text: str, width: int, style: str = "") -> list[str]:
    return [_styled(f" {line}".ljust(width), style) for line in wrap(text, width - 2)]


def _panel(title: str, rows: list[list[Cell]], widths: list[int], width: int) -> list[str]:
    """A box around the rows of a table; only the last column is wrapped."""
    side = _styled("│", _DIM)
    lines = [_styled(f"╭─ {title} ".ljust(width - 1, "─") + "╮", _DIM)]
    for row in rows:
        wrapped = wrap(row[-1].text, widths[-1] - 1, break_on_hyphens=False) or [""]
        for k, line in enumerate(wrapped):
            cells = [cell if k == 0 else Cell("") for cell in row[:-1]]
            # The gap before a column belongs to it by half, but for the first.
            texts = [
                " " * (at > 0) + _styled(cell.text.ljust(room - (at > 0)), cell.style)
                for at, (cell, room) in enumerate(zip(cells, widths, strict=False))
            ]
            lines.append(f"{side} {''.join(texts)} {line.ljust(widths[-1] - 1)} {side}")
    return [*lines, _styled("╰" + "─" * (width - 2) + "╯", _DIM)]


def _styled(text: str, style: str) -> str:
    if style == _TYPE:  # its brackets are dim
        bracket, kind = _code(_TYPE + ";2"), _code(_TYPE)
        return re.sub("[<>]", rf"{bracket}\g<0>{kind}", f"{kind}{text}{_code()}")
    return f"{_code(style)}{text}{_code()}" if style and text.strip() else text


def _code(style: str = "") -> str:
    return f"\x1b[0;{style}m" if style else "\x1b[0m"
