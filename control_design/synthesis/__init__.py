"""Structured synthesis over ellipses: fits of the Youla bound's controllers, a descent by CasADi's slopes."""
