"""Terms of a machine: which law adds to which balance of which drive.

The balances are force, chamber flow, command and supply flow. A term may have hysteresis.
"""

from collections.abc import Mapping
from typing import Literal

from pydantic import model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
    suggest_valid_name,
)
from hydrotele.terms.drive_state import VARIABLES, suggest_valid_variable
from hydrotele.terms.law import LAWS

_RENAMED_LAWS = {"table2": "bilinear_table"}
Value = float | str | tuple[float, ...] | tuple[tuple[float, ...], ...]
BALANCES = ("force", "flow_head", "flow_rod", "command", "flow_supply")
Balance = Literal["force", "flow_head", "flow_rod", "command", "flow_supply"]
DRIVE_VARIABLES = (
    "position", "velocity", "spool", "spool_rate", "pump_speed", "pressure_load", "pressure_head",
    "pressure_rod", "command", "force",
)  # fmt: skip
"""Variables that a law can take from another drive."""


class Play(StrictModel):
    """Backlash operator (play) between a state variable and the law of a term.

    The output stays constant while the variable differs from it by at most `half_width`
    [unit of the variable]. Beyond, the output follows the variable at this distance. The law reads
    the output as `play_output`, and the variable minus the output as `play_difference`. The initial
    output is the value nearest to 0 that the variable permits.
    """

    variable: str
    half_width: PositiveFloat


class Switch(StrictModel):
    """Relay with hysteresis that switches a law on and off by a state variable.

    The law becomes active when the variable passes `on`, and inactive when it returns past `off`
    (both in the unit of the variable). Each transition is a ramp, centred on its threshold, over a
    tenth of the interval between both thresholds. With `on` below `off` the law is active at low
    values of the variable.
    """

    variable: str
    on: float
    off: float

    @model_validator(mode="after")
    def _check(self):
        if self.on == self.off:
            raise ValueError(f"on and off are both {self.on:g}; they must be different")
        return self


class Term(StrictModel):
    """A law with parameters that adds a force, flow or command to one drive of a machine.

    - `axis`: name of the drive's axis.
    - `law`, `parameters`: name of the law, and the values of its arguments.
    - `name`: origin of the term, such as the name of an effect.
    - `balance`: `force` (on the drive [N] or [N m]), `flow_head` or `flow_rod` (into a chamber
      [m^3/s]), `command` (to valve or drive [1] or [V]) or `flow_supply` (flow of the shared pump,
      which follows with a time constant of 20 ms [m^3/s]).
    - `variables_from`: variables taken from another drive; with `{velocity: swing}` the variable
      `velocity` of the law is that of the swing.
    - `domain`: variable -> range to which it is clipped.
    - `window`: start and stop time between which the term is active [s], with a ramp of 0.1 s at each.
    - `play`, `switch`: hysteresis of the term, only one of them, in a machine with hydraulic axes.
    - `uncertainty`: standard deviation of the value of the law.
    - `source`: file or plug-in that defines the law; empty for laws of hydrotele.
    """

    renamed = {"of": "variables_from"}

    name: Name
    axis: Name
    balance: Balance
    law: str
    parameters: Mapping[str, Value] = {}
    variables_from: dict[str, Name] = {}
    domain: dict[str, tuple[float, float]] = {}
    window: tuple[float, float] | None = None
    play: Play | None = None
    switch: Switch | None = None
    uncertainty: NonNegativeFloat | None = None
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
            raise ValueError(f"law {self.law!r} is not known; {suggest_valid_name(self.law, LAWS, _RENAMED_LAWS)}")
        for variable in self.variables_from:
            if variable not in DRIVE_VARIABLES:
                raise ValueError(
                    f"variables_from: {variable!r} is not a variable of a drive;"
                    f" {suggest_valid_name(variable, DRIVE_VARIABLES)}"
                )
        for variable, (low, high) in self.domain.items():
            if variable not in VARIABLES:
                raise ValueError(f"domain: {variable!r} is not a variable; {suggest_valid_variable(variable)}")
            if not low < high:
                raise ValueError(f"domain of {variable}: [{low:g}, {high:g}] must be increasing")
        if self.play and self.switch:
            raise ValueError("play and switch: a term can have only one of them")
        for key, memory in (("play", self.play), ("switch", self.switch)):
            valid = VARIABLES.keys() - {"play_output", "play_difference"}
            if memory and memory.variable not in valid:
                known = suggest_valid_name(memory.variable, valid)
                raise ValueError(f"{key}: {memory.variable!r} is not a variable; {known}")
        if self.window and not self.window[0] < self.window[1]:
            raise ValueError("window: [{:g}, {:g}] must be increasing".format(*self.window))
        LAWS[self.law].encode_parameters(self.parameters)
        return self
