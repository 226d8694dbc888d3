"""Machines that no simulation reaches: what is left over has levels that the records themselves tell."""
