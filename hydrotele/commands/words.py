"""Words of the command line into overrides of a scenario."""

from json import dumps as json_text
from pathlib import Path

from hydrotele.errors import InputError


def overrides_of(items: list[str]) -> dict[str, str]:
    """Key path -> YAML text of every `key=value`.

    Raises:
        InputError: it is none.
    """
    pairs = {}
    for item in items:
        key, sign, value = item.partition("=")
        if not sign or not key:
            raise InputError(f"--set {item}", "must be key=value, for example servo.lead=0.04")
        pairs[key] = value
    return pairs


def chosen(machine: str | None, tool: str | None) -> dict[str, str]:
    """Overrides of a scenario's machine; a path counts from here, not from the scenario's file."""
    from hydrotele.machine_file import shipped_machines

    pairs = {}
    if machine is not None:
        named = machine in shipped_machines()
        pairs["machine"] = json_text(machine if named else str(Path(machine).resolve()))
    if tool is not None:
        pairs["tool"] = json_text(tool)
    return pairs
