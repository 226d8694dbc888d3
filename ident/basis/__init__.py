"""Poles, orthonormal bases, structure and search coordinates, models and their posterior."""
