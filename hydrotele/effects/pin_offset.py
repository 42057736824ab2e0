"""A cylinder whose base pin sits elsewhere than in the model."""

from hydrotele.effects._sizes import across, linkages
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """A thousandth of the closed length, 1.5 mm, is the play of a worn pin."""
    cylinder = machine.axes[location].cylinder
    assert cylinder
    size = cylinder.closed_length
    offset = Parameter("m", 0.0, -0.05 * size, 0.05 * size, 0.005 * size, 0.001 * size)
    return dict.fromkeys(across(machine, location), offset)


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """The base pin moves in its link's frame; the closed length, hence x at a length, stays."""
    cylinder = machine.axes[location].cylinder
    assert cylinder
    way = zip("xyz", cylinder.base_pin.position, strict=True)
    position = tuple(place + values.get(name, 0.0) for name, place in way)
    return changed(machine, f"axes.{location}.cylinder.base_pin.position", position)


EFFECT = Effect(
    "pin_offset", "the base pin of a cylinder sits elsewhere", "geometry", linkages, _parameters,
    _apply,
)  # fmt: skip
