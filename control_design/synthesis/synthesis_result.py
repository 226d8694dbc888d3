"""What a synthesis returns: the controller, how good it is, and what blocks it.

gamma is the largest weighted worst case over plants, ellipses and frequencies: at most 1 where every
requirement is met, 1.2 where requirements are exceeded by 20 %. Fields of these classes are written to
files by name.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from ident.data.keywords import clear_constructor
from ident.data.shown import NOT_STORED, Shown

# What a descent that found no stable loop reports in place of infinity, which JSON does not know: near the
# largest double, above every worst case.
LARGEST_GAMMA = 1e300


class Outcome(Enum):
    """How a synthesis ended; its words are those of the pages' sentences."""

    # Every requirement at every frequency of the dense grid.
    MET_ON_GRID = "met on the grid"
    # A stable loop, but some requirement is exceeded.
    NOT_MET = "not met"
    # No start led to a stable loop; the controller means nothing.
    NOT_CONVERGED = "not converged"


@dataclass(frozen=True)
class BlockingPoint:
    """A frequency at which a requirement keeps gamma from getting smaller.

    Attributes
    ----------
    plant : str
        Name of the plant, or "controller".
    weight : str
        Name of a weighted requirement; without a stable design, one of the words of `synthesis`, such as
        `NOMINAL`.
    omega_rad_s : float
        Where, rad/s; of an unstable pole its |ln z|/dt.
    value : float
        Weighted worst case there, no unit; inf where the loop or a member of the ellipse is unstable.
    joint : int or None
        Index of the joint it lies at, of several.
    """

    plant: str
    weight: str
    omega_rad_s: float
    value: float
    joint: int | None = field(default=None, metadata={"since": 2})


@dataclass(frozen=True)
class StartReport:
    """One run of a solver from one start.

    Attributes
    ----------
    status : str
        How it ended; "descent" for `MinimaxDescent`.
    iterations : int
        Steps that were taken.
    gamma_grid : float
        Worst case on its own grid; `LARGEST_GAMMA`: no stable loop.
    gamma_dense : float or None
        Worst case on the dense grid; None: unstable, or (status "descent") not checked there.
    """

    status: str
    iterations: int
    gamma_grid: float
    gamma_dense: float | None

    @property
    def stable(self) -> bool:
        """Whether it ended in a stable loop; a descent never leaves stability: a finite gamma says it did."""
        is_stable_descent = self.status == "descent" and self.gamma_grid < LARGEST_GAMMA
        return self.gamma_dense is not None or is_stable_descent


@clear_constructor
@dataclass(frozen=True, repr=False)
class SynthesisResult(Shown):
    """Best controller of a synthesis, and how good it is. Certify it with `certificate.certify` before use.

    Attributes
    ----------
    outcome : Outcome
        Says what gamma means.
    controller : Controller
        The best that was found; it means nothing where the outcome is not converged.
    gamma : float
        Largest weighted worst case over plants, ellipses and the dense grid; inf where nothing stable was
        found. Nothing of this class is checked: a synthesis fills it.
    blocking : tuple of BlockingPoint
        Where and by which weight gamma is reached, worst first.
    starts : tuple of StartReport
        All runs of a solver, in their order.
    gamma_history : tuple of float
        Dense gamma of the best point after the starts and each exchange round.
    grid_points : int
        Final size of the programme's grids.
    plants : tuple of UncertainPlant
        What it is for; not stored.
    specification : Specification or None
        What it is for; not stored.

    Examples
    --------
    >>> designed = flexlink.synthesise(example_plant(), example_specification(), starts=1, dense_points=1000)
    >>> designed.gamma <= 1.0, designed.controller.dt_s
    (True, 0.01)
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
        """The controller as `control.StateSpace`, without its limits.

        Parameters
        ----------
        include_delay : bool
            With the computational delay: `K_with_delay`, which the margins are about; else `K_without_delay`.

        Returns
        -------
        control.StateSpace
            As `Controller.to_control`.
        """
        return self.controller.to_control(include_delay=include_delay)
