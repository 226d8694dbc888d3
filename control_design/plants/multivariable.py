"""A plant with U inputs and Y outputs, and what is not known of its response matrix.

The response matrix of several joints has uncertainty of two kinds. A `ResponseBall` holds what the
identification leaves open: all entries of the matrix together, as a ball of the Frobenius norm behind left
and right factors. Errors of single channels (an actuator's gain, a sensor's) are weights, each with a complex
uncertainty of its own. `MultivariablePlant` puts both beside the nominal model and turns them into the blocks
that the scaled bound of `scaled_bound` works on.
"""

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
from ident.data.keywords import clear_constructor

if TYPE_CHECKING:
    import control


# The Tustin map takes the Nyquist frequency to infinity; beyond this multiple of 1/dt a proper weight has its
# value at infinity within nine digits.
_INFINITE_S_DT = 1e9

# A frequency asked for is one of the ball's own within this share: files round to nine digits or so.
_SAME_FREQUENCY_SHARE = 1e-8

# Zeros farther out in z are at infinity: rounding of the generalised eigenvalue problem.
_INFINITE_ZERO = 1e4


def tustin_s(omega_rad_s: Real, dt_s: float) -> Complex:
    """s = j (2/dt) tan(omega dt/2), (F,) complex in rad/s, in which weights and controllers are written.

    omega_rad_s (F,), dt_s in seconds. At most 1e9/dt, where the tangent goes to infinity at Nyquist.

    Not checked: frequencies above Nyquist, where the tangent changes its sign.
    """
    largest = _INFINITE_S_DT / dt_s
    with np.errstate(over="ignore"):
        size = 2.0 / dt_s * np.tan(np.asarray(omega_rad_s, dtype=np.float64) * dt_s / 2)
    return 1j * np.where(np.abs(size) > largest, largest, size)


class IdentifiedMatrix(Protocol):
    """What a ball needs of an identified matrix response (`ident.uncertainty` has it)."""

    @property
    def dt_s(self) -> float:
        """Sampling period in seconds."""
        ...

    @property
    def output_factor(self) -> Real:
        """Lo (Y, P), a factor of the covariance between outputs."""
        ...

    def input_factor(self, lowest_rad_s: float) -> tuple[Real, Real, Real, Real]:
        """State-space matrices A, B, C, D of the stable Li(z) with U inputs, kept constant below a
        frequency.

        lowest_rad_s: that frequency, rad/s. What it refuses goes up through `ResponseBall.of`.
        """
        ...

    def largest_radius(self, lowest_rad_s: float) -> float:
        """Radius of the ball that holds the response at every frequency from lowest_rad_s on.

        No unit. What it refuses goes up through `ResponseBall.of`.
        """
        ...


