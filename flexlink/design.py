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
    step_metrics,
)
from control_design.analysis.multivariable_certificate import MultivariableCertificate
from control_design.controllers import c_code
from control_design.controllers.controller import Controller
from control_design.convex import youla
from control_design.convex.convex_options import YoulaOptions
from control_design.plants import plant_set
from control_design.plants.guards import Guard
from control_design.plants.multivariable import MultivariablePlant, ResponseBall
from control_design.plants.transfer import of_polynomials
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification
from control_design.specification.multivariable import MultivariableSpecification
from control_design.synthesis import joint_synthesis, multivariable, synthesis
from control_design.synthesis.multivariable import MultivariableResult
from control_design.synthesis.order_search import Progress
from control_design.synthesis.synthesis_options import MultivariableOptions, SynthesisOptions
from control_design.synthesis.synthesis_result import SynthesisResult
from flexlink.keywords import WrongArgumentError, options_of, refuse_rate
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.frequency_fit import FrfIdentification
from ident.response_uncertainty import Uncertainty
from ident.uncertainty.matrix_response import MatrixPosterior

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


def state_space(system: Any, what: str = "the system", *, several: bool = False) -> control.StateSpace:
    """A system of python-control (ss, tf, zpk) or scipy.signal (dlti), or anything with `to_control()`, as a
    discrete `control.StateSpace` with one input and one output (several: any number, of a state space).

    what: its name in a refusal. Raises WrongArgumentError (a ValueError) for a system in continuous time or
    without a sampling time, with several inputs or outputs, or with more zeros than poles; for a measured
    response (frd), which has no poles; and for anything else.
    """
    if hasattr(system, "to_control"):
        system = system.to_control()
    if isinstance(system, control.FrequencyResponseData):
        raise WrongArgumentError(
            f"{what} is a frequency response (frd), which has no poles: identify it with "
            "flexlink.identify_frf, or give a model beside it, UncertainPlant(model, uncertainty=frd)"
        )
    if type(system).__module__.startswith("scipy.signal") and hasattr(system, "to_ss"):
        own = system.to_ss()
        system = control.ss(own.A, own.B, own.C, own.D, own.dt or 0, remove_useless_states=False)
    if isinstance(system, (MatrixPosterior, MultivariablePlant)):
        raise WrongArgumentError(
            f"{what} is a {type(system).__name__}, of several inputs and outputs: use "
            "flexlink.synthesise_multivariable and flexlink.certify_multivariable"
        )
    if not isinstance(system, (control.StateSpace, control.TransferFunction)):
        raise WrongArgumentError(
            f"{what} is a {type(system).__name__}; expected a discrete system of python-control: "
            "control.ss(A, B, C, D, dt_s) or control.tf(num, den, dt_s)"
        )
    _checked(system, what, several=several and isinstance(system, control.StateSpace))
    if isinstance(system, control.StateSpace):
        return system
    try:
        return of_polynomials(system.num[0][0], system.den[0][0], system.dt)
    except ValueError as error:
        raise WrongArgumentError(f"{what} {error}") from None


def measured_response(system: control.FrequencyResponseData, what: str = "the frd") -> FrequencyUncertainty:
    """An frd of python-control as a response without uncertainty; refused as in `state_space`."""
    _checked(system, what)
    order = np.argsort(system.omega, kind="stable")
    omega, centre = np.asarray(system.omega)[order], np.asarray(system.frdata[0, 0])[order]
    return FrequencyUncertainty(omega, centre, np.zeros((omega.size, 2, 2)), float(system.dt))


def _checked(system: Any, what: str, *, several: bool = False) -> None:
    """Refuses another number of signals than one (unless several), and a system without a sampling time."""
    if not several and (system.ninputs, system.noutputs) != (1, 1):
        raise WrongArgumentError(
            f"{what} has {system.ninputs} inputs and {system.noutputs} outputs; take one channel: "
            "system[output, input], as system[0, 0]; or design for all with "
            "flexlink.synthesise_multivariable(flexlink.MultivariablePlant(name, system), ...)"
        )
    measured = isinstance(system, control.FrequencyResponseData)
    if system.dt == 0 and not isinstance(system.dt, bool):
        mend = (
            "state the sampling time of the records: control.frd(response, omega, dt_s)"
            if measured
            else "sample it: control.sample_system(system, dt_s, 'zoh')"
        )
        raise WrongArgumentError(f"{what} is in continuous time, flexlink works in discrete time: {mend}")
    refuse_rate(system.dt)
    if system.dt is None or system.dt is True:
        raise WrongArgumentError(
            f"{what} has no sampling time in seconds (dt = {system.dt}), which discrete time needs: "
            "state it, system.dt = dt_s"
        )


