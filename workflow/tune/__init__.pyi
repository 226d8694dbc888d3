from .server import serve as serve, tuning as tuning
