"""What a synthesis returns: the controller, how good it is, and what blocks it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from ident.data.shown import NOT_STORED, Shown


class Outcome(Enum):
    """In words: `outcome` of the pages' sentences."""

    MET_ON_GRID = "met on the grid"  # every requirement at every frequency of the dense grid
    NOT_MET = "not met"  # a stable loop, but some requirement is exceeded
    NOT_CONVERGED = "not converged"  # no start led to a stable loop; the controller means nothing


@dataclass(frozen=True)
class BlockingPoint:
    """A frequency at which a requirement keeps gamma from getting smaller.

    weight: name of a weighted requirement; without a stable design, one of the words of `synthesis`. value:
    weighted worst case there, inf where the loop or a member of the ellipse is unstable. joint: index of the
    joint it lies at, of several.
    """

    plant: str
    weight: str
    omega_rad_s: float
    value: float
    joint: int | None = field(default=None, metadata={"since": 2})


LARGEST_GAMMA = 1e300
"""What a descent that found no stable loop reports in place of infinity."""


@dataclass(frozen=True)
class StartReport:
    """One run of a solver from one start: status, iterations, gamma of its own grid and of the dense grid.

    gamma_dense None: unstable, or (status "descent") not checked on the dense grid.
    """

    status: str
    iterations: int
    gamma_grid: float
    gamma_dense: float | None

    @property
    def stable(self) -> bool:
        """Whether it ended in a stable loop; a descent never leaves stability: a finite gamma says it did."""
        return self.gamma_dense is not None or (self.status == "descent" and self.gamma_grid < LARGEST_GAMMA)


@dataclass(frozen=True, repr=False)
class SynthesisResult(Shown):
    """Best controller found and how good it is.

    gamma: largest weighted worst case over plants, ellipses and the dense grid (<= 1: met; 1.2: requirements
    exceeded by 20 %). blocking: where and which weight, worst first. gamma_history: dense gamma of the best
    point after the starts and each exchange round. grid_points: final size of the programme's grids. outcome
    says what gamma means; certify with `certificate.certify` before use. plants, specification: what it is
    for; not stored.
    """

    outcome: Outcome
    controller: Controller
    gamma: float
    blocking: tuple[BlockingPoint, ...]
    starts: tuple[StartReport, ...]
    gamma_history: tuple[float, ...]
    grid_points: int
    plants: tuple[UncertainPlant, ...] = field(default=(), compare=False, metadata=NOT_STORED)
    specification: Specification | None = field(default=None, compare=False, metadata=NOT_STORED)

    def to_control(self, *, include_delay: bool = False) -> Any:
        """The controller as `control.StateSpace` without its limits: `K_without_delay`, or with include_delay
        `K_with_delay`, which the margins are about (`Controller.to_control`)."""
        return self.controller.to_control(include_delay=include_delay)
