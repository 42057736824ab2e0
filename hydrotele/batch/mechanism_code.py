"""Straight-line code of a machine's mechanism, traced from the functions of the reduced model.

Chains that move in a plane then have no three-dimensional vectors: products with zeros are left out. Values
that are 0, 1 or -1 for all machines are constants of the code; other geometry and masses are read
from memory.
"""

from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.tracing import Program, make_traceable_function, select_below, symbolic_array
from hydrotele.estimate.reduced_model import (
    Model,
    Space,
    compute_motion,
    drift_positions,
    model_space,
    project_mechanism,
    state_size,
)
from hydrotele.multibody.reduced_dynamics import (
    CLOSURE_TOLERANCE,
    RATE,
    Q,
    compute_dependent_rates,
    compute_dependent_slopes,
    compute_link_frames,
    correct_dependent_coordinates,
    linearise_loops,
    move_coordinates,
)

ARRAYS = (
    "z", "joint", "basis", "frame", "bar", "row", "mass", "force", "drive", "residual", "parameter", "step",
)  # fmt: skip
"""Arrays of the programs: state, arrays of `Space` and `ReducedMotion`, largest closure residual [m], parameters,
and (length of the step, half the length of the kick) [s]."""
_SINGLE_ARRAYS = ("mass", "force")  # positions, closed chains and transmissions, which set flows, stay in float64
PROGRAMS = ("move", "correct", "place", "pose")
"""Names of the programs of `MechanismCode`."""
STEP, HALF_KICK = range(2)  # rows of `step`
SHAPE, JOINT, GRAVITY = range(3)  # sources of parameters
_MOTION_COLUMNS = 18  # columns of `frame` that a pose has: rotation, origin, spin, velocity


class MechanismCode(NamedTuple):
    """Programs of a mechanism.

    Attributes:
        move: advances positions by the rates over a step, and the dependent ones with them.
        correct: one Newton step of the dependent positions, where the closures are not solved yet.
        place: frames, drive positions, their Jacobian rows, mass matrix and forces at the positions.
        pose: as `place`, but with the frames of the links instead of mass matrix and forces.
        parameters: (p, 3) SHAPE, JOINT or GRAVITY, row and column of each element of `parameter`.
        has_closures: whether the mechanism has dependent coordinates.
    """

    move: Program
    correct: Program
    place: Program
    pose: Program
    parameters: np.ndarray
    has_closures: bool


def trace_mechanism(model: Model, stacked: Model, precision: str = "double") -> MechanismCode:
    """Trace the mechanism of a model.

    Args:
        model: Model of one machine.
        stacked: Model whose parameters have a leading dimension for the machines.
        precision: "double", or "mixed" to compute mass matrix and forces in float32.
    """
    tracer = _Tracer(model, stacked, _SINGLE_ARRAYS if precision == "mixed" else ())
    return MechanismCode(
        tracer.trace_move(), tracer.trace_correct(), tracer.trace_place(False), tracer.trace_place(True),
        np.array(list(tracer.parameters), np.int64).reshape(-1, 3), len(model.mech.dependent) > 0,
    )  # fmt: skip


