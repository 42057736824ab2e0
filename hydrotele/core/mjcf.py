"""Read MJCF and URDF files of users for MuJoCo: resolve, check and limit all files that they name.

`read_mjcf` reads a file with everything that it names: included documents, nested models, meshes,
textures, height fields and skins. It expands `include`, makes every path absolute and counts what
`replicate`, `flexcomp` and the sizes of the document ask for. MuJoCo then receives the resolved text
and opens only files that were checked. All readers of MJCF use `read_mjcf`, `load_spec` or
`load_model`.
"""

import contextlib
import math
import os
import re
import shutil
import struct
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from xml.parsers import expat

import mujoco

from hydrotele.core.errors import InputError
from hydrotele.core.files import check_limit, open_regular, parse_xml, read_bytes

Element = ElementTree.Element

_FILE_ATTRIBUTES = (
    "file",
    *(f"file{side}" for side in ("right", "left", "up", "down", "front", "back")),
)
_NAMELESS_ASSETS = ("mesh", "hfield", "texture", "skin", "model")  # their default name is the stem of the file
_GENERATORS = ("flexcomp", "composite")  # elements that create a grid of elements
_GRID_ATTRIBUTES = ("count", "cellcount")  # points of a grid along its axes
_SIZE_ATTRIBUTES = (
    "width", "height", "nrow", "ncol", "resolution", "dim", "actdim", "nsample", "num",
)  # fmt: skip
"""Attributes whose product is the number of values that MuJoCo stores for an element."""
_BYTES_PER_FLEX_VERTEX = 32  # least bytes of a mesh file for a vertex and its two triangles
_VALUES_PER_MESH_VERTEX = 100  # coordinates, normals, triangles, hull and bounding boxes
_PNG_START = b"\x89PNG\r\n\x1a\n"
_LINE = re.compile(r",? *\bline (\d+)")
_MUJOCO_PHRASES = (
    (re.compile(r"^((XML )?Error: )+"), ""),
    (re.compile(r" Element name '', id -?\d+"), ""),
    (re.compile(r" Element name ('[^']*'), id -?\d+"), r" (element \1)"),
    (re.compile(r" Element '([^']*)'"), r" (element <\1>)"),
)
"""Parts of MuJoCo's messages that are not sentences, and their replacements."""


@dataclass(frozen=True)
class MjcfDocument:
    """An MJCF or URDF of which all files that it names have been found and checked.

    Attributes:
        path: file that was read.
        root: root element, without `include`; asset files have absolute paths.
        models: generated name -> document of every nested model (`model` asset), the innermost ones
            first; the `file` attributes of these assets contain the generated names.
        origins: element -> file and line of its start tag.
        is_verbatim: whether the file names no other file, so that its own text is complete.
    """

    path: Path
    root: Element
    models: "Mapping[str, MjcfDocument]"
    origins: Mapping[Element, tuple[Path, int]]
    is_verbatim: bool

    @property
    def text(self) -> str:
        """XML text, with one start tag per line; nested models (`model` assets) are not part of it."""
        ElementTree.indent(self.root)
        return ElementTree.tostring(self.root, encoding="unicode")

    def flatten(self) -> str:
        """Return one XML text in which the bodies of nested models replace the `attach` elements.

        Raises:
            InputError: as `load_spec`.
        """
        if not self.models:
            return self.text
        spec = self.load_spec()
        self.compile(spec)
        return spec.to_xml()

    def load_spec(self) -> mujoco.MjSpec:
        """Parse the document with MuJoCo.

        Raises:
            InputError: MuJoCo refuses it; names file and line.
        """
        for model in self.models.values():  # so that an error in a nested model names its own file
            with translate_mujoco_errors(model.path, model):
                mujoco.MjSpec.from_string(model.text, include=model.model_texts())
        with translate_mujoco_errors(self.path, self):
            return mujoco.MjSpec.from_string(self.text, include=self.model_texts())

    def compile(self, spec: mujoco.MjSpec) -> mujoco.MjModel:
        """Compile a MuJoCo spec of this document, which may have been changed since `load_spec`, to a model.

        Raises:
            InputError: MuJoCo refuses it; names file and line where MuJoCo states one.
        """
        with translate_mujoco_errors(self.path, self):
            return spec.compile()

    def model_texts(self) -> dict[str, bytes]:
        """Return name -> XML text of the nested models; `text` refers to them by these names."""
        return {name: model.text.encode() for name, model in self.models.items()}

    def find_origin(self, line: int) -> tuple[Path, int] | None:
        """Return file and line in the user's files of the element at a line of `text`.

        It is the last element that starts on or before that line; None if there is none.
        """
        starts: list[int] = []
        parser = expat.ParserCreate()
        parser.StartElementHandler = lambda *_: starts.append(parser.CurrentLineNumber)
        parser.Parse(self.text, True)
        found = [element for element, at in zip(self.root.iter(), starts, strict=True) if at <= line]
        return self.origins.get(found[-1]) if found else None


