"""What a log holds, without a model of it: `flexlink look`.

What stands here is the door of this room: other code imports nothing else of it.
"""

import lazy_loader

# A log is read before what draws it is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
