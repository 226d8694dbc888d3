"""Two-link arm, both motors to the tip: shared poles against poles of each channel by itself.

The arm of `examples/two_link_arm.py` (1 V binary sequences, 0.02 mm of noise), 8000 samples in all:

    both, shared       both motors at once, one set of poles (`identify_miso`)
    separate, shared   one motor at a time, 4000 samples each, one set of poles from the two records
    separate, own      the same records, two single-input identifications

Poles of their own on the record with both motors at work are left out: single-input fits in turns on what the
other channel leaves, the simple way, were off by more than the response itself after three turns (the inputs
that the integrator has summed are correlated, up to 0.5, over one record).

Error: root mean square over a log grid of |G_model / G - 1| of each channel, from 1 to 200 rad/s (rigid body
and the two close modes) and from 200 to 800 rad/s (around the third mode, below the noise from the shoulder,
where all models of that channel are far off); median over seeds. Modes: seeds in which a pair within 5 % of
that frequency was found (own poles: in shoulder/elbow). The order is chosen from the data everywhere.
Nothing is asked for in numbers; the reach is to be better than the fits channel by channel in both channels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import control
import numpy as np
from scipy.signal import dlsim

from benchmarks.harness import Print, main, timed
from examples.two_link_arm import AMPLITUDE_V, DT_S, ELBOW_ANGLE_RAD, NOISE_M
from ident import IdentOptions, Record, identify
from ident.one_input import identify_miso
from plant import prbs
from validation.example_arms import two_link_operating_point

N_SAMPLES = 8000
OPTIONS = IdentOptions(integrators=1)
OMEGA = np.geomspace(1.0, 800.0, 200)
LOW = OMEGA <= 200
# Responses (F, 2), and the frequencies of the pairs that each channel's model has.
Fitted = tuple[np.ndarray, list[np.ndarray]]


def experiment(
    arm: control.StateSpace, n_samples: int, motors: list[int], rng: np.random.Generator
) -> Record:
    """A record in which these motors get independent binary sequences and the others rest."""
    u = np.zeros((n_samples, 2))
    for motor in motors:
        u[:, motor] = prbs(13, 1, AMPLITUDE_V, n_samples, rng)
    tip = dlsim((arm.A, arm.B, arm.C, arm.D, DT_S), u)[1] + NOISE_M * rng.normal(size=(n_samples, 1))
    return Record(f"motors {motors}", u, tip, DT_S, ("shoulder", "elbow"), ("tip_m",))


def shared(records: list[Record]) -> Fitted:
    model = identify_miso(records, OPTIONS).model
    return model.frequency_response(OMEGA), [model.poles.omega_rad_s(DT_S)] * 2


def own_separately(records: list[Record]) -> Fitted:
    pairs = zip(records, records[0].input_names, strict=True)
    models = [identify([record.siso(name)], OPTIONS).model for record, name in pairs]
    responses = np.column_stack([model.frequency_response(OMEGA) for model in models])
    return responses, [model.poles.omega_rad_s(DT_S) for model in models]


METHODS: dict[str, tuple[bool, Callable[[list[Record]], Fitted]]] = {
    "both, shared": (True, shared),
    "separate, shared": (False, shared),
    "separate, own": (False, own_separately),
}


def run(out: Print, *, seeds: int = 20) -> None:
    continuous = two_link_operating_point(ELBOW_ANGLE_RAD)
    arm = control.c2d(continuous, DT_S)[["tip_m"], :]
    truth = arm(np.exp(1j * OMEGA * DT_S))[0].T
    modes = np.sort(np.abs([p for p in continuous.poles() if p.imag > 0]))[:3]
    errors = {name: np.zeros((seeds, 2, 2)) for name in METHODS}
    found = {name: np.zeros((2, 3), dtype=int) for name in METHODS}
    cpu: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        at_once = [experiment(arm, N_SAMPLES, [0, 1], rng)]
        one_by_one = [experiment(arm, N_SAMPLES // 2, [motor], rng) for motor in (0, 1)]
        for name, (together, method) in METHODS.items():
            (response, frequencies), spent = timed(partial(method, at_once if together else one_by_one))
            cpu[name].append(spent)
            square = np.abs(response / truth - 1) ** 2
            errors[name][seed] = np.sqrt([square[LOW].mean(axis=0), square[~LOW].mean(axis=0)])
            for channel, those in enumerate(frequencies):
                # Two modes are 7 % apart: a pair counts for the nearer one.
                near = {
                    int(np.argmin(np.abs(modes / w - 1)))
                    for w in those
                    if np.min(np.abs(modes / w - 1)) < 0.05
                }
                found[name][channel, list(near)] += 1
    out("relative error of the response, %   1 to 200 rad/s       200 to 800 rad/s     modes found at")
    out(
        f"{'experiment, poles':<18}  CPU s          shoulder   elbow     shoulder   elbow      "
        + "   ".join(f"{mode:.0f}" for mode in modes)
        + " rad/s"
    )
    for name in METHODS:
        low, high = 100 * np.median(errors[name], axis=0)
        counts = "  ".join(f"{a}/{b}" for a, b in found[name].T)
        out(
            f"{name:<18}  {np.median(cpu[name]):>5.1f}          {low[0]:>8.3f} {low[1]:>7.3f}     "
            f"{high[0]:>8.1f} {high[1]:>7.2f}      {counts}"
        )
    out()
    out("shared poles, both motors at once, against:        shoulder  elbow   (1 to 200 rad/s)")
    out(f"{'reach: median ratio of the errors':<50} {'< 1':>7} {'< 1':>7}")
    for name in list(METHODS)[1:]:
        ratio = np.median(errors["both, shared"][:, 0] / errors[name][:, 0], axis=0)
        out(f"{name:<50} {ratio[0]:>7.2f} {ratio[1]:>7.2f}")


if __name__ == "__main__":
    main(run)
