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
from control_design.plants.plant_set import UncertainPlant, frequency_response
from control_design.specification import Specification
from control_design.synthesis.synthesis_result import SynthesisResult
from diagnosis.answer import Diagnosis
from flexlink.design import measured_response, state_space
from flexlink.machines import Simulation
from ident.basis.model import GobfModel
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record
from ident.identification import Identification
from ident.search.error_surface import ErrorSurface
from ident.uncertainty import ResponsePosterior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["bode", "compare", "plot"]


@singledispatch
def plot(result: object) -> Figure:
    """Draw records, poles, a response with its ellipses, loop gains or causes, as on the pages.

    Returns a `matplotlib.figure.Figure`; save it with `figure.savefig("response.png")`. Raises TypeError if
    there is no picture of the argument.

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


def bode(result: Any) -> Figure:
    """Gain, phase and size of the ellipses of one response: an identification, a model, an uncertainty, a
    measured response, an uncertain plant, a controller, or a discrete system of python-control (ss, tf, frd).

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> [axes.get_ylabel() for axes in flexlink.bode(found).axes[:3]]
    ['gain [as logged]', 'phase [deg]', 'ellipse / gain [%]']
    """
    model = getattr(result, "model", result)
    return _bode(as_response(result), getattr(model, "input_name", "u"), getattr(model, "output_name", "y"))


def compare(*results: Any, names: str | Sequence[str] = ()) -> Figure:
    """Several responses on one plot, each as for `bode`; ellipses as bands where there are any.

    names: of the curves, in the same order; one may stand by itself. Raises ValueError for another
    number of names, TypeError for what has no response.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> rough = flexlink.identify(example_record(), n_pairs=0, n_real=2)
    >>> figure = flexlink.compare(found, rough, names=["one mode", "two lags"])
    >>> [text.get_text() for text in figure.legends[0].get_texts()]
    ['one mode', 'two lags']
    """
    from workflow.figures.bode import draw_comparison

    given = [names] if isinstance(names, str) else list(names)
    chosen = given or [f"{k + 1}: {type(result).__name__}" for k, result in enumerate(results)]
    if not results or len(chosen) != len(results):
        raise ValueError(f"expected a name for each response; got {len(results)} and {len(chosen)} names")
    return draw_comparison(dict(zip(chosen, map(as_response, results), strict=True)))


def as_response(result: Any) -> FrequencyUncertainty:
    """The response of a result over three decades up to its Nyquist frequency, or where it was measured, with
    its ellipses; without size where it is taken as exact."""
    found = getattr(result, "model", result)
    if isinstance(found, FrequencyUncertainty):
        return found
    if isinstance(found, UncertainPlant):
        if isinstance(found.uncertainty, (FrequencyUncertainty, ResponsePosterior)):
            return as_response(found.uncertainty)
        found = found.nominal
    if isinstance(found, control.FrequencyResponseData):
        return measured_response(found)
    if isinstance(found, ResponsePosterior):
        return found.at(_grid(found.dt_s))
    if isinstance(found, GobfModel):
        omega, dt_s = _grid(found.dt_s), found.dt_s
        centre = found.frequency_response(omega)
    else:
        system = state_space(found, f"a {type(result).__name__}")
        omega, dt_s = _grid(float(system.dt)), float(system.dt)
        centre = frequency_response(system, omega)
    return FrequencyUncertainty(omega, centre, np.zeros((omega.size, 2, 2)), dt_s)


@plot.register(Record)
def _record(record: Record) -> Figure:
    from workflow.figures.records import draw_records
    from workflow.tasks.results import RunRecord

    return draw_records([RunRecord(record, "estimation", None, "")], record.input_names, record.output_names)


@plot.register(Simulation)
def _simulation(simulation: Simulation) -> Figure:
    outputs = np.column_stack([simulation.hub_angle_rad, simulation.tip_m])
    return _record(
        Record(
            "simulated", simulation.voltage_V[:, None], outputs, simulation.dt_s, ("voltage_V",),
            ("hub_angle_rad", "tip_m"),
        )
    )  # fmt: skip


@plot.register(Identification)
def _poles(found: Identification) -> Figure:
    from workflow.figures.poles import draw_poles

    return draw_poles(found.model)


@plot.register(GobfModel)
def _model(model: GobfModel) -> Figure:
    return bode(model)


@plot.register(ResponsePosterior)
def _response(uncertainty: ResponsePosterior) -> Figure:
    return bode(uncertainty)


@plot.register(FrequencyUncertainty)
def _bode(response: FrequencyUncertainty, input_name: str = "u", output_name: str = "y") -> Figure:
    from workflow.figures.bode import draw_bode

    return draw_bode(response, f"{input_name} to {output_name}", "as logged")


@plot.register(Certificate)
def _certificate(certificate: Certificate) -> Figure:
    assert certificate.controller is not None
    return _loop(certificate.uncertain_plants[0], certificate.controller, certificate.specification)


@plot.register(SynthesisResult)
def _synthesis(result: SynthesisResult) -> Figure:
    return _loop(result.plants[0], result.controller, result.specification)


@plot.register(ClosedLoopTrajectory)
def _run(run: ClosedLoopTrajectory) -> Figure:
    from workflow.figures.closed_loop import draw_closed_loop
    from workflow.tasks.results import LoopRuns

    runs = LoopRuns(run.measured[None], run.command[None], None, run.limited[None])
    labels = {"output": ("output", ""), "command": ("command", "")}
    return draw_closed_loop(run.time_s, run.reference, runs, labels)


@plot.register(ErrorSurface)
def _surface(surface: ErrorSurface) -> Figure:
    from workflow.figures.pole_search import draw_surface

    return draw_surface(surface)


@plot.register(Diagnosis)
def _causes(found: Diagnosis) -> Figure:
    from workflow.figures.gap_answer import draw_probabilities

    return draw_probabilities(found)


def _loop(plant: UncertainPlant, controller: Controller, specification: Specification | None) -> Figure:
    from workflow.figures.sensitivity import draw_sensitivities, sensitivity_curves

    assert specification is not None
    own = plant.own_grid
    omega = _grid(plant.dt_s) if own is None else own[own > 0]
    return draw_sensitivities(sensitivity_curves(plant, controller, specification, omega), level=plant.level)


def _grid(dt_s: float) -> npt.NDArray[np.float64]:
    """Three decades up to the Nyquist frequency."""
    return np.geomspace(1e-3, 1.0, 600) * np.pi / dt_s
