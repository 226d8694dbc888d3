"""placeholder"""
from __future__ import annotations
from pydantic import BaseModel, ConfigDict
import numpy as np
class RationalWeight(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    def at(self, s):
        return np.polyval(self.numerator, s) / np.polyval(self.denominator, s)
class Specification(BaseModel):
    sensitivity_weight: RationalWeight
    effort_weight: RationalWeight
    controller_order: int
    computational_delay_samples: int
