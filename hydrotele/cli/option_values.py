"""Parse values of command-line options: scenario overrides and lists of numbers."""

from json import dumps as json_text

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


def parse_numbers(option: str, text: str) -> list[float]:
    """Return the positive numbers of an option value, which are separated by commas.

    Raises:
        InputError: the text is empty or contains something other than positive numbers.

    >>> parse_numbers("--horizons", "1, 5,30")
    [1.0, 5.0, 30.0]
    """
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(0.0 < number < float("inf") for number in numbers):
        raise InputError(f"{option} {text}", "must be positive numbers, for example 1,5,30")
    return numbers
