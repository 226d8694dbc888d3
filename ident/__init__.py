"""Identification: records in, GOBF models with their uncertainty out."""

from importlib import import_module
from typing import Any

_MODULES = {
    "basis.functions": ("basis_response", "basis_state_space", "regressor"),
    "basis.miso_model": ("MisoModel",),
    "basis.model": ("GobfModel",),
    "basis.options": ("IdentOptions",),
    "basis.poles": ("Poles",),
    "basis.structure": ("Structure",),
    "data.record": ("Record",),
    "data.signal_filter": ("band_limited",),
    "frequency_fit": ("FrfIdentification", "identify_frf"),
    "identification": ("Identification", "MisoIdentification"),
    "one_input": ("identify",),
    "search.error_surface": ("ErrorSurface", "error_surface"),
    "search.search_trace": ("SearchTrace",),
    "several_inputs": ("identify_miso",),
}
_WHERE = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_WHERE)


def __getattr__(name: str) -> Any:
    """PEP 562: settings and records are read before what computes with them is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'ident' has no attribute {name!r}")
    value = getattr(import_module(f"ident.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
