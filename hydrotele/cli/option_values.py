"""Parse values of command-line options, and define the option that all commands have: `--quiet`."""

import copy
import functools
import inspect
from collections.abc import Callable
from json import dumps as json_text
from typing import Annotated, Any, get_args

import typer
from rich.markup import escape

from hydrotele.core.errors import InputError
from hydrotele.core.files import resolve_path


def parse_overrides(items: list[str]) -> dict[str, str]:
    """Return {key path: YAML text} from a list of `key=value` strings.

    Raises:
        InputError: an item does not have the form `key=value`.
    """
    pairs = {}
    for item in items:
        key, sign, value = item.partition("=")
        if not sign or not key:
            raise InputError(f"--set {item}", "must be key=value, for example servo.lead=0.04")
        pairs[key] = value
    return pairs


def machine_overrides(machine: str | None, tool: str | None) -> dict[str, str]:
    """Return the scenario overrides that select a machine and its tool.

    A relative path is resolved from the working folder, not from the folder of the scenario file.
    """
    from hydrotele.machine.machine_file import shipped_machines

    pairs = {}
    if machine is not None:
        named = machine in shipped_machines()
        pairs["machine"] = json_text(machine if named else str(resolve_path(machine)))
    if tool is not None:
        pairs["tool"] = json_text(tool)
    return pairs


def parse_positive_numbers(option: str, text: str) -> list[float]:
    """Parse an option value that consists of positive numbers separated by commas.

    Raises:
        InputError: the text is empty or contains something other than positive numbers.

    >>> parse_positive_numbers("--horizons", "1, 5,30")
    [1.0, 5.0, 30.0]
    """
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(0.0 < number < float("inf") for number in numbers):
        raise InputError(f"{option} {text}", "must be positive numbers, for example 1,5,30")
    return numbers


def _set_quiet(context: typer.Context, value: bool) -> bool:
    """Silence notes and progress if a command or the program was called with `--quiet`."""
    if context.parent is not None:
        from hydrotele.cli.console import stderr_console

        stderr_console.quiet = value or bool(context.find_root().params.get("quiet"))
    return value


QuietOption = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", callback=_set_quiet,
        help="Print only results, warnings and errors: no progress and no notes.",
    ),
]  # fmt: skip


class CommandGroup(typer.Typer):
    """A group whose commands have the additional option `--quiet`.

    Help texts are printed as they are: a unit such as [s] is not a style of rich.
    """

    def command(self, name: str | None = None, *, epilog: str | None = None, **options: Any) -> Any:
        """Return a decorator that registers a function as a command and returns the function."""
        register = super().command(name, epilog=escape(epilog or ""), **options)

        def register_with_quiet(function: Callable) -> Callable:
            @functools.wraps(function)
            def call_without_quiet(quiet: bool, **values: Any) -> Any:
                return function(**values)

            own = inspect.signature(function).parameters.values()
            own = [parameter.replace(annotation=_escape_help(parameter.annotation)) for parameter in own]
            added = inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=QuietOption)
            call_without_quiet.__dict__["__signature__"] = inspect.Signature([*own, added])
            call_without_quiet.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, added)}
            register(call_without_quiet)
            return function

        return register_with_quiet


def _escape_help(annotation: Any) -> Any:
    """Return a parameter's annotation with escaped brackets in its help text.

    rich prints escaped brackets and reads others as markup.
    """
    type_, *facts = get_args(annotation)
    facts = [copy.copy(fact) for fact in facts]
    for fact in facts:
        fact.help = escape(fact.help or "")
    return Annotated[type_, *facts]


def check_range(option: str, value: float, low: float, high: float, what: str) -> None:
    """Raise an error if an option is not a number within a range.

    Args:
        option: name of the option.
        value: its value.
        low: smallest valid value.
        high: largest valid value.
        what: name of the quantity and its unit, for the message.

    Raises:
        InputError: the value is outside the range, infinite or not a number.

    >>> check_range("--seed", 3, 0, 10, "random seed")
    """
    if not low <= value <= high:
        raise InputError(f"{option} {value:g}", f"must be a {what} from {low:g} to {high:g}")
