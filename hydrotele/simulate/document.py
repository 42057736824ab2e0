"""The complete MJCF of a machine, with the files that it needs."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco

from hydrotele.core.errors import InputError


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
