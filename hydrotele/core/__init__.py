"""Machine-independent utilities: errors, file access, YAML validation, output, compilation."""
