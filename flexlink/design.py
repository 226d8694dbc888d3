"""Controllers: uncertain plants and a specification in, a controller and its certificate out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control
import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from control_design.analysis import certificate, closed_loop, multivariable_certificate
from control_design.analysis.certificate import Certificate
from control_design.analysis.closed_loop import (
    ClosedLoopTrajectory as LoopRun,
    LinearMachine,
    SampledMachine,
    step_metrics,
)
from control_design.analysis.multivariable_certificate import MultivariableCertificate
from control_design.controllers import c_code
from control_design.controllers.controller import Controller
from control_design.convex import youla
from control_design.convex.convex_options import YoulaOptions
from control_design.plants import plant_set
from control_design.plants.multivariable import MultivariablePlant, ResponseBall
from control_design.plants.weights import RationalWeight
from control_design.specification import Specification
from control_design.specification.multivariable import MultivariableSpecification
from control_design.synthesis import joint_synthesis, multivariable, synthesis
from control_design.synthesis.multivariable import MultivariableResult
from control_design.synthesis.synthesis_options import MultivariableOptions, SynthesisOptions
from control_design.synthesis.synthesis_result import SynthesisResult
from flexlink.keywords import one_line
from ident.data.frequency_uncertainty import FrequencyUncertainty
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


class WrongSystemError(ValueError, TypeError):
    """A system of another package that has no place here; one line that says what to do."""


def state_space(system: Any, what: str = "the system", *, several: bool = False) -> control.StateSpace:
    """A system of python-control (ss, tf, zpk) or scipy.signal (dlti), or anything with `to_control()`, as a
    discrete `control.StateSpace` with one input and one output (several: any number, of a state space).

    what: its name in a refusal. Raises WrongSystemError (a ValueError) for a system in continuous time or
    without a sampling time, with several inputs or outputs, or with more zeros than poles; for a measured
    response (frd), which has no poles; and for anything else.
    """
    if hasattr(system, "to_control"):
        system = system.to_control()
    if isinstance(system, control.FrequencyResponseData):
        raise WrongSystemError(
            f"{what} is a frequency response (frd), which has no poles: identify it with "
            "flexlink.identify_frf, or give a model beside it, UncertainPlant(model, uncertainty=frd)"
        )
    if type(system).__module__.startswith("scipy.signal") and hasattr(system, "to_ss"):
        own = system.to_ss()
        system = control.ss(own.A, own.B, own.C, own.D, own.dt or 0, remove_useless_states=False)
    if isinstance(system, (MatrixPosterior, MultivariablePlant)):
        raise WrongSystemError(
            f"{what} is a {type(system).__name__}, of several inputs and outputs: use "
            "flexlink.synthesise_multivariable and flexlink.certify_multivariable"
        )
    if not isinstance(system, (control.StateSpace, control.TransferFunction)):
        raise WrongSystemError(
            f"{what} is a {type(system).__name__}; expected a discrete system of python-control: "
            "control.ss(A, B, C, D, dt_s) or control.tf(num, den, dt_s)"
        )
    _checked(system, what, several=several and isinstance(system, control.StateSpace))
    if isinstance(system, control.StateSpace):
        return system
    above, below = (np.trim_zeros(np.atleast_1d(part[0][0]), "f") for part in (system.num, system.den))
    if above.size > below.size:
        raise WrongSystemError(
            f"{what} has more zeros than poles, so it answers before it is asked: expected as many poles, "
            "control.tf(num, den, dt_s) with num no longer than den"
        )
    return _in_sections(above, below, system.dt)


def _in_sections(above: npt.NDArray[Any], below: npt.NDArray[Any], dt_s: float) -> control.StateSpace:
    """above(z)/below(z) as sections of first and second order in a row: of slow poles that are close together
    one companion form leaves nothing but rounding."""
    if not above.size:
        return control.ss([], [], [], 0.0, dt_s)
    # Poles that the rounding of coefficients cannot tell from one are one.
    integrators, rest = 0, below
    while rest.size > 1 and abs(np.sum(rest)) <= rest.size * np.finfo(float).eps * np.sum(np.abs(rest)):
        integrators, rest = integrators + 1, np.cumsum(rest)[:-1]
    poles, zeros = _factors(np.append(np.roots(rest), np.ones(integrators))), _factors(np.roots(above))
    zeros += [np.ones(1)] * (len(poles) - len(zeros))
    found = control.ss([], [], [], above[0] / below[0], dt_s)
    for pole, zero in zip(poles, zeros, strict=True):
        found = control.series(found, control.tf2ss(control.tf(zero, pole, dt_s)))
    return found


def _factors(roots: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """Factors of second order and, of an odd number of roots, one of first order."""
    real = np.sort(roots[roots.imag == 0].real)[::-1]
    pairs = [np.poly([root, root.conj()]).real for root in roots[roots.imag > 0]]
    return pairs + [np.poly(real[at : at + 2]) for at in range(0, real.size, 2)]


def measured_response(system: control.FrequencyResponseData, what: str = "the frd") -> FrequencyUncertainty:
    """An frd of python-control as a response without uncertainty; refused as in `state_space`."""
    _checked(system, what)
    order = np.argsort(system.omega, kind="stable")
    omega, centre = np.asarray(system.omega)[order], np.asarray(system.frdata[0, 0])[order]
    return FrequencyUncertainty(omega, centre, np.zeros((omega.size, 2, 2)), float(system.dt))


def _checked(system: Any, what: str, *, several: bool = False) -> None:
    """Refuses another number of signals than one (unless several), and a system without a sampling time."""
    if not several and (system.ninputs, system.noutputs) != (1, 1):
        raise WrongSystemError(
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
        raise WrongSystemError(f"{what} is in continuous time, flexlink works in discrete time: {mend}")
    if system.dt is None or system.dt is True:
        raise WrongSystemError(
            f"{what} has no sampling time in seconds (dt = {system.dt}), which discrete time needs: "
            "state it, system.dt = dt_s"
        )


class UncertainPlant(plant_set.UncertainPlant):
    """A nominal state space and the ellipses around its response, for which a controller is designed.

    plant : Uncertainty, or a discrete system of python-control (ss, tf), or a model with `to_control()`
        An `Uncertainty` has its own ellipses; anything else is exact unless you give `uncertainty`.
    uncertainty : as in `control_design.UncertainPlant`, or a `control.frd` (measured response, exact).

    Other arguments as in `control_design.UncertainPlant`.

    Examples
    --------
    >>> import control
    >>> flexlink.UncertainPlant(control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01), name="motor")
    UncertainPlant 'motor': 1 state, dt = 0.01 s, no integrator, response taken as exact
    >>> flexlink.UncertainPlant(control.tf([0.1], [1.0, 0.5]), name="motor")
    Traceback (most recent call last):
    flexlink.design.WrongSystemError: plant 'motor' is in continuous time, flexlink works in discrete ...
    """

    @one_line
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
    **more: Any,
) -> SynthesisResult:
    """Design one controller for one or several uncertain plants.

    plants: an `UncertainPlant` or what makes one (ss, tf, a model), or several. rng: a generator, or the seed
    of one. more: as in `control_design.synthesise`. Raises SpecificationError where no controller can meet
    the specification.

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
        return synthesis.synthesise(chosen, specification, options, rng=generator, **more)


