"""Convex problems beside the synthesis: bound over all stabilising controllers (Youla), reference filter."""
