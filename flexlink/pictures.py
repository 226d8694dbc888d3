"""Pictures of results: the drawings of the pages, for one result at a time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import control
import numpy as np
import numpy.typing as npt

from control_design.analysis.certificate import Certificate
from control_design.analysis.closed_loop import ClosedLoopTrajectory
from control_design.controllers.controller import Controller
from control_design.plants.foreign_systems import measured_response, state_space
from control_design.plants.plant_set import UncertainPlant, frequency_response
from control_design.synthesis.synthesis_result import SynthesisResult
from diagnosis.answer import Diagnosis
from flexlink.comparison import Comparison
from flexlink.keywords import front_door
from flexlink.machines import Simulation
from ident.basis.model import GobfModel
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record
from ident.frequency_fit import FrfIdentification
from ident.identification import Identification
from ident.search.error_surface import ErrorSurface
from ident.uncertainty import ResponsePosterior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["bode", "nichols", "nyquist", "plot", "step"]


@singledispatch
def plot(result: object) -> Figure:
    """Draw records, poles, a response with its ellipses, loop gains or causes, as on the pages.

    Parameters
    ----------
    result : object
        A record, a model, an uncertainty, a design, a certificate or a diagnosis.

    Returns
    -------
    matplotlib.figure.Figure
        Save it with `figure.savefig("response.png")`.

    Raises
    ------
    TypeError
        There is no picture of the argument.

    Examples
    --------
    >>> figure = flexlink.plot(example_record())
    >>> [axes.get_xlabel() for axes in figure.axes[2:]]
    ['time, all records [s]', 'time in this record [s]']
    """
    raise TypeError(unknown("picture", result, plot))


def unknown(what: str, result: object, of: Any) -> str:
    """What there is a picture or a table of."""
    known = sorted({kind.__name__ for kind in of.registry} - {"object"})
    return f"no {what} of {type(result).__name__}; there is one of {', '.join(known)}"


@front_door
def bode(
    *results: Any,
    names: str | Sequence[str] = (),
    ax: Any = None,
    dB: bool = False,
    Hz: bool = False,
    omega_rad_s: Any = None,
) -> Figure:
    """Draw gain and phase of one response, or of several on one plot; ellipses are bands.

    Parameters
    ----------
    results : object
        Each an identification, a model, an uncertainty, a measured response, an uncertain plant, a
        controller, a discrete system of python-control (ss, tf, frd), or the loop of a design or a
        certificate.
    names : str or sequence of str
        Of the curves, in the same order; one may stand by itself.
    ax : axes of matplotlib, optional
        Two of them, gain and phase; of one response a third shows the size of its ellipses.
    dB, Hz : bool
        Gain in dB, frequency in Hz.
    omega_rad_s : (F,) array, optional
        Frequencies; a measured response has its own.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        Another number of names or axes.
    TypeError
        What has no response.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> [axes.get_ylabel() for axes in flexlink.bode(found).axes[:3]]
    ['gain [as logged]', 'phase [deg]', 'ellipse / gain [%]']
    >>> rough = flexlink.identify(example_record(), n_pairs=0, n_real=2)
    >>> figure = flexlink.bode(found, rough, names=["one mode", "two lags"], dB=True)
    >>> [text.get_text() for text in figure.legends[0].get_texts()]
    ['one mode', 'two lags']
    """
    from workflow.figures.bode import draw_bode, draw_comparison

    given_names = [names] if isinstance(names, str) else list(names)
    if not results or (given_names and len(given_names) != len(results)):
        raise ValueError(
            f"expected a name for each response; got {len(results)} responses and {len(given_names)} names"
        )
    # One response alone has a third panel, the size of its ellipses, unless two axes are given.
    if len(results) == 1 and not given_names:
        response = as_response(results[0], omega_rad_s)
        model = getattr(results[0], "model", results[0])
        channel = f"{getattr(model, 'input_name', 'u')} to {getattr(model, 'output_name', 'y')}"
        if ax is None or np.size(ax) == 3:
            return _figure(draw_bode(response, channel, "as logged", dB=dB, Hz=Hz), ax)
        given_names = [channel]
    # Several are told apart by their names, or by number and class.
    curve_names = given_names or [f"{k}: {type(result).__name__}" for k, result in enumerate(results, 1)]
    responses = {
        name: as_response(result, omega_rad_s) for name, result in zip(curve_names, results, strict=True)
    }
    return _figure(draw_comparison(responses, dB=dB, Hz=Hz), ax)


@front_door
def nyquist(loop: Any, controller: Any = None, *, ax: Any = None, omega_rad_s: Any = None) -> Figure:
    """Draw the Nyquist curve of a loop with its ellipses.

    Parameters
    ----------
    loop : object
        A design or a certificate, or a plant with a controller beside it, each as for `bode`.
    controller : object, optional
        Of a plant that is given alone.
    ax : axes of matplotlib, optional
        To draw on in place of a new figure.
    omega_rad_s : (F,) array, optional
        Frequencies; by default those that show the loop.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> law = flexlink.Controller.proportional(0.5, 0.01)
    >>> figure = flexlink.nyquist(example_plant(), law)
    >>> figure.axes[0].get_title(loc="left")
    'Loop K G'
    """
    from workflow.figures.nyquist import draw_alone, draw_nyquist

    return _figure(draw_alone(draw_nyquist, _loop_of(loop, controller, omega_rad_s)), ax)


@front_door
def nichols(loop: Any, controller: Any = None, *, ax: Any = None, omega_rad_s: Any = None) -> Figure:
    """Draw a loop on a Nichols chart: gain [dB] over phase, with lines of constant closed-loop gain.

    Parameters
    ----------
    loop : object
        A design or a certificate, or a plant with a controller beside it, each as for `bode`.
    controller : object, optional
        Of a plant that is given alone.
    ax : axes of matplotlib, optional
        To draw on in place of a new figure.
    omega_rad_s : (F,) array, optional
        Frequencies, rad/s; by default those that show the loop.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> law = flexlink.Controller.proportional(0.5, 0.01)
    >>> figure = flexlink.nichols(example_plant(), law)
    >>> figure.axes[0].get_xlabel()
    'phase of K G [deg]'
    """
    from workflow.figures.nyquist import draw_alone, draw_nichols

    return _figure(draw_alone(draw_nichols, _loop_of(loop, controller, omega_rad_s)), ax)


@front_door
def step(result: Any, controller: Any = None, *, ax: Any = None, time_s: Any = None) -> Figure:
    """Draw the step response of a plant, or of its loop with a controller, then with the command below.

    Parameters
    ----------
    result : object
        A plant or model; or a design or a certificate, whose nominal loop is taken.
    controller : object, optional
        As in `nyquist`; without one a plant is drawn as it is.
    ax : axes of matplotlib, optional
        One, of a loop two.
    time_s : (T,) array, optional
        Evenly sampled; by default until nothing moves.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    TypeError
        What has no poles.

    Examples
    --------
    >>> law = flexlink.Controller.proportional(0.5, 0.01)
    >>> figure = flexlink.step(example_plant(), law)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['output\\n[as logged]', 'command\\n[as logged]']
    """
    from workflow.figures.closed_loop import draw_closed_loop
    from workflow.tasks.results import LoopRuns

    plant, controller = _parts(result, controller)
    plant = state_space(getattr(plant, "nominal", getattr(plant, "model", plant)), "the plant")
    panels = {"output": ("output", "")}
    if controller is None:
        response = control.step_response(plant, time_s)
        command = response.inputs[None]
    else:
        # The command is what the controller makes of the error, reference less output.
        law = _law(controller)
        response = control.step_response(control.feedback(plant * law), time_s)
        command = control.forced_response(law, response.time, 1 - response.outputs).outputs[None]
        panels |= {"command": ("command", "")}
    output = response.outputs[None]
    # No limit of the command is drawn: the loop is linear here.
    runs = LoopRuns(output, command, None, np.zeros_like(output, dtype=bool))
    return _figure(draw_closed_loop(response.time, np.ones_like(response.time), runs, panels), ax)


def _figure(picture: Any, ax: Any = None) -> Figure:
    """A picture as a figure of matplotlib, or on axes that the caller has."""
    from workflow.figures.matplotlib_figure import figure_of

    return figure_of(picture, ax)


def _parts(result: Any, controller: Any) -> tuple[Any, Any]:
    """Plant and controller of a design or a certificate, or those that were given."""
    if isinstance(result, SynthesisResult):
        return result.plants[0], result.controller
    if isinstance(result, Certificate):
        return result.uncertain_plants[0], result.controller
    return result, controller


def _loop_of(result: Any, controller: Any, omega_rad_s: Any) -> FrequencyUncertainty:
    """The response of a loop K G with its ellipses, of a plant alone where there is no controller."""
    from workflow.figures.bands import smooth_grid, times

    plant, controller = _parts(result, controller)
    plant_response = as_response(plant, omega_rad_s)
    if controller is None:
        return plant_response
    law = _law(controller)
    # A measured response has its own frequencies, whatever is asked for.
    is_known_everywhere = as_response(plant, plant_response.omega_rad_s[:1]).omega_rad_s.size == 1
    if omega_rad_s is None and is_known_everywhere:
        # None was asked for: those that show the loop.
        grid = smooth_grid(
            plant_response.omega_rad_s[plant_response.omega_rad_s > 0],
            lambda omega: as_response(plant, omega).centre * frequency_response(law, omega),
        )
        plant_response = as_response(plant, grid)
    return times(plant_response, frequency_response(law, plant_response.omega_rad_s))


def _law(controller: Any) -> control.StateSpace:
    """A controller with its computational delay; a system of another package has it in itself."""
    if isinstance(controller, Controller):
        return controller.to_control(include_delay=True)
    return state_space(controller, "the controller")


def as_response(result: Any, omega_rad_s: Any = None) -> FrequencyUncertainty:
    """The response of a result at omega (F,) or over three decades up to its Nyquist frequency, or where it
    was measured, with its ellipses; without size where it is taken as exact. Of a design its loop."""
    if isinstance(result, (SynthesisResult, Certificate)):
        return _loop_of(result, None, omega_rad_s)
    model = getattr(result, "model", result)
    # What was measured keeps its frequencies.
    if isinstance(model, FrequencyUncertainty):
        return model
    if isinstance(model, control.FrequencyResponseData):
        return measured_response(model)
    if isinstance(model, UncertainPlant):
        if isinstance(model.uncertainty, (FrequencyUncertainty, ResponsePosterior)):
            return as_response(model.uncertainty, omega_rad_s)
        model = model.nominal

    # Everything else answers at any frequency.
    has_own_response = isinstance(model, (ResponsePosterior, GobfModel))
    if not has_own_response:
        model = state_space(model, f"a {type(result).__name__}")
    dt_s = float(model.dt_s if has_own_response else model.dt)
    omega = _grid(dt_s) if omega_rad_s is None else np.asarray(omega_rad_s, dtype=np.float64)
    if isinstance(model, ResponsePosterior):
        return model.at(omega)
    if isinstance(model, GobfModel):
        centre = model.frequency_response(omega)
    else:
        centre = frequency_response(model, omega)
    return FrequencyUncertainty(omega, centre, np.zeros((omega.size, 2, 2)), dt_s)


@plot.register(Record)
def _record(record: Record) -> Figure:
    from workflow.figures.records import draw_records
    from workflow.tasks.results import RunRecord

    shown = [RunRecord(record, "estimation", None, "")]
    return _figure(draw_records(shown, record.input_names, record.output_names))


@plot.register(Simulation)
def _simulation(simulation: Simulation) -> Figure:
    outputs = np.column_stack([simulation.hub_angle_rad, simulation.tip_m])
    record = Record(
        simulation.voltage_V,
        outputs,
        simulation.dt_s,
        name="simulated",
        input_names="voltage_V",
        output_names=("hub_angle_rad", "tip_m"),
    )
    return _record(record)


@plot.register(Identification)
def _poles(identification: Identification) -> Figure:
    from workflow.figures.poles import draw_poles

    return _figure(draw_poles(identification.model))


@plot.register(FrfIdentification)
def _fitted_response(fit: FrfIdentification) -> Figure:
    return bode(fit.response, fit.model, names=("measured", "fitted"), omega_rad_s=fit.omega_rad_s)


for kind in (GobfModel, ResponsePosterior, FrequencyUncertainty):
    plot.register(kind, bode)


@plot.register(Certificate)
@plot.register(SynthesisResult)
def _loop(result: Any) -> Figure:
    from workflow.figures.sensitivity import draw_sensitivities, sensitivity_curves

    plant, controller = _parts(result, None)
    assert result.specification is not None
    # A measured response is known at its own frequencies only; zero has no place on a logarithmic axis.
    omega = _grid(plant.dt_s) if plant.own_grid is None else plant.own_grid[plant.own_grid > 0]
    curves = sensitivity_curves(plant, controller, result.specification, omega)
    return _figure(draw_sensitivities(curves, level=plant.level))


@plot.register(ClosedLoopTrajectory)
def _run(run: ClosedLoopTrajectory) -> Figure:
    from workflow.figures.closed_loop import draw_closed_loop
    from workflow.tasks.results import LoopRuns

    runs = LoopRuns(run.measured[None], run.command[None], None, run.limited[None])
    labels = {"output": ("output", ""), "command": ("command", "")}
    return _figure(draw_closed_loop(run.time_s, run.reference, runs, labels))


@plot.register(ErrorSurface)
def _surface(surface: ErrorSurface) -> Figure:
    from workflow.figures.pole_search import draw_surface

    return _figure(draw_surface(surface))


@plot.register(Comparison)
def _comparison(comparison: Comparison) -> Figure:
    return comparison.plot()


@plot.register(Diagnosis)
def _causes(diagnosis: Diagnosis) -> Figure:
    from workflow.figures.gap_answer import draw_probabilities

    return _figure(draw_probabilities(diagnosis))


def _grid(dt_s: float) -> npt.NDArray[np.float64]:
    """Three decades up to the Nyquist frequency."""
    return np.geomspace(1e-3, 1.0, 600) * np.pi / dt_s