class UncertainPlant(plant_set.UncertainPlant):
    """A nominal state space and the ellipses around its response, for which a controller is designed.

    plant : Uncertainty, or a discrete system of python-control (ss, tf), or a model with `to_control()`
        An `Uncertainty` has its own ellipses, the result of `identify_frf` those of its posterior; anything
        else is exact unless you give `uncertainty`.
    uncertainty : as in `control_design.UncertainPlant`, or a `control.frd` (measured response, exact).

    Other arguments as in `control_design.UncertainPlant`.

    Examples
    --------
    >>> import control
    >>> flexlink.UncertainPlant(control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01), name="motor")
    UncertainPlant 'motor': 1 state, dt = 0.01 s, no integrator, response taken as exact
    >>> flexlink.UncertainPlant(control.tf([0.1], [1.0, 0.5]), name="motor")
    Traceback (most recent call last):
    flexlink.keywords.WrongArgumentError: plant 'motor' is in continuous time, flexlink works in discrete ...
    """

    def __init__(
        self,
        plant: Any = None,
        *,
        name: str = "plant",
        uncertainty: Any = None,
        nominal: Any = None,
        **more: Any,
    ) -> None:
        given = plant if nominal is None else nominal
        if nominal is not None and uncertainty is None and isinstance(plant, control.FrequencyResponseData):
            uncertainty = plant
        if isinstance(uncertainty, control.FrequencyResponseData):
            uncertainty = measured_response(uncertainty, f"the response of plant {name!r}")
        if uncertainty is None and isinstance(given, Uncertainty):
            uncertainty = given
        if uncertainty is None and isinstance(given, FrfIdentification):
            uncertainty = given.posterior
        super().__init__(
            name=name,
            nominal=state_space(given, f"plant {name!r}"),
            uncertainty=uncertainty,
            **more,
        )


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
    return synthesis.synthesise(
        _several(plants),
        specification,
        options_of(SynthesisOptions, options, settings),
        rng=np.random.default_rng(rng),
        guards=guards,
        progress=progress,
        thorough=thorough,
    )


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


def c_source(controller: Any, prefix: str = "controller", number: c_code.Number = "double") -> str:
    """C99 source of a controller; `control_design.c_source`.

    controller: a `Controller`, a result that has one (`synthesise`, `certify`), or a discrete system of
    python-control (ss, tf). prefix: start of every name. number: type of states and coefficients.
    """
    given = getattr(controller, "controller", controller)
    return c_code.c_source(_as_controller(given, 1), prefix, number)


def simulate_loop(controller: Any, machine: Any, reference: npt.ArrayLike, **more: Any) -> LoopRun:
    """Simulate the closed loop with limits and delay; arguments as in `control_design.simulate`.

    controller: a `Controller`, or a discrete system of python-control (ss, tf) as in `certify`, with a delay
    of one sample. machine: a `SampledArm` or anything with `measure`, `advance` and `reset`; a linear system
    or an `UncertainPlant` (its nominal) as well. more: `hub_torque_Nm`, `input_disturbance`,
    `output_disturbance` (T,), and the quantisation steps `measurement_step`, `command_step`. Raises
    ValueError where sampling times or lengths do not match.

    Examples
    --------
    >>> given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    >>> run = flexlink.simulate_loop(given, example_plant(), [1.0] * 400)
    >>> abs(flexlink.step_metrics(run).steady_error) < 1e-3
    True
    """
    if isinstance(machine, plant_set.UncertainPlant):
        machine = machine.nominal
    if isinstance(machine, control.lti.LTI):
        machine = LinearMachine(state_space(machine, "the machine"))
    if not all(hasattr(machine, part) for part in ("measure", "advance", "reset", "dt_s")):
        raise WrongArgumentError(
            f"the machine is a {type(machine).__name__}; expected flexlink.SampledArm(rig, effects, rng), a "
            "linear system or an UncertainPlant"
        )
    return closed_loop.simulate(_as_controller(controller, 1), machine, reference, **more)


def _as_controller(system: Any, delay_samples: int, *, several: bool = False) -> Controller:
    """A `Controller` as it is, or a system with a delay."""
    if isinstance(system, Controller):
        return system
    found = state_space(system, "the controller", several=several)
    return Controller(
        found.A, found.B, found.C, found.D, float(found.dt), computational_delay_samples=delay_samples
    )


def _several(plants: Any) -> tuple[plant_set.UncertainPlant, ...]:
    """One plant or a list of them, each an `UncertainPlant` or what makes one."""
    several = list(plants) if isinstance(plants, Sequence) and not isinstance(plants, str) else [plants]
    return tuple(
        each
        if isinstance(each, plant_set.UncertainPlant)
        else UncertainPlant(each, name="plant" if len(several) == 1 else f"plant {k + 1}")
        for k, each in enumerate(several)
    )
