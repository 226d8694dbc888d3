"""Identification: records in, GOBF models with their uncertainty out."""

from ident.basis import basis_response, basis_state_space, regressor
from ident.model import GobfModel
from ident.poles import Poles
from ident.record import Record
from ident.structure import Structure

__all__ = [
    "GobfModel",
    "Poles",
    "Record",
    "Structure",
    "basis_response",
    "basis_state_space",
    "regressor",
]
