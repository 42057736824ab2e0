"""The complete MJCF of a machine, with the files that it needs.

Names of what is added to a machine's MJCF; a prefix keeps them apart from the user's own.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco

from hydrotele.core.errors import InputError

OWN = "hydrotele_"
"""What the names begin with of all that no file of the user names."""

GROUND = f"{OWN}ground"
"""Name of the ground's geom, texture and material."""

TIP_SITE = f"{OWN}tip"
"""Name of the site at the arm's tip."""


def pin_site(closure: str, end: str) -> str:
    """Name of the site at an end, a or b, of a closure; a cylinder's is `<axis>_pin`."""
    return f"{OWN}{closure}_{end}"


class Mjcf(NamedTuple):
    """A complete MJCF.

    Attributes:
        name: of the machine.
        text: the document; it names its assets without folder.
        assets: name -> content of every file that it needs.
    """

    name: str
    text: str
    assets: Mapping[str, bytes]

    def compile(self) -> mujoco.MjModel:
        """The MuJoCo model.

        Raises:
            InputError: MuJoCo refuses it.
        """
        try:
            return mujoco.MjModel.from_xml_string(self.text, dict(self.assets))
        except ValueError as error:
            message = " ".join(str(error).split())
            raise InputError(f"machine {self.name}", f"does not compile: {message}") from None

    def save(self, path: Path, beside: Path | None = None) -> None:
        """Write the document, and its assets into the folder `<stem>_assets` beside it.

        Args:
            path: file to write.
            beside: the name that the file will have in the end, if that is another one.
        """
        folder = (beside or path).with_suffix("").name + "_assets"
        text = self.text
        for name, content in self.assets.items():
            path.with_name(folder).mkdir(exist_ok=True)
            path.with_name(folder).joinpath(name).write_bytes(content)
            text = text.replace(f'="{name}"', f'="{folder}/{name}"')
        path.write_text(text, encoding="utf-8")
