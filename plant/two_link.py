"""A planar arm of two flexible links with motors in shoulder and elbow, at large angles.

Link i bends by w_i(x), a sum of shapes phi_k(x) times a_k, across its undeformed axis, which turns with its
root:

    theta_1 shoulder angle, psi = theta_1 + w_1'(L_1) + theta_2 that of link 2's root.

In the axes of a link whose root moves with v and turns with omega, its point x moves with v_along - omega w
and v_across + omega x + w', so that each kinetic energy is a quadratic form of a few integrals over the link.
Lagrange's equations are taken from it by automatic differentiation: Coriolis and centrifugal forces included.
Neglected: axial shortening of a bent link (so no stiffening by centrifugal force), shear, rotary inertia of
the section, motor inductance.

`TwoLinkArm` describes the arm and has its equations as CasADi functions: accelerations, one sample, linear
matrices, rest. `TwoLinkMachine` runs it sample by sample. `Bending` holds the integrals over one link.
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

# Speed at which the smoothed dry friction, level * tanh(speed / this), reaches three quarters of its level,
# rad/s. Doubled, the arm creeps twice as fast under the same load; halved, the joint is stiffer to integrate.
_CREEP_RAD_S = 0.01
# Longest Runge-Kutta step over the fastest time constant of the arm at rest. The method of order 4 is stable
# up to 2.8 on the imaginary axis; its relative error a step is about 0.6^5 / 120 = 6e-4 of the fastest mode.
# Doubled, that becomes 32 times as large.
_STEP = 0.6


@dataclass(frozen=True)
class TwoLinkArm:
    """Two flexible links in a plane, with a motor in each joint.

    Coordinates q (n,): theta_1, theta_2, n_modes + 1 of link 1, n_modes of link 2. Raises ValueError for a
    mass, friction or number that is negative or none, or a hub with a radius.

    links, hubs, motors : pairs
        Shoulder's first.
    elbow_mass_kg : float
        The elbow motor, at the tip of link 1.
    payload_kg : float
        At the tip of link 2.
    coulomb_Nm : pair of float
        Dry friction of each joint.
    gravity_m_s2 : float
        Along minus y, 0 for an arm in a horizontal plane.
    n_modes : int
        Of each link, clamped and with what it carries as a point mass at its tip; link 1 also bends as under
        a moment at its tip.
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
    def bending(self) -> tuple[Bending, Bending]:
        """Integrals over the bent links 1 and 2."""
        near, far = self.links
        # Link 1 carries elbow, link 2 and payload; for its shapes all of that is a point mass.
        carried_by_far_kg = self.payload_kg
        carried_by_near_kg = self.elbow_mass_kg + (far.mass_per_length_kg_m * far.length_m + self.payload_kg)
        return (
            Bending.of(near, self.n_modes, carried_by_near_kg, under_moment=True),
            Bending.of(far, self.n_modes, carried_by_far_kg, under_moment=False),
        )

    @cached_property
    def coordinates(self) -> int:
        """Number n of coordinates q."""
        first, second = self.bending
        return 2 + first.at_tip.size + second.at_tip.size

    @cached_property
    def _rates(self) -> Any:
        """CasADi function of q (n,), q' (n,) and voltages u (2,) that gives q'' (n,).

        Lagrange's equations M q'' = dT/dq - d(M q')/dq q' - dV/dq - losses, with the mass matrix M, kinetic
        energy T and potential V.
        """
        import casadi as ca  # takes its time to load

        first, second = self.bending
        n = self.coordinates
        split = 2 + first.at_tip.size
        q = ca.SX.sym("q", n)
        v = ca.SX.sym("v", n)
        u = ca.SX.sym("u", 2)
        # Deflections of link 1 and link 2, and their rates.
        a = q[2:split]
        b = q[split:]
        a_rate = v[2:split]
        b_rate = v[split:]

        def rate(value: Any) -> Any:
            """Derivative in time of an expression in q."""
            return ca.jtimes(value, q, v)

        # Where the links point, and where elbow and tip are.
        turn_1 = q[0]
        turn_2 = q[0] + ca.dot(first.slope_at_tip, a) + q[1]
        along_1 = ca.vertcat(ca.cos(turn_1), ca.sin(turn_1))
        along_2 = ca.vertcat(ca.cos(turn_2), ca.sin(turn_2))
        across_1 = _across(along_1)
        across_2 = _across(along_2)
        elbow = self.links[0].length_m * along_1 + ca.dot(first.at_tip, a) * across_1
        tip = elbow + self.links[1].length_m * along_2 + ca.dot(second.at_tip, b) * across_2

        # Kinetic energy of links, elbow motor, payload and hubs.
        elbow_velocity = rate(elbow)
        elbow_along_2 = ca.dot(elbow_velocity, along_2)
        elbow_across_2 = ca.dot(elbow_velocity, across_2)
        link_1 = first.kinetic(0, 0, v[0], a, a_rate)
        link_2 = second.kinetic(elbow_along_2, elbow_across_2, rate(turn_2), b, b_rate)
        kinetic = link_1 + link_2
        tip_velocity = rate(tip)
        elbow_square = self.elbow_mass_kg * ca.sumsqr(elbow_velocity)
        payload_square = self.payload_kg * ca.sumsqr(tip_velocity)
        kinetic += 0.5 * (elbow_square + payload_square)
        kinetic += 0.5 * sum(
            hub.inertia_kg_m2 * rate(turn) ** 2 for hub, turn in zip(self.hubs, (turn_1, turn_2), strict=True)
        )

        # Potential energy of bending and of gravity: height is a moment of mass, kg m.
        height = first.static_moment(along_1[1], across_1[1], 0, a)
        height = height + second.static_moment(along_2[1], across_2[1], elbow[1], b)
        height = height + self.elbow_mass_kg * elbow[1]
        height = height + self.payload_kg * tip[1]
        springs = 0.5 * (ca.bilin(first.spring, a, a) + ca.bilin(second.spring, b, b))
        potential = springs + self.gravity_m_s2 * height

        # What joints lose and motors bring, and the Kelvin-Voigt damping of the links.
        joint_losses = []
        for i, (hub, motor) in enumerate(zip(self.hubs, self.motors, strict=True)):
            viscous_Nms = hub.viscous_friction_Nms + motor.back_emf_damping_Nms
            dry_Nm = self.coulomb_Nm[i] * ca.tanh(v[i] / _CREEP_RAD_S)
            joint_losses.append(viscous_Nms * v[i] + dry_Nm - motor.torque_per_volt_Nm_V * u[i])
        losses = ca.vertcat(
            *joint_losses,
            self.links[0].kelvin_voigt_s * (first.spring @ a_rate),
            self.links[1].kelvin_voigt_s * (second.spring @ b_rate),
        )

        momentum = ca.gradient(kinetic, v)
        force = ca.gradient(kinetic, q) - ca.jtimes(momentum, q, v) - ca.gradient(potential, q)
        mass_matrix = ca.hessian(kinetic, v)[0]
        factors = ca.ldl(mass_matrix)  # a third of the operations of a general solution
        acceleration = ca.ldl_solve(force - losses, *factors)
        return ca.Function("rates", [q, v, u], ca.cse([acceleration]))

    def sampled(self, dt_s: float) -> Any:
        """CasADi function of the state x (2n,) and held voltages u (2,) that gives x one sample later.

        The state is (q, q'). A sample of dt_s seconds is divided into equal Runge-Kutta steps of order 4, as
        many as the fastest mode of the stretched arm needs.
        """
        import casadi as ca

        state_matrix, _ = self.linear(0.0)
        eigenvalues = np.linalg.eigvals(state_matrix)
        fastest_rad_s = float(np.max(np.abs(eigenvalues)))
        steps = max(1, int(np.ceil(dt_s * fastest_rad_s / _STEP)))
        x = ca.SX.sym("x", 2 * self.coordinates)
        u = ca.SX.sym("u", 2)

        def slope(state: Any) -> Any:
            """Derivative of the state in time."""
            q, v = ca.vertsplit(state, self.coordinates)
            return ca.vertcat(v, self._rates(q, v, u))

        h = dt_s / steps
        k1 = slope(x)
        k2 = slope(x + 0.5 * h * k1)
        k3 = slope(x + 0.5 * h * k2)
        k4 = slope(x + h * k3)
        after_step = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        one_step = ca.Function("once", [x, u], [after_step])
        if steps == 1:
            return one_step
        # A map that hands the state on is smaller than the expressions of all steps in one.
        all_steps = one_step.mapaccum("sample", steps)
        states = all_steps(x, ca.repmat(u, 1, steps))
        return ca.Function("sample", [x, u], [states[:, -1]])

    def linear(self, elbow_rad: float) -> tuple[Real, Real]:
        """Matrices A (2n, 2n) and B (2n, 2) of the arm around rest at an elbow angle.

        The state is (q, q'), the inputs are voltages. Dry friction and gravity are left out: linearised
        at rest, the smoothed friction would be a large viscous one, and gravity bends the links at rest.
        """
        import casadi as ca

        n = self.coordinates
        free_arm = TwoLinkArm(
            self.links, self.hubs, self.motors, self.elbow_mass_kg, self.payload_kg, n_modes=self.n_modes
        )
        x = ca.SX.sym("x", 2 * n)
        u = ca.SX.sym("u", 2)
        slope = ca.vertcat(x[n:], free_arm._rates(x[:n], x[n:], u))
        jacobians = ca.Function("linear", [x, u], [ca.jacobian(slope, x), ca.jacobian(slope, u)])
        state_at_rest = np.zeros(2 * n)
        state_at_rest[1] = elbow_rad
        a, b = jacobians(state_at_rest, np.zeros(2))
        return np.asarray(a.full()), np.asarray(b.full())

    def rest(self, angles_rad: tuple[float, float]) -> tuple[Real, Real]:
        """State (2n,) at rest with these joint angles, and the voltages (2,) that hold it against gravity.

        The n unknowns are the voltages and the deflections; they make all accelerations zero. Without gravity
        all of them are zero. Where the solver does not converge its last iterate is taken.
        """
        n = self.coordinates
        angles = np.asarray(angles_rad, dtype=np.float64)

        def accelerations(unknowns: Real) -> Real:
            """q'' (n,) at rest under the voltages and deflections that are unknown."""
            voltages = unknowns[:2]
            q = np.concatenate([angles, unknowns[2:]])
            return np.asarray(self._rates(q, np.zeros(n), voltages).full())[:, 0]

        unknowns = np.zeros(n)
        if self.gravity_m_s2:
            import scipy.optimize  # takes its time to load

            # A tolerance near rounding: an arm that is not quite at rest would swing.
            unknowns = np.asarray(scipy.optimize.root(accelerations, unknowns, tol=1e-12).x)
        state = np.concatenate([angles, unknowns[2:], np.zeros(n)])
        return state, unknowns[:2]


