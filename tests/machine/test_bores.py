"""Bore and rod diameters of cylinders beside areas."""

import math

import pytest

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.machine.machine_file import load_machine


def write(folder, areas):
    text = (models_folder() / "rig" / "machine.yaml").read_text()
    lines = [line for line in text.splitlines() if "area_rod" not in line]
    place = next(k for k, line in enumerate(lines) if "area_head" in line)
    indent = len(lines[place]) - len(lines[place].lstrip())
    lines[place : place + 1] = [" " * indent + area for area in areas]
    (folder / "machine.yaml").write_text("\n".join(lines))
    (folder / "rig.xml").write_bytes((models_folder() / "rig" / "rig.xml").read_bytes())
    return folder


@pytest.mark.parametrize("count", [1, 2])
def test_diameters_become_areas(tmp_path, count):
    write(tmp_path, ["bore_mm: 40", "rod_diameter: 0.025", f"count: {count}"])
    cylinder = next(iter(load_machine(tmp_path).axes.values())).cylinder
    assert cylinder.area_head == pytest.approx(count * math.pi / 4 * 0.04**2)
    assert cylinder.area_rod == pytest.approx(count * math.pi / 4 * (0.04**2 - 0.025**2))


@pytest.mark.parametrize(
    ("areas", "message"),
    [
        (["bore_mm: 40"], "rod_diameter is missing"),
        (["bore_mm: 40", "rod_diameter_mm: 40"], "smaller than bore"),
        (["bore_mm: 40", "rod_diameter_mm: 25", "area_head_cm2: 12"], "not both"),
        (["bore_mm: x", "rod_diameter_mm: 25"], "finite number"),
        (["bore_mm: 40", "rod_diameter_mm: 25", "count: 1.5"], "number of cylinders"),
    ],
)
def test_wrong_diameters_are_refused(tmp_path, areas, message):
    with pytest.raises(InputError, match=message):
        load_machine(write(tmp_path, areas))
