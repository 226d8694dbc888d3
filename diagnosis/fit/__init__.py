"""Fits of candidate effects with uncertain nominal parameters; residual and discrepancy."""