def load_spec(path: str | Path) -> mujoco.MjSpec:
    """Read an MJCF or URDF as a MuJoCo spec.

    Raises:
        InputError: as `read_mjcf`, or MuJoCo refuses it.
    """
    return read_mjcf(path).load_spec()


def load_model(path: str | Path) -> mujoco.MjModel:
    """Read and compile an MJCF or URDF.

    Raises:
        InputError: as `read_mjcf`, or MuJoCo refuses it.
    """
    document = read_mjcf(path)
    return document.compile(document.load_spec())


@contextlib.contextmanager
def translate_mujoco_errors(where: object, document: MjcfDocument | None = None) -> Iterator[None]:
    """Convert errors that MuJoCo raises in the context to an InputError with one sentence.

    Args:
        where: location for the message.
        document: the document that MuJoCo reads, whose file and line then become the location.
    """
    try:
        yield
    except InputError:
        raise
    except (ValueError, RuntimeError, MemoryError, OSError, mujoco.FatalError) as error:
        said = " ".join(str(error).split())
        if not said or "unknown exception" in said:  # MuJoCo's words for an exception in C++
            said = "out of memory or an invalid value; check the sizes and numbers in the file"
        lines = list(_LINE.finditer(said))
        if document is not None and lines:
            origin = document.find_origin(int(lines[-1][1]))
            said = said[: lines[-1].start()] + said[lines[-1].end() :]
            where = f"{origin[0]}:{origin[1]}" if origin else where
        for phrase, replacement in _MUJOCO_PHRASES:
            said = phrase.sub(replacement, said)
        raise InputError(where, f"MuJoCo cannot read it: {said}") from None


def read_mjcf(path: str | Path) -> MjcfDocument:
    """Read an MJCF or URDF with all documents and assets that it names.

    Args:
        path: the file. Paths in it are relative to its folder; those of an included document may
            also be relative to the folder of that document, as in MuJoCo.

    Returns:
        The document.

    Raises:
        InputError: a file cannot be read, is a pipe or device, is too large or includes itself, or
            the document asks for too many elements or values. Names file and line.
    """
    return _Reader().read(Path(path), ())[0]


def copy_mjcf(mjcf: Path, target: Path, folder: str) -> None:
    """Copy an MJCF with all files that it names, so that the copy does not depend on the original.

    Args:
        mjcf: the MJCF file.
        target: path of the copy; included documents become a part of it.
        folder: name of the folder for asset files and nested models, created next to the copy if
            needed.

    Raises:
        InputError: as `read_mjcf`.
    """
    document = read_mjcf(mjcf)
    if document.is_verbatim:
        shutil.copyfile(mjcf, target)
        return
    beside = target.with_name(folder)
    beside.mkdir(exist_ok=True)
    copies: dict[str, str] = {}
    for name, model in document.models.items():
        copies[name] = f"{len(copies)}_{model.path.name}"
        _copy_assets(model.root, copies, beside, "")
        ElementTree.ElementTree(model.root).write(beside / copies[name], encoding="unicode")
    _copy_assets(document.root, copies, beside, f"{folder}/")
    ElementTree.ElementTree(document.root).write(target, encoding="unicode")


