"""Least squares at given poles, for records with one or several inputs and for frequency data, and local
refinement.
"""
