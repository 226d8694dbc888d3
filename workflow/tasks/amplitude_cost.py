"""What holding over amplitudes costs: the same specification for the linear arm behind its friction."""

from __future__ import annotations

from functools import partial

import numpy as np

from control_design.analysis.certificate import certify
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from workflow.engine.errors import naming
from workflow.tasks.design import find_design
from workflow.tasks.results import AmplitudeCost
from workflow.tasks.stage import StageInput


def find_amplitude_cost(stage: StageInput) -> AmplitudeCost:
    """A design for the arm behind its friction, certified there and over the amplitudes; empty where none are
    promised, or the run itself has no controller."""
    config, own = stage.config, stage.results.design
    if not config.control_channel.uncertainty.about_amplitudes or not own.has_controller:
        return AmplitudeCost()
    asked, tell = config.specification, partial(stage.progress.update, "amplitude_cost")
    linear = stage.results.uncertainty.plant(config, behind_friction=True)
    with naming("amplitude cost"):
        # From the starts of the run's own design: what differs is the plant.
        design = find_design([linear], asked, config.synthesis, config.certificate, stage.rng("design"), tell)
        if own.synthesis is None or design.synthesis is None or not design.has_controller:
            return AmplitudeCost(design)
        law = design.synthesis.controller
        behind, carried_over = (certify(law, [plant], asked) for plant in (linear, stage.plant))
    left = _left_by_unit(own.synthesis.controller, stage.plant), _left_by_unit(law, linear)
    return AmplitudeCost(design, behind, carried_over, left)


def _left_by_unit(law: Controller, plant: UncertainPlant) -> float:
    """Output that a unit of constant disturbance at the nominal plant's input leaves, |G / (1 + G K)|."""
    # A millionth of the Nyquist frequency: there an integrator is as good as infinite.
    omega = np.array([1e-6 * plant.nyquist_rad_s])
    return float(1 / np.abs(law.response(omega) + 1 / plant.channel.nominal_response(omega))[0])
