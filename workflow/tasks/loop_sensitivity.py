"""S measured in closed loop on the simulated arm, beside its prediction and its certified worst case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from control_design.analysis.closed_loop import MeasuredSensitivity, measure_sensitivity
from control_design.controllers.controller import Controller
from control_design.plants.plant_set import UncertainPlant
from ident.data.arrays import RealArray
from workflow.tasks.results import MeasuredPeak, SensitivityCheck
from workflow.tasks.simulated_rig import loop_of_arm
from workflow.tasks.stage import StageInput

# Share of a run before its step, so that the picture shows rest.
LEAD_IN = 0.05
# A run counts as settled when at its end it moves by less than this share of the step and, where tracking is
# asked for, has arrived within it. Within one count of the sensor no controller sees it.
SETTLED = 0.1
# Draws of random phases: the fewest that show a spread.
_DRAWS = 3
# Periods at the small size: sensor noise weighs ten times as much there as at the large one.
_PERIODS_SMALL = 4
# The small size over the large one: friction weighs ten times as much.
SMALL = 0.1
# Rms of the loop's command over that of the input in the records of the fit. Chosen, below 1: the model was
# fitted there.
_INPUT_SHARE = 0.7
# Peak over rms that a multisine's command stays below.
_CREST = 4.0
# Lines up to the predicted peak: it is read to 5 % of its frequency.
_LINES_BELOW_PEAK = 20
# Samples of a period at least.
_SHORTEST = 500
# Samples of a period at most: each is simulated on the nonlinear arm.
_LONGEST = 4000


def rms_of(signals: Sequence[RealArray]) -> float:
    """Root mean square of signals (T,), each about its mean, over all of them."""
    return float(np.sqrt(np.mean([np.var(signal) for signal in signals])))


def settling_samples(pole_radius: float, shortest: int, longest: int) -> int:
    """Samples of a trial in two halves, in either of which the slowest closed-loop pole dies out (to e^-7).

    pole_radius: its modulus, below 1; the result lies between shortest and longest.
    """
    # A pole on the circle would need a trial without end, one at zero none at all.
    radius = min(max(pole_radius, 0.5), 1 - 1e-9)
    samples = round(2 * 7 / -np.log(radius))
    return int(min(max(samples, shortest), longest))


@dataclass(frozen=True)
class SensitivityPlan:
    """How S is excited, and the nominal peak that it is compared with.

    Attributes
    ----------
    band_rad_s : tuple of two float
        Around the predicted peak [rad/s].
    period_samples, lead_in_periods : int
        Period of the multisine, and how many of them are left out.
    rms : float
        Of the reference at the large size, in units of the output.
    nominal_peak, nominal_omega_rad_s : float
        Largest |S| of the nominal loop, and where.
    """

    band_rad_s: tuple[float, float]
    period_samples: int
    lead_in_periods: int
    rms: float
    nominal_peak: float
    nominal_omega_rad_s: float

    def excitation(self, share: float = 1.0) -> dict[str, Any]:
        """Keywords of `sensitivity_of` for this share of the large size."""
        return {
            "rms": self.rms * share,
            "band_rad_s": self.band_rad_s,
            "period_samples": self.period_samples,
            "periods": _PERIODS_SMALL if share <= SMALL else 1,
            "draws": _DRAWS,
            "lead_in_periods": self.lead_in_periods,
        }


def plan_sensitivity(
    controller: Controller, plant: UncertainPlant, input_rms: float, transient_samples: int
) -> SensitivityPlan:
    """The excitation that measures the peak of S of this loop.

    Its band reaches from a twentieth of the predicted peak's frequency to ten times it, with lines a
    twentieth of it apart.

    Parameters
    ----------
    controller : Controller
    plant : UncertainPlant
    input_rms : float
        Of the records of the fit: the command stays below it, and below the voltage limit.
    transient_samples : int
        Samples in which the loop settles; they are left out.
    """
    dt = controller.dt_s
    # Some 2300 points a decade: a lightly damped peak is not missed between two.
    omega = np.geomspace(1e-3 / dt, plant.nyquist_rad_s, 8000)
    loop = controller.response(omega) * plant.channel.nominal_response(omega)
    size = 1 / np.abs(1 + loop)
    at = int(np.argmax(size))
    # The peak of a loop that rolls off late may lie where a reference can hardly excite it.
    centre = min(float(omega[at]), plant.nyquist_rad_s / 4)
    samples = round(2 * np.pi * _LINES_BELOW_PEAK / (centre * dt))
    period = int(np.clip(samples, _SHORTEST, _LONGEST))

    # A flat reference over the band; its size follows from the gain to the command.
    line = 2 * np.pi / (period * dt)
    lowest = max(centre / _LINES_BELOW_PEAK, line)
    highest = min(10 * centre, 0.8 * plant.nyquist_rad_s)
    inside = np.arange(lowest, highest, line)
    law = controller.response(inside)
    return_difference = 1 + law * plant.channel.nominal_response(inside)
    gain = np.abs(law) / np.abs(return_difference)
    command = _INPUT_SHARE * input_rms
    if controller.input_limit is not None:
        command = min(command, controller.input_limit / _CREST)
    lead_in = int(np.clip(np.ceil(transient_samples / period), 1, 4))
    rms_gain = float(np.sqrt(np.mean(gain**2)))
    return SensitivityPlan(
        band_rad_s=(float(lowest), float(highest)),
        period_samples=period,
        lead_in_periods=lead_in,
        rms=command / rms_gain,
        nominal_peak=float(size[at]),
        nominal_omega_rad_s=float(omega[at]),
    )


def sensitivity_on_arm(stage: StageInput, controller: Controller, transient_samples: int) -> SensitivityCheck:
    """The peak of S on the simulated arm, at a large and a small size, beside prediction and certified bound.

    Also on the arm of the closed-loop check, where that has further effects. Needs a certificate.
    """
    certificate = stage.results.certify.certificate
    assert certificate is not None
    options = stage.config.closed_loop
    plan = sensitivity_plan(stage, controller, transient_samples)
    certified = max(plant.worst_peak_sensitivity for plant in certificate.plants)
    arms: list[tuple[str, tuple[dict[str, Any], ...], float]] = [
        ("arm as identified", (), 1.0),
        ("arm as identified, reference ten times smaller", (), SMALL),
    ]
    if options.effects:
        arms.append(("arm of the closed-loop check", options.effects, 1.0))
    rows = []
    for number, (name, effects, share) in enumerate(arms):
        measurement = measured_on_arm(stage, controller, plan.excitation(share), str(number), effects)
        peak, std, omega = measurement.peak
        off_nominal_percent = 100 * (peak / plan.nominal_peak - 1)
        off_certified_percent = 100 * (peak / certified - 1) if np.isfinite(certified) else None
        rows.append(
            MeasuredPeak(
                name=name,
                reference_rms=measurement.reference_rms,
                peak=peak,
                peak_std=std,
                peak_omega_rad_s=omega,
                off_nominal_percent=off_nominal_percent,
                off_certified_percent=off_certified_percent,
                peak_command=measurement.peak_command,
                limited_fraction=measurement.limited_fraction,
                omega_rad_s=measurement.omega_rad_s,
                magnitude=np.abs(measurement.response),
                std=measurement.std,
            )
        )
    return SensitivityCheck(
        plan.nominal_peak, plan.nominal_omega_rad_s, certified, plan.band_rad_s, tuple(rows)
    )


def sensitivity_plan(stage: StageInput, controller: Controller, transient_samples: int) -> SensitivityPlan:
    """The excitation for the plant of a run, as large as the records of its fit allow."""
    used = stage.results.records.fitted(stage.config.control_channel)
    return plan_sensitivity(
        controller, stage.plant, rms_of([record.input for record in used]), transient_samples
    )


def measured_on_arm(
    stage: StageInput,
    controller: Controller,
    excitation: Mapping[str, Any],
    name: str,
    effects: Sequence[Mapping[str, Any]] = (),
) -> MeasuredSensitivity:
    """S measured on the simulated arm with further effects.

    excitation: keywords of `sensitivity_of`; name: its phases and noise are others than under another name.
    """
    arm = loop_of_arm(stage.config, stage.rng("closed_loop", "sensitivity noise", name), effects)
    phases = stage.rng("closed_loop", "sensitivity", name)
    return measure_sensitivity(controller, rng=phases, **excitation, **arm)
