"""Checks of the product from outside: blind protocol, the paper redrawn, example plants."""
