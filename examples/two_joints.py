"""From a log of two motors and two sensors to one certified controller and its C code.

    python examples/two_joints.py [FOLDER]

The machine is the two-link arm at an operating point; both joints are moved at once by independent binary
sequences. One model on shared poles, balls of its response, a controller of order 6 for every plant in them.
The controller then closes the loop around the true arm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import control
import numpy as np
from scipy.signal import dlsim

from control_design import (
    MultivariablePlant,
    MultivariableSpecification,
    ResponseBall,
    Specification,
    c_source,
    certify_multivariable,
    synthesise_multivariable,
)
from ident import IdentOptions, Record
from ident.several_outputs import identify_mimo
from ident.uncertainty.matrix_response import matrix_posterior
from plant import prbs
from validation.example_arms import two_link_operating_point

DT_S, SAMPLES, NOISE_RAD = 0.002, 8000, 2e-5
LOWEST_RAD_S = 0.05  # from where on the certificate knows the response
JOINTS = (
    Specification(bandwidth_rad_s=6.0, modulus_margin=0.4, effort_limit=80.0, input_limit=24.0),
    Specification(bandwidth_rad_s=10.0, modulus_margin=0.4, effort_limit=80.0, input_limit=24.0),
)


def run(folder: Path, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    arm = control.c2d(two_link_operating_point(2 * np.pi / 3), DT_S)[:2, :]
    u = np.column_stack([prbs(13, 1, 1.0, SAMPLES, rng) for _ in range(2)])
    y = dlsim((arm.A, arm.B, arm.C, arm.D, DT_S), u)[1] + NOISE_RAD * rng.normal(size=(SAMPLES, 2))
    record = Record(
        u,
        y,
        DT_S,
        name="arm",
        input_names=("shoulder_V", "elbow_V"),
        output_names=("shoulder_rad", "elbow_rad"),
    )

    found = identify_mimo([record], IdentOptions(integrators=1))
    print(f"model: {len(found.model.state_space()[0])} states, fit {found.output_fit_percent[0].round(2)} %")
    residues = found.model.residues()
    for pole, residue, one in zip(residues.poles, residues.pole, found.rank_one, strict=True):
        if pole.imag and one and abs(np.log(pole)) < 300 * DT_S:
            shape = np.linalg.svd(residue)[0][:, 0]
            ratio = float(np.real(shape[1] / shape[0]))
            print(
                f"mode of {abs(np.log(pole)) / DT_S:.1f} rad/s: elbow moves {ratio:+.2f} times the shoulder"
            )

    ball = ResponseBall.of(matrix_posterior([record], found), LOWEST_RAD_S)
    plant = MultivariablePlant("arm", found.model.to_control(), ball)
    asked = MultivariableSpecification(joints=JOINTS, controller_order=6)
    design = synthesise_multivariable(plant, asked)
    certificate = certify_multivariable(design.controller, plant, asked)
    verdict = certificate.verdicts[0]
    print(f"worst case {certificate.gamma:.3f} (at most 1 is needed), certified: {certificate.met}")
    print(f"every gain at the sensors may change by {verdict.output_disk.gain:.2f} at once")

    loop = control.feedback(arm * design.controller.to_control(include_delay=True), np.eye(2))
    print(f"true arm in the loop: largest pole {np.max(np.abs(loop.poles())):.4f}, 1 is the limit")
    (folder / "two_joints.c").write_text(c_source(design.controller))


if __name__ == "__main__":
    run(Path(*sys.argv[1:2]))
