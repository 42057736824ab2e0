"""MJCF text with or without what only a picture needs.

Hundreds of geoms that touch nothing double the cost of a step and make assembling slow, so physics
leaves them out; masses do not come from geoms here.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import PurePosixPath

Element = ElementTree.Element


def without_looks(root: Element) -> None:
    """Remove geoms that touch nothing, meshes and materials, cameras and lights, in place.

    Args:
        root: the `mujoco` element of an MJCF file.
    """
    world = root.find("worldbody")
    if world is None:
        return
    touching = _touching_by_class(root)
    _prune(world, "main", touching)
    kept = {(kind, geom.get(kind)) for geom in world.iter("geom") for kind in ("mesh", "hfield")}
    for asset in root.findall("asset"):
        for element in list(asset):
            if (element.tag, _asset_name(element)) not in kept:
                asset.remove(element)
    for geom in root.iter("geom"):  # in bodies and in default classes
        geom.attrib.pop("material", None)


def _asset_name(element: Element) -> str:
    """Name of an asset; MuJoCo takes the file's where there is none."""
    return element.get("name") or PurePosixPath(element.get("file", "")).stem


def name_geoms(root: Element) -> None:
    """Give every unnamed geom a name made of its body's, in place.

    `dm_control` searches the whole document for each unnamed element that it writes.
    """
    for body in root.iter("body"):
        for number, geom in enumerate(body.findall("geom")):
            if not geom.get("name"):
                geom.set("name", f"{body.get('name', 'body')}_look{number}")


def _touching_by_class(root: Element) -> dict[str, bool]:
    """Class name -> whether its geoms can touch something by default."""
    table: dict[str, bool] = {}

    def walk(element: Element, name: str, contype: int, conaffinity: int) -> None:
        geom = element.find("geom")
        if geom is not None:
            contype = int(geom.get("contype", contype))
            conaffinity = int(geom.get("conaffinity", conaffinity))
        table[name] = bool(contype or conaffinity)
        for child in element.findall("default"):
            walk(child, child.get("class", "main"), contype, conaffinity)

    for top in root.findall("default"):
        walk(top, top.get("class", "main"), 1, 1)
    table.setdefault("main", True)
    return table


def _prune(body: Element, inherited: str, touching: dict[str, bool]) -> None:
    childclass = body.get("childclass", inherited)
    for element in list(body):
        if element.tag == "geom":
            default = touching.get(element.get("class", childclass), True)
            stated = [element.get(key) for key in ("contype", "conaffinity")]
            own = any(value not in (None, "0") for value in stated)
            if not (own or (default and stated != ["0", "0"])):
                body.remove(element)
        elif element.tag in ("camera", "light"):
            body.remove(element)
        elif element.tag in ("body", "frame"):
            _prune(element, childclass, touching)
