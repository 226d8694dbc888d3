"""Identification: records in, GOBF models with their uncertainty out."""

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
from ident.identify import identify
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
