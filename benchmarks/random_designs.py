"""Random plants and specifications: is every returned design stable, and what does an impossible one say?

A case draws one to three flexible modes, up to two integrators, up to two samples of delay, a first-order
lag, and a posterior over coefficients from spreads of gain, lag, mode frequencies and dampings plus a short
impulse response; a specification; designs with low effort (with the default options where that finds nothing
stable); certifies.
Stability is then checked without any frequency response: plants drawn from inside the ellipses (a point of
the generators' ball lies in the ellipse of every frequency) and the closed-loop poles by python-control.
The proved gamma is compared with the largest weighted gain on the rims of the ellipses, sampled densely at
frequencies drawn anew, by plain matrix algebra.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import control
import numpy as np

from benchmarks.harness import Print, main, timed
from control_design import (
    Controller,
    Outcome,
    Specification,
    SpecificationError,
    SynthesisOptions,
    UncertainPlant,
    certify,
    synthesise,
)
from control_design.specification.requirement import LoopFunction
from ident import Poles
from ident.basis.functions import basis_response, basis_state_space
from ident.uncertainty import ResponsePosterior
from workflow.text.sentences.design import outcome

DT_S = 0.005
LOW_EFFORT = SynthesisOptions(
    starts=2, agreeing_starts=1, exchange_rounds=2, dense_points=3000, grid_points=80
)
SAMPLED = 60
RADIUS = float(np.sqrt(-2 * np.log(0.05)))
COUNTED = (
    *("designs", "met", "proved", "false", "unstable", "refused", "full effort", "not converged"),
    "silent",
)
MEANING = (
    "(met: certified; proved: robust stability for all frequencies; false: a sampled gain above the proved\n"
    "one; unstable: designs with an unstable nominal or sampled plant; refused: before optimising; silent:\n"
    "not met and no word on what blocks)"
)


@dataclass(frozen=True, eq=False)
class Physical:
    """gain b/(s+b) [1 + sum c w^2/(s^2 + 2 z w s + w^2)]/s^integrators, zero-order hold, delay in samples."""

    gain: float
    lag_per_s: float
    omega_rad_s: np.ndarray
    zeta: np.ndarray
    residue: np.ndarray
    integrators: int
    delay: int

    def without_integrators(self, omega: np.ndarray) -> np.ndarray:
        """Response (F,) times ((z - 1)/z)^integrators, without the delay; modal sum, exact hold."""
        system = control.ss([], [], [], [[1.0]])
        for w, z, c in zip(self.omega_rad_s, self.zeta, self.residue, strict=True):
            system = system + control.ss([[0, w], [-w, -2 * z * w]], [[0], [w]], [[c, 0]], 0)
        b = self.lag_per_s
        system = control.ss([[-b]], [[b]], [[self.gain]], 0) * system
        for _ in range(self.integrators):
            system = control.ss([[0.0]], [[1.0]], [[1.0]], 0) * system
        discrete = control.c2d(control.ss(system), DT_S, "zoh")
        value = np.asarray(control.frequency_response(discrete, omega).complex).reshape(-1)
        return value * (1 - np.exp(-1j * omega * DT_S)) ** self.integrators

    def poles(self) -> np.ndarray:
        """z-plane poles of the modes, upper half plane."""
        s = self.omega_rad_s * (-self.zeta + 1j * np.sqrt(1 - self.zeta**2))
        return np.exp(s * DT_S)


def random_physical(rng: np.random.Generator) -> Physical:
    """One plant."""
    n = int(rng.integers(1, 4))
    omega = np.sort(10 ** rng.uniform(0.6, 2.2, n)) * np.linspace(1.0, 1.3, n)
    return Physical(
        gain=float(10 ** rng.uniform(-0.5, 0.5)),
        lag_per_s=float(10 ** rng.uniform(0.3, 1.7)),
        omega_rad_s=omega,
        zeta=10 ** rng.uniform(-2.3, -1.2, n),
        residue=rng.choice([-1.0, 1.0], n) * 10 ** rng.uniform(-1.5, -0.2, n),
        integrators=int(rng.choice([0, 1, 2], p=[0.5, 0.4, 0.1])),
        delay=int(rng.integers(0, 3)),
    )


def posterior_of(plant: Physical, rng: np.random.Generator) -> ResponsePosterior:
    """Coefficients on doubled poles: exact for the plant and for the derivatives with respect to its
    parameters."""
    lag = np.exp(-plant.lag_per_s * DT_S)
    real = np.array([*([0.0] * plant.integrators), lag, lag])
    poles = Poles(real, np.repeat(plant.poles(), 2))
    fir = 6
    omega = np.unique(
        np.concatenate(
            [np.geomspace(0.5, np.pi / DT_S, 300)]
            + [
                w * (1 + z * np.linspace(-5, 5, 41))
                for w, z in zip(plant.omega_rad_s, plant.zeta, strict=True)
            ]
        )
    )
    below_nyquist = omega <= np.pi / DT_S
    omega = omega[below_nyquist]
    rows = basis_response(poles, np.exp(1j * omega * DT_S))
    stacked = np.vstack([rows.real, rows.imag])

    def project(value: np.ndarray, tolerance: float) -> np.ndarray:
        target = np.concatenate([value.real, value.imag])
        coefficients = np.linalg.lstsq(stacked, target, rcond=1e-13)[0]
        residual = np.linalg.norm(stacked @ coefficients - target) / np.linalg.norm(target)
        assert residual < tolerance, f"projection onto the basis misses by {residual:.1e}"
        return coefficients

    mean = project(plant.without_integrators(omega), 1e-6)
    columns = []
    spreads = {"gain": rng.uniform(0.02, 0.12), "lag_per_s": rng.uniform(0.03, 0.1)}
    for name, spread in spreads.items():
        columns.append(project(_slope(plant, name, None, omega) * spread, 1e-3))
    for mode in range(plant.omega_rad_s.size):
        for name, spread in (
            ("omega_rad_s", rng.uniform(0.2, 1.5) * plant.zeta[mode]),
            ("zeta", rng.uniform(0.05, 0.2)),
            ("residue", rng.uniform(0.02, 0.1)),
        ):
            columns.append(project(_slope(plant, name, mode, omega) * spread, 1e-3))
    low = np.linalg.norm(plant.without_integrators(omega[:1]))
    size = mean.size + fir
    factor = np.zeros((size, len(columns) + fir))
    factor[: mean.size, : len(columns)] = np.array(columns).T
    factor[mean.size :, len(columns) :] = np.eye(fir) * low * 10 ** rng.uniform(-4, -2.5)
    return ResponsePosterior(
        poles,
        np.append(mean, np.zeros(fir)),
        factor,
        DT_S,
        fir_length=fir,
        integrators=plant.integrators,
        input_delay_samples=plant.delay,
    )


def _slope(plant: Physical, name: str, mode: int | None, omega: np.ndarray) -> np.ndarray:
    """Derivative with respect to the logarithm of one parameter, by central differences."""
    values = []
    for sign in (1, -1):
        value = getattr(plant, name)
        if mode is None:
            value = value * (1 + sign * 1e-4)
        else:
            value = value.copy()
            value[mode] *= 1 + sign * 1e-4
        values.append(Physical(**(vars(plant) | {name: value})).without_integrators(omega))
    return (values[0] - values[1]) / 2e-4


def state_space(posterior: ResponsePosterior, coefficients: np.ndarray) -> control.StateSpace:
    """The plant of one coefficient vector."""
    a, b, _, _ = basis_state_space(posterior.poles)
    n = posterior.poles.order
    system = control.ss(a, b, coefficients[None, :n], 0, DT_S)
    taps = coefficients[n:]
    length = taps.size
    chain = control.ss(
        np.eye(length, k=-1), np.eye(length)[:, :1], taps[None, :], 0, DT_S
    )  # taps at lags 1, 2, ...
    system = control.ss(system + chain)
    for _ in range(posterior.integrators):
        system = control.ss([[1.0]], [[1.0]], [[1.0]], [[1.0]], DT_S) * system
    for _ in range(posterior.input_delay_samples):
        system = control.ss([[0.0]], [[1.0]], [[1.0]], 0, DT_S) * system
    return control.ss(system)


def random_case(seed: int) -> tuple[UncertainPlant, ResponsePosterior, Specification]:
    """Plant with ellipses, its posterior, and a specification."""
    rng = np.random.default_rng([seed, 1])
    physical = random_physical(rng)
    posterior = posterior_of(physical, rng)
    plant = UncertainPlant(
        state_space(posterior, posterior.mean), name=f"random {seed}", uncertainty=posterior
    )
    bandwidth = float(physical.omega_rad_s[0] * 10 ** rng.uniform(-1.3, -0.2))
    gain = float(np.abs(posterior.centre(np.array([bandwidth])))[0])
    specification = Specification(
        bandwidth_rad_s=bandwidth,
        integrator=bool(rng.random() < 0.4),
        low_frequency_rejection=0.02,
        modulus_margin=float(rng.uniform(0.3, 0.55)),
        effort_limit=float(10 ** rng.uniform(0.5, 1.5)) / gain,
        mode_peak_ratio=float(rng.uniform(0.5, 1.0)) if rng.random() < 0.25 else None,
        controller_order=int(rng.integers(3, 6)),
    )
    return plant, posterior, specification


def unstable_samples(controller: Controller, posterior: ResponsePosterior, rng: np.random.Generator) -> int:
    """Closed loops with a pole on or outside the circle, of `SAMPLED` plants on the ellipses' boundary."""
    k = controller.to_control(include_delay=True)
    unstable = 0
    for index in range(SAMPLED):
        direction = rng.standard_normal(posterior.covariance_factor.shape[1])
        direction *= RADIUS * (1.0 if index else 0.0) / np.linalg.norm(direction)
        plant = state_space(posterior, posterior.mean + posterior.covariance_factor @ direction)
        poles = np.linalg.eigvals(control.feedback(plant * k, 1).A)
        unstable += bool(np.max(np.abs(poles)) >= 1)
    return unstable


