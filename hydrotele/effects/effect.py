"""What an effect is: a name, a sentence, places, parameters, and the change of the Machine."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal

from hydrotele.machine.machine import Machine

Law = Literal["force", "flow", "valve", "supply", "geometry", "timing", "sensor"]
Values = Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number of an effect at one place of one machine.

    Attributes:
        unit: SI unit.
        nominal: its value in the machine as it is, without the effect.
        low: smallest physically plausible value.
        high: largest physically plausible value.
        scale: typical size of a deviation from nominal (the prior's standard deviation).
        least: deviation below which the effect is not worth naming.
        starts: values from which a search starts where the effect vanishes at nominal, or where
            its slope there tells little; empty where nominal is a good start.
        optional: whether it may be left out where the effect is planted, and is so where it is
            looked for among others: it then keeps its nominal value.
    """

    unit: str
    nominal: float
    low: float
    high: float
    scale: float
    least: float
    starts: tuple[float, ...] = ()
    optional: bool = False


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical effect that a machine can have and its model can lack.

    Attributes:
        name: fixed name, as in reports and files.
        sentence: what it is, one sentence.
        law: the law of the model that it changes.
        locations: machine -> names of the places where it can sit.
        parameters: (machine, location) -> parameter name -> Parameter.
        apply: (machine, location, parameter name -> value) -> machine that has it. With all values
            nominal it returns a machine that behaves as the given one.
        mechanism: what other effects have in common with it that are the same thing in another
            form, such as a delay and a lag of one sensor; empty for what stands alone.
    """

    name: str
    sentence: str
    law: Law
    locations: Callable[[Machine], tuple[str, ...]]
    parameters: Callable[[Machine, str], dict[str, Parameter]]
    apply: Callable[[Machine, str, Values], Machine]
    mechanism: str = ""


def changed(machine: Machine, path: str, value: Any) -> Machine:
    """Copy of a machine with one number replaced, at a dotted path such as `supply.pump_flow`."""
    return _replace(machine, path.split("."), value)


def _replace(node: Any, path: list[str], value: Any) -> Any:
    if not path:
        return value
    if isinstance(node, dict):
        return {**node, path[0]: _replace(node[path[0]], path[1:], value)}
    return node.model_copy(update={path[0]: _replace(getattr(node, path[0]), path[1:], value)})
