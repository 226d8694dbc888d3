"""The machine: rig, beam modes, motor, effects, sensors, excitation signals, simulation."""

import lazy_loader

# A rig is read before what simulates it is loaded.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