def sampled_gain(
    controller: Controller,
    plant: UncertainPlant,
    posterior: ResponsePosterior,
    specification: Specification,
    rng: np.random.Generator,
) -> float:
    """Largest weighted gain of members on the rims of the ellipses, at 600 frequencies of which a third lie
    at the modes."""
    omega = np.exp(rng.uniform(np.log(1e-2), np.log(np.pi / DT_S), 400))
    modes = rng.choice(np.log(posterior.poles.pairs) / DT_S, 200)
    near = np.abs(modes.imag) + modes.real * rng.uniform(-3, 3, 200)
    z = np.exp(1j * DT_S * np.concatenate([omega, near[near > 0]]))
    taps = z[:, None] ** -(1.0 + np.arange(posterior.fir_length))
    rows = np.hstack([basis_response(posterior.poles, z), taps])
    rows *= ((z / (z - 1)) ** posterior.integrators * z**-posterior.input_delay_samples)[:, None]
    columns = rows @ posterior.covariance_factor
    axes, sizes, _ = np.linalg.svd(np.stack([columns.real, columns.imag], axis=1), full_matrices=False)
    angle = np.linspace(0, 2 * np.pi, 721)
    rim = (axes * (RADIUS * sizes)[:, None]) @ np.stack([np.cos(angle), np.sin(angle)])
    members = (rows @ posterior.mean)[:, None] + rim[:, 0] + 1j * rim[:, 1]
    law = controller.to_control(include_delay=True)
    resolvent = z[:, None, None] * np.eye(law.nstates) - law.A
    k = (law.C @ np.linalg.solve(resolvent, law.B + 0j) + law.D)[:, 0]
    loop = np.abs(1 / (1 + members * k))
    return max(
        float(np.max(specification.magnitude(plant, np.angle(z) / DT_S, each)[:, None] * loop * factor))
        for each in LoopFunction
        for factor in [np.abs(k) ** each.value[0] * np.abs(members) ** each.value[1]]
    )


