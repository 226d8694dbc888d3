"""Storage, run directories, errors, progress, random streams."""
