"""What the table says about a point, and which way is better."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from workflow.config.run_config import AnyConfig, RunConfig
from workflow.describe.loop_metrics import LOOP_METRICS

if TYPE_CHECKING:
    from workflow.joints import JointsResults
    from workflow.tasks.results import AnyResults, RunResults

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
    StudyColumn("settling_time_with_friction_s", "settling time with friction, longest", "s", "smaller"),
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
# Numbers of the reference step, which a section of a run words too.
_OF_THE_STEP = (StudyColumn(metric.name, metric.label, metric.unit, metric.better) for metric in LOOP_METRICS)
# Columns by name, in the order of the table.
COLUMNS: Mapping[str, StudyColumn] = {column.name: column for column in (*_ALL, *_OF_THE_STEP)}


def numbers_of(results: AnyResults, config: AnyConfig) -> dict[str, Number]:
    """Numbers of a point from the results of its stages; None where there is none."""
    from workflow.engine.codec import plain

    numbers: dict[str, Number] = dict.fromkeys(COLUMNS)
    numbers["design_gamma"] = plain(results.design.gamma)
    # Which kind of results they are follows from the configuration.
    of_its_kind: Any = results
    if isinstance(config, RunConfig):
        return numbers | _of_one_loop(of_its_kind, config)
    return numbers | _of_joints(of_its_kind)


def _of_one_loop(results: RunResults, config: RunConfig) -> dict[str, Number]:
    """Numbers of a point of one loop; a column that has none is left out.

    Closed-loop numbers are the worst over the runs. The mode is the least damped one of the nominal closed
    loop, inside the band of the specification where it names one. The measured peak of S is that of the arm
    that was identified, at the larger of two sizes.
    """
    # Here: a study that is refused needs the names of the columns only.
    from workflow.describe.certificate import NOMINAL_AT, WORST_AT, margins_by_key
    from workflow.describe.closed_loop import metric_rows
    from workflow.tasks.design import bracket_numbers

    gamma = results.design.gamma
    certify = results.certify
    bracket = bracket_numbers(results.achievable_performance, gamma)
    joint = certify.sampled.joint
    numbers: dict[str, Number] = {
        "any_order_gamma": bracket["reached"],
        "above_any_order_percent": bracket["above_percent"],
    }
    used_specification = results.design.specification
    if used_specification is not None:
        numbers["design_bandwidth_rad_s"] = used_specification.bandwidth_rad_s
    if joint is not None:
        numbers["whole_held_percent"] = 100.0 * joint.coverage_given
        numbers["whole_stable_percent"] = 100.0 * joint.stable_share
    prefilter = results.reference_filter.filter
    if prefilter is not None:
        numbers["matching_error"] = prefilter.error_after
        numbers["matching_error_unfiltered"] = prefilter.error_before
    certificate = certify.certificate
    if certificate is not None:
        verdict = certificate.plants[0]
        for row in margins_by_key(certificate):
            place, _, name = row.key.rpartition(".")
            prefix = {WORST_AT: "", NOMINAL_AT: "nominal_"}[place]
            numbers["worst_gamma" if name == "gamma" else prefix + name] = row.value.plain
        numbers["bandwidth_rad_s"] = min(plant.bandwidth_rad_s for plant in certificate.plants)
        low, high = config.specification.mode_band_rad_s or (0.0, math.inf)
        modes = [mode for mode in verdict.closed_loop_modes if low <= mode.omega_rad_s <= high]
        least_damped = min(modes, key=lambda mode: mode.zeta, default=None)
        if least_damped is not None:
            numbers["mode_damping"] = least_damped.zeta
            numbers["mode_omega_rad_s"] = least_damped.omega_rad_s
    check = results.closed_loop.check
    if check is not None:
        numbers["disturbance_peak"] = check.spread_of("disturbance_peak")[-1]
        # A run that never gets there has no time: neither has the point.
        rows = metric_rows(check, "", "")
        for row in rows:
            metric = row.key.rpartition(".")[2]
            numbers[metric] = row.value.plain["largest"]
        numbers["settled_draws"] = check.settled_draws
        numbers["draws"] = check.draws
        if check.friction is not None:
            numbers["settling_time_with_friction_s"] = check.friction.settling.worst_s
        sensitivity = check.sensitivity
        if sensitivity is not None:
            numbers["predicted_peak_sensitivity"] = sensitivity.nominal_peak
            numbers["measured_peak_sensitivity"] = sensitivity.measured[0].peak
    return numbers


def _of_joints(results: JointsResults) -> dict[str, Number]:
    """Numbers of a point of several joints; a column that has none is left out.

    Each is the worst over the operating points, over sensors and actuators, and, in closed loop, over runs
    and joints. disk_margin is that of the nominal loop.
    """
    from workflow.engine.codec import plain

    numbers: dict[str, Number] = {}
    certificate = results.certify.certificate
    runs = results.closed_loop.runs
    if certificate is not None:
        verdicts = certificate.verdicts
        bounds = max(bound for verdict in verdicts for bound in verdict.bounds.values())
        numbers["worst_gamma"] = plain(bounds if math.isfinite(bounds) else certificate.gamma)
        if all(verdict.stable for verdict in verdicts):
            # The weaker side of the loop: at the commands or at the measurements.
            alphas = [min(verdict.input_disk.alpha, verdict.output_disk.alpha) for verdict in verdicts]
            numbers["disk_margin"] = min(alphas)
    if runs:
        numbers["settled_draws"] = sum(run.settled for run in runs)
        numbers["draws"] = len(runs)
        if all(run.settled for run in runs):
            # Of the joint that overshoots most.
            overshoots = [float(run.overshoot.max()) for run in runs]
            numbers["overshoot_percent"] = 100.0 * max(0.0, *overshoots)
    return numbers
