"""Controllers as people write them, certified; every number of the certificate against eigenvalues and dense
responses computed here, which share no code with `control_design`.

Stability for a gain, a rotation or a member of the uncertainty set is decided by eigenvalues of the closed
loop; the delay margin by the zeros of L(z) L(1/z) - 1, a generalised eigenvalue problem; peaks by dense
responses around every pole. Members of the set are G (1 + r a(z)), a an all-pass of either sign. A number is
false where it promises more than that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg

from benchmarks.harness import Print, main

_DT_S = 0.01
# Relative error to which eigenvalues next to the circle are trusted.
_SLACK = 1e-6
# Distance of a pole from the circle that counts as none, for the same reason.
_RADIUS = 1e-9

# A (n, n), B (n, 1), C (1, n), D.
System = tuple[Any, Any, Any, float]


def run(out: Print, *, controllers: int = 1000, seed: int = 47) -> None:
    """Count numbers that promise too much."""
    rng = np.random.default_rng(seed)
    false: list[str] = []
    stable = certified = numbers = loose = 0
    for number in range(controllers):
        case = drawn_case(rng)
        false_claims, stable_and_certified, checked, cautious = checked_case(case, rng)
        stable = stable + stable_and_certified[0]
        certified = certified + stable_and_certified[1]
        numbers = numbers + checked
        loose = loose + cautious
        false += [f"controller {number} ({case['kind']} on {case['plant']}): {line}" for line in false_claims]
    for line in false:
        out(line)
    out(f"{controllers} controllers, {stable} stable, {certified} certified; {numbers} numbers checked")
    out(f"false: {len(false)}; nominal gain margins more than .1 % too careful: {loose}")


def drawn_case(rng: np.random.Generator) -> dict[str, Any]:
    """A plant, a controller, a delay and a relative uncertainty, drawn."""
    plants = _plants(rng)
    name = str(rng.choice(list(plants)))
    plant = plants[name]
    kinds = _controllers(rng)
    kind = str(rng.choice(list(kinds)))
    k = kinds[kind]
    delay = int(rng.integers(0, 4))
    grid = np.geomspace(1e-3, np.pi, 400)
    loop = np.abs(_response(_series(k, plant), grid))
    gain = (
        10 ** rng.uniform(-1.5, 0.8) / max(float(np.median(loop)), 1e-9) * rng.choice([-1, 1], p=[0.25, 0.75])
    )
    if rng.uniform() < 0.7:  # most of those that stabilise, and some on the edge
        gains = gain * 10 ** rng.uniform(-3, 2, 40)
        good = [g for g in gains if _radius(_loop(k, plant, delay), float(g)) < 1]
        if good:
            gain = good[0]
            if rng.uniform() < 0.3:
                gain = _edge(_loop(k, plant, delay), gain)
    k = (k[0], k[1], k[2] * gain, k[3] * gain)
    relative = float(rng.choice([0.0, 10 ** rng.uniform(-3, -0.5)]))
    return {"plant": name, "kind": kind, "G": plant, "K": k, "delay": delay, "relative": relative}


def checked_case(
    case: dict[str, Any], rng: np.random.Generator
) -> tuple[list[str], tuple[bool, bool], int, int]:
    """What the certificate says falsely; (stable, certified); numbers checked; margins too careful."""
    import control

    from control_design import Controller, Specification, UncertainPlant, certify
    from control_design.plants.stated_uncertainty import StatedDiscs
    from control_design.plants.weights import RationalWeight

    nominal = control.ss(*case["G"][:3], [[case["G"][3]]], _DT_S)
    relative = case["relative"]
    loop = _loop(case["K"], case["G"], case["delay"])
    discs = RationalWeight(numerator=(relative or 1.0,), denominator=(1.0,))
    plant = UncertainPlant(
        nominal, name="plant", uncertainty=StatedDiscs(nominal, discs) if relative else None
    )
    a, b, c, d = case["K"]
    controller = Controller(a, b, c, [[d]], _DT_S, computational_delay_samples=case["delay"])
    asked = Specification(modulus_margin=0.3, computational_delay_samples=case["delay"])
    answer = certify(controller, [plant], asked)
    (verdict,) = answer.plants
    false: list[str] = []
    radius = _radius(loop, 1.0)
    if abs(radius - 1) > _RADIUS and verdict.stable != (radius < 1):
        false.append(f"stable {verdict.stable}, pole radius {radius}")
    if not (verdict.stable and radius < 1):
        return false + (["certified, though unstable"] if answer.certified else []), (False, False), 1, 0
    members = [loop]
    for _ in range(6 if relative and verdict.worst_margins.modulus > 0 else 0):
        # Real all-pass of either sign: z-plane pole anywhere inside the circle.
        pole = float(rng.choice([-1, 1]) * (1 - 10 ** rng.uniform(-3, 0)))
        size = float(relative * rng.choice([-1, 1])) * (1 - 1e-9)
        member = ([[pole]], [[1.0]], [[size * (1 - pole**2)]], 1.0 - size * pole)
        members.append(_series(loop, _system(member)))
    claims = [(verdict.nominal_margins, members[0]), *((verdict.worst_margins, m) for m in members)]
    numbers = 1
    for at, (margins, claimed_loop) in enumerate(claims):
        word = "nominal" if at == 0 else "worst"
        numbers += 5
        if not _radius(claimed_loop, 1.0) < 1 + _RADIUS:
            false.append(f"{word}: a member is unstable, modulus {margins.modulus:.6g}")
            continue
        high = min(margins.gain_up, 1e6)
        low = max(margins.gain_down, 1e-6)
        for word_2, end in (("gain_up", high * (1 - _SLACK)), ("gain_down", low * (1 + _SLACK))):
            gains = np.append(np.geomspace(1.0, end, 30), end)
            bad = [float(g) for g in gains if not _radius(claimed_loop, float(g)) < 1 + _RADIUS]
            if bad:
                false.append(f"{word} {word_2} {getattr(margins, word_2):.8g}: unstable at {bad[0]:.8g}")
        turn = min(margins.phase_rad, np.pi) * (1 - _SLACK)
        bad = [
            t for t in np.linspace(0, turn, 25) if not _radius(claimed_loop, np.exp(-1j * t)) < 1 + _RADIUS
        ]
        if bad:
            false.append(f"{word} phase {margins.phase_rad:.8g}: unstable at {bad[0]:.8g}")
        least = _delay_margin(claimed_loop)
        if margins.delay_s > least * (1 + _SLACK):
            false.append(f"{word} delay {margins.delay_s:.8g}, true {least:.8g}")
        theta = _around(claimed_loop)
        back = np.abs(1 + _response(claimed_loop, theta))
        nearest = float(np.min(back))
        if margins.modulus > nearest * (1 + _SLACK):
            false.append(f"{word} modulus {margins.modulus:.8g}, true {nearest:.8g}")
        proof = verdict.all_frequencies
        if proof.proved:
            numbers += 2
            if proof.distance > nearest * (1 + _SLACK):
                false.append(f"proved distance {proof.distance:.8g}, true {nearest:.8g}")
            if answer.gamma_bound is None or answer.gamma_bound < asked.modulus_margin / nearest * (
                1 - _SLACK
            ):
                false.append(f"gamma_bound {answer.gamma_bound}, true {asked.modulus_margin / nearest:.8g}")
        within = theta <= verdict.bandwidth_rad_s * _DT_S
        if np.any(within) and np.min(back[within]) < np.sqrt(2) * (1 - 1e-4):
            false.append(f"bandwidth {verdict.bandwidth_rad_s:.6g}: |1 + L| {np.min(back[within]):.6g}")
    up = verdict.nominal_margins.gain_up
    careful = 0
    if up < 1e6 and _radius(loop, up * 1.001) < 1 - _RADIUS:
        careful = 1
    return false, (True, answer.certified), numbers, careful


def _system(given: Any) -> System:
    a, b, c, d = given
    return np.atleast_2d(a), np.asarray(b, float), np.asarray(c, float), float(d)


def _series(first: System, second: System) -> System:
    """second after first."""
    (a, b, c, d) = first
    (e, f, g, h) = second
    n = a.shape[0]
    m = e.shape[0]
    whole = np.block([[a, np.zeros((n, m))], [f @ c, e]])
    return whole, np.vstack([b, f * d]), np.hstack([h * c, g]), h * d


def _loop(k: System, g: System, delay: int) -> System:
    chain: System = (np.eye(delay, k=-1), np.eye(delay, 1), np.eye(delay)[-1:, :], 0.0)
    loop = _series(k, chain) if delay else k
    return _series(loop, g)


def _radius(loop: System, gain: complex) -> float:
    """Largest pole modulus of 1 + gain L = 0."""
    a, b, c, d = loop
    back = 1 + gain * d
    if abs(back) < 1e-12:
        return float("inf")
    return float(np.max(np.abs(np.linalg.eigvals(a - (gain / back) * b @ c)), initial=0.0))


def _response(loop: System, theta: Any) -> Any:
    """L(e^{j theta}) by a Hessenberg-free solve, (F,)."""
    a, b, c, d = loop
    if not a.shape[0]:
        return np.full(np.shape(theta), complex(d))
    z_1 = np.expm1(1j * np.asarray(theta))
    matrices = z_1[:, None, None] * np.eye(a.shape[0]) - (a - np.eye(a.shape[0]))
    states = np.linalg.solve(matrices, np.broadcast_to(b.astype(complex), (z_1.size, *b.shape)))
    return (c @ states)[:, 0, 0] + d


def _around(loop: System) -> Any:
    """Angles: logarithmic, and geometric around every pole of the loop, open and closed."""
    a, b, c, d = loop
    poles = np.concatenate([np.linalg.eigvals(a), np.linalg.eigvals(a - b @ c / (1 + d))])
    parts = [np.geomspace(1e-7, np.pi, 3000)]
    is_slow = np.abs(poles) > 0.5
    for p in poles[is_slow]:
        away = np.geomspace(max(abs(1 - abs(p)), 1e-9) / 30, 0.3, 120)
        parts += [abs(np.angle(p)) + away, abs(np.angle(p)) - away]
    theta = np.unique(np.concatenate(parts))
    is_inside = (theta > 1e-7) & (theta <= np.pi)
    return theta[is_inside]


def _delay_margin(loop: System) -> float:
    """Smallest delay at which 1 + L e^{-j omega delay} vanishes, s: unit-circle zeros of L(z) L(1/z) - 1."""
    a, b, c, d = loop
    n = a.shape[0]
    identity = np.eye(a.shape[0])
    # z w = ... : x+ = A x + B v, w = z (A w + B u), v = C w + D u, and C x + D v = u.
    left = np.block([
        [a, b @ c, d * b],
        [np.zeros((n, n)), identity, np.zeros((n, 1))],
        [c, d * c, np.array([[d * d - 1.0]])],
    ])  # fmt: skip
    right = np.block([
        [identity, np.zeros((n, n + 1))],
        [np.zeros((n, n)), a, b],
        [np.zeros((1, 2 * n + 1))],
    ])  # fmt: skip
    z = scipy.linalg.eigvals(left, right)
    on_circle = np.isfinite(z) & (np.abs(np.abs(z) - 1) < 1e-7) & (z.imag > 1e-7)
    z = z[on_circle]
    theta = np.angle(z)
    if not theta.size:
        return float("inf")
    value = _response(loop, theta)
    crosses = np.abs(np.abs(value) - 1) < 1e-5
    theta = theta[crosses]
    value = value[np.abs(np.abs(value) - 1) < 1e-5]
    return float(np.min(np.mod(np.angle(-value), 2 * np.pi) / theta, initial=np.inf) * _DT_S)


def _edge(loop: System, gain: float) -> float:
    """A stable gain next to one that is not, on a random side."""
    high = gain
    for _ in range(60):
        high *= 1.3
        if not _radius(loop, high) < 1:
            break
    else:
        return gain
    low = gain
    for _ in range(30):
        middle = np.sign(low) * np.sqrt(low * high)
        low, high = (middle, high) if _radius(loop, float(middle)) < 1 else (low, middle)
    return float(low) * 0.999


def _tf(zeros: Any, poles: Any, gain: float) -> System:
    """State space in controller form of gain prod (z - q)/prod (z - p)."""
    top = np.atleast_1d(gain * np.real(np.poly(zeros)))
    bottom = np.atleast_1d(np.real(np.poly(poles)))
    n = bottom.size - 1
    top = np.concatenate([np.zeros(n + 1 - top.size), top])
    a = np.eye(n, k=-1)
    a[:1] = -bottom[1:] if n else a[:1]
    return a, np.eye(n, 1), (top[1:] - top[0] * bottom[1:])[None, :], float(top[0])


def _pair(radius: float, angle: float) -> list[complex]:
    return [radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]


def _plants(rng: np.random.Generator) -> dict[str, System]:
    u = rng.uniform
    light = float(1 - 10 ** rng.uniform(-4, -1))
    angle = float(u(0.1, 2.5))
    mode = _pair(light, angle)
    zero = _pair(light, angle * u(0.6, 1.4))
    slow = 1 - 10 ** u(-5, -0.5)
    return {
        "lag": _tf([], [slow], 1 - slow),
        "negative lag": _tf([], [slow], slow - 1),
        "unstable": _tf([], [1 + 10 ** u(-4, -0.5)], 0.1),
        "unstable, second order": _tf([-0.9], [1 + 10 ** u(-3, -1), 0.9], 0.01),
        "two unstable": _tf([u(0.7, 0.95)], _pair(1 + 10 ** u(-3, -1.3), u(0.02, 0.3)), 0.1),
        "unstable and resonant": _tf(zero, [1 + 10 ** u(-3, -1), *mode], 0.1),
        "integrator": _tf([], [1.0], 0.01),
        "integrator and mode": _tf(zero, [1.0, *mode], 0.01),
        "two integrators": _tf([-0.97], [1.0, 1.0], 1e-4),
        "resonant": _tf([u(0.3, 0.9)], mode, 0.1),
        "two modes": _tf([*zero, 0.2], [*mode, *_pair(0.99, u(0.2, 2.8))], 0.1),
        "non-minimum phase": _tf([1 + 10 ** u(-2, 0.5)], [u(0.5, 0.99), u(0.5, 0.99)], -0.05),
        "Nyquist pole": _tf([], [-light, 0.5], 0.1),
    }


def _controllers(rng: np.random.Generator) -> dict[str, System]:
    u = rng.uniform
    pairs = [p for _ in range(2) for p in _pair(u(0.2, 0.999), u(0.05, 3.0))]
    zeros = [p for _ in range(2) for p in _pair(u(0.2, 1.05), u(0.05, 3.0))]
    narrow = u(0.1, 2.8)
    return {
        "P": _tf([], [], 1.0),
        "PI": _tf([1 - 10 ** u(-3, -0.5)], [1.0], 1.0),
        "PD": _tf([1 - 10 ** u(-2.5, -0.5)], [u(0.0, 0.6)], 1.0),
        "PID": _tf([u(0.8, 0.999), u(0.5, 0.99)], [1.0, u(0.0, 0.6)], 1.0),
        "lead": _tf([u(0.8, 0.98)], [u(0.1, 0.7)], 1.0),
        "lag": _tf([u(0.5, 0.95)], [1 - 10 ** u(-4, -2)], 1.0),
        "notch": _tf(_pair(1.0, narrow), _pair(u(0.5, 0.99), narrow), 1.0),
        "biquads": _tf(zeros, pairs, 1.0),
        "biquad": _tf(zeros[:2], pairs[:2], 1.0),
        "narrow resonance": _tf(_pair(u(0.9, 1.0), narrow), _pair(1 - 10 ** u(-7, -3), narrow), 1.0),
        "slow unstable lag": _tf([u(0.2, 0.9)], [1 + 10 ** u(-4, -2)], 1.0),
    }


if __name__ == "__main__":
    main(run)
