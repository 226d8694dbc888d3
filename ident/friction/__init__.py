"""Dry friction identified with the linear arm: the response behind it, as if it were not there."""

from ident.friction.fit import FrictionFit, fit_friction
from ident.friction.posterior import other_output_without_friction, without_friction

__all__ = ["FrictionFit", "fit_friction", "other_output_without_friction", "without_friction"]
