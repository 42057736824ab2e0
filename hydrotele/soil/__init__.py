"""Soil that a bucket cuts, carries and drops, in the vertical plane of the arm.

`parameters` defines soil and bucket and packs their parameters into one flat array. `terrain` moves soil
between the cells of the profile. `step` contains the closed-form soil mechanics, the volume that a
tilted bucket holds, the time step of soil and bucket, and the wrench on a MuJoCo body. Every
environment has its own profile, bucket state and result; the parameters can be common to all.
Nothing is allocated during a step:

>>> import numpy as np
>>> from hydrotele.soil.parameters import CAT215, FORCE_R, RESULT_SIZE, SOILS
>>> from hydrotele.soil.parameters import make_bucket_state, make_level_profile, pack_soil_parameters
>>> from hydrotele.soil.step import EdgeMotion, step_soil
>>> numbers = pack_soil_parameters(SOILS["firm"], CAT215, start=3.0, cell=0.05)
>>> (surface, loose), state, out = make_level_profile(140), make_bucket_state(), np.zeros(RESULT_SIZE)
>>> for r in np.arange(6.0, 5.5, -0.002):  # drawn in at 0.4 m/s, 0.15 m deep, upright
...     edge = EdgeMotion(r, -0.15, -0.4, 0.0, -1.5)
...     step_soil(numbers, surface, loose, state, edge, 0.005, out)
>>> bool(20e3 < out[FORCE_R] < 50e3)  # N, against the motion
True

Not modelled: the sides of the trench (the profile is as wide as the bucket), the inertia of the
soil, its compaction below floor and heel, and pore water pressure. Loosened soil has weight and
friction but no cohesion; the strength of the bank does not change.
"""