@clear_constructor
@dataclass(frozen=True, eq=False)
class ResponseBall:
    """Responses G + Lo Delta Li with |Delta|_F <= radius at every frequency; `of` makes a ball of an
    identified response.

    Parameters
    ----------
    Lo : (Y, P) array
        Factor at the outputs.
    Li : control.StateSpace or (F, Q, U) complex array
        Factor at the inputs: stable and discrete with U inputs, or its values at omega_rad_s, between which
        nothing is known.
    radius : float
        Positive. For a Kronecker covariance Lo Lo^H (x) Li^H Li it is sqrt(chi^2 quantile / 2) with 2 U Y
        degrees of freedom.
    omega_rad_s : (F,) array or None
        Ascending and positive, at least two, for values; None for a state space.
    lowest_rad_s : float
        Below it the ball says nothing, and certificates begin there.

    Raises
    ------
    ValueError
        For shapes that do not fit, values that are not finite, an unstable Li or a radius that is not
        positive.

    Examples
    --------
    >>> found = flexlink.identify_mimo(example_two_joints(), n_real=0, n_pairs=1)
    >>> posterior = flexlink.matrix_posterior(example_two_joints(), found)
    >>> flexlink.ResponseBall.of(posterior, lowest_rad_s=0.6).lowest_rad_s
    0.6
    """

    Lo: Real
    Li: Any
    radius: float
    omega_rad_s: Real | None = None
    lowest_rad_s: float = 0.0

    def __post_init__(self) -> None:
        """Lock the arrays and check them.

        Raises the ValueError that the class names; `lowest_rad_s` is not checked.
        """
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
        """Ball of an identified matrix response; Li is exact, the radius the largest of a grid of
        frequencies.

        Parameters
        ----------
        posterior : IdentifiedMatrix
            Gives the factors and the radius.
        lowest_rad_s : float
            The slowest motion that the records tell: 2 pi over the length of the longest, or the lowest
            frequency that was excited. Below, an integrator's uncertainty grows without bound and is kept as
            it is there. Lower values widen every ball (one radius for all), higher ones leave more unchecked.

        Raises
        ------
        ValueError
            What the posterior or the constructor refuses, among it a lowest frequency that is not positive.
        """
        # Imported here, because it brings a plotting library with it.
        import control

        li = control.ss(*posterior.input_factor(lowest_rad_s), posterior.dt_s, remove_useless_states=False)
        radius = posterior.largest_radius(lowest_rad_s)
        return cls(posterior.output_factor, li, radius, lowest_rad_s=lowest_rad_s)

    def gram(self, omega_rad_s: Real) -> Complex:
        """radius^2 Li^H Li, (F, U, U) complex, at omega (F,) in rad/s. Raises ValueError at a frequency
        between those that values are given at.

        Frequencies outside their range are refused, too.
        """
        if self.omega_rad_s is None:
            values = matrix_response(self.Li, omega_rad_s)
        else:
            grid = self.omega_rad_s
            # A little below what is asked for, a tenth of `_SAME_FREQUENCY_SHARE`, so that rounding does not
            # take the next one.
            index = np.clip(np.searchsorted(grid, omega_rad_s * (1 - 1e-9)), 0, grid.size - 1)
            if np.any(np.abs(grid[index] - omega_rad_s) > _SAME_FREQUENCY_SHARE * omega_rad_s):
                raise ValueError("the uncertainty is known on its own frequencies only; ask there")
            values = self.Li[index]
        return self.radius**2 * conjugate(values) @ values


