"""Two multivariable design problems and their exact judges, numpy only: nothing of the product is used.

T: two joints with one flexible mode per link and a ball of uncertainty around the response, time in seconds.
D: the distillation column of Skogestad and Postlethwaite, time in minutes. Negative feedback, u = -K y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Array = np.ndarray
# Complex s (F,) -> (F, rows, columns)
Response = Callable[[Array], Array]

TS = 0.004
CHI = np.sqrt(15.507313 / 2)
LO = np.array([[1.0, 0.0], [0.36, 1.2]])


def solve(a: Array, b: Array) -> Array:
    return np.linalg.solve(a, b)


def herm(a: Array) -> Array:
    return np.conj(np.swapaxes(a, -1, -2))


def two_joints() -> tuple[Array, Array, Array]:
    """A, B, C of problem T at zero-order hold with one sample of delay, 10 states."""
    m = np.array([[2, 0.6, 0.45, 0.25], [0.6, 0.6, 0.1, 0.3], [0.45, 0.1, 1, 0], [0.25, 0.3, 0, 1]])
    damping = np.diag([5, 2, 2 * 0.004 * 12, 2 * 0.006 * 26])
    stiffness = np.diag([0.1, 0.04, 144, 676])
    force = np.vstack([np.diag([2.5, 1.5]), np.zeros((2, 2))])
    a = np.block([[np.zeros((4, 4)), np.eye(4)], [-solve(m, stiffness), -solve(m, damping)]])
    b = np.vstack([np.zeros((4, 2)), solve(m, force)])
    whole = np.zeros((10, 10))
    whole[:8, :8] = a * TS
    whole[:8, 8:] = b * TS
    power = np.eye(10)
    exponential = np.eye(10)
    for k in range(1, 40):  # |A Ts| < 3: the series reaches rounding by then
        power = power @ whole / k
        exponential = exponential + power
    late = np.zeros((10, 10))
    late[:8] = exponential[:8]
    c = np.zeros((2, 10))
    c[0, 0] = c[1, 1] = 1.0
    return late, np.vstack([np.zeros((8, 2)), np.eye(2)]), c


def nominal_t(s: Array) -> Array:
    z = (1 + s * TS / 2) / (1 - s * TS / 2)
    a, b, c = two_joints()
    return c @ solve(z[:, None, None] * np.eye(10) - a, b + 0j)


MODES_T = ((12.62, 0.0055, (1.0, -0.25)), (28.2, 0.0032, (0.35, -1.0)))


def slow_t(s: Array) -> Array:
    return 0.008 * (s / 10 + 1) * (s / 300 + 1) / ((s + 0.02) * (s / 3 + 1))


SHAPE_T = np.array([[1, 0.3], [0, np.sqrt(0.91)]]) @ np.diag([0.5, 0.75])


def factor_t(s: Array) -> Array:
    """Li (F, 4, 2) with Li^H Li = P."""
    rows = [slow_t(s)[:, None, None] * SHAPE_T]
    for w, a, v in MODES_T:
        f = 0.008 * a / (s**2 / w**2 + 0.04 * s / w + 1)
        rows.append(f[:, None, None] * np.array(v)[None, None, :])
    return np.concatenate(rows, axis=1)


def diagonal(values: list[Array]) -> Array:
    return np.stack(values, axis=-1)[..., None] * np.eye(len(values))


def w1_t(s: Array) -> Array:
    return diagonal([(s / 2 + b) / (s + 0.001 * b) for b in (5.0, 7.5)])


def w3_t(s: Array) -> Array:
    return diagonal([(s / 60 + 1) / (u * (s / 1500 + 1)) for u in (240.0, 160.0)])


def grid_t(finer: int = 1) -> Array:
    """omega (F,) of the judge of T, rad/s."""
    low = 1e-3
    high = 0.9999 * np.pi / TS
    t = np.linspace(-6, 6, 150 * finer)
    near = [f * np.exp(0.5 * np.sinh(t) / np.sinh(6)) for f in (12, 12.62, 26, 28.2)]
    omega = np.concatenate([np.geomspace(low, high, 500 * finer), *near])
    is_inside = (omega >= low) & (omega <= high)
    return np.sort(omega[is_inside])


def stable_t(a: Array, b: Array, c: Array, d: Array) -> bool:
    """Whether K(s) = C (sI - A)^-1 B + D by Tustin's rule stabilises the nominal plant of T."""
    n = a.shape[0]
    inverse = np.linalg.inv(np.eye(n) - a * TS / 2)
    ad = inverse @ (np.eye(n) + a * TS / 2)
    bd = inverse @ b * TS
    cd = c @ inverse
    dd = d + c @ inverse @ b * TS / 2
    ga, gb, gc = two_joints()
    closed = np.block([[ga - gb @ dd @ gc, -gb @ cd], [bd @ gc, ad]])
    return bool(np.max(np.abs(np.linalg.eigvals(closed))) < 1)


