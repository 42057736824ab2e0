"""The error raised for invalid user input."""

_MAX_BYTES = 400, 1400  # bytes of location and message; keys and values of a file can be very long


class InputError(ValueError):
    """Error in user input; the command line prints it and exits with status 2.

    Attributes:
        where: location of the error, from coarse to fine: file, then column, key, row or line.
        message: description of the error and how to correct it.

    Examples:
        A misspelt name gets the nearest valid one.

        >>> import hydrotele as ht
        >>> try:
        ...     ht.load_machine("cat251")
        ... except ht.InputError as error:
        ...     print(error.where, "|", error.message.partition(";")[0])
        machine 'cat251' | is neither a folder with machine.yaml nor a shipped machine
    """

    def __init__(self, where: object, message: str) -> None:
        """Store location and message, each shortened if too long; `where` may be a path."""
        self.where, self.message = map(_shorten_text, (str(where), message), _MAX_BYTES)
        super().__init__(self.where, self.message)  # pickling passes `args` to the constructor

    def __str__(self) -> str:
        """Return `where: message`."""
        return f"{self.where}: {self.message}"


def _shorten_text(text: str, max_bytes: int) -> str:
    """Escape the control characters of a text, except line breaks, and shorten it by cutting its middle.

    The result has at most `max_bytes` bytes of UTF-8.
    """
    if len(text) > 2 * max_bytes:
        text = f"{text[:max_bytes]} ... {text[-max_bytes:]}"
    text = "".join(c if c.isprintable() or c == "\n" else _escape_character(c) for c in text)
    content = text.encode()
    if len(content) <= max_bytes:
        return text
    head, tail = content[: 2 * max_bytes // 3 - 5], content[-(max_bytes // 3) :]
    return f"{head.decode(errors='ignore')} ... {tail.decode(errors='ignore')}"


def _escape_character(character: str) -> str:
    return character.encode("unicode_escape").decode()
