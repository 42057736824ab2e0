"""A soil that a bucket cuts, carries and drops, in the vertical plane of the arm.

`facts` says what the soil is, `shape` what the bucket looks like, `numbers` packs both into one
flat array; `cutting` has the closed forms of soil mechanics, `terrain` moves soil between cells,
`bucket` says how much a tilted bucket holds, and `step` puts them together for a control loop.
"""
