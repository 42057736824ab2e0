"""A gas spring that pushes a machine's slide back."""

from hydrotele.effects import Effect, Parameter, Term, law, term_parameter, with_terms

LENGTH = 0.8  # m, by which its gas would be compressed to nothing


@law
def gas_spring_force(s, force, length):
    """Force [N] of a gas spring, polytropic, with `force` at the closed end."""
    return -force * (length / (length - s.position)) ** 1.3


def locations(machine):
    return tuple(a for a in machine.axes if machine.position_kind(a) == "position")


def parameters(machine, axis):
    present = term_parameter(machine, "gas_spring", axis, "force", "force", 0.0)
    return {
        "force": Parameter("N", present, lower_bound=0.0, upper_bound=5000.0, prior_std=300.0, min_relevant_change=10.0)
    }


def apply(machine, axis, values):
    numbers = {"force": values["force"], "length": LENGTH}
    term = Term(
        name="gas_spring",
        axis=axis,
        balance="force",
        law="gas_spring_force",
        parameters=numbers,
        domain={"position": (0.0, 0.5)},
    )
    return with_terms(machine, "gas_spring", [term] if values["force"] else [], [axis])


EFFECT = Effect("gas_spring", "a gas spring that pushes the slide back", "force", locations, parameters, apply)
