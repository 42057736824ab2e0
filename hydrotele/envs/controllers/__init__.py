"""Controllers to compare with: they know what sensors read and the nominal machine, no truth."""
