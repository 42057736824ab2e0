"""What is printed: our styles are styles, and names or paths with brackets are text."""

import pytest

from hydrotele.cli.console import _Console


@pytest.mark.parametrize(
    "name",
    ["a[/]b", "[bold", "[link=file:///etc]x[/link]", "run [3]", "[red]", "\\[x]", "angle [deg]",
     ":smile:", "[/nothing]", "[@click=app.quit]x"],
)  # fmt: skip
def test_names_in_brackets_are_text(name):
    console = _Console(width=200, emoji=False, highlight=False)
    with console.capture() as seen:
        console.print(f"written to [bold]{name}[/]")
    if name in ("[red]", "\\[x]"):  # a style of ours styles, an escaped bracket is one
        assert "written to" in seen.get()
    else:
        assert name in seen.get()


def test_own_styles_are_styles():
    console = _Console(width=200, force_terminal=True, color_system="standard")
    with console.capture() as seen:
        console.print("[bold green]done[/] now")
    assert seen.get() == "\x1b[1;32mdone\x1b[0m now\n"
