"""A term of a machine: which law adds to which balance of which drive."""

from collections.abc import Mapping
from typing import Literal

from pydantic import model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, Positive, suggest
from hydrotele.terms.law import LAWS, VARIABLES, Value

BALANCES = ("force", "flow_head", "flow_rod", "command", "flow_supply")
Balance = Literal["force", "flow_head", "flow_rod", "command", "flow_supply"]
OF_A_DRIVE = (
    "position", "velocity", "spool", "spool_rate", "pump_speed", "pressure_load", "pressure_head",
    "pressure_rod", "command", "force",
)  # fmt: skip
"""Variables that a law may see of another drive than the one that it adds to."""


class Play(Facts):
    """A play through which a variable goes: what comes through follows half a width behind.

    The law sees it as `played`, beside the variable itself, and what lies between as `ahead`. It
    begins at 0, or as near as the variable lets it.
    """

    variable: str
    half_width: Positive


class Switch(Facts):
    """A variable that switches a law on and off, as a relay with hysteresis does.

    The law begins to act where the variable has passed `on`, and ends where it has gone back beyond
    `off`; each comes about over a tenth of what lies between. With `on` below `off` it acts where
    the variable is low.
    """

    variable: str
    on: float
    off: float

    @model_validator(mode="after")
    def _check(self):
        if self.on == self.off:
            raise ValueError(f"on and off are both {self.on:g}; between them must lie something")
        return self


class Term(Facts):
    """A law that adds to a balance of a drive.

    `balance` is `force` (on the drive [N] or [N m]), `flow_head` or `flow_rod` (into a chamber
    [m^3/s]), `command` (to valve or drive [1] or [V]) or `flow_supply` (to the flow of the pump
    that the valves share, which follows it with a lag of 20 ms [m^3/s]). `name` says what put it
    there, such as an effect's name. In `of` the variables that are another drive's: `{velocity:
    swing}` lets the law see the swing's velocity as its `velocity`. In `domain` a variable's range,
    beyond which it counts with the nearer end. With a `window` it acts only between two times [s],
    each with 0.1 s of rise or fall around it. A `play` or a `switch` gives it a memory, in a
    machine with hydraulic axes. The `uncertainty` is the standard deviation of what the law adds.
    `source` is the file or plug-in that defines the law, empty for laws of hydrotele.
    """

    name: Name
    axis: Name
    balance: Balance
    law: str
    parameters: Mapping[str, Value] = {}
    of: dict[str, Name] = {}
    domain: dict[str, tuple[float, float]] = {}
    window: tuple[float, float] | None = None
    play: Play | None = None
    switch: Switch | None = None
    uncertainty: NonNegative | None = None
    description: str = ""
    source: str = ""

    @model_validator(mode="after")
    def _check(self):
        if self.law not in LAWS and self.source:
            raise ValueError(
                f"the law {self.law!r} is defined by {self.source}, which is not loaded: if it is a"
                " file that you trust, name it on the command line with --effects FILE; if it is a"
                " plug-in, install it"
            )
        if self.law not in LAWS:
            raise ValueError(f"law {self.law!r} is not known; {suggest(self.law, LAWS)}")
        for variable in self.of:
            if variable not in OF_A_DRIVE:
                raise ValueError(f"of: {variable!r}; {suggest(variable, OF_A_DRIVE)}")
        for variable, (low, high) in self.domain.items():
            if variable not in VARIABLES:
                raise ValueError(f"domain: {variable!r}; {suggest(variable, VARIABLES)}")
            if not low < high:
                raise ValueError(f"domain of {variable}: [{low:g}, {high:g}] must rise")
        if self.play and self.switch:
            raise ValueError("play and switch: a term has one of them")
        for key, memory in (("play", self.play), ("switch", self.switch)):
            valid = VARIABLES.keys() - {"played", "ahead"}
            if memory and memory.variable not in valid:
                known = suggest(memory.variable, valid)
                raise ValueError(f"{key}: {memory.variable!r} is no variable; {known}")
        if self.window and not self.window[0] < self.window[1]:
            raise ValueError("window: [{:g}, {:g}] must rise".format(*self.window))
        LAWS[self.law].numbers(self.parameters)
        return self
