"""The uncertain plant: a nominal state space for the poles, ellipses for what must hold on the machine.

A design needs two things of a plant. Its nominal model, a discrete state space, tells how often the loop must
wind around -1 (`unstable_poles`, `n_integrators`) and where modes and zeros lie. Its uncertainty tells where
the true response may be at each frequency (`at` gives `Ellipses`). `PlantChannel` is one response with its
uncertainty, `UncertainPlant` a whole plant: the measured output and, where the damped point of the machine is
another one, a second channel for it. Below them stand the functions that evaluate, delay and classify a
discrete system without losing the digits of slow poles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from control_design.plants.ellipses import Complex, Ellipses, EvaluableUncertainty, Real, ResponseSet
from control_design.plants.foreign_systems import is_measured, measured_response, state_space
from ident.data.keywords import clear_constructor
from ident.data.shown import Shown

if TYPE_CHECKING:
    import control


# A frequency is one of a record's own, and inside its range, within this share: files round to ten digits or
# so.
_SAME_FREQUENCY_SHARE = 1e-9

# Frequencies evaluated at once: bounds the memory of the batch (n x n complex matrices of each), 13 MB at
# twenty states. No digit depends on it.
_BATCH_FREQUENCIES = 2048

# A pole in z with a smaller imaginary part counts as real. Chosen, some million roundings of a pole near one;
# a pair as slow would turn once in 6e9 samples.
_REAL_BELOW = 1e-9

# A pole in z nearer to 0 has died out within a sample: its frequency would be the logarithm of rounding.
_DEADBEAT_BELOW = 1e-6

# Zeros farther out in z are at infinity: rounding of a zero that the discrete system does not have.
_INFINITE_ZERO = 1e4

# A nominal pole nearer to the unit circle than this counts as on it: its response there is 1e10 times larger.
_ON_CIRCLE_DISTANCE = 1e-10

# (number of poles, distance from z = 1 within which all of them lie): how far rounding splits a multiple
# pole, the n-th root of 1e-15 with a factor of a hundred to a million in hand.
_INTEGRATOR_CLUSTERS = ((3, 1e-3), (2, 1e-5), (1, 1e-9))

# The mean of such a cluster stays accurate to rounding; poles whose mean is farther from z = 1 are slow
# poles.
_INTEGRATOR_MEAN_DISTANCE = 1e-9


class NominalPlant:
    """What follows from a discrete nominal `control.StateSpace` alone; base of plants with one or more
    inputs."""

    nominal: control.StateSpace

    @property
    def dt_s(self) -> float:
        """Sampling period in seconds."""
        return float(self.nominal.dt)

    @cached_property
    def poles(self) -> Complex:
        """Nominal poles in z, (n,).

        LinAlgError of numpy where A is not finite, which the plants' constructors refuse.
        """
        return np.asarray(np.linalg.eigvals(self.nominal.A), dtype=np.complex128)

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """Flexible modes of the nominal below the Nyquist frequency, ascending in frequency.

        Those with a damping ratio below 0.4 (`modes_of`), unstable ones with a negative ratio too; empty
        without any.
        """
        modes = modes_of(self.poles, self.dt_s)
        return tuple(mode for mode in modes if mode.omega_rad_s < np.pi / self.dt_s)


@dataclass(frozen=True, eq=False)
class PlantChannel(NominalPlant):
    """One response with its uncertainty.

    Parameters
    ----------
    nominal : control.StateSpace
        Discrete, one input and one output.
    uncertainty : object or None
        With a method `at(omega_rad_s, level)` it is known at any frequency; with omega_rad_s, centre,
        covariance and level on these frequencies only; None: the nominal response is exact.
    level : float
        Probability in (0, 1) of the ellipses where the uncertainty is known at any frequency, the usual 0.95;
        a record on its own frequencies brings its own level.

    Raises
    ------
    ValueError
        For a nominal that is no discrete state space with one input and one output, or not finite, a level
        outside (0, 1), an object that is no uncertainty, or own frequencies that do not ascend from zero to
        at most Nyquist.
    """

    nominal: control.StateSpace
    uncertainty: EvaluableUncertainty | ResponseSet | None = None
    level: float = 0.95

    def __post_init__(self) -> None:
        """Check nominal, level and uncertainty.

        Raises the ValueError that the class names; centre and covariance are checked when they are asked for.
        """
        # Imported here and below, because it brings a plotting library with it.
        import control

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
        grid = self.own_grid
        if grid is not None:
            ascending = grid.size >= 2 and np.all(np.diff(grid) > 0) and grid[0] >= 0
            if not ascending:
                raise ValueError(
                    "the uncertainty's own grid needs at least two ascending frequencies in rad/s"
                )
            if not grid[-1] <= np.pi / system.dt * (1 + _SAME_FREQUENCY_SHARE):
                raise ValueError(
                    f"the uncertainty's grid reaches {grid[-1]:.5g} rad/s; the Nyquist frequency is "
                    f"{np.pi / system.dt:.5g}"
                )

    @property
    def own_grid(self) -> Real | None:
        """Frequencies (F,) in rad/s where alone the uncertainty is known, or None if it can be evaluated
        anywhere.

        Not checked here: the constructor has done that.
        """
        if self.uncertainty is None or hasattr(self.uncertainty, "at"):
            return None
        return np.asarray(self.uncertainty.omega_rad_s, dtype=np.float64)

    def nominal_response(self, omega_rad_s: Real) -> Complex:
        """G_nom(e^{j omega dt}), (F,) complex, at omega (F,) in rad/s.

        Units of output per input. LinAlgError of numpy at a pole on the circle (omega = 0 with an
        integrator).
        """
        return frequency_response(self.nominal, omega_rad_s)

    def at(self, omega_rad_s: Real) -> Ellipses:
        """Ellipses at omega (F,) in rad/s, ascending.

        Frequencies of a record that is known on its own ones only must be among these; outside their range
        the nominal response stands alone, without uncertainty. Raises ValueError at a frequency between them,
        and where `Ellipses` refuses the record (not ascending, not finite, a covariance that is none);
        LinAlgError where the nominal has a pole there.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        if self.uncertainty is None:
            return Ellipses.of_no_size(omega, self.nominal_response(omega))
        record: Any = self.uncertainty
        if hasattr(record, "at"):
            record = record.at(omega, self.level)
            centre = np.asarray(record.centre)
            covariance = np.asarray(record.covariance)
            return Ellipses.from_covariance(omega, centre, covariance, self.level)
        grid = np.asarray(record.omega_rad_s, dtype=np.float64)
        below = omega < grid[0] * (1 - _SAME_FREQUENCY_SHARE)
        above = omega > grid[-1] * (1 + _SAME_FREQUENCY_SHARE)
        outside = below | above
        # The nearest of the record's frequencies: the one at or above, or the one before it.
        after = np.clip(np.searchsorted(grid, omega), 0, grid.size - 1)
        before = np.maximum(after - 1, 0)
        before_is_nearer = np.abs(grid[before] - omega) < np.abs(grid[after] - omega)
        index = np.where(before_is_nearer, before, after)
        missing = ~outside & (np.abs(grid[index] - omega) > _SAME_FREQUENCY_SHARE * omega)
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
    """Response (F,) complex of a discrete system with one input and one output at omega (F,) in rad/s.

    Of a larger system the response from its first input to its first output. LinAlgError of numpy at a pole
    on the circle.
    """
    return matrix_response(system, omega_rad_s)[:, 0, 0]


