"""A page with sliders that designs as they move: `flexlink tune`.

What stands here is the door of this room: other code imports nothing else of it.
"""

import lazy_loader

# The command line is up before what designs is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
