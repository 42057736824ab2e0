"""Physical effects that a machine can have and its model can lack, one file each.

One type for three uses: planted in a scenario, tried as a hypothesis, written into a patched
machine.
"""
