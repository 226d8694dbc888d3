"""The linear part of a repaired machine as a sampled state space, which a controller can be designed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import control
import numpy as np
import numpy.typing as npt
from scipy.signal import cont2discrete

from plant.effects import Effect, make_machine
from plant.machine import VoltagePath
from plant.modal import default_n_modes, equations_of_motion
from plant.rig import Rig

Real = npt.NDArray[np.float64]


def sampled_linear_machine(rig: Rig, effects: Sequence[Effect]) -> control.StateSpace:
    """voltage_V -> (hub_angle_rad, tip_m), the voltage held over the rig's sampling period.

    Rig values, compliances, gain, delay (any fraction of a sample) and lag of the actuator are in it. Dry
    friction, backlash, dead zone, saturation, ripple, the hardening spring, gravity and everything behind the
    tip sensor are not: they have no linear model, or none that is fed back.
    """
    machine = make_machine(rig, effects)
    if machine.joint.backlash_gap_rad is not None:
        machine = replace(machine, joint=replace(machine.joint, backlash_gap_rad=None))
    equations = equations_of_motion(machine, default_n_modes(machine.rig))
    a = equations.state_matrix()
    torque = machine.rig.motor.torque_per_volt_Nm_V * equations.shaft
    b = machine.voltage.gain * equations.input_column(torque)[:, None]
    c = np.array([equations.position_row(equations.encoder), equations.position_row(equations.tip)])
    if machine.voltage.lag_s > 0:
        a, b, c = _with_lag(a, b, c, machine.voltage.lag_s)
    return _sampled(a, b, c, rig.sampling.dt_s, machine.voltage)


def _with_lag(a: Real, b: Real, c: Real, lag_s: float) -> tuple[Real, Real, Real]:
    """The acting voltage as a further state."""
    n = a.shape[0]
    wide = np.zeros((n + 1, n + 1))
    wide[:n, :n], wide[:n, n:], wide[n, n] = a, b, -1 / lag_s
    column = np.zeros((n + 1, 1))
    column[n] = 1 / lag_s
    return wide, column, np.hstack([c, np.zeros((c.shape[0], 1))])


def _sampled(a: Real, b: Real, c: Real, dt_s: float, path: VoltagePath) -> control.StateSpace:
    """Exact under a held input that arrives late: past samples of the voltage become states."""
    whole = int(path.delay_s / dt_s * (1 + 1e-12))
    late = max(path.delay_s - whole * dt_s, 0.0)
    n = a.shape[0]
    first, early = _held(a, b, late)
    second, now = _held(a, b, dt_s - late)
    past = whole + int(late > 0)
    # columns[:, k]: effect of the voltage commanded k samples ago.
    columns = np.zeros((n, past + 1))
    columns[:, whole] += now[:, 0]
    if late > 0:
        columns[:, whole + 1] += (second @ early)[:, 0]
    A, B = np.zeros((n + past, n + past)), np.zeros((n + past, 1))
    A[:n, :n], A[:n, n:], B[:n] = second @ first, columns[:, 1:], columns[:, :1]
    if past:
        B[n] = 1.0
        A[n + 1 :, n:-1] = np.eye(past - 1)
    C = np.hstack([c, np.zeros((c.shape[0], past))])
    return control.ss(A, B, C, np.zeros((c.shape[0], 1)), dt_s)


def _held(a: Real, b: Real, time_s: float) -> tuple[Real, Real]:
    """e^(a t) and the integral of e^(a s) b over (0, t)."""
    none = np.zeros((1, len(a))), np.zeros((1, b.shape[1]))
    step, held, *_ = cont2discrete((a, b, *none), time_s, "zoh")
    return step, held
