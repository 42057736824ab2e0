"""A soil that a bucket cuts, carries and drops, in the vertical plane of the arm.

`facts` says what the soil is, `shape` what the bucket looks like, `numbers` packs both into one
flat array; `cutting` has the closed forms of soil mechanics, `terrain` moves soil between cells,
`bucket` says how much a tilted bucket holds, `step` puts them together for a control loop, and
`wrench` takes the result to a body of MuJoCo. One profile, one state and one result for each
environment, one array of numbers for all; nothing is allocated or shared:

>>> import numpy as np
>>> from hydrotele.soil.facts import SOILS
>>> from hydrotele.soil.facts import OUT, FORCE_R, bucket_state, level_profile, soil_parameters
>>> from hydrotele.soil.facts import CAT215
>>> from hydrotele.soil.step import EdgeMotion, soil_step
>>> numbers = soil_parameters(SOILS["firm"], CAT215, start=3.0, cell=0.05)
>>> (surface, loose), state, out = level_profile(140), bucket_state(), np.zeros(OUT)
>>> for r in np.arange(6.0, 5.5, -0.002):  # drawn in at 0.4 m/s, 0.15 m deep, upright
...     edge = EdgeMotion(r, -0.15, -0.4, 0.0, -1.5)
...     soil_step(numbers, surface, loose, state, edge, 0.005, out)
>>> bool(20e3 < out[FORCE_R] < 50e3)  # N, against the motion
True

What is left out: the sides of the trench (the profile is as wide as the bucket), the inertia of
soil, its compaction below floor and heel, and pressure of water. Loosened soil has weight and
friction but no cohesion; the bank stays as strong as it was.
"""
