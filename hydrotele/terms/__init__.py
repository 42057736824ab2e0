"""Terms: additional laws that act on a drive's force, flows or command in every simulator.

A `Term` of a machine names a law of `LAWS` and its parameters. Laws are small functions of the
state of a drive; they are compiled and called natively, by the reduced model and inside MuJoCo.
"""
