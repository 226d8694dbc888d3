"""Identification: records in, GOBF models with their uncertainty out."""

from ident.basis import basis_response, basis_state_space, regressor
from ident.identify import Identification, identify
from ident.model import GobfModel
from ident.options import IdentOptions
from ident.poles import Poles
from ident.record import Record
from ident.structure import Structure

__all__ = [
    "GobfModel",
    "IdentOptions",
    "Identification",
    "Poles",
    "Record",
    "Structure",
    "basis_response",
    "basis_state_space",
    "identify",
    "regressor",
]
