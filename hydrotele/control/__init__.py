"""Control of the arm: servo, trajectories, resolved motion, force at the tool tip."""
