"""A model of a measured frequency response: `flexlink identify` of a table of points.

What stands here is the door of this room: other code imports nothing else of it.
"""

import lazy_loader

# Only a response waits for what fits it.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
