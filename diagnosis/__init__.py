"""Why simulation and machine differ: which unmodelled effect, how sure, how far the gap shrinks with it."""

import lazy_loader

# A case file is read before what diagnoses it is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
