"""A plant with U inputs and Y outputs, and what is not known of its response matrix."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import scipy.linalg

from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import NominalPlant, delayed, matrix_response
from control_design.plants.scaled_bound import conjugate
from control_design.plants.weights import RationalWeight
from ident.data.arrays import lock

if TYPE_CHECKING:
    import control


def tustin_s(omega_rad_s: Real, dt_s: float) -> Complex:
    """s = j (2/dt) tan(omega dt/2) (F,), in which weights and controllers are written; 1e9/dt at most."""
    with np.errstate(over="ignore"):
        size = 2.0 / dt_s * np.tan(np.asarray(omega_rad_s, dtype=np.float64) * dt_s / 2)
    return 1j * np.where(np.abs(size) > 1e9 / dt_s, 1e9 / dt_s, size)


class IdentifiedMatrix(Protocol):
    """What a ball needs of an identified matrix response (`ident.uncertainty` has it)."""

    @property
    def dt_s(self) -> float: ...
    @property
    def output_factor(self) -> Real: ...
    def input_factor(self, lowest_rad_s: float) -> tuple[Real, Real, Real, Real]: ...
    def largest_radius(self, lowest_rad_s: float) -> float: ...


@dataclass(frozen=True, eq=False)
class ResponseBall:
    """G + Lo Delta Li with |Delta|_F <= radius at every frequency; `of` makes one of an identified response.

    Lo (Y, P); Li: stable discrete `control.StateSpace` with U inputs, or an array (F, Q, U) at omega_rad_s
    (F,) [rad/s], between which nothing is known. radius: for a Kronecker covariance Lo Lo^H (x) Li^H Li,
    sqrt(chi^2 quantile / 2) with 2 U Y degrees of freedom. lowest_rad_s: below it the ball says nothing, and
    certificates begin there. Raises ValueError for shapes that do not fit.
    """

    Lo: Real
    Li: Any
    radius: float
    omega_rad_s: Real | None = None
    lowest_rad_s: float = 0.0

    def __post_init__(self) -> None:
        lock(self, "Lo")
        if self.Lo.ndim != 2 or not np.all(np.isfinite(self.Lo)):
            raise ValueError(f"Lo must be a finite matrix (Y, P); got shape {self.Lo.shape}")
        if not (self.radius > 0 and np.isfinite(self.radius)):
            raise ValueError(f"radius must be positive; got {self.radius}")
        if self.omega_rad_s is None:
            system = self.Li
            if not hasattr(system, "A") or not np.all(np.abs(np.linalg.eigvals(system.A)) < 1):
                raise ValueError(
                    "Li must be a stable discrete control.StateSpace; or give omega_rad_s with it"
                )
            return
        lock(self, "omega_rad_s")
        lock(self, "Li", dtype=np.complex128)
        omega, values = self.omega_rad_s, self.Li
        if values.ndim != 3 or values.shape[0] != omega.size or not np.all(np.isfinite(values)):
            raise ValueError(f"Li must be finite and ({omega.size}, Q, U); got shape {values.shape}")
        if omega.size < 2 or not (omega[0] > 0 and np.all(np.diff(omega) > 0)):
            raise ValueError("omega_rad_s needs at least two ascending positive frequencies")

    @classmethod
    def of(cls, posterior: IdentifiedMatrix, lowest_rad_s: float) -> ResponseBall:
        """Of an identified matrix response, from lowest_rad_s on: Li exact, the radius the largest of a
        grid.

        lowest_rad_s: the slowest motion that the records tell, 2 pi over the length of the longest, or the
        lowest frequency that was excited. Below, an integrator's uncertainty grows without bound and is kept
        as it is there. Lower values widen every ball (one radius for all), higher ones leave more unchecked.
        """
        import control  # here, because it brings a plotting library with it

        li = control.ss(*posterior.input_factor(lowest_rad_s), posterior.dt_s, remove_useless_states=False)
        radius = posterior.largest_radius(lowest_rad_s)
        return cls(posterior.output_factor, li, radius, lowest_rad_s=lowest_rad_s)

    def gram(self, omega_rad_s: Real) -> Complex:
        """radius^2 Li^H Li (F, U, U)."""
        if self.omega_rad_s is None:
            values = matrix_response(self.Li, omega_rad_s)
        else:
            own = self.omega_rad_s
            index = np.clip(np.searchsorted(own, omega_rad_s * (1 - 1e-9)), 0, own.size - 1)
            if np.any(np.abs(own[index] - omega_rad_s) > 1e-8 * omega_rad_s):
                raise ValueError("the uncertainty is known on its own frequencies only; ask there")
            values = self.Li[index]
        return self.radius**2 * conjugate(values) @ values


@dataclass(frozen=True, eq=False)
class MultivariablePlant(NominalPlant):
    """Nominal plant (discrete `control.StateSpace`, dt in seconds) and its uncertainty: U inputs, Y outputs,
    u = -K y.

    ball: of the response matrix, or None. input_error, output_error: a weight per actuator or sensor, or (),
    one of the two: that channel's gain is (1 + w Delta), |Delta| <= 1 complex, each by itself. Poles at z = 1
    are allowed. Neglected: products of the ball and a channel's error. Raises ValueError for a plant that is
    not discrete, not finite, or whose parts do not fit.
    """

    name: str
    nominal: control.StateSpace
    ball: ResponseBall | None = None
    input_error: tuple[RationalWeight, ...] = ()
    output_error: tuple[RationalWeight, ...] = ()

    def __post_init__(self) -> None:
        import control  # here, because it brings a plotting library with it

        system = self.nominal
        if not isinstance(system, control.StateSpace):
            raise ValueError(f"the nominal plant must be a control.StateSpace; got {type(system).__name__}")
        if system.dt is None or system.dt is True or not system.dt > 0:
            raise ValueError(f"the nominal plant must be discrete with dt in seconds; got dt = {system.dt}")
        if not all(np.all(np.isfinite(getattr(system, each))) for each in "ABCD"):
            raise ValueError(f"plant {self.name!r} has a value that is not finite")
        for words, given, count in (
            ("input_error", self.input_error, self.inputs),
            ("output_error", self.output_error, self.outputs),
        ):
            if len(given) not in (0, count):
                raise ValueError(f"plant {self.name!r}: {words} needs {count} weights; got {len(given)}")
        if self.input_error and self.output_error:
            raise ValueError(f"plant {self.name!r}: give input_error or output_error, not both")
        if self.ball is not None and not isinstance(self.ball, ResponseBall):
            raise ValueError(
                f"plant {self.name!r}: ball is a {type(self.ball).__name__}; expected a ResponseBall, of an "
                "identified matrix ResponseBall.of(posterior, lowest_rad_s)"
            )
        if self.ball is not None:
            li = self.ball.Li
            columns = li.ninputs if self.ball.omega_rad_s is None else li.shape[2]
            if self.ball.Lo.shape[0] != self.outputs or columns != self.inputs:
                raise ValueError(
                    f"plant {self.name!r} has {self.outputs} outputs and {self.inputs} inputs; "
                    f"Lo has {self.ball.Lo.shape[0]} rows, Li {columns} columns"
                )

    @property
    def inputs(self) -> int:
        return int(self.nominal.ninputs)

    @property
    def outputs(self) -> int:
        return int(self.nominal.noutputs)

    @property
    def own_grid(self) -> Real | None:
        """Frequencies where alone the uncertainty is known, or None."""
        return None if self.ball is None else self.ball.omega_rad_s

    @cached_property
    def zeros(self) -> Complex:
        """Transmission zeros in z of a square plant; none otherwise."""
        if self.inputs != self.outputs or self.nominal.nstates == 0:
            return np.zeros(0, complex)
        a, b, c, d = (np.asarray(getattr(self.nominal, each), dtype=np.float64) for each in "ABCD")
        n, m = b.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            found = scipy.linalg.eigvals(
                np.block([[a, b], [c, d]]), scipy.linalg.block_diag(np.eye(n), np.zeros((m, m)))
            )
        return np.asarray(found[np.isfinite(found) & (np.abs(found) < 1e4)])

    def blocks(self, omega_rad_s: Real, delay_samples: int = 0) -> tuple[Complex, Complex, Complex]:
        """Nominal response (F, Y, U) behind the delay, and the Gram matrices seen (F, N, U, U) and entering
        (F, N, Y, Y) of `scaled_bound.BoundRows`: the ball first, actuators, sensors."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        late = np.exp(-1j * omega * self.dt_s * delay_samples)[:, None, None]
        G = matrix_response(self.nominal, omega) * late
        s = tustin_s(omega, self.dt_s)
        seen: list[Any] = []
        entering: list[Any] = []
        if self.ball is not None:
            seen.append(self.ball.gram(omega))
            entering.append(np.broadcast_to(self.ball.Lo @ self.ball.Lo.T, (omega.size, *G.shape[1:2] * 2)))
        for i, weight in enumerate(self.input_error):
            size = np.abs(weight.at(s))[:, None, None] ** 2
            axis = np.zeros((self.inputs, self.inputs))
            axis[i, i] = 1.0
            seen.append(np.broadcast_to(axis, (omega.size, *axis.shape)))
            entering.append(size * G[:, :, i, None] * np.conj(G[:, None, :, i]))
        for i, weight in enumerate(self.output_error):
            size = np.abs(weight.at(s))[:, None, None] ** 2
            axis = np.zeros((self.outputs, self.outputs))
            axis[i, i] = 1.0
            seen.append(size * np.conj(G[:, i, :, None]) * G[:, None, i, :])
            entering.append(np.broadcast_to(axis, (omega.size, *axis.shape)))
        empty = np.zeros((omega.size, 0))

        def stacked(parts: list[Any], size: int) -> Complex:
            together = np.stack(parts, axis=1) if parts else empty[:, :, None, None] * np.zeros((size, size))
            return np.asarray(together, dtype=np.complex128)

        return G, stacked(seen, self.inputs), stacked(entering, self.outputs)

    def delayed(self, samples: int) -> control.StateSpace:
        """The nominal behind the computational delay."""
        return delayed(self.nominal, samples)
