"""Check the numbers of all command-line options and arguments: finite, and within the declared range.

A command declares the range of a number by `min` and `max` of its option. typer checks these bounds,
but accepts infinity and NaN, which fulfil no comparison. Commands therefore need no checks of single
numbers.
"""

import functools
import math
from collections.abc import Iterator
from typing import Any

from typer.core import TyperGroup

from hydrotele.core.errors import InputError

MAX_PROCESSES = 1024
"""Largest number of processes that a command starts."""


class NumberCheckingGroup(TyperGroup):
    """Command group that rejects infinity and NaN as numbers of its commands and subgroups."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command or subgroup of a name, changed such that it rejects infinity and NaN as numbers."""
        command = super().get_command(ctx, cmd_name)
        for each in _iterate_leaf_commands(command):
            each.invoke = functools.partial(_invoke_with_finite_numbers, each, each.invoke)
        return command


def _iterate_leaf_commands(command: Any) -> Iterator[Any]:
    """Yield a command or, for a group, its commands and those of its subgroups."""
    below = getattr(command, "commands", None)
    if below is None:
        yield from () if command is None else (command,)
    else:
        for each in below.values():
            yield from _iterate_leaf_commands(each)


def _invoke_with_finite_numbers(command: Any, invoke: Any, ctx: Any) -> Any:
    """Run a command after checking that its numbers are finite; return its result.

    Args:
        command: the command, which declares the parameters.
        invoke: function of the context that runs the command.
        ctx: context with the values of the parameters.

    Raises:
        InputError: a number is infinite or NaN; the message names the option.
    """
    for parameter in command.params:
        value = ctx.params.get(parameter.name)
        for number in value if isinstance(value, list | tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                name = max(parameter.opts, key=len)
                raise InputError(name, f"must be a finite number, not {number}")
    return invoke(ctx)