# A run makes machines of the same few arms; to derive one step takes longer than to run a record.
_sampler = lru_cache(maxsize=16)(TwoLinkArm.sampled)


class TwoLinkMachine:
    """The arm as a controller sees it, sampled around rest at an operating point.

    Commands are voltages beyond those that hold the arm; measurements are joint angles from the operating
    point.

    arm : TwoLinkArm
    angles_rad : pair of float. Joint angles of the operating point.
    dt_s : float. Sampling period.
    noise_rad : float. Standard deviation of the normal noise of both angles.
    rng : source of the noise.
    """

    def __init__(
        self,
        arm: TwoLinkArm,
        angles_rad: tuple[float, float],
        dt_s: float,
        noise_rad: float,
        rng: np.random.Generator,
    ) -> None:
        self.dt_s = dt_s
        self._noise_rad = noise_rad
        self._rng = rng
        self._state_at_rest, self._holding_V = arm.rest(angles_rad)
        # CasADi reads and writes these arrays in place: to convert arrays at every sample would take as long
        # as the integration.
        self._x = self._state_at_rest.copy()
        self._u = np.zeros(2)
        self._next_x = np.empty(self._state_at_rest.size)
        self._buffer, self._sample = _sampler(arm, dt_s).buffer()
        self._buffer.set_arg(0, self._x.data)
        self._buffer.set_arg(1, self._u.data)
        self._buffer.set_res(0, self._next_x.data)

    def reset(self) -> None:
        """Put the arm back to rest at the operating point. The noise generator goes on."""
        self._x[:] = self._state_at_rest

    def measure(self) -> Real:
        """Joint angles (2,) from the operating point, rad, with new noise at every call."""
        motion = self._x[:2] - self._state_at_rest[:2]
        noise = self._noise_rad * self._rng.standard_normal(2)
        return np.asarray(motion + noise)

    def advance(self, u: Real) -> None:
        """Hold the voltages u (2,), beyond those that hold the arm, for one sample."""
        self._u[:] = self._holding_V + u
        self._sample()
        self._x[:] = self._next_x

    def run(self, u: Real) -> Real:
        """Joint angles (T, 2) as measured, rad, before each of the voltages u (T, 2) acts, from rest."""
        self.reset()
        angles = np.empty(u.shape)
        for k, voltages in enumerate(u):
            angles[k] = self.measure()
            self.advance(voltages)
        return angles


