"""A plant drawn from an identified posterior, as a machine that can be sampled in a closed loop."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from control_design.analysis.closed_loop import SampledMachine
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.uncertainty import ResponsePosterior

Real = npt.NDArray[np.float64]

FINITE = 1e9
"""Input at which a machine is clipped only so that a loop that runs away stays made of numbers."""


def realise(posterior: ResponsePosterior, coefficients: Real) -> tuple[Real, Real, Real, float]:
    """State space (A, B, C, D) of one draw of coefficients (P,): poles and kernel in parallel.

    A kernel of L taps is the basis of L poles at zero, a shift register; both parts carry their own
    integrators and delay, which doubles those states and changes nothing in the response from rest.
    """
    n, direct = posterior.poles.order, int(posterior.has_feedthrough)
    parts = [_part(posterior, posterior.poles, coefficients[:n], float(coefficients[n]) if direct else 0.0)]
    if posterior.fir_length:
        shift = Poles(np.zeros(posterior.fir_length), np.zeros(0, dtype=np.complex128))
        parts.append(_part(posterior, shift, coefficients[n + direct :], 0.0))
    spaces = [part.state_space() for part in parts]
    size = sum(space[0].shape[0] for space in spaces)
    a = np.zeros((size, size))
    start = 0
    for space in spaces:
        stop = start + space[0].shape[0]
        a[start:stop, start:stop] = space[0]
        start = stop
    b = np.concatenate([space[1][:, 0] for space in spaces])
    c = np.concatenate([space[2][0] for space in spaces])
    return a, b, c, sum(float(space[3][0, 0]) for space in spaces)


def _part(posterior: ResponsePosterior, poles: Poles, coefficients: Real, feedthrough: float) -> GobfModel:
    return GobfModel(
        poles,
        coefficients,
        posterior.dt_s,
        feedthrough=feedthrough,
        integrators=posterior.integrators,
        input_delay_samples=posterior.input_delay_samples,
    )


class StateSpaceMachine:
    """SISO state space as a `control_design.analysis.closed_loop.SampledMachine`.

    A direct term answers to the input of the same instant, which a sampled machine cannot do: it is measured
    before the input is known. With `holds_input` the machine keeps one sample of the loop's computational
    delay itself: `advance(u)` stores u for the next interval, so that the measurement may contain D times the
    input now acting. The controller must then run with one sample of delay less.
    """

    def __init__(self, a: Real, b: Real, c: Real, d: float, dt_s: float, *, holds_input: bool) -> None:
        if d != 0.0 and not holds_input:
            raise ValueError("a machine with a direct term needs holds_input")
        self._a, self._b, self._c, self._d = a, b, c, d
        self._dt_s, self._holds_input = dt_s, holds_input
        self.reset()

    @property
    def dt_s(self) -> float:
        return self._dt_s

    def reset(self) -> None:
        self._x = np.zeros(self._a.shape[0])
        self._held = 0.0

    def measure(self) -> Real:
        """(1,) output at t_k."""
        return np.array([float(self._c @ self._x) + self._d * self._held])

    def advance(self, u: float, /, *, hub_torque_Nm: float = 0.0) -> None:
        """Hold the input for one sample. Raises ValueError for a torque, which this machine has no input
        for."""
        if hub_torque_Nm != 0.0:
            raise ValueError("a machine known by its response only has no input for a hub torque")
        acting = self._held if self._holds_input else u
        self._x = self._a @ self._x + self._b * acting
        self._held = u


class ClippedMachine:
    """A machine that clips its input without telling the controller."""

    def __init__(self, machine: SampledMachine, limit: float) -> None:
        self._machine, self._limit = machine, limit

    @property
    def dt_s(self) -> float:
        return self._machine.dt_s

    def reset(self) -> None:
        self._machine.reset()

    def measure(self) -> Real:
        """Outputs (Y,) at t_k."""
        return self._machine.measure()

    def advance(self, u: float, /, *, hub_torque_Nm: float = 0.0) -> None:
        """Hold the clipped input for one sample."""
        self._machine.advance(min(max(u, -self._limit), self._limit), hub_torque_Nm=hub_torque_Nm)
