"""Published experiments repeated in simulation, one module or more per document."""