@dataclass(frozen=True, eq=False)
class Bending:
    """Integrals over a link with mass per length m, length L and K shapes phi (clamped modes and the like).

    mass, first, second : float
        int m dx, int m x dx, int m x^2 dx; kg, kg m, kg m^2.
    shape, arm : (K,)
        int m phi dx, int m x phi dx.
    square : (K, K)
        int m phi_i phi_j dx.
    spring : (K, K)
        int E I phi_i'' phi_j'' dx.
    at_tip, slope_at_tip : (K,)
        phi(L), phi'(L).
    """

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
    def of(cls, link: Link, n_modes: int, tip_mass_kg: float, *, under_moment: bool) -> Bending:
        """Integrals over a link with its first n_modes clamped modes under a point mass at the tip, kg.

        under_moment: one more shape, (x / L)^2, as a moment at the tip bends the link; modes alone, which
        have no curvature there, would take many to make it.
        """
        length = link.length_m
        m = link.mass_per_length_kg_m
        stiffness = link.bending_stiffness_Nm2
        modes = clamped_free_modes(stiffness, m, length, n_modes, tip_mass_kg)
        # Eight nodes for each half wave and sixteen for the ends integrate products of two shapes to
        # rounding. The tip is a node without weight, to have the shapes there too.
        nodes, weights = np.polynomial.legendre.leggauss(8 * n_modes + 16)
        x = np.append(0.5 * length * (nodes + 1), length)
        dx = np.append(0.5 * length * weights, 0.0)
        shape: Any = modes.shape(x)
        slope: Any = modes.slope(x)
        curvature: Any = modes.curvature(x)
        if under_moment:
            shape = np.column_stack([shape, (x / length) ** 2])
            slope = np.column_stack([slope, 2 * x / length**2])
            curvature = np.column_stack([curvature, np.full(x.size, 2 / length**2)])
        dm = m * dx
        return cls(
            mass=m * length,
            first=m * length**2 / 2,
            second=m * length**3 / 3,
            shape=dm @ shape,
            arm=(dm * x) @ shape,
            square=shape.T @ (dm[:, None] * shape),
            spring=stiffness * curvature.T @ (dx[:, None] * curvature),
            at_tip=shape[-1],
            slope_at_tip=slope[-1],
        )

    def kinetic(self, along: Any, across: Any, turn_rate: Any, a: Any, a_rate: Any) -> Any:
        """Kinetic energy of the link, J, a CasADi expression.

        It is 1/2 int m [(along - turn_rate w)^2 + (across + turn_rate x + w')^2] dx with the deflection w and
        its rate w'. along, across: velocity of the link's root in the link's axes, m/s. turn_rate: of the
        root, rad/s. a, a_rate (K,): factors of the shapes in the deflection, and their rates.
        """
        import casadi as ca

        bent = ca.dot(self.shape, a)
        bending_rate = ca.dot(self.shape, a_rate)
        inertia = ca.bilin(self.square, a, a) + self.second
        twice_energy = self.mass * (along**2 + across**2) - 2 * along * turn_rate * bent
        twice_energy += turn_rate**2 * inertia + ca.bilin(self.square, a_rate, a_rate)
        root_coupling = 2 * across * (turn_rate * self.first + bending_rate)
        twice_energy += root_coupling + 2 * turn_rate * ca.dot(self.arm, a_rate)
        return 0.5 * twice_energy

    def static_moment(self, along_y: Any, across_y: Any, root_y: Any, a: Any) -> Any:
        """Integral of the height over the link's mass, kg m, a CasADi expression.

        along_y, across_y: heights of the unit vectors along and across the link. root_y: height of its root,
        m. a (K,): factors of the shapes in the deflection.
        """
        import casadi as ca

        return self.mass * root_y + self.first * along_y + ca.dot(self.shape, a) * across_y


def _across(along: Any) -> Any:
    """Unit vector (2,) across a unit vector (2,), a quarter turn counter-clockwise from it."""
    import casadi as ca

    return ca.vertcat(-along[1], along[0])
