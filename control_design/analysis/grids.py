"""Plants and specification on grids: a lean one for the optimisers, a dense one for their checks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from control_design.analysis.worst_case import PlantData
from control_design.plants.ellipses import Real
from control_design.plants.frequency_grid import GridOptions, programme_grid
from control_design.plants.plant_set import Mode, UncertainPlant
from control_design.specification import Specification


class Grids:
    """Every plant on its lean grid (F,), which grows by exchange, and on its dense one, which is fixed."""

    def __init__(
        self, plants: Sequence[UncertainPlant], specification: Specification, options: GridOptions
    ) -> None:
        self.plants, self.spec = tuple(plants), specification
        self.grids: list[Real] = []
        self.dense: list[PlantData] = []
        for plant in plants:
            modes = _grid_modes(plant, specification)
            edges = [edge for asked in specification.weighted(plant) for edge in asked.band or ()]
            lean = programme_grid(plant, modes, options, edges)
            self.grids.append(lean)
            dense = programme_grid(plant, modes, options, lean, dense=True)
            self.dense.append(PlantData.build(plant, specification, dense))

    def lean(self, grids: Sequence[Real] | None = None) -> list[PlantData]:
        """Every plant on its lean grid, as it is now or as given."""
        return [
            PlantData.build(plant, self.spec, grid)
            for plant, grid in zip(self.plants, self.grids if grids is None else grids, strict=True)
        ]

    @property
    def scale_rad_s(self) -> float:
        """Frequency around which the controller has to act: bandwidth and lowest mode, or a tenth of
        Nyquist."""
        candidates = [mode.omega_rad_s for plant in self.plants for mode in plant.modes[:1]]
        if self.spec.bandwidth_rad_s is not None:
            candidates.append(3.0 * self.spec.bandwidth_rad_s)
        if not candidates:
            return 0.1 * self.plants[0].nyquist_rad_s
        return float(np.exp(np.mean(np.log(candidates))))


def _grid_modes(plant: UncertainPlant, specification: Specification) -> tuple[Mode, ...]:
    """Modes that deserve dense points: the plant's, and the performance channel's where damping is asked
    for."""
    modes = list(plant.modes)
    if specification.mode_peak_ratio is not None:
        modes += [
            m
            for m in plant.damped.modes
            if all(abs(m.omega_rad_s - o.omega_rad_s) > 1e-6 * o.omega_rad_s for o in modes)
        ]
    return tuple(modes)
