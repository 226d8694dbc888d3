"""Stated knowledge tested against the data, residual tests, validation."""