@clear_constructor
@dataclass(frozen=True, eq=False)
class MultivariablePlant(NominalPlant):
    """Plant with U inputs and Y outputs and its uncertainty, under the law u = -K y.

    Parameters
    ----------
    name : str
        Errors name the plant by it.
    nominal : control.StateSpace
        Discrete, dt in seconds. Poles at z = 1 are allowed.
    ball : ResponseBall or None
        Uncertainty of the response matrix.
    input_error, output_error : tuple of RationalWeight
        A weight for each actuator or sensor, or (): that channel's gain is (1 + w Delta), |Delta| <= 1
        complex, each by itself. One of the two only.

    Raises
    ------
    ValueError
        For a plant that is not discrete or not finite, or whose parts do not fit.

    Notes
    -----
    Neglected: products of the ball and a channel's error.

    Examples
    --------
    >>> found = flexlink.identify_mimo(example_two_joints(), n_real=0, n_pairs=1)
    >>> posterior = flexlink.matrix_posterior(example_two_joints(), found)
    >>> ball = flexlink.ResponseBall.of(posterior, lowest_rad_s=0.6)
    >>> plant = flexlink.MultivariablePlant("two joints", found.to_control(), ball)
    >>> plant.name, plant.dt_s
    ('two joints', 0.01)
    """

    name: str
    nominal: control.StateSpace
    ball: ResponseBall | None = None
    input_error: tuple[RationalWeight, ...] = ()
    output_error: tuple[RationalWeight, ...] = ()

    def __post_init__(self) -> None:
        """Check the parts against one another.

        Raises the ValueError that the class names; poles outside the circle are allowed.
        """
        # Imported here, because it brings a plotting library with it.
        import control

        system = self.nominal
        if not isinstance(system, control.StateSpace):
            raise ValueError(f"the nominal plant must be a control.StateSpace; got {type(system).__name__}")
        if system.dt is None or system.dt is True or not system.dt > 0:
            raise ValueError(f"the nominal plant must be discrete with dt in seconds; got dt = {system.dt}")
        if not all(np.all(np.isfinite(getattr(system, matrix))) for matrix in "ABCD"):
            raise ValueError(f"plant {self.name!r} has a value that is not finite")
        for field_name, weights, count in (
            ("input_error", self.input_error, self.inputs),
            ("output_error", self.output_error, self.outputs),
        ):
            if len(weights) not in (0, count):
                raise ValueError(
                    f"plant {self.name!r}: {field_name} needs {count} weights; got {len(weights)}"
                )
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
        """Number of inputs U."""
        return int(self.nominal.ninputs)

    @property
    def outputs(self) -> int:
        """Number of outputs Y."""
        return int(self.nominal.noutputs)

    @property
    def own_grid(self) -> Real | None:
        """Frequencies (F,) in rad/s where alone the uncertainty is known, or None: it is known everywhere."""
        if self.ball is None:
            return None
        return self.ball.omega_rad_s

    @cached_property
    def zeros(self) -> Complex:
        """Transmission zeros in z, (N,) complex, of a plant with as many inputs as outputs; none otherwise.

        They are the finite generalised eigenvalues of the pencil [A - zI, B; C, D].

        Where the pencil is singular at every z, zeros come out as nan and are left out.
        """
        if self.inputs != self.outputs or self.nominal.nstates == 0:
            return np.zeros(0, complex)
        a, b, c, d = (np.asarray(getattr(self.nominal, matrix), dtype=np.float64) for matrix in "ABCD")
        n, m = b.shape
        system_matrix = np.block([[a, b], [c, d]])
        states_only = scipy.linalg.block_diag(np.eye(n), np.zeros((m, m)))
        with np.errstate(divide="ignore", invalid="ignore"):
            zeros = scipy.linalg.eigvals(system_matrix, states_only)
        is_finite = np.isfinite(zeros) & (np.abs(zeros) < _INFINITE_ZERO)
        return np.asarray(zeros[is_finite])

    def blocks(self, omega_rad_s: Real, delay_samples: int = 0) -> tuple[Complex, Complex, Complex]:
        """Nominal response and the Gram matrices of N uncertain blocks: the ball first, then actuators,
        sensors.

        Parameters
        ----------
        omega_rad_s : (F,) array
            Frequencies.
        delay_samples : int
            Computational delay in front of the plant.

        Returns
        -------
        G : (F, Y, U) complex array
            Nominal response behind the delay.
        seen : (F, N, U, U) complex array
            L_i^H L_i of each block B_i Delta_i L_i: what it sees of the input.
        entering : (F, N, Y, Y) complex array
            B_i B_i^H: how it enters the output. Both are fields of `scaled_bound.BoundRows`.

        Raises
        ------
        ValueError
            A ball known on its own frequencies only is asked between them. LinAlgError of numpy at a pole of
            the nominal on the circle (omega = 0 with an integrator). Not checked: that frequencies ascend.
        """
        omega = np.asarray(omega_rad_s, dtype=np.float64)
        delay_response = np.exp(-1j * omega * self.dt_s * delay_samples)[:, None, None]
        G = matrix_response(self.nominal, omega) * delay_response
        s = tustin_s(omega, self.dt_s)
        input_square = (omega.size, self.inputs, self.inputs)
        output_square = (omega.size, self.outputs, self.outputs)
        seen: list[Any] = []
        entering: list[Any] = []
        if self.ball is not None:
            seen.append(self.ball.gram(omega))
            entering.append(np.broadcast_to(self.ball.Lo @ self.ball.Lo.T, output_square))
        # An actuator's error sees its own input only and enters through that column of G.
        for i, weight in enumerate(self.input_error):
            size = np.abs(weight.at(s))[:, None, None] ** 2
            axis = np.zeros(input_square[1:])
            axis[i, i] = 1.0
            seen.append(np.broadcast_to(axis, input_square))
            entering.append(size * G[:, :, i, None] * np.conj(G[:, None, :, i]))
        # A sensor's error sees the inputs through that row of G and enters at its own output.
        for i, weight in enumerate(self.output_error):
            size = np.abs(weight.at(s))[:, None, None] ** 2
            axis = np.zeros(output_square[1:])
            axis[i, i] = 1.0
            seen.append(size * np.conj(G[:, i, :, None]) * G[:, None, i, :])
            entering.append(np.broadcast_to(axis, output_square))

        def stacked(blocks: list[Any], shape: tuple[int, int, int]) -> Complex:
            """Blocks of a shape (F, n, n) as one array (F, N, n, n); N = 0 for none.

            Lists and shapes are made above; nothing is checked.
            """
            if blocks:
                return np.asarray(np.stack(blocks, axis=1), dtype=np.complex128)
            return np.zeros((shape[0], 0, *shape[1:]), dtype=np.complex128)

        return G, stacked(seen, input_square), stacked(entering, output_square)

    def delayed(self, samples: int) -> control.StateSpace:
        """The nominal system behind a computational delay of whole samples.

        samples: not negative, not checked (a negative number counts as none).
        """
        return delayed(self.nominal, samples)
