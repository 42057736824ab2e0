"""The one error that the user can mend."""


class InputError(ValueError):
    """Something the user gave is wrong; the command line prints it and exits with status 2.

    Attributes:
        where: the place, from coarse to fine: file, then column, key, row or line.
        message: what is wrong there and what to do about it.
    """

    def __init__(self, where: object, message: str) -> None:
        """Keep the place and the message; `where` may be a path."""
        super().__init__(str(where), message)  # both in args, so that it survives pickling
        self.where = str(where)
        self.message = message

    def __str__(self) -> str:
        """Return `where: message`."""
        return f"{self.where}: {self.message}"
