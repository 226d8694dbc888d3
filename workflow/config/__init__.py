"""Configuration of a run, checked with the offending key named."""
