"""From an uncertain frequency response to a certified controller."""

import lazy_loader

# A specification is read before what designs for it is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
