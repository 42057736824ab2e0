"""The operator's side: plans, resolved motion, servo."""
