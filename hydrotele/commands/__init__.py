"""What the commands of `hydrotele` do; `cli.py` only declares them."""
