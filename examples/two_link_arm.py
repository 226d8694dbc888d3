"""Two-link flexible arm at an operating point: both motors to the tip, one basis with shared poles.

    python examples/two_link_arm.py [FOLDER]

Both motors are excited at once by independent binary sequences, the tip is measured with 0.02 mm of noise.
Both joints turn freely: two poles at the origin without a Jordan chain (the motors brake), which one output
sees as one integrator, given as known. Fitting increments of the tip would remove it too, but differences of
a noisy position multiply the noise by frequency, just where the modes are small. From the shoulder the third
mode is far below the noise; its poles are found through the elbow.
"""

from __future__ import annotations

import sys
from pathlib import Path

import control
import numpy as np
from matplotlib.figure import Figure
from scipy.signal import dlsim

from ident import IdentOptions, Record
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior
from plant import prbs
from validation.example_arms import two_link_operating_point

DT_S, ELBOW_ANGLE_RAD, NOISE_M, AMPLITUDE_V = 0.002, 2 * np.pi / 3, 2e-5, 1.0
OMEGA = np.geomspace(1.0, 1000.0, 500)


def experiment(n_samples: int, rng: np.random.Generator) -> tuple[control.StateSpace, Record]:
    """The arm behind a zero-order hold (tip output only), and a record of it."""
    arm = control.c2d(two_link_operating_point(ELBOW_ANGLE_RAD), DT_S)[["tip_m"], :]
    u = np.column_stack([prbs(13, 1, AMPLITUDE_V, n_samples, rng) for _ in range(2)])
    tip = dlsim((arm.A, arm.B, arm.C, arm.D, DT_S), u)[1] + NOISE_M * rng.normal(size=(n_samples, 1))
    return arm, Record(
        u,
        tip,
        DT_S,
        name="two-link arm",
        input_names=("shoulder_voltage_V", "elbow_voltage_V"),
        output_names=("tip_m",),
    )


def run(n_samples: int = 8000, seed: int = 0):
    """Identify the arm; returns the identification, the true response (F, 2) and the ball around it."""
    arm, record = experiment(n_samples, np.random.default_rng(seed))
    result = identify_mimo([record], IdentOptions(integrators=1))
    truth = arm(np.exp(1j * OMEGA * DT_S))[0].T
    return result, truth, matrix_posterior([record], result).at(OMEGA)


def report(result, truth) -> None:
    true = sorted((p for p in two_link_operating_point(ELBOW_ANGLE_RAD).poles() if p.imag > 0), key=abs)
    for name, modes in (("true", true), ("found", np.log(result.model.poles.pairs) / DT_S)):
        print(f"{name} modes: " + "; ".join(f"{abs(p):.2f} rad/s, {-p.real / abs(p):.3f}" for p in modes))
    noise_m = np.sqrt(result.noise_covariance[0, 0])
    print(f"states: {result.model.state_space()[0].shape[0]}, noise {1e3 * noise_m:.4f} mm")
    error = np.abs(result.model.frequency_response(OMEGA)[:, 0] / truth - 1)[OMEGA <= 200]
    for name, value in zip(result.model.input_names, np.sqrt(np.mean(error**2, axis=0)), strict=True):
        print(f"{name} -> tip_m: rms relative error up to 200 rad/s {100 * value:.3f} %")


def figure(result, truth, ball) -> Figure:
    picture = Figure(figsize=(9, 6.5), layout="constrained")
    gain, phase = picture.subplots(2, 1, sharex=True)
    model = result.model.frequency_response(OMEGA)[:, 0]
    # What a channel of a member of the ball is off at most.
    radii = ball.output_factor[0, 0] * ball.radius[:, None] * np.linalg.norm(ball.input_factor, axis=1)
    for i, (name, colour) in enumerate((("shoulder", "tab:blue"), ("elbow", "tab:orange"))):
        low = np.maximum(np.abs(model[:, i]) - radii[:, i], 1e-9)
        gain.fill_between(OMEGA, low, np.abs(model[:, i]) + radii[:, i], color=colour, alpha=0.25, lw=0)
        for axis, show in ((gain, np.abs), (phase, lambda g: np.degrees(np.unwrap(np.angle(g))))):
            axis.semilogx(OMEGA, show(truth[:, i]), "k-" if i else "k:", lw=1, label=f"truth, {name}")
            axis.semilogx(OMEGA, show(model[:, i]), color=colour, lw=2.2, alpha=0.7, label=f"model, {name}")
            axis.grid(alpha=0.3)
    gain.set(yscale="log", ylim=(1e-9, 2), ylabel="gain, m/V", title="Two-link arm, both motors to tip")
    phase.set(xlabel="frequency, rad/s", ylabel="phase, degrees", xlim=OMEGA[[0, -1]])
    phase.set_yticks(range(-1080, 1, 180))
    gain.legend(title="bands: 95 % of the model", loc="lower left")
    return picture


if __name__ == "__main__":
    identified, true_response, uncertain = run()
    report(identified, true_response)
    figure(identified, true_response, uncertain).savefig(Path(*sys.argv[1:2]) / "two_link_arm.png", dpi=120)
