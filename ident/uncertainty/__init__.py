"""The two types through which control design sees identification."""

from __future__ import annotations

from ident.basis.posterior import EmbeddingReport, ResponsePosterior
from ident.data.ellipses import EllipseAxes
from ident.data.frequency_uncertainty import FrequencyUncertainty

__all__ = ["EllipseAxes", "EmbeddingReport", "FrequencyUncertainty", "ResponsePosterior"]
