"""How much the redrawing of the paper computes."""

from __future__ import annotations

from dataclasses import dataclass

# Order of all models of the paper, section 4.
ORDER = 4
# Its real poles.
N_REAL = 2
# Its pole pairs.
N_PAIRS = 1
# Sampling period: 200 Hz, p. 104.
DT_S = 0.005


@dataclass(frozen=True)
class PaperSettings:
    """Seed of the run and the sizes of its repetitions; the defaults take well below a minute on one core.

    repeats: fresh draws of input and noise over which the methods are compared; searches: records on which
    every DIRECT variant is tried; evaluations: budget of one DIRECT search; surface_points: grid points per
    axis of the error surface that is drawn; grids: points per axis of the grids on which minima are counted.
    """

    seed: int = 2006
    repeats: int = 10
    searches: int = 10
    evaluations: int = 500
    surface_points: int = 161
    grids: tuple[int, ...] = (21, 41, 81, 161, 321)

    def __post_init__(self) -> None:
        sizes = (self.repeats, self.searches, self.surface_points, *self.grids)
        if not (self.seed >= 0 and self.grids and min(sizes) >= 1 and self.evaluations >= 20):
            raise ValueError(f"need seed >= 0, sizes >= 1 and evaluations >= 20; got {self}")
