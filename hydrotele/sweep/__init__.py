"""Many runs of one scenario, into one table."""
