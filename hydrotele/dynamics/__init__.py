"""The reduced model of a Machine: closed chains in independent coordinates, compiled."""
