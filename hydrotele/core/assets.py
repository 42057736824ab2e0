"""Files that an MJCF names: meshes, textures and height fields, found beside it and copied."""

import os
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

from hydrotele.core.errors import InputError
from hydrotele.core.files import open_regular, read_xml
from hydrotele.core.limits import check_limit

_FOLDERS = {"texture": "texturedir"}  # element -> compiler's attribute; others have `meshdir`
_FILES = ("file", *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")))


def asset_files(tree: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str, str]]:
    """Every file that a document names: (element, attribute, path relative to the document)."""
    folders: dict[str, str] = {}
    for compiler in tree.findall("compiler"):
        folders |= compiler.attrib
    for assets in tree.findall("asset"):
        for element in assets:
            kind = _FOLDERS.get(element.tag, "meshdir")
            folder = folders.get(kind, folders.get("assetdir", ""))
            for attribute in _FILES:
                if file := element.get(attribute):
                    yield element, attribute, os.path.join(folder, file)


def check_assets(tree: ElementTree.Element, mjcf: Path) -> None:
    """Refuse files that are missing, no regular files, or too large, before they are read.

    Args:
        tree: the document.
        mjcf: its file, which paths are relative to.

    Raises:
        InputError: names the document, the element and the file.
    """
    for element, attribute, file in asset_files(tree):
        where = f"{mjcf}: <{element.tag} {attribute}={element.get(attribute)!r}>"
        try:
            with open_regular(mjcf.parent / file) as opened:
                check_limit(where, "ASSET_BYTES", os.fstat(opened.fileno()).st_size)
        except InputError as error:
            raise InputError(where, error.message) from None


def copy_mjcf(mjcf: Path, target: Path, folder: str) -> bool:
    """Copy a document and the files that it names, so that the copies can be handed on.

    Args:
        mjcf: the document.
        target: the copy.
        folder: name of the folder beside the copy that takes the files, where there are any.

    Returns:
        Whether it could: a document that includes others is not copied.

    Raises:
        InputError: a file is missing or too large.
    """
    tree = read_xml(mjcf)
    if tree.find(".//include") is not None:
        return False
    check_assets(tree, mjcf)
    files = list(asset_files(tree))
    if not files:
        shutil.copyfile(mjcf, target)
        return True
    target.with_name(folder).mkdir(exist_ok=True)
    for number, (element, attribute, file) in enumerate(files):
        source = mjcf.parent / file
        if attribute == "file" and not element.get("name"):
            element.set("name", source.stem)  # MuJoCo's choice, which the new name would change
        copy = f"{folder}/{number}_{source.name}"
        shutil.copyfile(source, target.parent / copy)
        element.set(attribute, copy)
    for compiler in tree.findall("compiler"):
        for key in ("meshdir", "texturedir", "assetdir"):
            compiler.attrib.pop(key, None)
    ElementTree.ElementTree(tree).write(target, encoding="unicode")
    return True