def worst_gain(m11: Array, m12: Array, m21: Array, m22: Array, chi: float) -> Array:
    """Largest norm of the upper LFT over the ball, per frequency (F,): one convex scalar search, exact."""
    h11 = herm(m11) @ m11
    h12 = herm(m11) @ m12
    norm = chi * np.linalg.norm(m11, 2, axis=(1, 2))
    inside = norm < 1
    eye1 = np.eye(m11.shape[2])
    r11 = herm(m21) @ m21
    r12 = herm(m21) @ m22
    r22 = herm(m22) @ m22
    c2 = chi**2
    g22 = herm(m12) @ m12
    base = eye1 - c2 * h11
    inverse = np.linalg.inv(np.where(inside[:, None, None], base, eye1))
    # A > 0 from here on: x0 = largest eigenvalue of M21'M21 against I - chi^2 M11'M11.
    least = np.max(np.linalg.eigvals(inverse @ r11).real, axis=1)

    def value(log_x: Array) -> Array:
        x = (np.maximum(least, 1e-300) * (1 + np.exp(log_x)))[:, None, None]
        a = x * np.where(inside[:, None, None], base, eye1) - r11
        b = x * c2 * h12 + r12
        whole = x * c2 * g22 + r22 + herm(b) @ np.linalg.solve(a, b)
        return np.linalg.eigvalsh((whole + herm(whole)) / 2)[:, -1]

    low = np.full(norm.size, -30.0)
    high = np.full(norm.size, 40.0)
    share = (np.sqrt(5) - 1) / 2
    left = high - share * (high - low)
    right = low + share * (high - low)
    f_left = value(left)
    f_right = value(right)
    for _ in range(90):
        smaller = f_left < f_right
        high = np.where(smaller, right, high)
        low = np.where(smaller, low, left)
        new = np.where(smaller, high - share * (high - low), low + share * (high - low))
        f_new = value(new)
        left, f_left, right, f_right = (
            np.where(smaller, new, right),
            np.where(smaller, f_new, f_right),
            np.where(smaller, left, new),
            np.where(smaller, f_left, f_new),
        )
    return np.where(inside, np.sqrt(np.maximum(np.minimum(f_left, f_right), 0)), np.inf)


@dataclass(frozen=True)
class Judged:
    """Worst cases of T: of W1 S, of W3 K S, the larger, and the larger one of the nominal plant."""

    sensitivity: float
    effort: float
    nominal: float

    @property
    def gamma(self) -> float:
        return max(self.sensitivity, self.effort)


def judge_t(
    a: Array, b: Array, c: Array, d: Array, *, ball: float = 1.0, omega: Array | None = None
) -> Judged:
    """The exact judge of T for K(s) in Tustin's s; infinite for an unstable nominal loop."""
    if not stable_t(a, b, c, d):
        return Judged(np.inf, np.inf, np.inf)
    omega = grid_t() if omega is None else omega
    s = 2j / TS * np.tan(omega * TS / 2)
    k = c @ solve(s[:, None, None] * np.eye(a.shape[0]) - a, b + 0j) + d
    g = nominal_t(s)
    li = factor_t(s)
    s0 = np.linalg.inv(np.eye(2) + g @ k)
    largest = []
    nominal = 0.0
    for weighted in (w1_t(s) @ s0, w3_t(s) @ k @ s0):
        # chi goes with Li: |Delta| <= 1 then, and the formula's chi is 1.
        chi = CHI * ball
        m = chi * li @ k @ s0
        largest.append(float(np.max(worst_gain(m @ LO, m, weighted @ LO, weighted, 1.0))))
        nominal = max(nominal, float(np.max(np.linalg.norm(weighted, 2, axis=(1, 2)))))
    return Judged(*largest, nominal)


