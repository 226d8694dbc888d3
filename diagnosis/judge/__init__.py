"""What the fits of a search say: which effects are there, and whether that is all."""
