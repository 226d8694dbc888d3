"""Controllers: uncertain plants and a specification in, a controller and its certificate out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import control
import numpy as np
import numpy.typing as npt

from control_design.analysis import certificate, closed_loop, multivariable_certificate
from control_design.analysis.certificate import Certificate
from control_design.analysis.closed_loop import (
    ClosedLoopTrajectory as LoopRun,
    LinearMachine,
)
from control_design.analysis.multivariable_certificate import MultivariableCertificate
from control_design.controllers import c_code
from control_design.controllers.controller import Controller
from control_design.convex import youla
from control_design.convex.convex_options import YoulaOptions
from control_design.plants.foreign_systems import state_space
from control_design.plants.guards import Guard
from control_design.plants.multivariable import MultivariablePlant, ResponseBall
from control_design.plants.plant_set import UncertainPlant
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification
from control_design.specification.multivariable import MultivariableSpecification
from control_design.synthesis import joint_synthesis, multivariable, synthesis
from control_design.synthesis.multivariable import MultivariableResult
from control_design.synthesis.order_search import Progress
from control_design.synthesis.synthesis_options import MultivariableOptions, SynthesisOptions
from control_design.synthesis.synthesis_result import SynthesisResult
from flexlink.keywords import front_door, options_of
from ident.data.keywords import WrongArgumentError

__all__ = [
    "Certificate",
    "Controller",
    "LoopRun",
    "MultivariableCertificate",
    "MultivariableOptions",
    "MultivariablePlant",
    "MultivariableResult",
    "MultivariableSpecification",
    "RationalWeight",
    "ResponseBall",
    "Specification",
    "SynthesisOptions",
    "SynthesisResult",
    "UncertainPlant",
    "YoulaOptions",
    "c_source",
    "certify",
    "certify_multivariable",
    "simulate_loop",
    "step_metrics",
    "synthesise",
    "synthesise_jointly",
    "synthesise_multivariable",
    "youla_bracket",
]


step_metrics = front_door(closed_loop.step_metrics)


@front_door
def synthesise(
    plants: Any,
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator | int = 0,
    guards: Sequence[Guard] = (),
    progress: Progress | None = None,
    thorough: bool = True,
    **settings: Any,
) -> SynthesisResult:
    """Design one controller for one or several uncertain plants.

    Parameters
    ----------
    plants : UncertainPlant or what makes one, or a sequence of them
        A system of python-control (ss, tf), a model or an uncertainty makes one.
    specification : Specification
        What every plant has to meet.
    options : SynthesisOptions, optional
        Or its fields as settings: `starts=1`.
    rng : numpy Generator or int
        A generator, or the seed of one, of the starts of the search.
    guards : sequence of Guard
        Single responses that must be stable as well, whatever the weights say of them.
    progress : callable, optional
        Called with the share that is done and what is being done.
    thorough : bool
        Search from many starts where those from the Youla bound do not settle it.

    Returns
    -------
    SynthesisResult
        Its `outcome` says whether the specification is met on the grid; certify it before use.

    Raises
    ------
    SpecificationError
        No controller can meet the specification.

    Examples
    --------
    >>> designed = flexlink.synthesise(example_plant(), example_specification(), starts=1, dense_points=1000)
    >>> designed.outcome.name, designed.controller.order
    ('MET_ON_GRID', 2)
    """
    _refuse_requirements(settings)
    return synthesis.synthesise(
        _several(plants),
        specification,
        options_of(SynthesisOptions, options, settings),
        rng=np.random.default_rng(rng),
        guards=guards,
        progress=progress,
        thorough=thorough,
    )


@front_door
def synthesise_jointly(
    plants: Any,
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator | int = 0,
    stable_share: float = 0.999,
    draws: int = 10_000,
    rounds: int = 3,
    first: SynthesisResult | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> joint_synthesis.JointDesign:
    """Design a controller with which the stated share of sampled responses is stable.

    Parameters
    ----------
    plants : UncertainPlant or what makes one, or a sequence of them
        With an uncertainty that can be drawn from, as of `flexlink.uncertainty`.
    specification : Specification
        What every plant has to meet.
    options : SynthesisOptions, optional
        Or its fields as settings.
    rng : numpy Generator or int
        Of the search and of the samples.
    stable_share : float
        Of the sampled responses, below 1: Monte Carlo, not a bound.
    draws : int
        Sampled responses of each plant.
    rounds : int
        Designs with guards (responses that were unstable before) at most.
    first : SynthesisResult, optional
        A design to begin with.
    progress : callable, optional
        Called with the share that is done and what is being done.

    Returns
    -------
    JointDesign
        The last `result`, whether the share was `reached`, and how many were `unstable` each time.

    Examples
    --------
    >>> spread = flexlink.uncertainty(flexlink.identify(example_record(), n_pairs=1, n_real=0))
    >>> asked = flexlink.Specification(modulus_margin=0.4, bandwidth_rad_s=0.5, controller_order=1)
    >>> found = flexlink.synthesise_jointly(spread, asked, starts=1, dense_points=1000, draws=2000)
    >>> found.reached, found.unstable
    (True, (0,))
    """
    _refuse_requirements(settings)
    return joint_synthesis.synthesise_jointly(
        _several(plants),
        specification,
        options_of(SynthesisOptions, options, settings),
        rng=np.random.default_rng(rng),
        stable_share=stable_share,
        draws=draws,
        rounds=rounds,
        first=first,
        progress=progress,
    )


@front_door
def youla_bracket(
    plants: Any, specification: Specification, options: YoulaOptions | None = None, **settings: Any
) -> youla.YoulaBracket:
    """Return what no controller of any order can fall below, and what one of high order reaches.

    Parameters
    ----------
    plants, specification
        As in `synthesise`.
    options : YoulaOptions, optional
        Or its fields as settings: `grid_points=60`.

    Returns
    -------
    YoulaBracket
        `floor` and what is reached over the `ellipse`, both worst weighted gains.

    Examples
    --------
    >>> bound = flexlink.youla_bracket(
    ...     example_plant(), example_specification(), grid_points=60, dense_points=1000
    ... )
    >>> 0.0 < bound.floor <= 1.0
    True
    """
    return youla.youla_bracket(_several(plants), specification, options_of(YoulaOptions, options, settings))


@front_door
def certify(
    controller: Any,
    plants: Any = None,
    specification: Specification | None = None,
    *,
    n_dense: int = 6000,
    between_own_points: Literal["nothing", "linear"] = "linear",
    joint_coverage: float | None = None,
    rng: np.random.Generator | int = 0,
    joint_draws: int = 4000,
    joint_stable_share: float = 0.999,
) -> Certificate:
    """Certify a controller from any source, independently of the optimiser.

    Parameters
    ----------
    controller : Controller, SynthesisResult or discrete system of python-control
        A system (ss, tf) leads from error to command; the computational delay of the specification is added.
    plants, specification
        As in `synthesise`; by default those of a result of `synthesise`.
    n_dense : int
        Points of the grid.
    between_own_points : 'linear' or 'nothing'
        What is taken of a measured response between its frequencies.
    joint_coverage : float, optional
        Probability that the worst case holds for a complete posterior sample.
    rng : numpy Generator or int
        Of these samples.
    joint_draws : int
        How many.
    joint_stable_share : float
        Of them that has to be stable.

    Returns
    -------
    Certificate

    Raises
    ------
    ValueError
        Sampling times or delays do not match, or the loop is algebraic.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> flexlink.certify(given, example_plant(), example_specification()).certified
    True
    """
    # A design brings what it was made for; what is given beside it comes first.
    if isinstance(controller, SynthesisResult):
        plants = controller.plants if plants is None else plants
        specification = specification or controller.specification
        controller = controller.controller
    if plants is None or specification is None:
        raise ValueError("certify needs plants and a specification for this controller")
    return certificate.certify(
        _as_controller(controller, specification.computational_delay_samples),
        _several(plants),
        specification,
        n_dense=n_dense,
        between_own_points=between_own_points,
        joint_coverage=joint_coverage,
        rng=np.random.default_rng(rng),
        joint_draws=joint_draws,
        joint_stable_share=joint_stable_share,
    )


@front_door
def synthesise_multivariable(
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    options: MultivariableOptions | None = None,
    **settings: Any,
) -> MultivariableResult:
    """Design one controller of all sensors and actuators; `control_design.synthesise_multivariable`.

    Parameters
    ----------
    plants : MultivariablePlant or sequence of them
        One for each operating point.
    specification : MultivariableSpecification
        One joint for each channel.
    options : MultivariableOptions, optional
        Or its fields as settings.

    Returns
    -------
    MultivariableResult

    Examples
    --------
    >>> designed = flexlink.synthesise_multivariable(
    ...     example_joint_plant(), example_joint_specification(), rounds=2, steps=2
    ... )
    >>> designed.controller.order
    2
    """
    chosen = options_of(MultivariableOptions, options, settings)
    return multivariable.synthesise_multivariable(plants, specification, chosen)


@front_door
def certify_multivariable(
    controller: Any,
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    *,
    dense_points: int = 1500,
) -> MultivariableCertificate:
    """Certify a controller of all sensors and actuators; `control_design.certify_multivariable`.

    Parameters
    ----------
    controller : Controller, MultivariableResult or discrete control.StateSpace
        A system leads from errors to commands, as in `certify`.
    plants : MultivariablePlant or sequence of them
        What the controller has to work for.
    specification : MultivariableSpecification
        One joint for each channel.
    dense_points : int
        Points of the grid.

    Returns
    -------
    MultivariableCertificate

    Examples
    --------
    >>> designed = flexlink.synthesise_multivariable(
    ...     example_joint_plant(), example_joint_specification(), rounds=2, steps=2
    ... )
    >>> flexlink.certify_multivariable(designed, example_joint_plant(), example_joint_specification()).met
    True
    """
    # A result of the synthesis has its controller.
    law = getattr(controller, "controller", controller)
    return multivariable_certificate.certify_multivariable(
        _as_controller(law, specification.computational_delay_samples, several=True),
        plants,
        specification,
        dense_points=dense_points,
    )


@front_door
def c_source(controller: Any, prefix: str = "controller", number: c_code.Number = "double") -> str:
    """C99 source of a controller; `control_design.c_source`.

    Parameters
    ----------
    controller : Controller, SynthesisResult, Certificate or discrete system of python-control
        The law; of a system, from error to command.
    prefix : str
        Start of every name in the source.
    number : 'double' or 'float'
        Type of states and coefficients.

    Returns
    -------
    str

    Examples
    --------
    >>> law = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[2.0]], dt_s=0.01)
    >>> "hub_step" in flexlink.c_source(law, prefix="hub", number="float")
    True
    """
    law = getattr(controller, "controller", controller)
    return c_code.c_source(_as_controller(law, 1), prefix, number)


@front_door
def simulate_loop(
    controller: Any,
    machine: Any,
    reference: npt.ArrayLike,
    *,
    measured_index: int = 0,
    hub_torque_Nm: npt.ArrayLike | None = None,
    input_disturbance: npt.ArrayLike | None = None,
    output_disturbance: npt.ArrayLike | None = None,
    measurement_step: float = 0.0,
    command_step: float = 0.0,
    clip: float = np.inf,
) -> LoopRun:
    """Simulate the closed loop from rest, with limits, delay and quantisation.

    Parameters
    ----------
    controller : Controller or discrete system of python-control
        A system as in `certify`, with a delay of one sample.
    machine : SampledArm, linear system or UncertainPlant
        Or anything with `measure`, `advance` and `reset`; of an uncertain plant its nominal is taken.
    reference : (T,) array
        In units of the measured signal.
    measured_index : int
        Signal of the machine that is fed back.
    hub_torque_Nm, input_disturbance, output_disturbance : (T,) array, optional
        Torque on the machine [N m]; added to the applied command; added to the measured output, in its units.
    measurement_step, command_step : float
        Quantisation of the two signals; 0 for none.
    clip : float
        The machine clips its input there, both signs, in units of the command.

    Returns
    -------
    LoopRun

    Raises
    ------
    ValueError
        Sampling times or lengths do not match.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> run = flexlink.simulate_loop(given, example_plant(), [1.0] * 400)
    >>> abs(flexlink.step_metrics(run).steady_error) < 1e-3
    True
    """
    # Of a plant the nominal system is the machine.
    if isinstance(machine, UncertainPlant):
        machine = machine.nominal
    if isinstance(machine, control.lti.LTI):
        machine = LinearMachine(state_space(machine, "the machine"))
    if not all(hasattr(machine, part) for part in ("measure", "advance", "reset", "dt_s")):
        raise WrongArgumentError(
            f"the machine is a {type(machine).__name__}; expected flexlink.SampledArm(rig, effects, rng), a "
            "linear system or an UncertainPlant"
        )
    return closed_loop.simulate(
        _as_controller(controller, 1),
        machine,
        reference,
        measured_index=measured_index,
        hub_torque_Nm=hub_torque_Nm,
        input_disturbance=input_disturbance,
        output_disturbance=output_disturbance,
        measurement_step=measurement_step,
        command_step=command_step,
        clip=clip,
    )


def _refuse_requirements(settings: dict[str, Any]) -> None:
    """Refuse what belongs into the specification, in one line that says so (WrongArgumentError)."""
    for name in settings:
        key = "controller_order" if name == "order" else name
        if key in Specification.model_fields:
            raise WrongArgumentError(
                f"synthesise: {name} is a requirement: flexlink.Specification({key}=...), no setting of the "
                "synthesis"
            )


def _as_controller(system: Any, delay_samples: int, *, several: bool = False) -> Controller:
    """A `Controller` as it is, or a system with a delay."""
    if isinstance(system, Controller):
        return system
    law = state_space(system, "the controller", several=several)
    return Controller(law.A, law.B, law.C, law.D, float(law.dt), computational_delay_samples=delay_samples)


def _several(plants: Any) -> tuple[UncertainPlant, ...]:
    """One plant or a list of them, each an `UncertainPlant` or what makes one."""
    # A string is a sequence, too, and no plant: it is refused by name.
    are_several = isinstance(plants, Sequence) and not isinstance(plants, str)
    systems = list(plants) if are_several else [plants]
    uncertain_plants = []
    for number, system in enumerate(systems, 1):
        if isinstance(system, UncertainPlant):
            uncertain_plants.append(system)
        else:
            name = "plant" if len(systems) == 1 else f"plant {number}"
            uncertain_plants.append(UncertainPlant(system, name=name))
    return tuple(uncertain_plants)