def _copy_assets(root: Element, copies: dict[str, str], folder: Path, prefix: str) -> None:
    """Copy the files that a resolved document names to a folder, and make the document name the copies.

    Assets without a name also get one: the stem of their original file, which is MuJoCo's default.

    Args:
        root: root element of the document, changed in place.
        copies: {source path, or generated name of a nested model: file name of its copy}; files in
            it are not copied again, and new copies are added to it.
        folder: folder of the copies.
        prefix: text before the file names in the document, such as `assets/`.
    """
    for element, attribute in _file_references(root):
        source = str(element.get(attribute))
        if source not in copies:
            copies[source] = f"{len(copies)}_{Path(source).name}"
            shutil.copyfile(source, folder / copies[source])
        if attribute == "file" and element.tag in _NAMELESS_ASSETS and not element.get("name"):
            element.set("name", Path(source).stem)
        element.set(attribute, prefix + copies[source])


def _file_references(root: Element) -> list[tuple[Element, str]]:
    """Return (element, attribute) of all attributes below a root element that name a file."""
    return [(element, key) for element in root.iter() for key in _FILE_ATTRIBUTES if element.get(key)]


class _Reader:
    """Reader of one file and all documents that it names; size limits hold for all of them together."""

    def __init__(self) -> None:
        self.origins: dict[Element, tuple[Path, int]] = {}
        self.models: dict[Path, tuple[str, MjcfDocument, float]] = {}
        self.bytes = self.asset_bytes = 0

    def read(self, path: Path, parents: tuple[Path, ...]) -> tuple[MjcfDocument, float]:
        """Read a document.

        Args:
            path: its file.
            parents: files of the documents that it is nested in, outermost first.

        Returns:
            The document, and the number of its elements with all copies, such as those by
            `replicate`.
        """
        root = self._parse(path)
        included = {path.resolve()}
        self._expand_includes(root, path, path, included, 1)
        models: dict[str, MjcfDocument] = {}
        sizes: dict[str, float] = {}
        vertices: dict[Element, float] = {}
        values = 0.0
        if root.tag == "robot":
            self._resolve_urdf_meshes(root, path)
        folders = self._extract_asset_folders(root)
        references = _file_references(root)
        for element, attribute in references:
            if element.tag == "model":
                name, document, count = self._read_model(element, path, (*parents, path.resolve()))
                models |= {**document.models, name: document}
                element.set("name", element.get("name") or Path(str(element.get("file"))).stem)
                sizes[element.attrib["name"]] = count
                element.set("file", name)
                continue
            file = self._resolve_asset(element, attribute, path, folders)
            with open_regular(file) as opened:
                size = os.fstat(opened.fileno()).st_size
                self.asset_bytes += size
                check_limit(self._format_attribute_location(element, attribute), "ASSET_BYTES", self.asset_bytes)
                values += _count_pixels(opened.read(24))
            vertices[element] = size / _BYTES_PER_FLEX_VERTEX
            element.set(attribute, str(file))
        elements = _count_elements(root, path, self.origins, sizes, vertices, values)
        verbatim = not references and len(included) == 1
        return MjcfDocument(path, root, models, self.origins, verbatim), elements

    def _parse(self, path: Path) -> Element:
        content = read_bytes(path)
        self.bytes += len(content)
        check_limit(path, "FILE_BYTES", self.bytes)
        root = parse_xml(path, content, self.origins)
        check_limit(path, "MJCF_ELEMENTS", len(self.origins))
        return root

    def _expand_includes(self, element: Element, path: Path, main: Path, included: set[Path], depth: int) -> None:
        """Replace the `include` elements below an element by the content of their files, in place.

        Args:
            element: the element.
            path: file that contains the element.
            main: file of the outermost document; included files are sought in its folder first.
            included: resolved paths of all included files and of `main`; new ones are added.
            depth: nesting depth of the element.
        """
        check_limit(self._format_location(element), "FILE_DEPTH", depth)
        for child in list(element):
            if child.tag != "include":
                self._expand_includes(child, path, main, included, depth + 1)
                continue
            where = self._format_attribute_location(child, "file")
            if len(child) or not child.get("file"):
                raise InputError(
                    self._format_location(child), "an <include> must have the attribute file and no children"
                )
            file = _find_file(PurePosixPath(child.attrib["file"]), main.parent, path.parent)
            if file.resolve() in included:
                raise InputError(
                    where, f"{file} is already included; a document can be included once, and not in itself"
                )
            included.add(file.resolve())
            try:
                content = self._parse(file)
            except InputError as error:
                raise InputError(where, str(error)) from None
            if not len(content):
                raise InputError(where, f"{file} has no elements to include")
            self._expand_includes(content, file, main, included, depth)
            index = list(element).index(child)
            element[index : index + 1] = list(content)

    def _extract_asset_folders(self, root: Element) -> dict[str, str]:
        """Return the `compiler` attributes that locate asset files, and remove them from the document.

        The keys of the result are `meshdir`, `texturedir` and `strippath`. The attribute `assetdir`
        sets the first two.
        """
        folders: dict[str, str] = {}
        for compiler in root.iter("compiler"):
            for key in ("assetdir", "meshdir", "texturedir", "strippath"):
                if (value := compiler.attrib.pop(key, None)) is not None:
                    folders |= dict.fromkeys(("meshdir", "texturedir") if key == "assetdir" else (key,), value)
        return folders

    def _resolve_asset(self, element: Element, attribute: str, path: Path, folders: Mapping[str, str]) -> Path:
        """Return the absolute path of an asset file.

        The file is sought in the asset folder of its kind, relative to the folder of the document.
        If it is missing there, it is sought relative to the folder of the file that contains the
        element.

        Args:
            element: the asset.
            attribute: attribute of the asset that names the file.
            path: file of the document.
            folders: result of `_extract_asset_folders`.

        Raises:
            InputError: there is no such file, or it is not a readable regular file.
        """
        folder = folders.get("texturedir" if element.tag == "texture" else "meshdir", "")
        named = _portable_path(element.attrib[attribute])
        if folders.get("strippath") == "true":
            named = PurePosixPath(named.name)
        beside = self.origins[element][0].parent
        first = _find_file(_portable_path(folder) / named, path.parent, path.parent)
        file = first if first.exists() else _find_file(named, beside, beside)
        file = file if file.exists() else first
        try:
            with open_regular(file):
                return file.absolute()
        except InputError as error:
            raise InputError(self._format_attribute_location(element, attribute), f"{file}: {error.message}") from None

    def _read_model(self, element: Element, path: Path, parents: tuple[Path, ...]) -> tuple[str, MjcfDocument, float]:
        """Read the document of a `model` asset, or return it if it was read before.

        Args:
            element: the asset.
            path: file of the document with the asset.
            parents: files of the documents that it is nested in, outermost first.

        Returns:
            Generated unique name, document, and number of its elements with all copies.
        """
        where = self._format_attribute_location(element, "file")
        file = _find_file(_portable_path(element.attrib["file"]), self.origins[element][0].parent, path.parent)
        key = file.resolve()
        if key in parents:
            raise InputError(where, f"{file} is a model inside itself")
        check_limit(where, "FILE_DEPTH", len(parents))
        if key not in self.models:
            try:
                document, count = self.read(file, parents)
            except InputError as error:
                raise InputError(where, str(error)) from None
            self.models[key] = f"hydrotele_model_{len(self.models)}.xml", document, count
        return self.models[key]

    def _resolve_urdf_meshes(self, root: Element, path: Path) -> None:
        """Make the mesh paths of a URDF absolute in place, and check the total size of the existing files.

        Missing files are accepted here, since those of visual meshes may be missing.
        """
        compiler = root.find("mujoco/compiler")
        if compiler is None:
            compiler = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
        strip, folder = compiler.get("strippath", "true") == "true", compiler.get("meshdir", "")
        for mesh in root.iter("mesh"):
            named = _portable_path(mesh.get("filename", "").removeprefix("package://"))
            named = _portable_path(folder) / (named.name if strip else named)
            file = _find_file(named, path.parent, path.parent)
            if file.exists():
                with open_regular(file) as opened:
                    self.asset_bytes += os.fstat(opened.fileno()).st_size
                check_limit(f"{self._format_location(mesh)}: {file}", "ASSET_BYTES", self.asset_bytes)
            mesh.set("filename", str(file.absolute()))
        compiler.set("strippath", "false")

    def _format_location(self, element: Element) -> str:
        path, line = self.origins[element]
        return f"{path}:{line}"

    def _format_attribute_location(self, element: Element, attribute: str) -> str:
        return f"{self._format_location(element)}: <{element.tag} {attribute}={element.get(attribute)!r}>"


