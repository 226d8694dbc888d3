"""Which experiment separates what is still possible."""
