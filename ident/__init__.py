"""Identification: records in, GOBF models with their uncertainty out."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ident.basis.functions import basis_response, basis_state_space, regressor
    from ident.basis.miso_model import MisoModel
    from ident.basis.model import GobfModel
    from ident.basis.options import IdentOptions
    from ident.basis.poles import Poles
    from ident.basis.structure import Structure
    from ident.data.record import Record
    from ident.data.signal_filter import band_limited
    from ident.frequency_fit import FrfIdentification, identify_frf
    from ident.identification import Identification, MisoIdentification
    from ident.one_input import identify
    from ident.search.error_surface import ErrorSurface, error_surface
    from ident.search.search_trace import SearchTrace
    from ident.several_inputs import identify_miso

__all__ = [
    "ErrorSurface",
    "FrfIdentification",
    "GobfModel",
    "IdentOptions",
    "Identification",
    "MisoIdentification",
    "MisoModel",
    "Poles",
    "Record",
    "SearchTrace",
    "Structure",
    "band_limited",
    "basis_response",
    "basis_state_space",
    "error_surface",
    "identify",
    "identify_frf",
    "identify_miso",
    "regressor",
]

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


def __getattr__(name: str) -> Any:
    """PEP 562: settings and records are read before what computes with them is loaded."""
    if name not in _WHERE:
        raise AttributeError(f"module 'ident' has no attribute {name!r}")
    value = getattr(import_module(f"ident.{_WHERE[name]}"), name)
    globals()[name] = value
    return value
