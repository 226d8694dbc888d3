"""The two types through which control design sees identification."""

from __future__ import annotations

from ident.ellipses import Ellipses, offset_disc_radius
from ident.frequency_uncertainty import FrequencyUncertainty
from ident.posterior import EmbeddingReport, ResponsePosterior

__all__ = ["Ellipses", "EmbeddingReport", "FrequencyUncertainty", "ResponsePosterior", "offset_disc_radius"]
