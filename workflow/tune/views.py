"""What `flexlink tune` draws of a loop beside its margins: Bode, poles and zeros, the step with friction.

Everything returned is JSON-able: curves of few digits, for the page's own drawing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from control_design.analysis.closed_loop import ClosedLoopTrajectory
from control_design.analysis.stability import closed_loop_poles
from control_design.controllers.controller import Controller
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant
from ident.friction import FrictionFit
from ident.resampling import resampled_friction
from workflow.describe.friction import settling_range
from workflow.figures.bands import outline
from workflow.figures.style import ratio_unit
from workflow.tasks.friction_loop import FrictionLoop, friction_feedforward

# Largest modulus of a root that is drawn: the circle and what is near it; a zero far outside would make the
# circle a point. Chosen.
_LARGEST_ROOT = 3.0


def short(values: Real | Sequence[float]) -> list[float | None]:
    """Five digits of each value; None where it is not finite."""
    numbers = np.asarray(values, dtype=float).tolist()
    return [float(f"{value:.5g}") if math.isfinite(value) else None for value in numbers]


def bode(law: Controller, plant: UncertainPlant, omega_rad_s: Real, units: tuple[str, str]) -> dict[str, Any]:
    """Gain, its unit, and phase of the loop K G, of the plant G and of the controller K with its delay.

    Parameters
    ----------
    law : Controller
        K, with its computational delay.
    plant : UncertainPlant
        Its centres are G.
    omega_rad_s : (F,) array
        Ascending, where the plant is known.
    units : (str, str)
        Of input and output of the plant; "" where nobody stated it.

    Returns
    -------
    dict
        `x`: the frequencies; `curves`: of each response its symbol, unit, `gain` (F,) and `deg` (F,). Phases
        run on without jumps of a turn. Those of loop and plant lie between -360 and 0 degrees where the loop
        is nearest to a gain of one, so that a phase margin is the distance to -180 degrees that is seen.
    """
    controller = law.response(omega_rad_s)
    centre = plant.at(omega_rad_s).centre
    loop = controller * centre
    # A response of zero has no logarithm; it is not where the loop crosses.
    gain = np.maximum(np.abs(loop), np.finfo(float).tiny)
    crossover = int(np.argmin(np.abs(np.log(gain))))
    curves = []
    for symbol, unit, values, shifted in (
        ("K G", "1", loop, True),
        ("G", ratio_unit(*reversed(units)), centre, True),
        ("K", ratio_unit(*units), controller, False),
    ):
        degrees = np.degrees(np.unwrap(np.angle(values)))
        if shifted:
            # Whole turns are arbitrary: at the crossover the phase is to lie between -360 and 0 degrees.
            degrees = degrees - 360.0 * np.ceil(degrees[crossover] / 360.0)
        curves.append({"symbol": symbol, "unit": unit, "gain": short(np.abs(values)), "deg": short(degrees)})
    return {"x": short(omega_rad_s), "curves": curves}


def roots(law: Controller, plant: UncertainPlant) -> dict[str, list[list[float | None]]]:
    """Poles of the nominal loop, poles and zeros of controller and nominal plant, in z: [real parts,
    imaginary parts] each, those of a modulus below `_LARGEST_ROOT`."""
    without_delay = law.to_control()
    roots_by_name = {
        "loop poles": closed_loop_poles(law, plant),
        "controller poles": law.poles,
        "controller zeros": without_delay.zeros(),
        "plant poles": plant.poles,
        "plant zeros": plant.zeros,
    }
    drawn = {}
    for name, values in roots_by_name.items():
        z: Complex = np.asarray(values, dtype=np.complex128)
        near = z[np.abs(z) < _LARGEST_ROOT]
        drawn[name] = [short(near.real), short(near.imag)]
    return drawn


@dataclass(frozen=True)
class FrictionStep:
    """The reference step on the identified arm with its dry friction.

    Attributes
    ----------
    friction : FrictionFit
        As identified, at the step of the logs.
    size : float
        Of the step, in units of the output.
    steps : dict of float
        Steps of the loop's converters, by the names of `FrictionLoop`.
    """

    friction: FrictionFit
    size: float
    steps: dict[str, float] = field(default_factory=dict)

    def curves(self, law: Controller, samples: int, given: Real) -> list[dict[str, Any]]:
        """The step without and with friction feed-forward: words, x [s] and y each.

        law: without feed-forward; samples: that are shown; given (T,): what a reference filter makes of the
        step, held to its end.
        """
        friction = resampled_friction(self.friction, law.dt_s)
        reference = np.pad(given, (0, max(samples - given.size, 0)), mode="edge")[:samples]
        curves = []
        for words, feedforward in (
            ("with friction", None),
            ("with friction and its feed-forward", friction_feedforward(law, friction)),
        ):
            loop = FrictionLoop.of(replace(law, feedforward=feedforward), friction, **self.steps)
            run = loop.run(reference)
            curves.append({"words": words, **line(run, samples)})
        return curves

    def settling(self, law: Controller, given: Real) -> str:
        """Settling times of steps of half to twice the size, in words: with friction one size says little.

        given: as of `curves`.
        """
        friction = resampled_friction(self.friction, law.dt_s)
        # From rest, as a run has it.
        step = np.append(0.0, np.full(given.size, self.size))
        loop = FrictionLoop.of(law, friction, **self.steps)
        return settling_range(loop.settling(step, np.append(0.0, given)))


def line(run: ClosedLoopTrajectory, shown: int) -> dict[str, Any]:
    """The first samples of a run's output, as many of them as draw the same curve."""
    time_s, output = outline(run.time_s[:shown], run.measured[:shown])
    return {"x": short(time_s), "y": short(output)}
