"""Dynamic identification from logs: filtering and differentiation, then regression of forces.

`identify_dynamics` estimates inertial and friction parameters of a mechanism, `identify_hydraulics`
the parameters of valves, oil and supply. `design_motion` designs an informative excitation.
"""
