"""The uncertain plant: a nominal state space for the poles, ellipses for what must hold on the machine."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import Complex, Ellipses, EvaluableUncertainty, Real, ResponseSet
from ident.data.shown import Shown

if TYPE_CHECKING:
    import control


class NominalPlant:
    """What follows from a discrete nominal `control.StateSpace` alone."""

    nominal: control.StateSpace

    @property
    def dt_s(self) -> float:
        return float(self.nominal.dt)

    @cached_property
    def poles(self) -> Complex:
        """Nominal poles in z, (n,)."""
        return np.asarray(np.linalg.eigvals(self.nominal.A), dtype=np.complex128)

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Flexible modes of the nominal, below the Nyquist frequency."""
        return tuple(m for m in modes_of(self.poles, self.dt_s) if m.omega_rad_s < np.pi / self.dt_s)


@dataclass(frozen=True, eq=False)
class PlantChannel(NominalPlant):
    """One response with its uncertainty. nominal: SISO discrete `control.StateSpace`. uncertainty: an object
    with `at(omega, level)` (any frequency), a record with omega_rad_s, centre, covariance, level (its own
    frequencies only), or None (the nominal response is exact)."""

    nominal: control.StateSpace
    uncertainty: EvaluableUncertainty | ResponseSet | None = None
    level: float = 0.95

    def __post_init__(self) -> None:
        import control  # here and below, because it brings a plotting library with it

        system = self.nominal
        if not isinstance(system, control.StateSpace):
            raise ValueError(
                f"the nominal plant must be a control.StateSpace; got {type(system).__name__}, "
                "convert with control.ss"
            )
        if not (system.ninputs == 1 and system.noutputs == 1):
            raise ValueError(
                f"the nominal plant must have one input and one output; got {system.ninputs} and "
                f"{system.noutputs}"
            )
        if system.dt is None or system.dt is True or not system.dt > 0:
            raise ValueError(
                f"the nominal plant must be discrete with a sampling time in seconds; got dt = {system.dt}"
            )
        for name in ("A", "B", "C", "D"):
            if not np.all(np.isfinite(getattr(system, name))):
                raise ValueError(f"the nominal plant has a value that is not finite in {name}")
        if not 0 < self.level < 1:
            raise ValueError(f"level must lie in (0, 1); got {self.level}")
        uncertainty = self.uncertainty
        if uncertainty is not None and not (hasattr(uncertainty, "at") or hasattr(uncertainty, "covariance")):
            raise ValueError(
                "uncertainty needs a method at(omega_rad_s, level), or omega_rad_s, centre, "
                "covariance, level; "
                f"got {type(uncertainty).__name__}"
            )
        own = self.own_grid
        if own is not None:
            if own.size < 2 or not np.all(np.diff(own) > 0) or not own[0] >= 0:
                raise ValueError(
                    "the uncertainty's own grid needs at least two ascending frequencies in rad/s"
                )
            if not own[-1] <= np.pi / system.dt * (1 + 1e-9):
                raise ValueError(
                    f"the uncertainty's grid reaches {own[-1]:.5g} rad/s; the Nyquist frequency is "
                    f"{np.pi / system.dt:.5g}"
                )

    @property
    def own_grid(self) -> Real | None:
        """Frequencies (F,) where alone the uncertainty is known, or None if it can be evaluated anywhere."""
        if self.uncertainty is None or hasattr(self.uncertainty, "at"):
            return None
        return np.asarray(self.uncertainty.omega_rad_s, dtype=np.float64)

    def nominal_response(self, omega_rad_s: Real) -> Complex:
        """G_nom(e^{j omega dt}), (F,); see `frequency_response`."""
        return frequency_response(self.nominal, omega_rad_s)

    def at(self, omega_rad_s: Real) -> Ellipses:
        """Ellipses at omega (F,). Of a record with its own grid omega must be on it; outside its range the
        nominal response stands alone, without uncertainty. Raises ValueError at a frequency without
        ellipse."""
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        if self.uncertainty is None:
            return Ellipses.of_no_size(omega, self.nominal_response(omega))
        record: Any = self.uncertainty
        if hasattr(record, "at"):
            record = record.at(omega, self.level)
            centre, covariance = np.asarray(record.centre), np.asarray(record.covariance)
            return Ellipses.from_covariance(omega, centre, covariance, self.level)
        own = np.asarray(record.omega_rad_s, dtype=np.float64)
        outside = (omega < own[0] * (1 - 1e-9)) | (omega > own[-1] * (1 + 1e-9))
        index = np.clip(np.searchsorted(own, omega), 0, own.size - 1)
        before = np.maximum(index - 1, 0)
        index = np.where(np.abs(own[before] - omega) < np.abs(own[index] - omega), before, index)
        missing = ~outside & (np.abs(own[index] - omega) > 1e-9 * omega)
        if np.any(missing):
            raise ValueError(
                f"the uncertainty is known on its own grid only; {omega[np.argmax(missing)]:.6g} "
                "rad/s is not on it"
            )
        centre = np.asarray(record.centre, dtype=np.complex128)[index]
        covariance = np.asarray(record.covariance, dtype=np.float64)[index]
        if np.any(outside):
            centre = np.where(outside, self.nominal_response(omega), centre)
            covariance = np.where(outside[:, None, None], 0.0, covariance)
        return Ellipses.from_covariance(omega, centre, covariance, float(record.level))


