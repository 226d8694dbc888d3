"""What a pole search looked at, kept for the report: evaluated points, descents and warnings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.basis.poles import Poles
from ident.data.arrays import RealArray, readonly_real


@dataclass(frozen=True, eq=False)
class SearchStage:
    """One global search: coordinates (E, D) of the points in the order of evaluation and log J (E,)."""

    title: str
    coordinate_names: tuple[str, ...]
    points: RealArray
    log_cost: RealArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "coordinate_names", tuple(self.coordinate_names))
        object.__setattr__(self, "points", readonly_real(self.points))
        object.__setattr__(self, "log_cost", readonly_real(self.log_cost))
        if self.points.shape != (self.log_cost.size, len(self.coordinate_names)):
            raise ValueError(
                f"points must be ({self.log_cost.size}, {len(self.coordinate_names)}); got "
                f"{self.points.shape}"
            )


@dataclass(frozen=True, eq=False)
class PolishedMinimum:
    """End of one descent: where it was started from, the poles it reached and their residual sum of
    squares."""

    stage: str
    poles: Poles
    rss: float


@dataclass(frozen=True, eq=False)
class SearchTrace:
    """All global searches and descents of one identification.

    Attributes
    ----------
    stages : tuple of SearchStage
    minima : tuple of PolishedMinimum
        In the order they were found.
    warnings : tuple of str
        Each one sentence with advice.
    evaluations : int
        Cost evaluations in all, rescans and descents included.
    """

    stages: tuple[SearchStage, ...]
    minima: tuple[PolishedMinimum, ...]
    warnings: tuple[str, ...]
    evaluations: int

    def to_arrays(self) -> dict[str, np.ndarray[Any, Any]]:
        """Plain arrays, exact round trip through `from_arrays`."""
        arrays: dict[str, np.ndarray[Any, Any]] = {
            "n_stages": np.array(len(self.stages)),
            "n_minima": np.array(len(self.minima)),
            "warnings": np.array(self.warnings, dtype=np.str_),
            "evaluations": np.array(self.evaluations),
            "minima_rss": np.array([minimum.rss for minimum in self.minima], dtype=np.float64),
            "minima_stage": np.array([minimum.stage for minimum in self.minima], dtype=np.str_),
        }
        for i, stage in enumerate(self.stages):
            arrays[f"stage{i}_title"] = np.array(stage.title)
            arrays[f"stage{i}_names"] = np.array(stage.coordinate_names, dtype=np.str_)
            arrays[f"stage{i}_points"] = stage.points
            arrays[f"stage{i}_log_cost"] = stage.log_cost
        for i, minimum in enumerate(self.minima):
            arrays[f"minimum{i}_real"] = minimum.poles.real
            arrays[f"minimum{i}_pairs"] = minimum.poles.pairs
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray[Any, Any]]) -> SearchTrace:
        return cls(
            stages=tuple(
                SearchStage(
                    str(arrays[f"stage{i}_title"]),
                    tuple(str(name) for name in arrays[f"stage{i}_names"]),
                    arrays[f"stage{i}_points"],
                    arrays[f"stage{i}_log_cost"],
                )
                for i in range(int(arrays["n_stages"]))
            ),
            minima=tuple(
                PolishedMinimum(
                    str(arrays["minima_stage"][i]),
                    Poles(arrays[f"minimum{i}_real"], arrays[f"minimum{i}_pairs"]),
                    float(arrays["minima_rss"][i]),
                )
                for i in range(int(arrays["n_minima"]))
            ),
            warnings=tuple(str(item) for item in arrays["warnings"]),
            evaluations=int(arrays["evaluations"]),
        )
