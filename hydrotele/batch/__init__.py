"""Batch of machines, simulated by the reduced model on the CPU or on a CUDA device.

`hydrotele.batch.Batch(machine, count, device="cpu")` has the same laws as the estimator: exact closed
chains, hydraulic circuit, command delays and sensors. Contacts with the ground or with objects are not
part of the reduced model; `hydrotele.envs` simulates these with MuJoCo.
"""

from hydrotele.batch.batch import Batch, as_dlpack
from hydrotele.batch.machine_step import Machines, Noise, Timing

__all__ = ["Batch", "Machines", "Noise", "Timing", "as_dlpack"]
