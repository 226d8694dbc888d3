"""Runs for several joints at once: `flexlink run --config` of a file with [[joints]].

What stands here is the door of this room: other code imports nothing else of it.
"""

import lazy_loader

# A configuration that is refused does not wait for what identifies, designs and draws.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
