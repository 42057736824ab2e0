"""Each message of docs/faq.md is one that the program has: its words occur in the source."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "faq.md").read_text(encoding="utf-8").partition("## Messages")[2]
MESSAGES = [one for cell in re.findall(r"^\| (`.+?) \|", PAGE, re.M) for one in re.findall(r"`(.+?)`", cell)]
FOREIGN = ("Input should be", "Invalid value")  # of pydantic and typer


@pytest.fixture(scope="module")
def texts():
    """Sources of the package, with the parts of texts over several lines joined."""
    sources = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "hydrotele").rglob("*.py"))
    return re.sub(r"""["']\s*\n\s*f?["']""", "", sources)


def test_the_page_has_messages():
    assert len(MESSAGES) > 40


@pytest.mark.parametrize("message", MESSAGES)
def test_the_source_has_the_words_of_the_message(message, texts):
    """Values and inserted parts interrupt a message; half of its pairs of words must be in the source."""
    words = re.sub(r"\.\.\.", " \1 ", message).split()
    pairs = [" ".join(words[k : k + 2]) for k in range(len(words) - 1)]
    pairs = [one.strip(" .:;,?'()") for one in pairs if "\1" not in one] or [message.strip(" .")]
    known = [one for one in pairs if one in texts or message.startswith(FOREIGN)]
    assert 2 * len(known) >= len(pairs), pairs