def frequency_response(system: control.StateSpace, omega_rad_s: Real) -> Complex:
    """`matrix_response` (F,) of a SISO discrete system."""
    return matrix_response(system, omega_rad_s)[:, 0, 0]


def matrix_response(system: control.StateSpace, omega_rad_s: Real) -> Complex:
    """C (zI - A)^-1 B + D on z = e^{j omega dt}, (F, Y, U), for a discrete system; zI - A as (z - 1) I - (A -
    I) with z - 1 = expm1(j omega dt), for slow poles."""
    a = np.asarray(system.A, dtype=np.float64)
    b = np.asarray(system.B, dtype=np.float64)
    c = np.asarray(system.C, dtype=np.float64)
    d = np.asarray(system.D, dtype=np.float64)
    omega = np.atleast_1d(np.asarray(omega_rad_s, dtype=np.float64))
    n = a.shape[0]
    response = np.empty((*omega.shape, *d.shape), dtype=np.complex128)
    response[:] = d
    if n == 0:
        return response
    theta = omega * float(system.dt)
    z_minus_1 = -2.0 * np.sin(theta / 2) ** 2 + 1j * np.sin(theta)
    shifted = a - np.eye(n)
    for start in range(0, omega.size, 2048):  # bounds the memory of the batch
        part = z_minus_1[start : start + 2048]
        matrices = part[:, None, None] * np.eye(n) - shifted
        states = np.linalg.solve(matrices, np.broadcast_to(b, (part.size, *b.shape)))
        response[start : start + 2048] += c @ states
    return response


def delayed(system: control.StateSpace, samples: int) -> control.StateSpace:
    """A discrete system behind a delay of whole samples of every input, whose states come after its own."""
    if samples == 0:
        return system
    import control

    a, b, c, d = (np.asarray(getattr(system, name), dtype=np.float64) for name in "ABCD")
    for _ in range(samples):
        n, inputs = b.shape
        a = np.block([[a, b], [np.zeros((inputs, n + inputs))]])
        b = np.vstack([np.zeros((n, inputs)), np.eye(inputs)])
        c, d = np.hstack([c, d]), np.zeros_like(d)
    return control.ss(a, b, c, d, system.dt)


def count_integrators(poles_z: Complex) -> int:
    """Poles at z = 1. A multiple pole splits by a root of the rounding error (1e-8 for two, 1e-5 for three),
    but the mean of the cluster stays accurate; a true slow pole (1e-3 rad/s at 1 kHz: 1e-6 from z = 1) is
    none."""
    distance = np.asarray(poles_z, dtype=np.complex128) - 1.0
    distance = distance[np.argsort(np.abs(distance), kind="stable")]
    for count, radius in ((3, 1e-3), (2, 1e-5), (1, 1e-9)):
        if (
            distance.size >= count
            and abs(distance[count - 1]) < radius
            and abs(np.mean(distance[:count])) < 1e-9
        ):
            return count
    return 0


@dataclass(frozen=True)
class Mode:
    """A lightly damped pole pair: undamped frequency [rad/s] and damping ratio."""

    omega_rad_s: float
    zeta: float


def modes_of(poles_z: Complex, dt_s: float, *, zeta_below: float = 0.4) -> tuple[Mode, ...]:
    """Oscillatory pole pairs of z-plane poles as s = ln(z)/dt, ascending in frequency; zeta < 0: unstable."""
    poles = np.asarray(poles_z, dtype=np.complex128)
    upper = poles[(np.imag(poles) > 1e-9) & (np.abs(poles) > 1e-6)]
    modes = [Mode(float(abs(value)), float(-value.real / abs(value))) for value in np.log(upper) / dt_s]
    return tuple(sorted((m for m in modes if m.zeta < zeta_below), key=lambda m: m.omega_rad_s))


