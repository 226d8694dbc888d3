"""What makes a simulation predict better: the effects and values that serve logs they were not fitted to."""
