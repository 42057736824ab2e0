"""The one error that the user can mend."""

_MOST = 400, 1400  # bytes of place and message; a file may have keys and values of any length


class InputError(ValueError):
    """Something the user gave is wrong; the command line prints it and exits with status 2.

    Attributes:
        where: the place, from coarse to fine: file, then column, key, row or line.
        message: what is wrong there and what to do about it.
    """

    def __init__(self, where: object, message: str) -> None:
        """Keep the place and the message, each cut in its middle; `where` may be a path."""
        self.where, self.message = map(_shortened, (str(where), message), _MOST)
        super().__init__(self.where, self.message)  # both in args, so that it survives pickling

    def __str__(self) -> str:
        """Return `where: message`."""
        return f"{self.where}: {self.message}"


def _shortened(text: str, most: int) -> str:
    """The beginning and the end of a text in at most `most` bytes, control characters escaped."""
    if len(text) > 2 * most:
        text = f"{text[:most]} ... {text[-most:]}"
    text = "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text)
    content = text.encode()
    if len(content) <= most:
        return text
    head, tail = content[: 2 * most // 3 - 5], content[-(most // 3) :]
    return f"{head.decode(errors='ignore')} ... {tail.decode(errors='ignore')}"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()
