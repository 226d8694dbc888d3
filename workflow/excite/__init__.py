"""Experiments that are planned within limits: `flexlink excite`.

What stands here is the door of this room: other code imports nothing else of it.
"""

import lazy_loader

# The limits are checked before what plans and draws is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