def matrix_response(system: control.StateSpace, omega_rad_s: Real) -> Complex:
    """Response matrix of a discrete system with U inputs and Y outputs.

    Parameters
    ----------
    system : control.StateSpace
        Discrete, dt in seconds.
    omega_rad_s : (F,) array
        Frequencies.

    Returns
    -------
    (F, Y, U) complex array
        C (zI - A)^-1 B + D on z = e^{j omega dt}.

    Raises
    ------
    LinAlgError
        By numpy, at a pole on the circle exactly; nan frequencies give nan.

    Notes
    -----
    zI - A is formed as (z - 1) I - (A - I) with z - 1 = expm1(j omega dt), so that a pole of 1e-3 rad/s at 1
    kHz keeps its digits.
    """
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
    for start in range(0, omega.size, _BATCH_FREQUENCIES):
        batch = slice(start, start + _BATCH_FREQUENCIES)
        part = z_minus_1[batch]
        matrices = part[:, None, None] * np.eye(n) - shifted
        states = np.linalg.solve(matrices, np.broadcast_to(b, (part.size, *b.shape)))
        response[batch] += c @ states
    return response


def delayed(system: control.StateSpace, samples: int) -> control.StateSpace:
    """Discrete system behind a delay of whole samples of every input; the states of the delay come after
    those of the system. samples = 0 returns the system itself.

    A negative number counts as none (not checked).
    """
    if samples == 0:
        return system
    import control

    a = np.asarray(system.A, dtype=np.float64)
    b = np.asarray(system.B, dtype=np.float64)
    c = np.asarray(system.C, dtype=np.float64)
    d = np.asarray(system.D, dtype=np.float64)
    # Each sample of delay turns the inputs into states, which then drive the system so far.
    for _ in range(samples):
        n, inputs = b.shape
        a = np.block([[a, b], [np.zeros((inputs, n + inputs))]])
        b = np.vstack([np.zeros((n, inputs)), np.eye(inputs)])
        c = np.hstack([c, d])
        d = np.zeros_like(d)
    return control.ss(a, b, c, d, system.dt)


