"""Terms: additional laws that act on a drive's force, flows or command in every simulator.

A `Term` of a machine specifies a law of `LAWS` and its parameters. Laws are small functions of the
state of a drive. They are compiled, and both the reduced model and MuJoCo call them natively.
"""
