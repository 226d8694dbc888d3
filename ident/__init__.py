"""Identification: records in, GOBF models with their uncertainty out."""

import lazy_loader

# Settings and records are read before what computes with them is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
