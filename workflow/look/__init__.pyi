from .command import look as look
