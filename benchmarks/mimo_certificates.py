"""Certificates of random matrix designs against dense samples of the ball: does any sample exceed a bound?

A case draws a plant of two or three inputs and outputs (real poles, flexible modes, perhaps an integrator
per joint), a ball with a dynamic Li, weights, and a stable random controller scaled until the certificate
says proved. At many frequencies off the certificate's grid, members of the ball (random ones, and rank-one
ones climbed towards the worst) are put into det and singular values by plain matrix algebra.
"""

from __future__ import annotations

import control
import numpy as np

from benchmarks.harness import Print, main
from control_design import (
    Controller,
    MultivariablePlant,
    MultivariableSpecification,
    ResponseBall,
    Specification,
    certify_multivariable,
)

DT_S = 0.01
_ROUNDING = 1e-7  # relative; a sample beyond the bound by more is a false certificate


def draw(rng: np.random.Generator) -> tuple[MultivariablePlant, MultivariableSpecification, Controller]:
    """Plant, specification, controller of gain one."""
    size = int(rng.integers(2, 4))
    blocks = [np.diag(np.exp(-DT_S * 10 ** rng.uniform(-1, 1.5, size)))]
    for _ in range(int(rng.integers(1, 3))):
        pole = np.exp(DT_S * 10 ** rng.uniform(0.7, 2) * (-(10 ** rng.uniform(-2.3, -0.7)) + 1j))
        blocks.append(np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
    n = sum(block.shape[0] for block in blocks)
    a = np.zeros((n, n))
    at = 0
    for block in blocks:
        a[at : at + block.shape[0], at : at + block.shape[0]] = block
        at += block.shape[0]
    b, c = rng.standard_normal((n, size)), DT_S * rng.standard_normal((size, n))
    nominal = control.ss(a, b, c, np.zeros((size, size)), DT_S)
    fade = np.diag(np.exp(-DT_S * 10 ** rng.uniform(0, 2, size)))
    li = control.ss(
        fade, np.eye(size) - fade, DT_S * rng.standard_normal((size, size)), np.zeros((size, size)), DT_S
    )
    plant = MultivariablePlant("random", nominal, ResponseBall(rng.standard_normal((size, size)), li, 1.0))
    joints = tuple(
        Specification(bandwidth_rad_s=10 ** rng.uniform(-0.5, 1), effort_limit=10 ** rng.uniform(0, 2))
        for _ in range(size)
    )
    order = int(rng.integers(0, 5))
    own = np.diag(rng.uniform(0, 0.99, order))
    gain = rng.standard_normal((size, size)) @ np.linalg.pinv(
        control.dcgain(nominal) if rng.random() < 0.5 else np.eye(size)
    )
    controller = Controller(
        own, rng.standard_normal((order, size)), 0.3 * rng.standard_normal((size, order)), gain, DT_S
    )
    return plant, MultivariableSpecification(joints=joints), controller


def scaled(controller: Controller, factor: float) -> Controller:
    return Controller(controller.A, controller.B, factor * controller.C, factor * controller.D, DT_S)


def worst_excess(plant, specification, controller, bounds, rng, frequencies: int, samples: int) -> float:
    """Largest ratio of a sampled weighted gain to its certified bound."""
    size = plant.inputs
    omega = np.exp(rng.uniform(np.log(1e-3), np.log(np.pi / DT_S), frequencies))
    z = np.exp(1j * omega * DT_S)
    s = 2 / DT_S * (z - 1) / (z + 1)

    def response(system) -> np.ndarray:
        a, b, c, d = (np.asarray(getattr(system, each)) for each in "ABCD")
        return c @ np.linalg.solve(z[:, None, None] * np.eye(a.shape[0]) - a, b + 0j) + d

    G, li = response(plant.nominal) / z[:, None, None], response(plant.ball.Li)
    K, lo = response(controller), plant.ball.Lo
    weights = specification.weights(size, size)
    values = {
        name: np.stack([w.at(s) for w in each], axis=-1)[..., None] * np.eye(size)
        for name, (_, each) in weights.items()
    }

    def gains(delta: np.ndarray) -> np.ndarray:
        S = np.linalg.inv(np.eye(size) + (G + lo @ delta @ li) @ K)
        each = [
            np.linalg.norm(values[name] @ (S if of == "y" else K @ S), 2, axis=(1, 2)) / bounds[name]
            for name, (of, _) in weights.items()
        ]
        return np.max(each, axis=0)

    def unit(delta: np.ndarray) -> np.ndarray:
        return delta / np.linalg.norm(delta, axis=(1, 2), keepdims=True)

    def gauss() -> np.ndarray:
        shape = frequencies, size, size
        return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)

    at = unit(gauss())
    best, width = gains(at), np.full(frequencies, 0.5)
    for number in range(samples):
        trial = unit(gauss() if number < samples // 4 else at + width[:, None, None] * gauss())
        value = gains(trial)
        better = value > best
        at[better], best = trial[better], np.maximum(best, value)
        width = np.where(better, width, np.maximum(0.97 * width, 1e-3))
    return float(np.max(best))


def run(
    out: Print, *, cases: int = 500, first_seed: int = 0, frequencies: int = 300, samples: int = 200
) -> None:
    proved, false, nearest = 0, 0, []
    for seed in range(first_seed, first_seed + cases):
        rng = np.random.default_rng(seed)
        plant, specification, controller = draw(rng)
        verdict = None
        for factor in 2.0 ** np.arange(2, -12, -2.0):
            certified = scaled(controller, factor)
            found = certify_multivariable(certified, plant, specification, dense_points=300).verdicts[0]
            if found.proved:
                verdict = found
                break
        if verdict is None:
            continue
        proved += 1
        excess = worst_excess(plant, specification, certified, verdict.bounds, rng, frequencies, samples)
        nearest.append(excess)
        if excess > 1 + _ROUNDING:
            false += 1
            out(f"seed {seed}: a sample reaches {excess:.8f} of its bound")
    out(
        f"{cases} cases, {proved} proved, {false} false; the worst sample of a case reaches "
        f"{np.median(nearest):.4f} of its bound in the median, {np.max(nearest):.5f} at most"
    )


if __name__ == "__main__":
    main(run)
