"""Identify two real machines from public records and compare with the published results.

    python tools/studies/identify_real.py ../shared/real [--only emps]

EMPS benchmark (one prismatic axis) through the shipped machine; Franka Panda (seven joints, record
of Gaz et al. 2019) as a plain chain, without a shipped machine. The last quarter of either record
is held out; the errors of the whole record are given too, as the publications have them.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np

from hydrotele.identify.identification import identify_with_friction_shapes
from hydrotele.identify.joint_motion import Processing
from hydrotele.identify.record import IdentificationRecord, build_records
from hydrotele.identify.regressor_setup import RegressorSetup, machine_setup
from hydrotele.identify.result import Identification, parameter_rows
from hydrotele.logs.dataset import load_dataset
from hydrotele.logs.log import load_log
from hydrotele.machine.machine_file import load_machine
from hydrotele.multibody.chain import Chain, load_chain
from hydrotele.multibody.regressor import FrictionTerm
from hydrotele.simulate.closed_loops import load_closed_chain

HELD_OUT = 0.25
WIDE = 10.0  # Hz: the whole of what is in the Panda's torques besides noise
# Franka Panda, joint by joint: orientation of the frame [rad], its place [m]
PANDA = (
    ((0, 0, 0), (0, 0, 0.333)), ((-np.pi / 2, 0, 0), (0, 0, 0)),
    ((np.pi / 2, 0, 0), (0, -0.316, 0)), ((np.pi / 2, 0, 0), (0.0825, 0, 0)),
    ((-np.pi / 2, 0, 0), (-0.0825, 0.384, 0)), ((np.pi / 2, 0, 0), (0, 0, 0)),
    ((np.pi / 2, 0, 0), (0.088, 0, 0)),
)  # fmt: skip
PUBLISHED = {"mass.carriage": 95.11, "viscous.slide": 203.5, "coulomb.slide": 20.39,
             "offset.slide": -3.165}  # fmt: skip


def panda_chain() -> Chain:
    """The Panda's joints with bodies of 1 kg: nothing of its inertia is known beforehand."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for k, (rpy, xyz) in enumerate(PANDA, start=1):
        quaternion = np.empty(4)
        mujoco.mju_euler2Quat(quaternion, np.array(rpy, float), "XYZ")
        body = body.add_body(
            name=f"link{k}", pos=xyz, quat=quaternion, mass=1.0, inertia=(0.01, 0.01, 0.01),
            explicitinertial=True,
        )  # fmt: skip
        body.add_joint(name=f"joint{k}", axis=(0, 0, 1))
    return load_chain(spec.compile())


def panda_records(path: Path) -> list[IdentificationRecord]:
    """The record on a uniform clock, whole, without its last quarter, and that quarter."""
    log = load_log(path)
    period = float(np.median(np.diff(log.time)))
    time = np.arange(log.time[0], log.time[-1], period)
    names = [f"joint{k}" for k in range(1, 8)]
    position, torque = (
        np.column_stack([np.interp(time, log.time, log[f"{kind}.{name}"]) for name in names])
        for kind in ("angle", "torque")
    )
    cut = round((1.0 - HELD_OUT) * len(time))
    unknown = np.full(7, np.nan)
    return [
        IdentificationRecord(
            name, period, tuple(names), position[rows], unknown, torque[rows], unknown
        )
        for name, rows in (
            ("whole", slice(None)), ("fit", slice(0, cut)), ("heldout", slice(cut, None))
        )
    ]  # fmt: skip


def panda(real: Path) -> None:
    """Rank and torque error, without and with friction."""
    whole, fit, heldout = panda_records(real / "panda" / "exciting_1.parquet")
    chain = panda_chain()
    for friction in (False, True):
        kinds = {"coulomb": 0.0, "viscous": 0.0} if friction else {}
        setup = RegressorSetup(
            chain, chain.joints, chain.bodies, tuple(FrictionTerm(j, kinds) for j in chain.joints),
            offsets={} if friction else None,
        )  # fmt: skip
        print(f"Panda, {'Coulomb, viscous, offset' if friction else 'no friction'}")
        for name, (learned, judged), band in (
            ("fitted and evaluated on the whole record", (whole, whole), None),
            ("fitted and evaluated on the whole record", (whole, whole), WIDE),
            ("held out: last quarter", (fit, heldout), None),
            ("held out: last quarter", (fit, heldout), WIDE),
        ):
            found = identify_with_friction_shapes([learned], judged, setup, Processing(band=band))
            print(f"  {name}: {len(found.motion_identifiability.base)} base parameters of {len(found.names)},"
                  f" {len(found.data_identifiability.base)} determined despite noise, torque error"
                  f" {100 * relative(found):.2f} % (below {found.band:.3g} Hz),"
                  f" {found.seconds:.1f} s")  # fmt: skip


def relative(found: Identification) -> float:
    """Norm of all drives' errors over that of their forces, held-out run."""
    forces = found.forces
    return float(np.linalg.norm(forces.measured - forces.predicted) / np.linalg.norm(forces.measured))


def emps(real: Path) -> None:
    """Parameters against the published ones, and the force error."""
    machine = load_machine("emps")
    fit, heldout, _ = build_records(load_dataset(real / "emps" / "main.parquet", machine))
    for asymmetry in (False, True):
        setup = machine_setup(machine, load_closed_chain(machine), asymmetry=asymmetry)
        found = identify_with_friction_shapes(fit, heldout, setup)
        print(f"EMPS, viscous friction {'by direction' if asymmetry else 'equal in both directions'}")
        for row in parameter_rows(found):
            if row.value is None:
                continue
            known = PUBLISHED.get(row.name)
            away = f", {100 * (row.value / known - 1):+.2f} % from published {known}" if known else ""
            print(f"  {row.name:24s} {row.value:9.3f} +- {row.std:.3f} {row.unit}{away}")
        print(f"  relative force error, held out: {100 * found.heldout['slide'].relative_error:.2f} %"
              f" (below {found.band:.3g} Hz)")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("real", type=Path, help="folder with the records")
    parser.add_argument("--only", choices=["emps", "panda"])
    asked = parser.parse_args()
    if asked.only != "panda":
        emps(asked.real)
    if asked.only != "emps":
        panda(asked.real)
