"""What knows no machine: errors, files, YAML with line numbers, output, compiled functions."""
