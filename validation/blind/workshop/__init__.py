"""Workshop cases of the blind protocol: imperfect and imperfectly known machines, awkward logs."""
