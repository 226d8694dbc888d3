"""The loop with dry friction on the nonlinear default arm, against what records and controller predict.

One controller (the default arm's); arms with dry friction of several levels and records, noise and phases of
several seeds. From the records of an arm come its linear part and its friction; from these:
1. Peak of |S| as measured with random-phase multisines of several sizes (rms): predicted 95 % interval, the
   measured one on the nonlinear arm, off: measured from the linear prediction. Stated as the reach: the share
   of arms and sizes inside, sizes below the predicted sticking step left out. Claimed: sizes, from the
   largest down, whose intervals end within 5 % above the certified peak; held: measured no higher than that.
2. Sticking step: largest step of the reference after which the hub stays within its pre-sliding deflection
   until the command has settled, noise aside; found on the nonlinear arm by bisection to 1 %.
3. Error at rest: after steps of several sizes (with noise and encoder; mean over the last tenth of 3 s, which
   noise moves by 0.1 mrad), over the largest that friction can leave.
4. Feed-forward of the friction on a sine of 0.05 rad at 0.1 rad/s: rms tracking error of the hub (noise and
   encoder off), with over without, and that of the same arm without friction, below which no feed-forward of
   friction leads; besides, the same as measured (1 mrad of noise in it).
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.closed_loop_sensitivity import designed, identified, without_integrator
from benchmarks.harness import Print, main
from benchmarks.without_friction import estimation_records, with_friction
from control_design.analysis.closed_loop import measure_sensitivity, simulate
from control_design.controllers.controller import Controller
from ident.friction import fit_friction
from plant import SampledArm, parse_effects
from plant.machine import DryFriction
from workflow.config.run_config import SimulatedSource, built_in_config
from workflow.tasks.friction_loop import (
    TOLERANCE_PERCENT,
    FrictionLoop,
    drawn,
    friction_feedforward,
    predicted_peak,
)
from workflow.tasks.loop_sensitivity import SensitivityPlan, plan_sensitivity, rms_of, settling_samples
from workflow.tasks.simulated_rig import encoded_arm, rig_of

FRICTIONS_NM = (0.005, 0.02, 0.1)
SIZES_RAD = (0.003, 0.01, 0.03, 0.1, 0.2)
STEPS_RAD = (0.02, 0.1, 0.3)
DRAWS = 16
# Amplitude of the slow sine.
SINE_RAD = 0.05
# Its frequency.
SINE_RAD_S = 0.1


def sticking_on_arm(controller: Controller, source: SimulatedSource, samples: int) -> float:
    """By bisection, noise and encoder off."""
    arm = SampledArm(rig_of(source), parse_effects(source.effects), None)
    low = 1e-5
    high = 1.0
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        moved = simulate(controller, arm, np.full(samples, middle)).measured
        low, high = (middle, high) if np.max(np.abs(moved)) <= DryFriction.PRE_SLIDING_RAD else (low, middle)
    return low


def sine_errors(law: Controller, source: SimulatedSource, seed: int) -> tuple[float, float]:
    """rms after the first quarter of a period: of the hub, and as measured."""
    quarter = round(0.5 * np.pi / SINE_RAD_S / law.dt_s)
    reference = SINE_RAD * np.sin(0.5 * np.pi * np.arange(5 * quarter) / quarter)
    quiet = SampledArm(rig_of(source), parse_effects(source.effects), None)
    noisy = encoded_arm(source, (), np.random.default_rng([seed, 4]))
    hub, measured = (simulate(law, arm, reference).measured for arm in (quiet, noisy))
    return tuple(float(np.sqrt(np.mean((reference - y)[quarter:] ** 2))) for y in (hub, measured))


def one_arm(
    controller: Controller, plan: SensitivityPlan, torque_Nm: float, seed: int
) -> tuple[np.ndarray, tuple[float, ...], float, list[tuple[float, float]]]:
    """Rows (sizes, 3) of measured peak and interval; sticking step predicted, its interval and found; largest
    error at rest over its bound; rms errors on the sine without, with feed-forward, and without friction."""
    config, _ = built_in_config()
    channel = config.control_channel
    source = with_friction(config.source, torque_Nm, 16384)
    key = [seed, FRICTIONS_NM.index(torque_Nm)]
    records = estimation_records(source, seed)
    at_hub = [record.siso(channel.input, channel.output) for record in records]
    friction = fit_friction(at_hub, channel.identification)
    loops = drawn(controller, friction, np.random.default_rng([*key, 1]), DRAWS)
    peaks = np.empty((len(SIZES_RAD), 3))
    for k, size in enumerate(SIZES_RAD):
        excitation = plan.excitation(size / plan.rms)
        phases = partial(np.random.default_rng, [*key, 2, k])
        arm = encoded_arm(source, (), np.random.default_rng([*key, 3, k]))
        peaks[k, 0] = measure_sensitivity(controller, arm, phases(), **excitation).peak[0]
        peaks[k, 1:] = predicted_peak(loops, phases, np.random.default_rng([*key, 5, k]), **excitation)
    samples = settling_samples(float(np.max(np.abs(controller.poles))), 200, 6000)
    fitted = FrictionLoop.of(controller, friction)
    spread = [loop.sticking_step(samples) for loop in loops]
    stuck = sticking_on_arm(controller, source, samples)
    left = []
    for size in STEPS_RAD:
        arm = encoded_arm(source, (), np.random.default_rng([seed, 6]))
        left.append(abs(size - float(np.mean(simulate(controller, arm, np.full(600, size)).measured[-60:]))))
    law = replace(controller, feedforward=friction_feedforward(controller, friction))
    loose = source.model_copy(update={"effects": ()})
    pairs = ((controller, source), (law, source), (controller, loose))
    errors = [sine_errors(each, arm, seed) for each, arm in pairs]
    sticking = fitted.sticking_step(samples), min(spread), max(spread), stuck
    return peaks, sticking, max(left) / fitted.error_at_rest, errors


def run(out: Print, *, seeds: int = 14, first: int = 0) -> None:
    config = without_integrator(built_in_config()[0])
    with tempfile.TemporaryDirectory() as folder:
        plant = identified(config, Path(folder))
    controller, certificate = designed([plant], config)
    records = estimation_records(config.source, config.run.seed)
    plan = plan_sensitivity(controller, plant, rms_of([record.input for record in records]), 300)
    bound = certificate.plants[0].worst_peak_sensitivity
    out(f"no integrator: linear peak of |S| {plan.nominal_peak:.4f}, certified {bound:.4f}")
    held = 0
    counted = 0
    claims = 0
    claims_kept = 0
    for torque_Nm in FRICTIONS_NM:
        arms = [one_arm(controller, plan, torque_Nm, first + k) for k in range(seeds)]
        peaks = np.array([arm[0] for arm in arms])
        sticking = np.array([arm[1] for arm in arms])
        inside = (peaks[:, :, 1] <= peaks[:, :, 0]) & (peaks[:, :, 0] <= peaks[:, :, 2])
        moves = np.array(SIZES_RAD) >= sticking[:, :1]
        held = held + int(np.sum(inside & moves))
        counted = counted + int(np.sum(moves))
        allowed = (1 + TOLERANCE_PERCENT / 100) * bound
        claimed = np.cumprod(peaks[:, ::-1, 2] <= allowed, axis=1)[:, ::-1] == 1
        claims += int(np.sum(claimed))
        claims_kept += int(np.sum(claimed & (peaks[:, :, 0] <= allowed)))
        out(f"\nfriction {torque_Nm:g} N m, {seeds} arms")
        out("  reference, rad rms      " + " ".join(f"{size:>15g}" for size in SIZES_RAD))
        middle = np.median(peaks, axis=0)
        spans = [f"{low:.3f} to {high:.3f}" for _, low, high in middle]
        out("  predicted |S|, median   " + " ".join(f"{span:>15}" for span in spans))
        out("  measured |S|, median    " + " ".join(f"{value:15.4f}" for value, _, _ in middle))
        out("  claimed, of arms        " + " ".join(f"{int(n):>12}/{seeds}" for n in claimed.sum(axis=0)))
        off = 100 * (middle[:, 0] / plan.nominal_peak - 1)
        out("  off the linear one, %   " + " ".join(f"{value:+15.1f}" for value in off))
        out("  inside, of arms         " + " ".join(f"{int(n):>12}/{seeds}" for n in inside.sum(axis=0)))
        ratio = sticking[:, 0] / sticking[:, 3]
        out(
            f"  sticking step: predicted {np.median(sticking[:, 0]):.3g} rad, found {sticking[0, 3]:.3g}; "
            f"predicted over found {ratio.min():.3f} to {ratio.max():.3f}"
        )
        errors_at_rest = [arm[2] for arm in arms]
        out(
            f"  error at rest over its bound: median {np.median(errors_at_rest):.2f}, "
            f"largest {max(errors_at_rest):.2f}"
        )
        sine = 1e3 * np.array([arm[3] for arm in arms])
        for k, of in enumerate(("of the hub", "as measured")):
            without, with_it, loose = np.median(sine[:, :, k], axis=0)
            gain = sine[:, 1, k] / sine[:, 0, k]
            out(
                f"  slow sine, {of}: rms error {without:.2f} mrad without feed-forward, {with_it:.2f} with, "
                f"{loose:.2f} without friction; with over without {gain.min():.3f} to {gain.max():.3f}"
            )
    out(
        f"\ninside, sizes from the sticking step on: {held} of {counted} = {100 * held / counted:.1f} % "
        f"(reach: 95 %); at most 5 % above the certified peak, where claimed: {claims_kept} of {claims}"
    )


if __name__ == "__main__":
    main(run, seeds="{seeds} from {first}")
