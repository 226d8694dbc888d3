"""Which hypotheses the records support, and how surely."""