def run(out: Print, *, first_seed: int = 0, seeds: int = 200) -> None:
    counts = dict.fromkeys(COUNTED, 0)
    times: list[float] = []
    nearest: list[float] = []
    out(
        "seed int modes delay order  outcome        gamma  bound/dense  proved  design s  certify s  unstable"
    )
    for seed in range(first_seed, first_seed + seeds):
        plant, posterior, specification = random_case(seed)
        head = (
            f"{seed:4d} {plant.n_integrators:3d} {posterior.poles.pairs.size // 2:5d} "
            f"{posterior.input_delay_samples:5d} {specification.controller_order:5d}  "
        )
        try:
            design = partial(synthesise, [plant], specification, LOW_EFFORT, rng=np.random.default_rng(seed))
            result, taken = timed(design)
            times.append(taken)
        except SpecificationError as error:
            counts["refused"] += 1
            counts["silent"] += "rad/s" not in str(error) and "delay" not in str(error)
            out(f"{head}refused before optimising: {str(error).split(':', 1)[1].strip()}")
            continue
        if result.outcome is Outcome.NOT_CONVERGED:
            counts["full effort"] += 1
            out(f"{head}no stable design with low effort; with the default options:")
            out(f"       {outcome(result)}")
            result = synthesise([plant], specification, rng=np.random.default_rng(seed))
        if result.outcome is Outcome.NOT_CONVERGED:
            counts["not converged"] += 1
            counts["silent"] += not result.blocking
            out(f"{head}no stable design found")
            out(f"       {outcome(result)}")
            continue
        counts["designs"] += 1
        certificate, spent = timed(partial(certify, result.controller, [plant], specification))
        proof = certificate.plants[0].all_frequencies
        unstable = unstable_samples(result.controller, posterior, np.random.default_rng([seed, 2]))
        if proof.proved:
            sampled = sampled_gain(
                result.controller, plant, posterior, specification, np.random.default_rng([seed, 3])
            )
            nearest.append(sampled / proof.gamma)
            counts["false"] += nearest[-1] > 1
        counts["unstable"] += unstable > 0 or not certificate.plants[0].stable
        counts["proved"] += proof.proved
        counts["met"] += certificate.certified
        ratio = proof.gamma / certificate.gamma if np.isfinite(proof.gamma) else np.inf
        out(
            f"{head}{result.outcome.name:12s} {certificate.gamma:7.3f}  {ratio:11.5f}  "
            f"{proof.proved!s:>6}  {taken:8.2f}  {spent:9.2f}  {unstable:3d} of {SAMPLED}"
        )
        if not proof.proved:
            out(f"       {proof.obstacle.value}")
        if result.outcome is Outcome.NOT_MET:
            counts["silent"] += not result.blocking
            out(f"       {outcome(result)}")
    out()
    out(", ".join(f"{key} {value}" for key, value in counts.items()))
    out(MEANING)
    out(f"sampled gain over the proved one: median {np.median(nearest):.4f}, largest {np.max(nearest):.5f}")
    out(f"CPU seconds of a design: median {np.median(times):.2f}, largest {np.max(times):.2f}")


if __name__ == "__main__":
    main(run)
