"""Workshop cases of the blind protocol: imperfectly known machines, awkward logs, undocumented imperfections."""
