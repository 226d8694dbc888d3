"""An arm written down independently of the package, for comparison.

Polynomial Ritz functions instead of eigenfunctions, the extra angles of compliance and base as
coordinates relative to the hub, the energies of the rig description by quadrature, and general-purpose
integrators. Shares no code with `plant` but the record of nominal parameters.
"""

import numpy as np
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import leggauss
from scipy.integrate import solve_ivp


class RitzArm:
    """States: coordinates (hub, base, twist, q_1..q_P), speeds, voltage lag, sensor lag."""

    def __init__(
        self,
        rig,
        n=7,
        joint=None,
        base=None,
        ripple=None,
        cubic=0.0,
        drag=0.0,
        gravity=0.0,
        disturbance=None,
        voltage_lag=0.0,
        sensor_lag=0.0,
    ):
        link, hub, motor = rig.link, rig.hub, rig.motor
        length, r, mp = link.length_m, hub.radius_m, rig.payload.mass_kg
        area = link.width_m * link.thickness_m
        m, stiffness = link.density_kg_m3 * area, link.youngs_modulus_Pa * area * link.thickness_m**2 / 12
        x, w = leggauss(40)
        x, w = length * (x + 1) / 2, length * w / 2
        # (x/L)^2 times Legendre polynomials of 2x/L - 1: clamped, complete, and well conditioned.
        shapes = [
            (Polynomial([0, 1 / length]) ** 2)
            * np.polynomial.Legendre.basis(k).convert(kind=Polynomial)(Polynomial([-1, 2 / length]))
            for k in range(n)
        ]
        self.n = 3 + n
        hub_, base_, twist_ = np.eye(self.n)[:3]

        def displacement(at):
            return np.concatenate([[r + at, 0, r + at], [s(at) for s in shapes]])

        def field(order):
            return np.array([[s.deriv(order)(at) for s in shapes] for at in x])

        at_nodes = np.array([displacement(at) for at in x])
        self.tip = displacement(length)
        mass = m * (at_nodes.T * w) @ at_nodes + mp * np.outer(self.tip, self.tip)
        mass += hub.inertia_kg_m2 * np.outer(hub_, hub_)
        curvature = np.zeros((x.size, self.n))
        curvature[:, 3:] = field(2)
        bending = stiffness * (curvature.T * w) @ curvature
        stiff, damp = bending.copy(), link.kelvin_voigt_s * bending
        self.shaft = hub_ - (base_ if base else 0)
        self.gain = motor.gear_ratio * motor.torque_constant_Nm_A / motor.resistance_ohm
        damp += (hub.viscous_friction_Nms + self.gain * motor.gear_ratio * motor.back_emf_Vs_rad) * np.outer(
            self.shaft, self.shaft
        )
        keep = [True, bool(base), bool(joint)] + [True] * n
        if joint:
            stiff, damp = (
                stiff + joint[0] * np.outer(twist_, twist_),
                damp + joint[1] * np.outer(twist_, twist_),
            )
        if base:
            stiff, damp = stiff + base[0] * np.outer(base_, base_), damp + base[1] * np.outer(base_, base_)
            mass += base[2] * np.outer(base_, base_)
        pick = np.eye(self.n)[:, keep]
        self.mass, self.damp, self.stiff = (pick.T @ a @ pick for a in (mass, damp, stiff))
        self.tip, self.shaft, self.hub = (a @ pick for a in (self.tip, self.shaft, hub_))
        self.root = (hub_ + twist_) @ pick
        self.n = pick.shape[1]
        self.inverse = np.linalg.inv(self.mass)
        # Gravity: X = (r + x) cos b - w sin b - cos b s(x), shortening s = 1/2 int_0^x w'^2, by nested
        # quadrature.
        self.g, self.ripple, self.cubic, self.disturbance = gravity, ripple, cubic, disturbance
        self.drag = drag
        self.moment = m * w @ (r + x) + mp * (r + length)
        moments = np.zeros(pick.shape[0])
        moments[3:] = [m * w @ s(x) + mp * s(length) for s in shapes]
        shortening = np.zeros((pick.shape[0],) * 2)
        for at, weight in [*zip(x, m * w, strict=True), (length, mp)]:
            inner = (at / length) * x
            slope = np.array([s.deriv()(inner) for s in shapes])
            shortening[3:, 3:] += weight * 0.5 * (slope * (at / length) * w) @ slope.T
        self.moments, self.shortening = moments @ pick, pick.T @ shortening @ pick
        self.voltage_lag, self.sensor_lag = voltage_lag, sensor_lag

    def derivative(self, t, s, voltage, hub_torque=0.0, tip_force=0.0):
        c, v = s[: self.n], s[self.n : 2 * self.n]
        acting = s[2 * self.n] if self.voltage_lag else voltage
        force = -self.stiff @ c - self.damp @ v + self.shaft * self.gain * acting
        force = force + self.hub * hub_torque + self.tip * tip_force
        if self.ripple:
            amplitude, cycles, phase = self.ripple
            force = force + self.shaft * amplitude * np.sin(cycles * (self.shaft @ c) + phase)
        if self.disturbance:
            amplitude, frequency, phase = self.disturbance
            force = force + self.hub * amplitude * np.sin(2 * np.pi * frequency * t + phase)
        if self.cubic:
            force = force - self.hub * self.cubic * (self.hub @ c) ** 3
        if self.drag:
            force = force - self.hub * self.drag * (self.hub @ v) * abs(self.hub @ v)
        if self.g:
            sine, cosine = np.sin(self.root @ c), np.cos(self.root @ c)
            push = -self.moment * sine - cosine * self.moments @ c + sine * c @ self.shortening @ c
            force = force + self.g * (
                self.root * push - sine * self.moments - 2 * cosine * self.shortening @ c
            )
        rate = [v, self.inverse @ force]
        rate.append([(voltage - acting) / self.voltage_lag if self.voltage_lag else 0.0])
        rate.append([(self.tip @ c - s[2 * self.n + 1]) / self.sensor_lag if self.sensor_lag else 0.0])
        return np.concatenate(rate)

    def outputs(self, s):
        c = s[: self.n]
        return np.array(
            [self.shaft @ c, self.tip @ c, s[2 * self.n + 1] if self.sensor_lag else self.tip @ c]
        )

    def records(self, voltage, dt, delay=0.0, hub_torque=None, tip_force=None, rtol=1e-9):
        """(T, 3) outputs at t_k by a general solver, restarted wherever an input jumps."""
        torque = np.zeros(len(voltage)) if hub_torque is None else hub_torque
        force = np.zeros(len(voltage)) if tip_force is None else tip_force
        s, out = np.zeros(2 * self.n + 2), []
        for k in range(len(voltage)):
            out.append(self.outputs(s))
            inside = np.mod(delay, dt)
            for start, stop in ((0.0, inside), (inside, dt)):
                if stop - start < 1e-12:
                    continue
                index = int(np.floor((k * dt + 0.5 * (start + stop) - delay) / dt))
                held = voltage[index] if index >= 0 else 0.0
                solution = solve_ivp(
                    self.derivative,
                    (k * dt + start, k * dt + stop),
                    s,
                    args=(held, torque[k], force[k]),
                    method="LSODA",
                    rtol=rtol,
                    atol=1e-3 * rtol,
                )
                assert solution.success
                s = solution.y[:, -1]
        return np.array(out)
