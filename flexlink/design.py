"""Controllers: uncertain plants and a specification in, a controller and its certificate out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import control
import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from control_design.analysis import certificate, closed_loop
from control_design.analysis.closed_loop import LinearMachine, SampledMachine, step_metrics
from control_design.controllers.c_code import c_source
from control_design.controllers.controller import Controller
from control_design.plants import plant_set
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification
from control_design.synthesis import synthesis, synthesis_result
from control_design.synthesis.synthesis_options import SynthesisOptions
from flexlink.models import Uncertainty
from flexlink.shown import Shown, dressed

__all__ = [
    "Certificate",
    "Controller",
    "LoopRun",
    "RationalWeight",
    "Specification",
    "SynthesisOptions",
    "SynthesisResult",
    "UncertainPlant",
    "c_source",
    "certify",
    "simulate_loop",
    "step_metrics",
    "synthesise",
]


class UncertainPlant(Shown, plant_set.UncertainPlant):
    """What a controller is designed for: a nominal state space and the ellipses around its response.

    plant : Uncertainty, or control.StateSpace, or a model with `to_control()`
        An `Uncertainty` brings its own ellipses; anything else is exact unless `uncertainty` is given.

    Other arguments as `control_design.UncertainPlant`.

    Examples
    --------
    >>> import control
    >>> flexlink.UncertainPlant(control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01), name="motor")
    UncertainPlant 'motor': 1 state, dt = 0.01 s, no integrator, response taken as exact
    """

    def __init__(
        self,
        plant: Any = None,
        *,
        name: str = "plant",
        uncertainty: Any = None,
        nominal: control.StateSpace | None = None,
        **more: Any,
    ) -> None:
        given = plant if nominal is None else nominal
        if uncertainty is None and isinstance(given, Uncertainty):
            uncertainty = given
        super().__init__(
            name=name,
            nominal=given if isinstance(given, control.StateSpace) else given.to_control(),
            uncertainty=uncertainty,
            **more,
        )


@dataclass(frozen=True, eq=False, repr=False)
class SynthesisResult(Shown, synthesis_result.SynthesisResult):
    """What `synthesise` found, and what was asked of it."""

    plants: tuple[plant_set.UncertainPlant, ...] = ()
    specification: Specification = field(default_factory=Specification)

    def to_control(self) -> control.StateSpace:
        """The controller as `control.StateSpace`, without its computational delay and limits."""
        return self.controller.to_control()


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Shown, certificate.Certificate):
    """What `certify` checked, and on what."""

    table_in_notebook = True
    controller: Controller | None = None
    uncertain_plants: tuple[plant_set.UncertainPlant, ...] = ()
    specification: Specification = field(default_factory=Specification)


@dataclass(frozen=True, eq=False, repr=False)
class LoopRun(Shown, closed_loop.ClosedLoopTrajectory):
    """A closed loop in time, from `simulate_loop`."""


def synthesise(
    plants: plant_set.UncertainPlant | Sequence[plant_set.UncertainPlant],
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator | int = 0,
    **more: Any,
) -> SynthesisResult:
    """One controller for one or several uncertain plants; arguments as `control_design.synthesise`.

    rng: a generator, or the seed of one.

    Examples
    --------
    >>> quick = flexlink.SynthesisOptions(starts=1, sufficient_gamma=0.99, dense_points=1000)
    >>> designed = flexlink.synthesise(example_plant(), example_specification(), quick)
    >>> designed.outcome.name, designed.controller.order
    ('MET_ON_GRID', 2)
    """
    chosen = _several(plants)
    generator = np.random.default_rng(rng)
    with threadpool_limits(1):
        result = synthesis.synthesise(chosen, specification, options, rng=generator, **more)
    return dressed(SynthesisResult, result, plants=chosen, specification=specification)


def certify(
    controller: Controller | SynthesisResult,
    plants: plant_set.UncertainPlant | Sequence[plant_set.UncertainPlant] | None = None,
    specification: Specification | None = None,
    **more: Any,
) -> Certificate:
    """Check a controller from any source, independently of the optimiser; `control_design.certify`.

    plants, specification: taken from the result of `synthesise` where that is given.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> flexlink.certify(given, example_plant(), example_specification()).certified
    True
    """
    if isinstance(controller, SynthesisResult):
        plants = controller.plants if plants is None else plants
        specification = specification or controller.specification
        controller = controller.controller
    if plants is None or specification is None:
        raise ValueError("certify needs plants and a specification beside a controller")
    chosen = _several(plants)
    with threadpool_limits(1):
        found = certificate.certify(controller, chosen, specification, **more)
    return dressed(
        Certificate, found, controller=controller, uncertain_plants=chosen, specification=specification
    )


def simulate_loop(controller: Controller, machine: Any, reference: npt.ArrayLike, **more: Any) -> LoopRun:
    """Run the loop in time, limits and delay included; arguments as `control_design.simulate`.

    machine: a `SampledArm` or anything with `measure`, `advance` and `reset`; a linear system or an
    `UncertainPlant` (its nominal) as well.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> run = flexlink.simulate_loop(given, example_plant(), [1.0] * 400)
    >>> abs(flexlink.step_metrics(run).steady_error) < 1e-3
    True
    """
    if isinstance(machine, plant_set.UncertainPlant):
        machine = machine.nominal
    chosen: SampledMachine = LinearMachine(machine) if isinstance(machine, control.StateSpace) else machine
    return dressed(LoopRun, closed_loop.simulate(controller, chosen, reference, **more))


def _several(
    plants: plant_set.UncertainPlant | Sequence[plant_set.UncertainPlant],
) -> tuple[plant_set.UncertainPlant, ...]:
    return (plants,) if isinstance(plants, plant_set.UncertainPlant) else tuple(plants)
