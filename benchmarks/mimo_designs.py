"""Designs of problems T and D of `mimo_problems` by the product, judged by the independent judges.

T: full K of orders 6 and 8; decentralised K, and the ball three times as large, at order 8. D: order 8 with
integrators.
Every row: the worst case the synthesis saw, the judge's, the certificate's bound for all frequencies, CPU s.
"""

from __future__ import annotations

import time

import control
import numpy as np
import scipy.linalg
from scipy.signal import tf2ss

from benchmarks.harness import Print, main
from benchmarks.mimo_problems import (
    CHI,
    GAIN_D,
    LO,
    MODES_T,
    SHAPE_T,
    TS,
    judge_d,
    judge_t,
    two_joints,
)
from control_design import (
    Controller,
    MultivariableOptions,
    MultivariablePlant,
    MultivariableSpecification,
    ResponseBall,
    Specification,
    certify_multivariable,
    synthesise_multivariable,
)
from control_design.plants.weights import RationalWeight

# Sampling period of D, min: Tustin's rule keeps every value of D at its frequency in s.
DT_D = 0.01


def tustin(a, b, c, d, dt_s):
    """Discrete state space with the values of the continuous one at Tustin's s."""
    eye = np.eye(a.shape[0])
    inverse = np.linalg.inv(eye - a * dt_s / 2)
    return inverse @ (eye + a * dt_s / 2), inverse @ b * dt_s, c @ inverse, d + c @ inverse @ b * dt_s / 2


def continuous(controller: Controller):
    """A, B, C, D of the controller in Tustin's s."""
    a = controller.A
    dt = controller.dt_s
    inverse = np.linalg.inv(a + np.eye(a.shape[0]))
    c = controller.C
    return (
        2 / dt * (a - np.eye(a.shape[0])) @ inverse,
        4 / dt * inverse @ inverse @ controller.B,
        c,
        controller.D - c @ inverse @ controller.B,
    )


def plant_t(ball: float = 1.0) -> MultivariablePlant:
    """Problem T, its ball `ball` times as large."""
    a, b, c = two_joints()
    parts = []
    top = 0.008 * np.polymul([1 / 10, 1], [1 / 300, 1])
    bottom = np.polymul([1, 0.02], [1 / 3, 1])
    rows = [(tf2ss(top, bottom), row) for row in SHAPE_T]
    rows += [(tf2ss([0.008 * size], [1 / w**2, 0.04 / w, 1]), np.array(v)) for w, size, v in MODES_T]
    for (fa, fb, fc, fd), row in rows:
        parts.append((fa, fb * row, fc, fd * row))
    stacked = (
        scipy.linalg.block_diag(*(part[0] for part in parts)),
        np.vstack([part[1] for part in parts]),
        scipy.linalg.block_diag(*(part[2] for part in parts)),
        np.vstack([part[3] for part in parts]),
    )
    li = control.ss(*tustin(*stacked, TS), TS)
    return MultivariablePlant(
        "T", control.ss(a, b, c, np.zeros((2, 2)), TS), ResponseBall(LO, li, CHI * ball)
    )


def specification_t(order: int, structure: str = "full") -> MultivariableSpecification:
    joints = tuple(
        Specification(
            sensitivity_weight=RationalWeight(numerator=(0.5, b), denominator=(1, 0.001 * b)),
            effort_weight=RationalWeight(numerator=(1 / 60 / u, 1 / u), denominator=(1 / 1500, 1)),
            computational_delay_samples=0,
        )
        for b, u in ((5.0, 240.0), (7.5, 160.0))
    )
    return MultivariableSpecification(joints=joints, structure=structure, controller_order=order)


def plant_d() -> MultivariablePlant:
    """Problem D, sampled by Tustin's rule."""
    system = tustin(-np.eye(2) / 75, np.eye(2) / 75, GAIN_D, np.zeros((2, 2)), DT_D)
    weight = RationalWeight(numerator=(1.0, 0.2), denominator=(0.5, 1.0))
    return MultivariablePlant("D", control.ss(*system, DT_D), input_error=(weight, weight))


def specification_d(order: int) -> MultivariableSpecification:
    joint = Specification(
        sensitivity_weight=RationalWeight(numerator=(0.5, 0.05), denominator=(1, 1e-6)),
        integrator=True,
        computational_delay_samples=0,
    )
    return MultivariableSpecification(joints=(joint, joint), controller_order=order)


def judged(problem: str, controller: Controller) -> float:
    """The independent judge's value."""
    a, b, c, d = continuous(controller)
    if problem == "D":
        return judge_d(lambda s: c @ np.linalg.solve(s[:, None, None] * np.eye(a.shape[0]) - a, b + 0j) + d)
    return judge_t(a, b, c, d, ball=3.0 if problem == "T, ball x 3" else 1.0).gamma


CASES = {
    "T, full": (plant_t, lambda: specification_t(6)),
    "T, full, order 8": (plant_t, lambda: specification_t(8)),
    "T, decentralised": (plant_t, lambda: specification_t(8, "decentralised")),
    "T, ball x 3": (lambda: plant_t(3.0), lambda: specification_t(8)),
    "D": (plant_d, lambda: specification_d(8)),
}


def run(out: Print, *, cases: str = "all") -> None:
    for name, (plant, specification) in CASES.items():
        if cases not in ("all", name):
            continue
        nominal_plant = plant()
        asked = specification()
        for starts in (1, 3):
            options = MultivariableOptions(starts=starts)
            start = time.process_time()
            result = synthesise_multivariable(nominal_plant, asked, options)
            seconds = time.process_time() - start
            verdict = certify_multivariable(result.controller, nominal_plant, asked).verdicts[0]
            bound = max(verdict.bounds.values())
            out(
                f"{name:18s} order {asked.controller_order}, starts {starts}: synthesis "
                f"{result.gamma:.4f}, judge {judged(name, result.controller):.4f}, for all frequencies "
                f"{bound:.4f}, {seconds:.1f} s"
            )


if __name__ == "__main__":
    main(run)