def count_integrators(poles_z: Complex) -> int:
    """Number of poles at z = 1, from 0 to 3, among poles_z (N,) complex.

    A multiple pole splits by a root of the rounding error (1e-8 for two poles, 1e-5 for three), but the mean
    of the cluster stays accurate. A true slow pole (1e-3 rad/s at 1 kHz: 1e-6 from z = 1) is no integrator.

    0 for no poles. A nan is never at 1.
    """
    distance = np.asarray(poles_z, dtype=np.complex128) - 1.0
    distance = distance[np.argsort(np.abs(distance), kind="stable")]
    for count, radius in _INTEGRATOR_CLUSTERS:
        if distance.size < count:
            continue
        within_radius = abs(distance[count - 1]) < radius
        if within_radius and abs(np.mean(distance[:count])) < _INTEGRATOR_MEAN_DISTANCE:
            return count
    return 0


@dataclass(frozen=True)
class Mode:
    """A lightly damped pole pair: undamped frequency in rad/s and damping ratio zeta (negative: unstable)."""

    omega_rad_s: float
    zeta: float


def modes_of(poles_z: Complex, dt_s: float, *, zeta_below: float = 0.4) -> tuple[Mode, ...]:
    """Oscillatory pole pairs among poles in z, ascending in frequency.

    Parameters
    ----------
    poles_z : (N,) complex array
        Of a pair both are there; the one in the upper half plane is read.
    dt_s : float
        Sampling period in seconds.
    zeta_below : float
        Pairs of this damping ratio or more are no modes: at .4 the peak is 3 dB, and nothing narrow is left
        that a grid of frequencies could miss.

    Returns
    -------
    tuple of Mode
        From s = ln(z)/dt: frequency |s|, rad/s, and zeta = -Re s/|s|, negative outside the circle. Empty
        without pairs; nan is none. Not checked: dt_s above 0.
    """
    poles = np.asarray(poles_z, dtype=np.complex128)
    oscillating = (np.imag(poles) > _REAL_BELOW) & (np.abs(poles) > _DEADBEAT_BELOW)
    modes = []
    for s in np.log(poles[oscillating]) / dt_s:
        mode = Mode(float(abs(s)), float(-s.real / abs(s)))
        if mode.zeta < zeta_below:
            modes.append(mode)
    return tuple(sorted(modes, key=lambda mode: mode.omega_rad_s))


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False, init=False)
class UncertainPlant(NominalPlant, Shown):
    """A plant from its input to its measured output, with ellipses: one for each load or operating point.

    Parameters
    ----------
    plant : object
        Discrete, one input and one output: of python-control (ss, tf), scipy (dlti), or anything with
        `to_control()`. A result of `flexlink.uncertainty` has its own ellipses, one of `identify_frf` those
        of its posterior; anything else is exact unless `uncertainty` is given. The state space that is made
        of it is kept as `nominal`.
    nominal : control.StateSpace, optional
        In place of `plant`.
    name : str
        Not empty; errors and tables name the plant by it.
    uncertainty : object or None
        Of the measured output, see `PlantChannel`; a `control.frd` is a measured response, taken as exact.
    integrators : int or None
        Poles at z = 1, 0 to 2; None: counted. A number that contradicts the nominal is refused.
    performance : PlantChannel or None
        The response whose |Gp S| the damping requirement bounds, from the same input; None: the measured
        output.
    level : float
        Probability of the ellipses of the measured output, in (0, 1); the usual 0.95.

    Raises
    ------
    ValueError
        For an empty name, a wrong number of integrators, an undamped mode, a performance channel of another
        sampling period, or what `state_space` and `PlantChannel` refuse.

    Examples
    --------
    >>> import control
    >>> flexlink.UncertainPlant(control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01), name="motor")
    UncertainPlant 'motor': 1 state, dt = 0.01 s, no integrator, response taken as exact
    >>> flexlink.UncertainPlant(control.tf([0.1], [1.0, 0.5]), name="motor")
    Traceback (most recent call last):
    ident.data.keywords.WrongArgumentError: plant 'motor' is in continuous time, flexlink works in ...
    """

    name: str
    nominal: control.StateSpace
    uncertainty: EvaluableUncertainty | ResponseSet | None = None
    integrators: int | None = None
    performance: PlantChannel | None = None
    level: float = 0.95

    def __init__(
        self,
        plant: Any = None,
        *,
        name: str = "plant",
        uncertainty: Any = None,
        nominal: Any = None,
        integrators: int | None = None,
        performance: PlantChannel | None = None,
        level: float = 0.95,
    ) -> None:
        """Take nominal and uncertainty from what is given, and check the parts against one another."""
        system = plant if nominal is None else nominal
        # A measured response has no poles: beside a nominal model it is what must hold on the machine.
        if nominal is not None and uncertainty is None and is_measured(plant):
            uncertainty = plant
        if is_measured(uncertainty):
            uncertainty = measured_response(uncertainty, f"the response of plant {name!r}")
        if uncertainty is None:
            uncertainty = getattr(system, "own_uncertainty", None)
        values = {
            "name": name,
            "nominal": state_space(system, f"plant {name!r}"),
            "uncertainty": uncertainty,
            "integrators": integrators,
            "performance": performance,
            "level": level,
        }
        # Fields of a frozen class are set through `object`.
        for key, value in values.items():
            object.__setattr__(self, key, value)
        self._refuse_misfits()

    def _refuse_misfits(self) -> None:
        """Check the parts against one another and count the integrators.

        Raises the ValueError that the class names.
        """
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
        if np.any(np.abs(np.abs(self._other_poles) - 1.0) < _ON_CIRCLE_DISTANCE):
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
        """The response from the input to the measured output.

        Raises the ValueError of `PlantChannel` when it is first asked for.
        """
        return PlantChannel(self.nominal, self.uncertainty, self.level)

    @property
    def nyquist_rad_s(self) -> float:
        """Nyquist frequency pi/dt in rad/s."""
        return float(np.pi / self.dt_s)

    @property
    def damped(self) -> PlantChannel:
        """The channel whose |Gp S| the damping requirement bounds.

        That is `performance`, or the measured output's channel without one.
        """
        return self.channel if self.performance is None else self.performance

    @cached_property
    def zeros(self) -> Complex:
        """Finite nominal zeros in z, (n,) complex; those that are infinite but for rounding are dropped.

        Empty for a static plant. By the control library, from the state space.
        """
        if self.nominal.nstates == 0:
            return np.zeros(0, complex)
        zeros = np.asarray(self.nominal.zeros(), dtype=np.complex128)
        is_finite = np.isfinite(zeros) & (np.abs(zeros) < _INFINITE_ZERO)
        return zeros[is_finite]

    @property
    def n_integrators(self) -> int:
        """Poles at z = 1, 0 to 2."""
        assert self.integrators is not None
        return self.integrators

    @cached_property
    def unstable_poles(self) -> int:
        """Number of nominal poles outside the unit circle; integrators are not among them.

        None lies on the circle: the constructor refuses that.
        """
        return int(np.sum(np.abs(self._other_poles) > 1.0))

    def slow_poles_rad_s(self, below_rad_s: float) -> tuple[float, ...]:
        """Frequencies |log z|/dt in rad/s beyond which the plant integrates: those of nominal poles below
        `below_rad_s`, ascending, 0 for an integrator.

        Each zero below that frequency takes the slope of one pole away again: as many poles are left out, the
        fastest first.

        Not checked: a frequency of 0 or less leaves the integrators alone.
        """
        poles = self._other_poles
        zeros = self.zeros
        # Roots at z = 0 are delays: infinitely fast.
        is_delay = poles == 0
        is_zero_at_0 = zeros == 0
        pole_frequencies = np.sort(np.abs(np.log(poles[~is_delay])) / self.dt_s)
        zero_frequencies = np.sort(np.abs(np.log(zeros[~is_zero_at_0])) / self.dt_s)
        slow = [0.0] * self.n_integrators
        for frequency in pole_frequencies:
            if frequency < below_rad_s:
                slow.append(float(frequency))
        n_slow_zeros = int(np.sum(zero_frequencies < below_rad_s))
        return tuple(slow[: max(len(slow) - n_slow_zeros, 0)])

    @property
    def _other_poles(self) -> Complex:
        """Nominal poles without the integrators, (n,) complex, the nearest to z = 1 first.

        Nothing can be refused.
        """
        by_distance = np.argsort(np.abs(self.poles - 1.0), kind="stable")
        return self.poles[by_distance][self.n_integrators :]

    @property
    def ellipse_modes(self) -> tuple[Mode, ...]:
        """Flexible modes of the basis functions whose coefficients the posteriors of both channels are about.

        An ellipse is narrow or wide around them, and the nominal need not have them. Ascending in frequency
        by channel, twice where both channels have one; none of an uncertainty that is no posterior. Nothing
        is checked.
        """
        # Imported here, because it brings compiled kernels with it.
        from ident.uncertainty import ResponsePosterior

        modes: list[Mode] = []
        for channel in (self.channel, self.damped):
            uncertainty = channel.uncertainty
            if isinstance(uncertainty, ResponsePosterior):
                modes.extend(modes_of(uncertainty.poles.values, self.dt_s))
        return tuple(modes)

    @property
    def own_grid(self) -> npt.NDArray[np.float64] | None:
        """Frequencies (F,) in rad/s where alone the measured output's uncertainty is known, or None."""
        return self.channel.own_grid

    def at(self, omega_rad_s: Real) -> Ellipses:
        """Ellipses of the response from the input to the measured output at omega (F,) in rad/s.

        Raises what `PlantChannel.at` raises.
        """
        return self.channel.at(omega_rad_s)