def synthesise_jointly(
    plants: Any,
    specification: Specification,
    options: SynthesisOptions | None = None,
    *,
    rng: np.random.Generator | int = 0,
    **more: Any,
) -> joint_synthesis.JointDesign:
    """As `synthesise`, until the stated share of sampled responses is stable (Monte Carlo, not a bound).

    Arguments as `control_design.synthesise_jointly` (`stable_share`, `draws`, `rounds`); `rng` as in
    `synthesise`. The plants need an uncertainty that can be drawn from, as of `flexlink.uncertainty`.

    Examples
    --------
    >>> spread = flexlink.uncertainty(flexlink.identify(example_record(), n_pairs=1, n_real=0))
    >>> asked = flexlink.Specification(modulus_margin=0.4, bandwidth_rad_s=0.5, controller_order=1)
    >>> quick = flexlink.SynthesisOptions(starts=1, dense_points=1000)
    >>> found = flexlink.synthesise_jointly(flexlink.UncertainPlant(spread), asked, quick, draws=2000)
    >>> found.reached, found.unstable
    (True, (0,))
    """
    chosen = _several(plants)
    with threadpool_limits(1):
        return joint_synthesis.synthesise_jointly(
            chosen, specification, options, rng=np.random.default_rng(rng), **more
        )


