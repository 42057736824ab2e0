"""Published experiments, repeated in simulation: what was seen then, and what is seen here."""
