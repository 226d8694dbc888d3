"""Records, their readers, frequency data, ellipses, non-parametric estimates, and what a check finds."""