def array_shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays of the programs for one machine, without those of one value per machine."""
    space = model_space(model)
    motion = space.motion
    found: dict[str, tuple[int, ...]] = {name: getattr(motion, name).shape for name in ("joint", "basis", "bar")}
    found |= {name: getattr(space, name).shape for name in ("row", "mass", "force", "drive")}
    found["frame"] = (1 + model.mech.link_count, _MOTION_COLUMNS)
    return {"z": (state_size(model),), **found, "residual": (1,)}


class _Tracer:
    """Makes the symbolic arrays of the programs; the parameters are shared by all programs."""

    def __init__(self, model: Model, stacked: Model, single: tuple[str, ...]) -> None:
        self._single = [ARRAYS.index(name) for name in single]
        self.model, self.shapes = model, array_shapes(model)
        self.parameters: dict[tuple[int, int, int], int] = {}
        self._stacked, self._functions = stacked.mech, {}

    def _make_traceable(self, function: Any) -> Any:
        return make_traceable_function(function, self._functions)

    def _begin(self) -> tuple[Program, Any, Space, dict[str, Any]]:
        """Return a new program with its model, work space and arrays of loaded values."""
        sizes = [max(1, int(np.prod(self.shapes[name]))) if name in self.shapes else 0 for name in ARRAYS]
        program, mech = Program(sizes, self._single), self.model.mech
        loaded = {name: symbolic_array(program, k, self.shapes[name]) for k, name in enumerate(ARRAYS) if sizes[k]}
        space = model_space(self.model)
        used = {name: array.copy() for name, array in loaded.items()}
        used["frame"] = space.motion.frame.astype(object)
        for k, value in enumerate(self._read_values(program, GRAVITY, self._stacked.gravity[:, None]).ravel()):
            used["frame"][0, 21 + k] = -value
        for b in mech.independent:
            used["basis"][b] = space.motion.basis[b]
        motion = space.motion._replace(
            **{
                name: getattr(space.motion, name).astype(object)
                for name in ("jacobian", "momentum", "mass", "loop", "normal")
            },
            **{name: used[name] for name in ("joint", "basis", "frame", "bar")},
        )
        own = mech._replace(
            shape=self._read_values(program, SHAPE, self._stacked.shape),
            joint=self._read_values(program, JOINT, self._stacked.joint),
        )
        space = space._replace(motion=motion, **{name: used[name] for name in ("row", "mass", "force", "drive")})
        return program, self.model._replace(mech=own), space, {"loaded": loaded, "used": used}

    def _read_values(self, program: Program, source: int, values: np.ndarray) -> np.ndarray:
        """Return constants and loaded values for an array (1 or m, r, c) of parameters."""
        out = np.empty(values.shape[1:], object)
        for place in np.ndindex(out.shape):
            first = float(values[(0, *place)])
            if first in (0.0, 1.0, -1.0) and np.all(values[(slice(None), *place)] == first):
                out[place] = first
            else:
                number = self.parameters.setdefault((source, *place), len(self.parameters))
                out[place] = program.load(ARRAYS.index("parameter"), number)
        return out

    def _store(self, program: Program, arrays: dict[str, Any], names: dict[str, Any]) -> Program:
        """Store the chosen elements of arrays, unless they still have their loaded values."""
        for name, chosen in names.items():
            before, after = arrays["loaded"][name], arrays["used"][name]
            for k in np.arange(before.size).reshape(before.shape)[chosen].ravel():
                if after.flat[k] is not before.flat[k]:
                    program.store(ARRAYS.index(name), int(k), after.flat[k])
        return program

    def trace_move(self) -> Program:
        program, model, space, arrays = self._begin()
        mech, z, joint = model.mech, arrays["used"]["z"], arrays["used"]["joint"]
        self._make_traceable(drift_positions)(model, space, z, program.load(ARRAYS.index("step"), STEP))
        n, total = len(mech.independent), len(mech.independent) + len(model.transmission)
        for f in range(n):
            joint[RATE, mech.independent[f]] = z[total + f]
        if len(mech.dependent):
            self._make_traceable(move_coordinates)(mech, space.motion, z, 1)
        else:
            joint[Q] = z[:n]
        return self._store(program, arrays, {"z": slice(None), "joint": slice(Q, RATE + 1), "drive": slice(None)})

    def trace_correct(self) -> Program:
        program, model, space, arrays = self._begin()
        if not len(model.mech.dependent):
            return program
        joint = arrays["used"]["joint"]
        before = joint[Q].copy()
        worst = self._make_traceable(linearise_loops)(model.mech, space.motion)
        self._make_traceable(correct_dependent_coordinates)(model.mech, space.motion)
        for k in model.mech.dependent:
            joint[Q, k] = select_below(worst, CLOSURE_TOLERANCE, before[k], joint[Q, k])
        return self._store(program, arrays, {"joint": Q})

    def trace_place(self, as_pose: bool) -> Program:
        program, model, space, arrays = self._begin()
        mech, motion, used = model.mech, space.motion, arrays["used"]
        if len(mech.dependent):
            used["residual"][0] = self._make_traceable(linearise_loops)(mech, motion)
            self._make_traceable(compute_dependent_slopes)(mech, motion)
            self._make_traceable(compute_dependent_rates)(mech, motion)
        else:
            used["residual"][0] = 0.0
            self._make_traceable(compute_link_frames)(
                mech.tree, mech.shape, mech.link_count, motion.joint, motion.frame, motion.jacobian
            )
        self._make_traceable(compute_motion)(model, space, used["z"])
        names: dict[str, Any] = {"joint": slice(Q, RATE + 1), "basis": mech.dependent, "row": slice(None)}
        names |= {"drive": slice(None), "bar": (slice(None), 0), "residual": slice(None)}
        if as_pose:
            used["frame"] = used["frame"][: 1 + mech.link_count, :_MOTION_COLUMNS]
            names["frame"] = slice(None)
        else:
            self._make_traceable(project_mechanism)(model, space, program.load(ARRAYS.index("step"), HALF_KICK))
            names |= {"mass": np.tril_indices(len(used["mass"])), "force": slice(None)}
        return self._store(program, arrays, names)
