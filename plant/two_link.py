"""A planar arm of two flexible links with motors in shoulder and elbow, at large angles.

Link i bends by w_i(x), a sum of shapes phi_k(x) times a_k, across its undeformed axis, which turns with its
root:

    theta_1 shoulder angle, psi = theta_1 + w_1'(L_1) + theta_2 that of link 2's root.

In the axes of a link whose root moves with v and turns with omega, its point x moves with v_along - omega w
and v_across + omega x + w', so that each kinetic energy is a quadratic form of a few integrals over the link.
Lagrange's equations are taken from it by automatic differentiation: Coriolis and centrifugal forces included.
Neglected: axial shortening of a bent link (so no stiffening by centrifugal force), shear, rotary inertia of
the section, motor inductance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from plant.beam import clamped_free_modes
from plant.rig import Hub, Link, Motor

Real = npt.NDArray[np.float64]

_CREEP_RAD_S = 0.01  # speed at which dry friction reaches three quarters of its level
_STEP = 0.6  # of a step of integration, over the fastest time constant of the arm at rest


@dataclass(frozen=True)
class TwoLinkArm:
    """links, hubs, motors: shoulder's first. elbow_mass_kg: the elbow motor, at the tip of link 1.
    payload_kg: at the tip of link 2. coulomb_Nm: dry friction of each joint. gravity_m_s2: along minus y, 0
    for an arm in a horizontal plane. n_modes: of each link, clamped and with what it carries as a point mass
    at its tip; link 1 also bends as under a moment at its tip.

    Coordinates q: theta_1, theta_2, n_modes + 1 of link 1, n_modes of link 2. Raises ValueError for a mass,
    friction or number that is negative or none, or a hub with a radius.
    """

    links: tuple[Link, Link]
    hubs: tuple[Hub, Hub]
    motors: tuple[Motor, Motor]
    elbow_mass_kg: float = 0.0
    payload_kg: float = 0.0
    coulomb_Nm: tuple[float, float] = (0.0, 0.0)
    gravity_m_s2: float = 0.0
    n_modes: int = 1

    def __post_init__(self) -> None:
        if any(hub.radius_m != 0 for hub in self.hubs):
            raise ValueError("both hub radii must be zero")
        sizes = (self.elbow_mass_kg, self.payload_kg, *self.coulomb_Nm)
        if not all(0 <= size < np.inf for size in sizes) or self.n_modes < 1:
            raise ValueError(f"masses and friction must not be negative, n_modes at least 1; got {sizes}")

    @cached_property
    def _shapes(self) -> tuple[_Bending, _Bending]:
        far = self.links[1].mass_per_length_kg_m * self.links[1].length_m + self.payload_kg
        return (
            _Bending.of(self.links[0], self.n_modes, self.elbow_mass_kg + far, under_moment=True),
            _Bending.of(self.links[1], self.n_modes, self.payload_kg, under_moment=False),
        )

    @cached_property
    def coordinates(self) -> int:
        """Number of coordinates q."""
        return 2 + sum(each.at_tip.size for each in self._shapes)

    @cached_property
    def _rates(self) -> Any:
        """CasADi function (q, q', u) -> q''."""
        import casadi as ca  # takes its time to load

        first, second = self._shapes
        n, split = self.coordinates, 2 + first.at_tip.size
        q, v, u = (ca.SX.sym(name, size) for name, size in (("q", n), ("v", n), ("u", 2)))
        a, da, b, db = q[2:split], v[2:split], q[split:], v[split:]

        def rate(value: Any) -> Any:
            return ca.jtimes(value, q, v)

        turn_1 = q[0]
        turn_2 = q[0] + ca.dot(first.slope_at_tip, a) + q[1]
        along_1 = ca.vertcat(ca.cos(turn_1), ca.sin(turn_1))
        elbow = self.links[0].length_m * along_1 + ca.dot(first.at_tip, a) * _across(along_1)
        along_2 = ca.vertcat(ca.cos(turn_2), ca.sin(turn_2))
        tip = elbow + self.links[1].length_m * along_2 + ca.dot(second.at_tip, b) * _across(along_2)
        root = rate(elbow)
        kinetic = first.kinetic(0, 0, v[0], a, da) + second.kinetic(
            ca.dot(root, along_2), ca.dot(root, _across(along_2)), rate(turn_2), b, db
        )
        kinetic += 0.5 * (self.elbow_mass_kg * ca.sumsqr(root) + self.payload_kg * ca.sumsqr(rate(tip)))
        kinetic += 0.5 * sum(
            hub.inertia_kg_m2 * rate(turn) ** 2 for hub, turn in zip(self.hubs, (turn_1, turn_2), strict=True)
        )
        height = (
            first.static_moment(along_1[1], _across(along_1)[1], 0, a)
            + second.static_moment(along_2[1], _across(along_2)[1], elbow[1], b)
            + self.elbow_mass_kg * elbow[1]
            + self.payload_kg * tip[1]
        )
        springs = 0.5 * (ca.bilin(first.spring, a, a) + ca.bilin(second.spring, b, b))
        potential = springs + self.gravity_m_s2 * height

        momentum = ca.gradient(kinetic, v)
        force = ca.gradient(kinetic, q) - ca.jtimes(momentum, q, v) - ca.gradient(potential, q)
        losses = ca.vertcat(
            *(
                (hub.viscous_friction_Nms + motor.back_emf_damping_Nms) * v[i]
                + self.coulomb_Nm[i] * ca.tanh(v[i] / _CREEP_RAD_S)
                - motor.torque_per_volt_Nm_V * u[i]
                for i, (hub, motor) in enumerate(zip(self.hubs, self.motors, strict=True))
            ),
            self.links[0].kelvin_voigt_s * (first.spring @ da),
            self.links[1].kelvin_voigt_s * (second.spring @ db),
        )
        mass = ca.ldl(ca.hessian(kinetic, v)[0])  # a third of the operations of a general solution
        return ca.Function("rates", [q, v, u], ca.cse([ca.ldl_solve(force - losses, *mass)]))

    def sampled(self, dt_s: float) -> Any:
        """CasADi function (x, u) -> x one sample later, u held; x = (q, q'), by Runge-Kutta steps."""
        import casadi as ca

        fastest = float(np.max(np.abs(np.linalg.eigvals(self.linear(0.0)[0]))))
        steps = max(1, int(np.ceil(dt_s * fastest / _STEP)))
        x, u = ca.SX.sym("x", 2 * self.coordinates), ca.SX.sym("u", 2)

        def slope(at: Any) -> Any:
            q, v = ca.vertsplit(at, self.coordinates)
            return ca.vertcat(v, self._rates(q, v, u))

        h = dt_s / steps
        k1 = slope(x)
        k2 = slope(x + 0.5 * h * k1)
        k3 = slope(x + 0.5 * h * k2)
        k4 = slope(x + h * k3)
        once = ca.Function("once", [x, u], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
        if steps == 1:
            return once
        all_of = once.mapaccum("sample", steps)
        return ca.Function("sample", [x, u], [all_of(x, ca.repmat(u, 1, steps))[:, -1]])

    def linear(self, elbow_rad: float) -> tuple[Real, Real]:
        """A (2n, 2n) and B (2n, 2) of x = (q, q') around rest at an elbow angle, without dry friction and
        gravity."""
        import casadi as ca

        n = self.coordinates
        free = TwoLinkArm(
            self.links, self.hubs, self.motors, self.elbow_mass_kg, self.payload_kg, n_modes=self.n_modes
        )
        x, u = ca.SX.sym("x", 2 * n), ca.SX.sym("u", 2)
        slope = ca.vertcat(x[n:], free._rates(x[:n], x[n:], u))
        found = ca.Function("linear", [x, u], [ca.jacobian(slope, x), ca.jacobian(slope, u)])
        rest = np.zeros(2 * n)
        rest[1] = elbow_rad
        a, b = found(rest, np.zeros(2))
        return np.asarray(a.full()), np.asarray(b.full())

    def rest(self, angles_rad: tuple[float, float]) -> tuple[Real, Real]:
        """State (2n,) at rest with these joint angles, and the voltages (2,) that hold it against gravity."""
        n, angles = self.coordinates, np.asarray(angles_rad, dtype=np.float64)

        def pulled(unknown: Real) -> Real:
            q = np.concatenate([angles, unknown[2:]])
            return np.asarray(self._rates(q, np.zeros(n), unknown[:2]).full())[:, 0]

        held = np.zeros(n)
        if self.gravity_m_s2:
            import scipy.optimize  # takes its time to load

            held = np.asarray(scipy.optimize.root(pulled, held, tol=1e-12).x)
        return np.concatenate([angles, held[2:], np.zeros(n)]), held[:2]


_sampler = lru_cache(maxsize=16)(TwoLinkArm.sampled)  # a run makes machines of the same arm


class TwoLinkMachine:
    """The arm sampled every dt_s around rest at the given joint angles: commands are voltages beyond those
    that hold it, measurements joint angles from there, with normal noise of noise_rad."""

    def __init__(
        self,
        arm: TwoLinkArm,
        angles_rad: tuple[float, float],
        dt_s: float,
        noise_rad: float,
        rng: np.random.Generator,
    ) -> None:
        self.dt_s, self._noise, self._rng = dt_s, noise_rad, rng
        self._rest, self._hold = arm.rest(angles_rad)
        # Arrays of its own: to convert them at every sample would take as long as the integration.
        self._x, self._u, self._next = self._rest.copy(), np.zeros(2), np.empty(self._rest.size)
        self._buffer, self._sample = _sampler(arm, dt_s).buffer()
        self._buffer.set_arg(0, self._x.data)
        self._buffer.set_arg(1, self._u.data)
        self._buffer.set_res(0, self._next.data)

    def reset(self) -> None:
        self._x[:] = self._rest

    def measure(self) -> Real:
        """Joint angles (2,) from the operating point."""
        return np.asarray(self._x[:2] - self._rest[:2] + self._noise * self._rng.standard_normal(2))

    def advance(self, u: Real) -> None:
        """Hold the voltages (2,) for one sample."""
        self._u[:] = self._hold + u
        self._sample()
        self._x[:] = self._next

    def run(self, u: Real) -> Real:
        """Joint angles (T, 2) as measured, before each of the voltages (T, 2) is applied, from rest."""
        self.reset()
        found = np.empty(u.shape)
        for k, now in enumerate(u):
            found[k] = self.measure()
            self.advance(now)
        return found


@dataclass(frozen=True, eq=False)
class _Bending:
    """Integrals over a link with mass per length m: mass, of x, of x^2; of phi (K,), of x phi (K,), of phi
    phi' (K, K); bending stiffness (K, K); shapes and slopes (K,) at the tip."""

    mass: float
    first: float
    second: float
    shape: Real
    arm: Real
    square: Real
    spring: Real
    at_tip: Real
    slope_at_tip: Real

    @classmethod
    def of(cls, link: Link, n_modes: int, tip_mass_kg: float, *, under_moment: bool) -> _Bending:
        length, ei, m = link.length_m, link.bending_stiffness_Nm2, link.mass_per_length_kg_m
        modes = clamped_free_modes(ei, m, length, n_modes, tip_mass_kg)
        nodes, weights = np.polynomial.legendre.leggauss(8 * n_modes + 16)
        x, area = np.append(0.5 * length * (nodes + 1), length), np.append(0.5 * length * weights, 0.0)
        bent: list[Any] = [modes.shape(x), modes.slope(x), modes.curvature(x)]
        if under_moment:
            more = (x / length) ** 2, 2 * x / length**2, np.full(x.size, 2 / length**2)
            bent = [np.column_stack(pair) for pair in zip(bent, more, strict=True)]
        shape, slope, curvature = bent
        dm = m * area
        return cls(
            mass=m * length, first=m * length**2 / 2, second=m * length**3 / 3, shape=dm @ shape,
            arm=(dm * x) @ shape, square=shape.T @ (dm[:, None] * shape),
            spring=ei * curvature.T @ (area[:, None] * curvature), at_tip=shape[-1], slope_at_tip=slope[-1],
        )  # fmt: skip

    def kinetic(self, along: Any, across: Any, turn: Any, a: Any, da: Any) -> Any:
        """Energy of the link for the velocity of its root in its axes, its angular velocity, a and a'."""
        import casadi as ca

        bent, moved = ca.dot(self.shape, a), ca.dot(self.shape, da)
        energy = self.mass * (along**2 + across**2) - 2 * along * turn * bent
        energy += turn**2 * (ca.bilin(self.square, a, a) + self.second) + ca.bilin(self.square, da, da)
        energy += 2 * across * (turn * self.first + moved) + 2 * turn * ca.dot(self.arm, da)
        return 0.5 * energy

    def static_moment(self, along_y: Any, across_y: Any, root_y: Any, a: Any) -> Any:
        """Integral of the height over the link's mass."""
        import casadi as ca

        return self.mass * root_y + self.first * along_y + ca.dot(self.shape, a) * across_y


def _across(along: Any) -> Any:
    """The direction across an axis, counter-clockwise."""
    import casadi as ca

    return ca.vertcat(-along[1], along[0])
