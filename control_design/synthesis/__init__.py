"""Structured synthesis over ellipses (CasADi/IPOPT)."""
