"""Control of the arm: joint servo, reference plans, resolved motion and tip force estimation."""
