"""Control tasks on simulated machines: whole episodes in native code, one or thousands."""
