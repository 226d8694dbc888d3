"""Records, their readers, frequency data, ellipses and non-parametric estimates."""
