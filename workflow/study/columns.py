"""What the table says about a point, and which way is better."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any, Literal

from workflow.config.joints_config import AnyConfig, JointsConfig
from workflow.config.run_config import RunConfig

if TYPE_CHECKING:
    from control_design.analysis.margins import Margins
    from workflow.tasks.results import RunResults

Number = float | int | None


@dataclass(frozen=True)
class StudyColumn:
    """A number of the table. `better` None: it is stated, not judged."""

    name: str
    label: str
    unit: str = ""
    better: Literal["larger", "smaller"] | None = None

    def badness(self, value: float) -> float:
        """Smaller is better. Only for columns that are judged."""
        return -value if self.better == "larger" else value


# Margins without further word are the worst over the ellipses, as the certificate states them.
_ALL = (
    StudyColumn("worst_gamma", "worst-case gamma", "", "smaller"),
    StudyColumn("modulus_margin", "modulus margin", "", "larger"),
    StudyColumn("gain_margin_dB", "gain margin", "dB", "larger"),
    StudyColumn("phase_margin_deg", "phase margin", "deg", "larger"),
    StudyColumn("delay_margin_ms", "delay margin", "ms", "larger"),
    StudyColumn("disk_margin", "nominal disk margin, all joints at once", "", "larger"),
    StudyColumn("bandwidth_rad_s", "bandwidth", "rad/s", "larger"),
    StudyColumn("design_bandwidth_rad_s", "bandwidth of the design", "rad/s"),
    StudyColumn("mode_damping", "mode damping", "", "larger"),
    StudyColumn("mode_omega_rad_s", "of the mode at", "rad/s"),
    StudyColumn("settling_time_s", "settling time", "s", "smaller"),
    StudyColumn("settling_time_with_friction_s", "settling time with friction, longest", "s", "smaller"),
    StudyColumn("rise_time_s", "rise time", "s", "smaller"),
    StudyColumn("overshoot_percent", "overshoot", "%", "smaller"),
    StudyColumn("peak_command", "peak command", "", "smaller"),
    StudyColumn("disturbance_peak", "disturbance peak", "", "smaller"),
    StudyColumn("settled_draws", "runs that stop moving"),
    StudyColumn("draws", "runs"),
    StudyColumn("design_gamma", "gamma of the design", "", "smaller"),
    StudyColumn("any_order_gamma", "gamma of any order", "", "smaller"),
    StudyColumn("above_any_order_percent", "above any order", "%", "smaller"),
    StudyColumn("whole_held_percent", "sampled responses within gamma", "%", "larger"),
    StudyColumn("whole_stable_percent", "sampled responses stable", "%", "larger"),
    StudyColumn("matching_error", "model-matching error", "", "smaller"),
    StudyColumn("matching_error_unfiltered", "model-matching error without reference filter", "", "smaller"),
    StudyColumn("predicted_peak_sensitivity", "peak of S, predicted", "", "smaller"),
    StudyColumn("measured_peak_sensitivity", "peak of S, measured", "", "smaller"),
    StudyColumn("nominal_modulus_margin", "modulus margin, nominal", "", "larger"),
    StudyColumn("nominal_gain_margin_dB", "gain margin, nominal", "dB", "larger"),
    StudyColumn("nominal_phase_margin_deg", "phase margin, nominal", "deg", "larger"),
    StudyColumn("nominal_delay_margin_ms", "delay margin, nominal", "ms", "larger"),
)
COLUMNS: Mapping[str, StudyColumn] = {column.name: column for column in _ALL}


def numbers_of(results: RunResults, config: AnyConfig) -> dict[str, Number]:
    """Numbers of a point from the results of its stages; None where there is none."""
    from workflow.engine.codec import plain

    found: dict[str, Number] = {**dict.fromkeys(COLUMNS), "design_gamma": plain(results.design.gamma)}
    return found | (
        _of_joints(results) if isinstance(config, JointsConfig) else _of_one_loop(results, config)
    )


def _of_one_loop(results: RunResults, config: RunConfig) -> dict[str, Number]:
    """Closed-loop numbers are the worst over the runs. The mode is the least damped one of the nominal closed
    loop, inside the band of the specification where it names one. The measured peak of S is that of the arm
    that was identified, at the larger of two sizes.
    """
    # Here: a study that is refused needs the names of the columns only.
    from control_design.analysis.margins import Margins
    from workflow.engine.codec import plain
    from workflow.tasks.design import bracket_numbers

    gamma, certify = results.design.gamma, results.certify
    bracket, joint = bracket_numbers(results.achievable_performance, gamma), certify.sampled.joint
    found: dict[str, Number] = {
        "any_order_gamma": bracket["reached"],
        "above_any_order_percent": bracket["above_percent"],
    }
    if (used := results.design.specification) is not None:
        found["design_bandwidth_rad_s"] = used.bandwidth_rad_s
    if joint is not None:
        shares = 100.0 * joint.coverage_given, 100.0 * joint.stable_share
        found["whole_held_percent"], found["whole_stable_percent"] = shares
    if (prefilter := results.reference_filter.filter) is not None:
        found["matching_error"] = prefilter.error_after
        found["matching_error_unfiltered"] = prefilter.error_before
    if (certificate := certify.certificate) is not None:
        verdict, bound = certificate.plants[0], certificate.gamma_bound
        # Of several plants a stated number is the least, and an unstable one has none.
        least_margins = reduce(Margins.worse, (plant.worst_margins for plant in certificate.plants))
        found |= _margins("", least_margins) | _margins("nominal_", verdict.nominal_margins)
        found["worst_gamma"] = plain(certificate.gamma if bound is None else bound)
        found["bandwidth_rad_s"] = min(plant.bandwidth_rad_s for plant in certificate.plants)
        low, high = config.specification.mode_band_rad_s or (0.0, math.inf)
        modes = [mode for mode in verdict.closed_loop_modes if low <= mode.omega_rad_s <= high]
        if least := min(modes, key=lambda mode: mode.zeta, default=None):
            found["mode_damping"], found["mode_omega_rad_s"] = least.zeta, least.omega_rad_s
    if (check := results.closed_loop.check) is not None:
        # A run that never gets there has no time: neither has the point.
        worst = "settling_time_s", "rise_time_s", "overshoot_percent", "peak_command", "disturbance_peak"
        found |= {name: check.spread_of(name)[-1] for name in worst}
        found["settled_draws"], found["draws"] = check.settled_draws, check.draws
        if check.friction is not None:
            found["settling_time_with_friction_s"] = check.friction.settling.worst_s
        if (loop := check.sensitivity) is not None:
            peaks = loop.nominal_peak, loop.measured[0].peak
            found["predicted_peak_sensitivity"], found["measured_peak_sensitivity"] = peaks
    return found


def _of_joints(results: Any) -> dict[str, Number]:
    """Worst over the operating points, over sensors and actuators, and, in closed
    loop, over runs and joints. disk_margin is that of the nominal loop."""
    from workflow.engine.codec import plain

    found: dict[str, Number] = {}
    certificate, runs = results.certify.certificate, results.closed_loop.runs
    if certificate is not None:
        verdicts = certificate.verdicts
        bounds = max(bound for verdict in verdicts for bound in verdict.bounds.values())
        found["worst_gamma"] = plain(bounds if math.isfinite(bounds) else certificate.gamma)
        if all(verdict.stable for verdict in verdicts):
            disks = [disk.alpha for one in verdicts for disk in (one.input_disk, one.output_disk)]
            found["disk_margin"] = min(disks)
    if runs:
        found["settled_draws"], found["draws"] = sum(run.settled for run in runs), len(runs)
        if all(run.settled for run in runs):
            found["overshoot_percent"] = 100.0 * max(0.0, *(float(run.overshoot.max()) for run in runs))
    return found


def _margins(prefix: str, margins: Margins) -> dict[str, Number]:
    """Infinite ones are None."""
    sides = [margins.gain_up] if math.isfinite(margins.gain_up) else []
    sides += [1.0 / margins.gain_down] if margins.gain_down else []
    phase, delay = margins.phase_rad, margins.delay_s
    return {
        f"{prefix}modulus_margin": margins.modulus,
        f"{prefix}gain_margin_dB": 20 * math.log10(min(sides)) if sides and min(sides) > 0 else None,
        f"{prefix}phase_margin_deg": math.degrees(phase) if math.isfinite(phase) else None,
        f"{prefix}delay_margin_ms": 1e3 * delay if math.isfinite(delay) else None,
    }
