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

    plants: an `UncertainPlant` or what makes one (ss, tf, a model), or several. rng: a generator, or the seed
    of one. settings: fields of `SynthesisOptions`, instead of `options`. Others as in
    `control_design.synthesise`. Raises SpecificationError where no controller can meet the specification.

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
    """As `synthesise`, until the stated share of sampled responses is stable (Monte Carlo, not a bound).

    Arguments as `control_design.synthesise_jointly`; `rng` and settings as in `synthesise`. The plants need
    an uncertainty that can be drawn from, as of `flexlink.uncertainty`.

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
    """What no controller of any order can fall below (`floor`); `control_design.youla_bracket`.

    settings: fields of `YoulaOptions`, instead of `options`.

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

    controller: a `Controller`, a result of `synthesise`, or a discrete system of python-control (ss, tf) from
    error to command, to which the computational delay of the specification is added. plants: as in
    `synthesise`. plants and specification default to those of a result of `synthesise`.

    n_dense: points of the grid. between_own_points: the response between measured frequencies.
    joint_coverage: probability that the worst case holds for a complete posterior sample, with `rng` (a
    generator or the seed of one), `joint_draws`, `joint_stable_share`. Raises ValueError where sampling times
    or delays do not match, or the loop is algebraic.

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
    settings: fields of `MultivariableOptions`, instead of `options`."""
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

    controller: a `Controller`, a result of `synthesise_multivariable`, or a discrete `control.StateSpace`
    from errors to commands, as in `certify`.
    """
    given = getattr(controller, "controller", controller)
    return multivariable_certificate.certify_multivariable(
        _as_controller(given, specification.computational_delay_samples, several=True),
        plants,
        specification,
        dense_points=dense_points,
    )


@front_door
def c_source(controller: Any, prefix: str = "controller", number: c_code.Number = "double") -> str:
    """C99 source of a controller; `control_design.c_source`.

    controller: a `Controller`, a result that has one (`synthesise`, `certify`), or a discrete system of
    python-control (ss, tf). prefix: start of every name. number: type of states and coefficients.
    """
    given = getattr(controller, "controller", controller)
    return c_code.c_source(_as_controller(given, 1), prefix, number)


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
    """Simulate the closed loop with limits and delay; arguments as in `control_design.simulate`.

    controller: a `Controller`, or a discrete system of python-control (ss, tf) as in `certify`, with a delay
    of one sample. machine: a `SampledArm` or anything with `measure`, `advance` and `reset`; a linear system
    or an `UncertainPlant` (its nominal) as well. reference: (T,) in units of the measured signal.
    hub_torque_Nm, input_disturbance, output_disturbance: (T,) from outside. measurement_step, command_step:
    quantisation of the two signals, 0 for none. measured_index: which signal of the machine is fed back.
    clip: limit of the command of the converter, both signs. Raises ValueError where sampling times or lengths
    do not match.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> run = flexlink.simulate_loop(given, example_plant(), [1.0] * 400)
    >>> abs(flexlink.step_metrics(run).steady_error) < 1e-3
    True
    """
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
    found = state_space(system, "the controller", several=several)
    return Controller(
        found.A, found.B, found.C, found.D, float(found.dt), computational_delay_samples=delay_samples
    )


def _several(plants: Any) -> tuple[UncertainPlant, ...]:
    """One plant or a list of them, each an `UncertainPlant` or what makes one."""
    several = list(plants) if isinstance(plants, Sequence) and not isinstance(plants, str) else [plants]
    return tuple(
        each
        if isinstance(each, UncertainPlant)
        else UncertainPlant(each, name="plant" if len(several) == 1 else f"plant {k + 1}")
        for k, each in enumerate(several)
    )
