"""What the loop has to do: the engineer's words, and the requirements they stand for."""

from control_design.plants.weights import RationalWeight
from control_design.specification.requirement import LoopFunction, SpecificationItem, WeightedRequirement
from control_design.specification.specification import GIVES_WAY, Specification, SpecificationError

__all__ = [
    "GIVES_WAY",
    "LoopFunction",
    "RationalWeight",
    "Specification",
    "SpecificationError",
    "SpecificationItem",
    "WeightedRequirement",
]
