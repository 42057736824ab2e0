"""Pages that list every command of hydrotele with its arguments, options and examples."""

import re
from pathlib import Path
from typing import Any, get_args, get_origin

import typer.main
import yaml

from hydrotele.cli.main import app
from hydrotele.cli.program_help import COMMAND_GROUPS, OPTIONS

EXAMPLE = re.compile(r"^Examples?:\s*")
TEXTS: dict[str, str] = yaml.safe_load(Path(__file__).with_name("commands.yaml").read_text(encoding="utf-8"))
"""Command as it is typed -> paragraph on its purpose and its guide (Markdown)."""
REPEATABLE = " Can be given several times."


def find_commands() -> dict[str, Any]:
    """Return {name: command of typer} of all top-level commands."""
    return dict(typer.main.get_command(app).commands)  # pyright: ignore[reportAttributeAccessIssue]


def format_command(command: Any, words: str, level: int = 1) -> list[str]:
    """Return the parts of the text on a command and its subcommands; `words` is the command as it is typed."""
    parts = [f"{'#' * level} {words}", *_paragraphs(command.help or ""), *_paragraphs(TEXTS.get(words, ""))]
    commands = getattr(command, "commands", {})
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option" and not p.hidden]
    if not commands:
        needed = [f"{p.opts[0]} {_value_name(p)}" for p in options if p.required]
        last = [_argument(p) for p in arguments if p.name == "more"]  # values that follow those of an option
        first = [_argument(p) for p in arguments if p.name != "more"]
        typed = [f"hydrotele {words}", *first, *needed, *last, "[OPTIONS]" if options else ""]
        parts.append(f"Usage:\n\n```console\n{' '.join(word for word in typed if word)}\n```")
    if arguments:
        rows = [f"| `{_argument(p)}` | {_escape(p.help or '')} | {_default(p)} |" for p in arguments]
        parts.append("\n".join(["| argument | meaning | default |", "| --- | --- | --- |", *rows]))
    if options and not commands:
        rows = [f"| {_option(p)} | {_escape(p.help or '').replace(REPEATABLE, '')} | {_default(p)} |" for p in options]
        parts.append("\n".join(["| option | meaning | default |", "| --- | --- | --- |", *rows]))
    if command.epilog:
        parts += _format_epilog(command.epilog)
    for name, inner in commands.items():
        parts += format_command(inner, f"{words} {name}", level + 1)
    return [part for part in parts if part]


def _paragraphs(text: str) -> list[str]:
    return [" ".join(part.split()) for part in text.replace("\b", "").replace("\f", "").split("\n\n")]


def _argument(parameter: Any) -> str:
    name = (parameter.metavar or parameter.name).upper().rstrip(".")
    shown = f"{name}..." if parameter.nargs == -1 or parameter.multiple else name
    return shown if parameter.required else f"[{shown}]"


def _option(parameter: Any) -> str:
    names = [f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts)]
    value = "" if parameter.is_flag else f" {_value_name(parameter)}"
    return f"{', '.join(names)}{value}{', repeatable' if parameter.multiple else ''}"


def _value_name(parameter: Any) -> str:
    annotation = parameter.type_descriptor.annotation
    if get_origin(annotation) is list:
        annotation = get_args(annotation)[0]
    choices = get_args(annotation)
    if choices and all(isinstance(choice, str) for choice in choices):
        return " or ".join(f"`{choice}`" for choice in choices)
    text = parameter.metavar or getattr(annotation, "__name__", str(annotation))
    return {"str": "TEXT", "int": "INTEGER", "float": "NUMBER", "Path": "PATH"}.get(text, text)


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    value = parameter.default
    if value is None or callable(value) or value == ():
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"`{value}`"


def _escape(text: str) -> str:
    return " ".join(text.split()).replace("\\[", "[").replace("|", "\\|")


def _format_epilog(epilog: str) -> list[str]:
    """Return the epilog of a command as Markdown: blocks marked with a backspace keep their lines."""
    parts = []
    for block in re.split(r"\n\s*\n", epilog.strip("\n").replace("\\[", "[")):
        is_kept = block.startswith("\b") or parts == []
        lines = block.replace("\b\n", "").replace("\b", "").split("\n")
        if is_kept and EXAMPLE.match(lines[0]):
            lines = [EXAMPLE.sub("", line).strip() for line in lines]
            lines = [word.strip() for line in lines for word in line.split("   |   ")]
            parts.append("Examples:\n\n```console\n" + "\n".join(lines) + "\n```")
        elif is_kept:
            is_table = any(line.startswith("  ") for line in lines)
            parts.append("```text\n" + "\n".join(lines) + "\n```" if is_table else " ".join(lines))
        else:
            parts.append(" ".join(" ".join(lines).split()))
    return parts


def list_pages() -> dict[str, str]:
    """Return {path of the page: its text} of all commands, and of their index."""
    commands = find_commands()
    pages = {f"commands/{name}.md": "\n\n".join(format_command(c, name)) + "\n" for name, c in commands.items()}
    parts = [
        "# Commands",
        "The program `hydrotele` has one command for each task. Each page below describes a command: its purpose,"
        " usage, arguments, options and examples. `hydrotele COMMAND --help` prints arguments, options and examples.",
        "In *Usage*, words in capitals are values that you give, and brackets enclose what may be omitted. `...` and"
        " *repeatable* mark what can be given several times. An option with two names, such as `--review`,"
        " `--no-review`, is switched on by the first and off by the second. Where the column *default* is empty, the"
        " option is not used unless it is given, or its description states the default.",
        "The exit status of a command is 0 for success, 2 for an error in the input, and 3 for a failed simulation;"
        " pages of commands state others.",
        "Options of the program itself:",
    ]
    parts.append("| option | meaning |\n| --- | --- |\n" + "\n".join(f"| `{k}` | {v} |" for k, v in OPTIONS.items()))
    for title, group in COMMAND_GROUPS.items():
        rows = [f"| [{name}]({name}.md) | {_escape(text)} |" for name, text in group.items()]
        parts += [f"## {title}", "| command | purpose |\n| --- | --- |\n" + "\n".join(rows)]
    names = "\n".join(name for group in COMMAND_GROUPS.values() for name in group)
    parts.append(f"```{{toctree}}\n:hidden:\n\n{names}\n```")
    pages["commands/index.md"] = "\n\n".join(parts) + "\n"
    return pages