def _portable_path(name: str) -> PurePosixPath:
    r"""Return a path with / in place of \, which MuJoCo accepts."""
    return PurePosixPath(PureWindowsPath(name).as_posix() if "\\" in name else name)


def _find_file(name: PurePosixPath, first: Path, second: Path) -> Path:
    """Return the path of a file in the first of two folders that contains it; if none does, in `first`.

    Args:
        name: file name or path relative to the folders.
        first: folder that is tried first.
        second: folder that is tried next.

    Raises:
        InputError: no file can have this name.
    """
    try:
        return next((folder / name for folder in (first, second) if (folder / name).exists()), first / name)
    except (OSError, ValueError) as error:  # a name that no file can have
        raise InputError(str(name), f"is not a valid file name: {error}") from None


def _count_pixels(head: bytes) -> float:
    """Return the number of values of a PNG image from its first 24 bytes; 0 for other files."""
    if not head.startswith(_PNG_START) or len(head) < 24:
        return 0.0
    width, height = struct.unpack(">II", head[16:24])
    return float(width) * height


def _count_elements(
    root: Element, path: Path, origins: Mapping[Element, tuple[Path, int]], models: Mapping[str, float],
    vertices: Mapping[Element, float], values: float,
) -> float:  # fmt: skip
    """Count the elements and stored values of a document with all copies, and check their limits.

    Args:
        root: root element.
        path: its file.
        origins: element -> file and line.
        models: name -> number of elements of every `model` asset.
        vertices: element -> largest number of vertices in the file that it names.
        values: number of values of the images.

    Returns:
        The number of elements.

    Raises:
        InputError: there are too many elements or values.
    """
    tags: Counter[str] = Counter()
    sizes: dict[str, float] = {}  # values per element of a kind, from the defaults
    user_values: dict[Element, float] = {}  # values per element of any kind, from <size nuser_...>
    most_elements: dict[Element, float] = {}
    most_values: dict[Element, float] = {}

    def locate_largest_element(amounts: Mapping[Element, float]) -> str:
        """Return file, line and tag of the element with the largest number of copies or values, as text."""
        element = max(amounts, key=lambda element: amounts[element])
        file, line = origins.get(element, (path, 0))
        return f"{file}:{line}: <{element.tag}>"

    def read_numbers(element: Element, attribute: str) -> list[float]:
        try:
            found = [abs(float(word)) for word in element.get(attribute, "").split()]
        except ValueError:
            found = [math.nan]
        if any(math.isnan(number) for number in found):
            file, line = origins[element]
            said = f"<{element.tag} {attribute}={element.get(attribute)!r}>: must be a number"
            raise InputError(f"{file}:{line}", said)
        return found

    def count_subtree(element: Element, copies: float, is_default: bool) -> None:
        nonlocal values
        tag, own = element.tag, 1.0
        if tag in _GENERATORS:
            own += math.prod(number for key in _GRID_ATTRIBUTES for number in read_numbers(element, key))
            own += vertices.get(element, 0.0)
        elif tag == "attach":
            own += models.get(element.get("model", ""), 0.0)
        elif tag == "size":
            own += sum(read_numbers(element, "nkey"))
            for key in element.attrib:
                if key.startswith("nuser_"):
                    user_values[element] = user_values.get(element, 0.0) + sum(read_numbers(element, key))
                elif key == "nuserdata":
                    values += sum(read_numbers(element, key))
        stored = [number for key in _SIZE_ATTRIBUTES if key in element.attrib for number in read_numbers(element, key)]
        stated = math.prod(stored) if stored else 0.0
        if tag == "mesh" and element.get("builtin"):
            stated = _VALUES_PER_MESH_VERTEX * max(read_numbers(element, "params"), default=0.0) ** 2
        if is_default:
            sizes[tag] = max(sizes.get(tag, 0.0), stated)
        tags[tag] += copies * own  # type: ignore[assignment]
        values += copies * stated
        most_elements[element], most_values[element] = copies * own, copies * stated
        if tag == "replicate":
            copies *= max(1.0, math.prod(read_numbers(element, "count")))
        for child in element:
            count_subtree(child, copies, is_default or tag == "default")

    count_subtree(root, 1.0, False)
    elements = tags.total() + sum(models.values())
    check_limit(locate_largest_element(most_elements), "MJCF_ELEMENTS", elements)
    values += sum(size * tags[tag] for tag, size in sizes.items())
    for element, size in user_values.items():
        most_values[element] += size * elements
        values += size * elements
    check_limit(locate_largest_element(most_values), "MJCF_VALUES", values)
    return elements
