"""What a result says of itself in text: a function for each class, its first line the headline.

Classes are found by their name, so that printing a record does not import what diagnoses a machine. Marks:
"!" before what is to be looked at, "met" and "NOT met" before requirements. Bounds are rounded to the safe
side (`at_least`, `at_most`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from workflow.text.findings.sentences import words
from workflow.text.formats import at_least, at_most, bound, hertz, listing

if TYPE_CHECKING:
    from control_design.analysis.certificate import Certificate
    from control_design.analysis.closed_loop import ClosedLoopTrajectory
    from control_design.analysis.multivariable_certificate import MultivariableCertificate
    from control_design.convex.youla import YoulaBracket
    from control_design.plants.plant_set import UncertainPlant
    from control_design.specification.requirement import SpecificationItem
    from control_design.synthesis.joint_synthesis import JointDesign
    from control_design.synthesis.multivariable import MultivariableResult
    from control_design.synthesis.synthesis_result import SynthesisResult
    from diagnosis.answer import Diagnosis
    from flexlink.comparison import Comparison
    from flexlink.machines import Simulation
    from ident.basis.model import GobfModel
    from ident.basis.poles import Poles
    from ident.basis.posterior import ResponsePosterior
    from ident.comparators.innovation_model import InnovationModel
    from ident.comparators.polynomial_model import PolynomialModel
    from ident.data.finding import Finding
    from ident.data.record import Record
    from ident.frequency_fit import FrfIdentification
    from ident.identification import Identification, MimoIdentification
    from ident.response_uncertainty import Uncertainty
    from ident.search.error_surface import ErrorSurface
    from ident.uncertainty.matrix_response import MatrixPosterior

# Causes that are listed of a diagnosis, the likeliest first, beside those of the repaired model.
_SHOWN_CAUSES = 3
# Requirements that are listed of a design, the hardest first.
_SHOWN_REQUIREMENTS = 3
# A stability radius beyond this is of a loop that no uncertainty reaches: it is left out.
_UNLIMITED_RADIUS = 1e300
# A cause beside those that are named is told of an answer that is rather incomplete than complete.
_EVEN_ODDS = 0.5


def _modes(poles: Poles, dt_s: float) -> list[str]:
    """A line for each mode, its frequency and damping ratio."""
    lines = []
    for omega, zeta in zip(poles.omega_rad_s(dt_s), poles.zeta(), strict=True):
        lines.append(f"  mode at {omega:.4g} rad/s ({hertz(omega):.3g} Hz), damping ratio {zeta:.3g}")
    return lines


def _warnings(findings: Iterable[Finding]) -> list[str]:
    """A line for each finding; of equal sentences one."""
    return [f"  ! {sentence}" for sentence in dict.fromkeys(words(finding) for finding in findings)]


def _fits(names: Sequence[str], fit_percent: Iterable[float]) -> str:
    return ", ".join(f"{fit:.1f} % of {name}" for name, fit in zip(names, fit_percent, strict=True))


def record(result: Record) -> list[str]:
    reference = "" if result.reference is None else f", reference {', '.join(result.reference_names)}"
    lines = [
        f"Record '{result.name}': {result.n_samples} samples, every {result.dt_s:.6g} s, "
        f"{result.n_samples * result.dt_s:.4g} s in all",
        f"  {', '.join(result.input_names)} -> {', '.join(result.output_names)}{reference}",
    ]
    # What time stamps were taken for, where there were any.
    column = result.time_column
    if column is not None:
        known = "" if column.stated or column.in_header else " (no unit stated)"
        lines.append(f"  time column '{column.name}' in {column.unit}{known}")
        if column.doubtful:
            lines.append(
                '  ! its steps look like integers of a smaller unit: state time_unit = "ms", or "s" if '
                "it is right"
            )
    return lines


def identification(result: Identification) -> list[str]:
    model = result.model
    return [
        f"GobfModel of order {model.order}, {model.input_name} -> {model.output_name}, dt = {model.dt_s:.6g} "
        "s: "
        f"fits {_fits(result.record_names, result.fit_percent)}",
        *_modes(model.poles, model.dt_s),
        *_warnings(result.warnings),
    ]


def frf_identification(result: FrfIdentification) -> list[str]:
    model = result.model
    omega = result.omega_rad_s
    # A measured response has ellipses of its own: the fit is good where it stays inside of them.
    inside_percent = 100 * result.share_inside
    headline = (
        f"GobfModel of order {model.order} of a measured response, dt = {model.dt_s:.6g} s: inside "
        f"{inside_percent:.3g} % of {omega.size} ellipses, {omega[0]:.4g} to {omega[-1]:.4g} rad/s"
    )
    verdicts = [f"  {words(verdict)}" for verdict in result.verdicts]
    return [headline, *_modes(model.poles, model.dt_s), *verdicts, *_warnings(result.warnings)]


def mimo_identification(result: MimoIdentification) -> list[str]:
    model: Any = result.model
    inputs = ", ".join(model.input_names)
    # A model of one output has no tuple of names.
    outputs = ", ".join(model.output_names) if hasattr(model, "output_names") else model.output_name
    fits = _fits(result.record_names, result.fit_percent)
    headline = f"Model of order {model.order}, {inputs} -> {outputs}, dt = {model.dt_s:.6g} s: fits {fits}"
    return [headline, *_modes(model.poles, model.dt_s), *_warnings(result.warnings)]


def matrix_posterior(result: MatrixPosterior) -> list[str]:
    inputs = ", ".join(result.model.input_names)
    outputs = ", ".join(result.model.output_names)
    headline = (
        f"Matrix response {inputs} -> {outputs}, {100 * result.level:.4g} % balls frequency by frequency"
    )
    return [headline, *_modes(result.model.poles, result.dt_s)]


def error_surface(result: ErrorSurface) -> list[str]:
    points = " x ".join(str(count) for count in result.mean_square.shape)
    coordinates = " and ".join(result.names)
    lowest = result.mean_square.min()
    highest = result.mean_square.max()
    # More than one: a search that only descends may end in the wrong one.
    n_minima = len(result.local_minima())
    return [
        f"Error surface over {coordinates}, {points} points: mean square {lowest:.4g} to {highest:.4g}, "
        f"{n_minima} local minima inside"
    ]


def youla_bracket(result: YoulaBracket) -> list[str]:
    lines = [
        f"Controllers of any order: worst weighted gain of {at_least(result.floor, 4)} at least, but for the "
        f"basis of Q and the grid; one reaches {at_most(result.ellipse, 4)} over the ellipses"
    ]
    if len(result.plants) > 1:
        lines += [
            f"  {plant.plant}: floor {at_least(plant.inscribed, 4)}, reached {at_most(plant.ellipse, 4)}"
            for plant in result.plants
        ]
    return lines


def multivariable_result(result: MultivariableResult) -> list[str]:
    if result.outcome.name == "NOT_CONVERGED":
        lines = ["No controller: no stable design was found"]
    else:
        commands, errors = result.controller.D.shape
        lines = [
            f"Controller of order {result.controller.order}, {commands} commands from {errors} errors: worst "
            f"weighted gain {at_most(result.gamma, 4)} on the grid (certify it before use)"
        ]
    for name, value in result.worst.items():
        # The joint and the plant that allow no less.
        places = "".join(
            f" (joints[{point.joint}] of '{point.plant}' at {point.omega_rad_s:.4g} rad/s)"
            for point in result.blocking
            if point.weight == name
        )
        lines.append(f"  {name}: {at_most(value, 4)} against 1{places}")
    return lines


def multivariable_certificate(result: MultivariableCertificate) -> list[str]:
    lines = [
        f"{'Certified' if result.met else 'Not certified'}: worst weighted gain {at_most(result.gamma, 4)}"
    ]
    for verdict in result.verdicts:
        if not verdict.stable:
            lines.append(
                f"  the nominal loop of '{verdict.plant}' is UNSTABLE (largest pole radius "
                f"{at_most(verdict.pole_radius, 6)})"
            )
            continue
        # The value on the grid, and the bound between its points, which decides.
        for name, value in verdict.bounds.items():
            lines.append(
                f"  {_met(value <= 1)} {verdict.plant}: {name}: {at_most(verdict.worst[name], 4)} against 1, "
                f"at most {at_most(value, 4)} at every frequency (largest at "
                f"joints[{verdict.worst_joint[name]}], {verdict.worst_at[name]:.4g} rad/s)"
            )
        # What limits of the command do to the end of a step, where there are any.
        limited = verdict.limited
        if limited is not None and limited.steps:
            lines.append(
                f"  {_met(limited.ends)} {verdict.plant}: at the limits of the command: "
                f"{at_most(limited.worst, 3)} away from where it must end, against 0.02"
            )
        if verdict.stability_radius < _UNLIMITED_RADIUS:
            lines.append(
                f"  {verdict.plant}: the uncertainty may grow by a factor of "
                f"{at_least(verdict.stability_radius, 4)} before the loop can be unstable"
            )
    return lines


def _met(is_met: bool) -> str:
    return "met    " if is_met else "NOT met"


def gobf_model(result: GobfModel) -> list[str]:
    channel = f"{result.input_name} -> {result.output_name}"
    return [
        f"GobfModel of order {result.order}, {channel}, dt = {result.dt_s:.6g} s",
        *_modes(result.poles, result.dt_s),
    ]


def uncertainty(result: Uncertainty) -> list[str]:
    report: Any = result.report
    lines = [
        f"Response {result.input_name} -> {result.output_name}, 95 % ellipses frequency by frequency: noise "
        f"{report.noise_std:.3g}, from {report.n_rows} samples"
    ]
    for omega, share in result.at_modes():
        lines.append(f"  mode at {omega:.4g} rad/s: semi-axis {100 * share:.2g} % of the response")
    # Told only where the data raise the odds of a further mode.
    if result.missed_mode_suspected:
        lines.append(
            f"  ! a mode may be missing from the model (probability {report.probability_missed_mode:.2g}, "
            f"most probably at {report.missed_mode_rad_s:.3g} rad/s)"
        )
    return lines + _warnings(result.warnings)


def response_posterior(result: ResponsePosterior) -> list[str]:
    # The poles of the tangent method stand twice.
    modes = dict.fromkeys(_modes(result.poles, result.dt_s))
    return [
        f"Response {result.input_name} -> {result.output_name} with ellipses at any frequency, dt = "
        f"{result.dt_s:.6g} s, from {result.mean.size} coefficients",
        *modes,
    ]


def simulation(result: Simulation) -> list[str]:
    hub_rad = np.abs(result.hub_angle_rad).max()
    tip_m = np.abs(result.tip_m).max()
    return [
        f"Simulated {result.time_s.size} samples, every {result.dt_s:.6g} s: hub to {hub_rad:.3g} rad, tip "
        f"to {tip_m:.3g} m"
    ]


def uncertain_plant(result: UncertainPlant) -> list[str]:
    states = f"{result.nominal.nstates} state{'s' if result.nominal.nstates != 1 else ''}"
    integrators = ("no integrator", "one integrator", "two integrators")[result.n_integrators]
    is_exact = result.uncertainty is None
    # What a certificate for this plant would cover.
    known = "response taken as exact" if is_exact else f"{100 * result.level:.4g} % ellipses"
    lines = [f"UncertainPlant '{result.name}': {states}, dt = {result.dt_s:.6g} s, {integrators}, {known}"]
    for mode in result.modes:
        lines.append(f"  mode at {mode.omega_rad_s:.4g} rad/s, damping ratio {mode.zeta:.3g}")
    return lines


def synthesis_result(result: SynthesisResult) -> list[str]:
    if result.outcome.name == "NOT_CONVERGED":
        lines = ["No controller: no stable design was found"]
    else:
        # What the optimisation saw: the certificate looks at all frequencies, this one at a grid.
        if any(plant.uncertainty is not None for plant in result.plants):
            over = "over all ellipses of the grid"
        else:
            over = "on the grid, for the nominal plant only (no uncertainty was given)"
        if result.outcome.name == "MET_ON_GRID":
            verdict = "the specification is met there (certify it before use)"
        else:
            verdict = "the specification is not met"
        lines = [
            f"Controller of order {result.controller.order}: worst weighted gain {at_most(result.gamma, 4)} "
            f"{over}, {verdict}"
        ]
    # What to relax first, where the specification is missed.
    for point in result.blocking[:_SHOWN_REQUIREMENTS]:
        lines.append(
            f"  hardest: {point.weight} of '{point.plant}' at {point.omega_rad_s:.4g} rad/s, "
            f"{at_most(point.value, 4)}"
        )
    return lines


def certificate(result: Certificate) -> list[str]:
    lines = [_certificate_headline(result)]
    # Of an unstable loop nothing was achieved (nan).
    for item in result.items:
        if not math.isnan(item.achieved):
            lines.append(_requirement(result, item))
    for plant in result.plants:
        if plant.stable:
            margins = plant.worst_margins
            down = f", {at_most(margins.gain_down, 4)} down" if margins.gain_down > 0 else ""
            lines.append(
                f"  {'nominal' if result.nominal_only else 'worst-case'} margins of {plant.plant}: gain "
                f"{at_least(margins.gain_up, 4)} up{down}, phase {at_least(math.degrees(margins.phase_rad))} "
                f"deg, delay {at_least(1000 * margins.delay_s, 4)} ms, modulus "
                f"{at_least(margins.modulus, 4)}, |S| below -3 dB up to {at_least(plant.bandwidth_rad_s, 4)} "
                "rad/s"
            )
    return lines + _warnings(result.warnings)


def _certificate_headline(result: Certificate) -> str:
    # A loop that is unstable has no margins: its numbers would mislead.
    unstable = next((plant for plant in result.plants if not plant.stable), None)
    if unstable is not None:
        return (
            f"Not certified: the nominal loop of '{unstable.plant}' is UNSTABLE (largest pole radius "
            f"{at_most(unstable.pole_radius, 6)}); check the sign and the gain of the controller"
        )
    headline = "Certified" if result.certified else "Not certified"
    if result.nominal_only:
        headline += " for the nominal plant only (no uncertainty was given)"
    if result.certified and result.warnings:
        headline += ", but the ellipses are in doubt (below)"
    headline += f": worst weighted gain {at_most(result.gamma, 4)}"
    if result.gamma_bound is not None:
        headline += f", at most {at_most(result.gamma_bound, 4)} at every frequency"
    return headline


def _requirement(result: Certificate, item: SpecificationItem) -> str:
    """A requirement of a certificate in a line; of effort also in units of the command."""
    name = item.requirement
    if result.nominal_only:
        name = name.replace(", worst case", "")
    line = (
        f"  {_met(item.met)} {item.plant}: {name}: {bound(item.achieved, item.at_least)} against "
        f"{item.required:.4g} {item.unit}"
    )
    # The weight is relative; a user thinks in units of the command.
    limit = None if result.specification is None else result.specification.effort_limit
    if item.requirement.startswith("effort") and limit is not None:
        line += (
            f" (|K S| at most {at_most(item.achieved * limit, 4)} against {limit:.4g} command units per "
            "measured unit)"
        )
    return line


def closed_loop_trajectory(result: ClosedLoopTrajectory) -> list[str]:
    # The last sample is held for a period, too.
    duration_s = result.time_s[-1] + result.dt_s
    largest_command = np.abs(result.command).max()
    limited_percent = 100 * result.limited.mean()
    return [
        f"Closed loop over {duration_s:.4g} s: output ends at {result.measured[-1]:.4g} (reference "
        f"{result.reference[-1]:.4g}), command at most {largest_command:.4g}, limited in "
        f"{limited_percent:.3g} % of the samples"
    ]


def _plain(name: str) -> str:
    """The name of an effect in words."""
    return name.replace("_", " ")


def diagnosis(result: Diagnosis) -> list[str]:
    added = [effect.id for effect in result.repair]
    lines = [_diagnosis_headline(result, added)]
    # A value that was re-estimated and did not move is not told.
    moved = [name for name, deviation in result.deviations.items() if deviation]
    if moved:
        lines.append(f"  moved in the repaired model: {', '.join(moved)}")
    # The likeliest causes, and whatever else the repaired model holds.
    for effect in result.effects:
        if effect not in result.effects[:_SHOWN_CAUSES] and effect.name not in added:
            continue
        kind = "probability" if effect.name in ("none", "unknown") else "present with probability"
        repaired = ", in the repaired model" if effect.name in added else ""
        lines.append(f"  {_plain(effect.name)}: {kind} {effect.presence:.2g}{repaired}")
    not_excluded = [name for name in result.ambiguous_with if name not in added]
    if not_excluded:
        lines.append(f"  not excluded: {_plain(', '.join(not_excluded))}")
    lines += [f"  doubtful: {doubt}" for doubt in result.doubts]
    return lines


def _diagnosis_headline(result: Diagnosis, added: Sequence[str]) -> str:
    """What the answer is, with the sizes of the model error in multiples of the noise."""
    complete = result.completeness
    if result.verdict == "none":
        if complete.threshold > 0:
            return (
                "No model error beyond noise, tolerances and model_error = "
                f"{100 * complete.threshold:.3g} % ({100 * complete.most:.3g} % of the motion remains)"
            )
        return f"No model error beyond noise and tolerances (error / noise: {_sizes(result, ())})"
    if result.verdict == "unknown":
        cause = "of unknown cause" if added else "explained by none of the candidate effects"
        return f"Model error {cause} (error / noise: {_sizes(result, added)})"
    # A cause that is found need not be the only one.
    incomplete = ", and something else" if complete.probability < _EVEN_ODDS else ""
    return f"Model error / noise: {_sizes(result, added)}{incomplete}"


def _sizes(result: Diagnosis, effects: Sequence[str]) -> str:
    from workflow.describe.diagnosis_words import times_noise

    # In the order of the repair: as stated, with other values, with the effects.
    sizes = f"{times_noise(result.gap_before)} nominal"
    if result.deviations:
        sizes += f", {times_noise(result.gap_refit)} re-estimated"
    if effects:
        sizes += f", {times_noise(result.gap_after)} with {_plain(listing(effects))}"
    return sizes


def finding(result: Finding) -> list[str]:
    return [words(result)]


def joint_design(result: JointDesign) -> list[str]:
    unstable = result.unstable[-1] if result.unstable else "-"
    return [*synthesis_result(result.result), f"  unstable of {result.draws} sampled responses: {unstable}"]


def comparison(result: Comparison) -> list[str]:
    validation = result.validation
    lines = [
        f"Validation on record '{validation.name}', {validation.n_samples} samples of "
        f"{validation.output_names[0]}: fit of the free run"
    ]
    for model in result.models:
        line = f"  {model.name}: {model.fit_percent:.1f} %, order {model.order}"
        # A model without a noise model does not predict one sample ahead.
        if not math.isnan(model.one_step_percent):
            line += f", {model.one_step_percent:.1f} % one sample ahead"
        if not math.isnan(model.fit_s):
            line += f", fitted in {model.fit_s:.2g} s"
        lines.append(line)
    return lines


def polynomial_model(result: PolynomialModel) -> list[str]:
    return [
        f"{result.method} model of order {result.order}, dt = {result.dt_s:.6g} s: {result.b.size} "
        f"coefficients in B, {result.a.size - 1} in A, {result.f.size - 1} in F, {result.c.size - 1} in C, "
        f"delay {result.delay_samples}"
    ]


def innovation_model(result: InnovationModel) -> list[str]:
    noise = "" if result.K is None else ", with its noise"
    return [f"{result.method} model of order {result.order}, dt = {result.dt_s:.6g} s{noise}"]


# The function of each class, by the name of the class.
SUMMARIES: Mapping[str, Callable[[Any], list[str]]] = {
    "Certificate": certificate,
    "ClosedLoopTrajectory": closed_loop_trajectory,
    "Comparison": comparison,
    "Diagnosis": diagnosis,
    "ErrorSurface": error_surface,
    "Finding": finding,
    "FrfIdentification": frf_identification,
    "GobfModel": gobf_model,
    "Identification": identification,
    "InnovationModel": innovation_model,
    "JointDesign": joint_design,
    "MatrixPosterior": matrix_posterior,
    "MimoIdentification": mimo_identification,
    "MultivariableCertificate": multivariable_certificate,
    "MultivariableResult": multivariable_result,
    "PolynomialModel": polynomial_model,
    "Record": record,
    "ResponsePosterior": response_posterior,
    "Simulation": simulation,
    "SynthesisResult": synthesis_result,
    "UncertainPlant": uncertain_plant,
    "Uncertainty": uncertainty,
    "YoulaBracket": youla_bracket,
}
