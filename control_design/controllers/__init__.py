"""Controllers: second-order sections, state space, export to C."""
