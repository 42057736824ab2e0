"""Which joints of a machine's links follow from its closures."""

from hydrotele.machine.machine import Machine


def following_joints(machine: Machine) -> tuple[str, ...]:
    """Names of the undriven joints of links that the closures determine."""
    driven = {axis.joint for axis in machine.axes.values()}
    names: list[str] = []
    for closure in machine.closures.values():
        for link in links_of_loop(machine, closure.a.link, closure.b.link):
            joint = machine.links[link].joint
            if joint and joint.name not in driven and joint.name not in names:
                names.append(joint.name)
    return tuple(names)


def links_of_loop(machine: Machine, a: str, b: str) -> list[str]:
    """Links between two links of the tree, without their common parents."""
    chains = []
    for link in (a, b):
        chain = []
        while link != "world":
            chain.append(link)
            link = machine.links[link].parent
        chains.append(chain)
    return [x for x in chains[0] + chains[1] if not (x in chains[0] and x in chains[1])]
