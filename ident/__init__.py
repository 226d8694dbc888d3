"""Identification: records in, GOBF models with their uncertainty out."""

from ident.basis import basis_response, basis_state_space, regressor
from ident.error_surface import ErrorSurface, error_surface
from ident.frequency_fit import FrfIdentification, identify_frf
from ident.identify import Identification, identify
from ident.miso_identification import MisoIdentification
from ident.miso_model import MisoModel
from ident.model import GobfModel
from ident.options import IdentOptions
from ident.poles import Poles
from ident.prefilter import band_limited
from ident.record import Record
from ident.search_trace import SearchTrace
from ident.several_inputs import identify_miso
from ident.structure import Structure

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
