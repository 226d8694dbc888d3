"""Identification: records in, GOBF models with their uncertainty out."""

from ident.basis import basis_response, basis_state_space, regressor
from ident.error_surface import ErrorSurface, error_surface
from ident.identify import Identification, identify
from ident.model import GobfModel
from ident.options import IdentOptions
from ident.poles import Poles
from ident.prefilter import band_limited
from ident.record import Record
from ident.search_trace import SearchTrace
from ident.structure import Structure

__all__ = [
    "ErrorSurface",
    "GobfModel",
    "IdentOptions",
    "Identification",
    "Poles",
    "Record",
    "SearchTrace",
    "Structure",
    "band_limited",
    "basis_response",
    "basis_state_space",
    "error_surface",
    "identify",
    "regressor",
]
