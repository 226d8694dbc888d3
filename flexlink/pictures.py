"""Pictures of results: the drawings of the pages, for one result at a time."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from diagnosis.answer import Diagnosis
from flexlink.design import Certificate, LoopRun, SynthesisResult
from flexlink.machines import Simulation
from ident.basis.model import GobfModel
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record
from ident.identification import Identification
from ident.uncertainty import ResponsePosterior

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot"]


@singledispatch
def plot(result: object) -> Figure:
    """Draw a result as the pages do: records, poles, a response with its ellipses, loop gains, causes.

    Returns a `matplotlib.figure.Figure`: `figure.savefig("response.png")`. Raises TypeError for anything that
    has no picture.

    Examples
    --------
    >>> figure = flexlink.plot(example_record())
    >>> [axes.get_xlabel() for axes in figure.axes[2:]]
    ['time, all records [s]', 'time in this record [s]']
    """
    raise TypeError(f"there is no picture of a {type(result).__name__}")


@plot.register(Record)
def _record(record: Record) -> Figure:
    from workflow.figures.records import draw_records
    from workflow.tasks.results import RunRecord

    shown = RunRecord(record, "estimation", None, "")
    return draw_records([shown], record.input_names, record.output_names)


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
    omega = _grid(model.dt_s)
    exact = FrequencyUncertainty(
        omega, model.frequency_response(omega), np.zeros((omega.size, 2, 2)), model.dt_s
    )
    return _bode(exact, model.input_name, model.output_name)


@plot.register(ResponsePosterior)
def _response(uncertainty: ResponsePosterior) -> Figure:
    response = uncertainty.at(_grid(uncertainty.dt_s))
    return _bode(response, uncertainty.input_name, uncertainty.output_name)


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


@plot.register(LoopRun)
def _run(run: LoopRun) -> Figure:
    from workflow.figures.closed_loop import draw_closed_loop
    from workflow.tasks.results import LoopRuns

    runs = LoopRuns(run.measured[None], run.command[None], None, run.limited[None])
    labels = {"output": ("output", ""), "command": ("command", "")}
    return draw_closed_loop(run.time_s, run.reference, runs, labels)


@plot.register(Diagnosis)
def _causes(found: Diagnosis) -> Figure:
    from workflow.figures.gap_answer import draw_probabilities

    return draw_probabilities(found)


def _loop(plant: UncertainPlant, controller: Controller, specification: Specification) -> Figure:
    from workflow.figures.sensitivity import draw_sensitivities, sensitivity_curves

    own = plant.own_grid
    omega = _grid(plant.dt_s) if own is None else own[own > 0]
    curves = sensitivity_curves(plant, controller, specification, omega)
    return draw_sensitivities(curves, level=plant.level)


def _grid(dt_s: float) -> npt.NDArray[np.float64]:
    """Three decades up to the Nyquist frequency."""
    return np.geomspace(1e-3, 1.0, 600) * np.pi / dt_s
