"""The steps from a log or an arm to a certified controller."""