def youla_bracket(
    plants: Any, specification: Specification, options: YoulaOptions | None = None
) -> youla.YoulaBracket:
    """What no controller of any order can fall below (`floor`); `control_design.youla_bracket`.

    Examples
    --------
    >>> coarse = flexlink.YoulaOptions(grid_points=60, dense_points=1000)
    >>> bound = flexlink.youla_bracket(example_plant(), example_specification(), coarse)
    >>> 0.0 < bound.floor <= 1.0
    True
    """
    with threadpool_limits(1):
        return youla.youla_bracket(_several(plants), specification, options)


def certify(
    controller: Any,
    plants: Any = None,
    specification: Specification | None = None,
    **more: Any,
) -> Certificate:
    """Certify a controller from any source, independently of the optimiser.

    controller: a `Controller`, a result of `synthesise`, or a discrete system of python-control (ss, tf) from
    error to command, to which the computational delay of the specification is added. plants: as in
    `synthesise`. plants and specification default to those of a result of `synthesise`.

    more: `n_dense` (points of the grid, 6000); `between_own_points` ("linear" or "nothing": the response
    between measured frequencies); `joint_coverage` (probability that the worst case holds for a complete
    posterior sample), with `rng` (a generator or the seed of one), `joint_draws`, `joint_stable_share`.
    Raises ValueError where sampling times or delays do not match, or the loop is algebraic.

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
    chosen = _several(plants)
    if controller is not None and not isinstance(controller, Controller):
        controller = _as_controller(controller, specification.computational_delay_samples)
    if "joint_coverage" in more:
        more["rng"] = np.random.default_rng(more.get("rng", 0))
    with threadpool_limits(1):
        return certificate.certify(controller, chosen, specification, **more)


def synthesise_multivariable(
    plants: MultivariablePlant | Sequence[MultivariablePlant],
    specification: MultivariableSpecification,
    options: MultivariableOptions | None = None,
) -> MultivariableResult:
    """Design one controller of all sensors and actuators; `control_design.synthesise_multivariable`."""
    with threadpool_limits(1):
        return multivariable.synthesise_multivariable(plants, specification, options)


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
    law = getattr(controller, "controller", controller)
    if not isinstance(law, Controller):
        law = _as_controller(law, specification.computational_delay_samples, several=True)
    with threadpool_limits(1):
        return multivariable_certificate.certify_multivariable(
            law, plants, specification, dense_points=dense_points
        )


def c_source(controller: Any, prefix: str = "controller", number: c_code.Number = "double") -> str:
    """C99 source of a controller; `control_design.c_source`.

    controller: a `Controller`, a result that has one (`synthesise`, `certify`), or a discrete system of
    python-control (ss, tf). prefix: start of every name. number: type of states and coefficients.
    """
    given = getattr(controller, "controller", controller)
    return c_code.c_source(
        given if isinstance(given, Controller) else _as_controller(given, 1), prefix, number
    )


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
        raise WrongSystemError(
            f"the machine is a {type(machine).__name__}; expected flexlink.SampledArm(rig, effects, rng), a "
            "linear system or an UncertainPlant"
        )
    chosen: SampledMachine = machine
    if not isinstance(controller, Controller):
        controller = _as_controller(controller, 1)
    return closed_loop.simulate(controller, chosen, reference, **more)


def _as_controller(system: Any, delay_samples: int, *, several: bool = False) -> Controller:
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
