"""Values of a machine file that are marked as estimates, in the order in which they should be replaced."""

import re
from pathlib import Path
from typing import NamedTuple

from hydrotele.core.datafile import read_yaml
from hydrotele.core.files import read_text

ESTIMATE_MARK = "estimate"
"""Comment that marks the value of a line in machine.yaml as an estimate; a reason may follow."""

_MARKED = re.compile(rf"#\s*{ESTIMATE_MARK}\b")

# The steady state first: geometry and areas set forces and speeds; the rest changes the transients.
_GROUPS = (
    (
        "pins and strokes of the cylinders",
        re.compile(r"axes\..*\.(base_pin|rod_pin|closed_length|stroke)|links\..*\.position|closures"),
    ),
    ("bores, rods and motors", re.compile(r"axes\..*\.(bore|rod_diameter|area_|count|displacement)")),
    ("pump and relief valve", re.compile(r"(supply|supplies|merging|engine)\.")),
    ("masses", re.compile(r"links\.")),
    ("valves", re.compile(r"axes\..*\.valve")),
    ("friction, volumes, leakage, cylinder masses", re.compile(r"axes\.")),
    ("sensors", re.compile(r"sensors")),
    ("others", re.compile("")),
)


class EstimateGroup(NamedTuple):
    """Marked values of one kind: a title, and the lines and key paths."""

    title: str
    keys: tuple[tuple[int, str], ...]


def find_estimates(path: Path) -> list[EstimateGroup]:
    """Return the values of a machine file on lines with the comment `# estimate`, grouped in order of effect.

    Args:
        path: the machine file.

    Returns:
        The groups that are not empty.
    """
    marked = {n for n, line in enumerate(read_text(path).splitlines(), start=1) if _MARKED.search(line)}
    _, lines = read_yaml(path)
    keys: dict[int, tuple] = {}
    for key, line in lines.items():
        if line in marked and (line not in keys or len(key) < len(keys[line])):
            keys[line] = key
    groups: dict[str, list[tuple[int, str]]] = {title: [] for title, _ in _GROUPS}
    for line, key in sorted(keys.items()):
        dotted = ".".join(map(str, key))
        title = next(title for title, pattern in _GROUPS if pattern.match(dotted))
        groups[title].append((line, dotted))
    return [EstimateGroup(title, tuple(found)) for title, found in groups.items() if found]
