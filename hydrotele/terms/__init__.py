"""Terms: additional force, flow or command laws of a drive that every simulator applies.

A law is a small function of a drive's state, such as a drag force as a function of velocity. A
`Term` of a machine names a law, its parameters, and the drive and balance to which it adds. Laws are
compiled; the reduced model and the MuJoCo model both call the compiled code.
"""
