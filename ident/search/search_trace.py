"""What a pole search looked at, kept for the report: evaluated points, descents and warnings."""

from __future__ import annotations

from dataclasses import dataclass

from ident.basis.poles import Poles
from ident.data.arrays import RealArray, lock
from ident.data.finding import Finding


@dataclass(frozen=True, eq=False)
class SearchStage:
    """One global search: coordinates (E, D) of the points in the order of evaluation and log J (E,)."""

    title: str
    coordinate_names: tuple[str, ...]
    points: RealArray
    log_cost: RealArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "coordinate_names", tuple(self.coordinate_names))
        lock(self, "points", "log_cost")
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

    stages : tuple of SearchStage
    minima : tuple of PolishedMinimum. In the order they were found.
    warnings : tuple of Finding
    evaluations : int. Cost evaluations in all, rescans and descents included.
    """

    stages: tuple[SearchStage, ...]
    minima: tuple[PolishedMinimum, ...]
    warnings: tuple[Finding, ...]
    evaluations: int