def reference_t() -> tuple[Array, Array, Array, Array]:
    """The decentralised PI with lead of the reference table."""
    parts = []
    for k, wi, zero, pole in ((8.0255, 0.0467, 1.1844, 28.1681), (12.7493, 0.0263, 3.2877, 55.733)):
        top = k * np.polymul([1, wi], [1 / zero, 1])
        bottom = np.polymul([1, 0], np.polymul([1 / pole, 1], [1 / pole, 1]))
        top = top / bottom[0]
        bottom = bottom / bottom[0]
        companion = np.array([[0.0, 1, 0], [0, 0, 1], -bottom[:0:-1]])
        parts.append((companion, np.array([[0.0], [0], [1]]), top[::-1][None, :]))
    (a1, b1, c1), (a2, b2, c2) = parts
    zero = np.zeros
    return (
        np.block([[a1, zero((3, 3))], [zero((3, 3)), a2]]),
        np.block([[b1, zero((3, 1))], [zero((3, 1)), b2]]),
        np.block([[c1, zero((1, 3))], [zero((1, 3)), c2]]),
        zero((2, 2)),
    )


def order_six_t() -> tuple[Array, Array, Array, Array]:
    """The order-6 controller printed with the problem: 0.9553."""
    blocks = (
        [[-81.2414, 326.846], [-8.13658, 3.55148]],
        [[-7.30426, 6.85005], [-85.8054, -20.0084]],
        [[-0.00918594, -0.00543475], [-0.00198963, -0.0183786]],
    )
    a = np.zeros((6, 6))
    for i, block in enumerate(blocks):
        a[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    b = [
        [-62.7525, 23.9005], [-29.716, -76.3773], [-0.883429, -6.57177],
        [62.0402, 9.87791], [-1.79541, 1.04241], [-2.41414, 1.9736],
    ]  # fmt: skip
    c = [
        [6.34427, -7.40113, -20.7714, 54.8089, -0.0578521, -0.197825],
        [23.2358, -86.2176, 12.544, 24.3638, -0.530504, 0.449314],
    ]
    return a, np.array(b), np.array(c), np.array([[2.53822, -3.27633], [-0.228401, 3.65572]])


GAIN_D = np.array([[87.8, -86.4], [108.2, -109.6]])


def nominal_d(s: Array) -> Array:
    return GAIN_D / (75 * s + 1)[:, None, None]


def w_i(s: Array) -> Array:
    return (s + 0.2) / (0.5 * s + 1)


def w_p(s: Array) -> Array:
    return (s / 2 + 0.05) / (s + 1e-6)


def judge_d(k: Response) -> float:
    """mu of problem D: the D-scaled bound, exact for its three blocks. Stability is the caller's."""
    omega = np.geomspace(1e-6, 1e4, 1201)
    s = 1j * omega
    g = nominal_d(s)
    kk = k(s)
    s0 = np.linalg.inv(np.eye(2) + g @ kk)
    ks = kk @ s0
    wi = w_i(s)[:, None, None]
    wp = w_p(s)[:, None, None]
    m = np.concatenate(
        [np.concatenate([wi * ks @ g, wi * ks], axis=2), np.concatenate([wp * s0 @ g, wp * s0], axis=2)],
        axis=1,
    )

    def norm(x: Array) -> Array:
        left = np.exp(np.concatenate([x, np.zeros_like(x)], axis=1))
        return np.linalg.norm(left[:, :, None] * m / left[:, None, :], 2, axis=(1, 2))

    # Convex in the logarithms of the scalings: descent by halved steps along eight directions.
    x = np.zeros((omega.size, 2))
    x += (
        0.5
        * np.log(np.linalg.norm(m[:, 2:, :2], axis=(1, 2)) / np.linalg.norm(m[:, :2, 2:], axis=(1, 2)))[
            :, None
        ]
    )
    best = norm(x)
    step = np.full(omega.size, 1.0)
    angles = np.arange(8) * np.pi / 4
    for _ in range(150):
        moved = False
        gained = np.zeros(omega.size, dtype=bool)
        for angle in angles:
            trial = x + step[:, None] * np.array([np.cos(angle), np.sin(angle)])
            value = norm(trial)
            better = value < best
            x = np.where(better[:, None], trial, x)
            best = np.where(better, value, best)
            gained |= better
            moved |= bool(np.any(better))
        step = np.where(gained, step, step / 2)
        if not moved and np.max(step) < 1e-9:
            break
    return float(np.max(best))


def inverse_d(s: Array) -> Array:
    """The check controller of D: .7/s G^-1, its pole at 1e-5."""
    return (0.7 * (75 * s + 1) / (s + 1e-5))[:, None, None] * np.linalg.inv(GAIN_D)
