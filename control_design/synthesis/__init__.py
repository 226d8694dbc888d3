"""Structured synthesis over ellipses: fits of the Youla bound's controllers, descent, CasADi/IPOPT."""