@dataclass(frozen=True, eq=False, repr=False)
class UncertainPlant(NominalPlant, Shown):
    """Input -> measured output with ellipses (`PlantChannel`), one plant per load or operating point.

    integrators: poles at z = 1, None = counted; a number that contradicts the nominal is refused.
    performance: the channel whose |Gp S| the damping weight bounds; None = the measured output itself.
    """

    name: str
    nominal: control.StateSpace
    uncertainty: EvaluableUncertainty | ResponseSet | None = None
    integrators: int | None = None
    performance: PlantChannel | None = None
    level: float = 0.95

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("an uncertain plant needs a name")
        channel = self.channel
        counted = count_integrators(self.poles)
        if self.integrators is None:
            object.__setattr__(self, "integrators", counted)
        elif self.integrators != counted:
            raise ValueError(
                f"plant {self.name!r}: {self.integrators} integrators declared, the nominal has "
                f"{counted} poles at z = 1"
            )
        if counted > 2:
            raise ValueError(f"plant {self.name!r}: at most two integrators are supported; got {counted}")
        if np.any(np.abs(np.abs(self._other_poles) - 1.0) < 1e-10):
            raise ValueError(
                f"plant {self.name!r}: a nominal pole lies on the unit circle away from z = 1 "
                "(undamped mode); "
                "its response is infinite there, give it damping"
            )
        if self.performance is not None and self.performance.dt_s != channel.dt_s:
            raise ValueError(
                f"plant {self.name!r}: measured and performance channel differ in sampling time "
                f"({channel.dt_s} and {self.performance.dt_s} s)"
            )

    @cached_property
    def channel(self) -> PlantChannel:
        """Input -> measured output."""
        return PlantChannel(self.nominal, self.uncertainty, self.level)

    @property
    def nyquist_rad_s(self) -> float:
        return float(np.pi / self.dt_s)

    @property
    def damped(self) -> PlantChannel:
        """The channel whose |Gp S| the damping requirement bounds."""
        return self.channel if self.performance is None else self.performance

    @cached_property
    def zeros(self) -> Complex:
        """Finite nominal zeros in z, (n,); numerically infinite ones (|z| > 1e4) are dropped."""
        if self.nominal.nstates == 0:
            return np.zeros(0, complex)
        zeros = np.asarray(self.nominal.zeros(), dtype=np.complex128)
        return zeros[np.isfinite(zeros) & (np.abs(zeros) < 1e4)]

    @property
    def n_integrators(self) -> int:
        assert self.integrators is not None
        return self.integrators

    @cached_property
    def unstable_poles(self) -> int:
        """Poles strictly outside the unit circle; integrators are not among them."""
        return int(np.sum(np.abs(self._other_poles) > 1.0))

    def slow_poles_rad_s(self, below_rad_s: float) -> tuple[float, ...]:
        """|log z|/dt of nominal poles below a frequency, ascending, 0 for integrators: beyond each the plant
        integrates. As many as zeros below it are left out, the fastest first."""
        poles, zeros = (
            np.sort(np.abs(np.log(roots[roots != 0])) / self.dt_s)
            for roots in (self._other_poles, self.zeros)
        )
        slow = [0.0] * self.n_integrators + [float(pole) for pole in poles if pole < below_rad_s]
        return tuple(slow[: max(len(slow) - int(np.sum(zeros < below_rad_s)), 0)])

    @property
    def _other_poles(self) -> Complex:
        """Poles without the integrators."""
        return self.poles[np.argsort(np.abs(self.poles - 1.0), kind="stable")][self.n_integrators :]

    @property
    def ellipse_modes(self) -> tuple[Mode, ...]:
        """Flexible modes of the poles that ellipses stand on, which the nominal need not have."""
        from ident.uncertainty import ResponsePosterior  # here, because it brings compiled kernels with it

        known = [
            c.uncertainty for c in (self.channel, self.damped) if isinstance(c.uncertainty, ResponsePosterior)
        ]
        return tuple(mode for each in known for mode in modes_of(each.poles.values, self.dt_s))

    @property
    def own_grid(self) -> npt.NDArray[np.float64] | None:
        return self.channel.own_grid

    def at(self, omega_rad_s: Real) -> Ellipses:
        """Ellipses of input -> measured output at omega (F,)."""
        return self.channel.at(omega_rad_s)
