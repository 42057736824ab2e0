"""Terms that an effect puts into a machine, found again by the effect's name."""

from collections.abc import Iterable

from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import Balance, Term


def term_number(
    machine: Machine, name: str, axis: str, balance: Balance, parameter: str, absent: float
) -> float:
    """A parameter of the term that an effect put onto a drive.

    Args:
        machine: the machine.
        name: of the effect.
        axis: of the drive.
        balance: of the term.
        parameter: of its law.
        absent: what to return where there is no such term.

    Returns:
        Its value.
    """
    for term in machine.terms:
        if (term.name, term.axis, term.balance) == (name, axis, balance):
            value = term.parameters[parameter]
            assert isinstance(value, float)
            return value
    return absent


def with_terms(
    machine: Machine, name: str, terms: Iterable[Term], axes: Iterable[str] | None = None
) -> Machine:
    """A machine whose terms of a name are these, in place of those of that name.

    Args:
        machine: the machine.
        name: of the effect.
        terms: the new ones, none to take the effect out.
        axes: of which terms are replaced; None for all.

    Returns:
        The changed machine.
    """
    where = set(machine.axes if axes is None else axes)
    kept = [term for term in machine.terms if term.name != name or term.axis not in where]
    return machine.model_copy(update={"terms": (*kept, *terms)})
