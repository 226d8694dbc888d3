"""A frequency response with a 2x2 covariance at every frequency: what identification hands to control.

`FrequencyUncertainty` is the response as a Gaussian over real and imaginary part, frequency by frequency, as
estimators, measured tables and empirical responses give it and as controllers are designed for it. It checks
its numbers once, so that whoever takes one need not. `ellipse` draws the regions of a confidence level,
`normalised_distance` and `contains` compare another response with them; `from_csv` and `to_csv` exchange
tables with other programs. Nothing is said of how errors at different frequencies belong together.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ident.data.arrays import BoolArray, ComplexArray, RealArray, lock, readonly
from ident.data.ellipses import EllipseAxes, chi2_radius, ellipse_distance, relative_deficit, standard_axes
from ident.data.keywords import clear_constructor
from ident.data.record_files import read_table
from ident.data.response_columns import read_response
from ident.data.table import LARGEST

# By how much a covariance may miss symmetry or semidefiniteness, relative to its largest entry: a product of
# factors misses them by rounding, not by more.
PSD_TOLERANCE = 1e-9
# Relative excess of a frequency over the Nyquist frequency that counts as rounding.
ABOVE_NYQUIST = 1e-9
# Frequencies of a grid of our own, for whoever asks for none (not used in this file): a hundred a decade over
# four decades, so that the widest step, 2.3 %, is finer than a mode with 2 % damping is wide (4 %).
FREQUENCIES = 400
# The column of a table that may be left out where it is zero.
CROSS_COLUMN = "covariance_real_imag"


@clear_constructor
@dataclass(frozen=True, eq=False)
class FrequencyUncertainty:
    """A frequency response G(e^{j omega dt}) ~ N(centre, covariance) over (Re, Im), frequency by frequency.

    Attributes
    ----------
    omega_rad_s : ndarray, shape (F,)
        Frequencies, rad/s, strictly increasing, 0 <= omega <= pi / dt_s.
    centre : ndarray, shape (F,)
        Complex response, in units of the output per unit of the input.
    covariance : ndarray, shape (F, 2, 2)
        Symmetric and positive semidefinite; zero where the response is known exactly.
    dt_s : float
        Sampling time, s.
    level : float
        Confidence level of each frequency's ellipse taken by itself, between 0 and 1. The default of 0.95 is
        convention: 1 in 20 outside.
    method : str
        Where the numbers come from, in words.

    Raises
    ------
    ValueError
        A shape or a number does not fit; the message names the first frequency at fault.

    Examples
    --------
    >>> omega = np.array([1.0, 10.0, 100.0])
    >>> covariance = np.tile(1e-4 * np.eye(2), (3, 1, 1))
    >>> measured = flexlink.FrequencyUncertainty(omega, 1 / (1 + 0.1j * omega), covariance, dt_s=0.005)
    >>> measured.ellipse(0.95).semi_major.round(4)
    array([0.0245, 0.0245, 0.0245])
    """

    omega_rad_s: RealArray
    centre: ComplexArray
    covariance: RealArray
    dt_s: float
    level: float = 0.95
    method: str = "given"

    def __post_init__(self) -> None:
        """Lock the arrays, check them, and make the covariance exactly symmetric.

        Raises ValueError where a shape or a number does not fit, naming the first frequency at fault.
        """
        lock(self, "omega_rad_s")
        lock(self, "centre", dtype=np.complex128)
        omega = self.omega_rad_s
        centre = self.centre
        covariance = np.array(self.covariance, dtype=np.float64)
        is_a_list = omega.ndim == 1 and omega.size > 0
        if not is_a_list or centre.shape != omega.shape or covariance.shape != (omega.size, 2, 2):
            raise ValueError(
                "need omega (F,), centre (F,) and covariance (F,2,2) with F >= 1; "
                f"got {omega.shape}, {centre.shape}, {covariance.shape}"
            )
        if not (0 < self.dt_s < np.inf):
            raise ValueError(f"dt_s must be positive and finite; got {self.dt_s}")
        chi2_radius(self.level)  # its ValueError refuses a level outside of (0, 1)

        # Comparisons with NaN are false, so what must hold is asked for and negated. `LARGEST` is 1e100:
        # squares of larger numbers leave the range of doubles.
        nyquist = np.pi / self.dt_s
        _refuse_first(~np.isfinite(omega), omega, "omega is not finite")
        _refuse_first(~(np.diff(omega) > 0), omega[1:], "omega must be strictly increasing; it is not")
        _refuse_first(omega < 0, omega, "omega must not be negative")
        is_above = omega > nyquist * (1 + ABOVE_NYQUIST)
        _refuse_first(is_above, omega, f"omega is above pi / dt_s = {nyquist:.6g} rad/s")
        _refuse_first(~(np.abs(centre) < LARGEST), omega, f"the centre is not finite, or beyond {LARGEST:g}")
        is_finite = np.all(np.isfinite(covariance), axis=(1, 2))
        _refuse_first(~is_finite, omega, "the covariance is not finite")
        upper = covariance[:, 0, 1]
        lower = covariance[:, 1, 0]
        largest = np.abs(covariance).max(axis=(1, 2))
        is_skew = np.abs(upper - lower) > PSD_TOLERANCE * largest
        _refuse_first(is_skew, omega, "the covariance is not symmetric")
        is_indefinite = relative_deficit(covariance) > PSD_TOLERANCE
        _refuse_first(is_indefinite, omega, "the covariance is not positive semidefinite")

        cross = 0.5 * (upper + lower)
        covariance[:, 0, 1] = cross
        covariance[:, 1, 0] = cross
        object.__setattr__(self, "dt_s", float(self.dt_s))
        object.__setattr__(self, "level", float(self.level))
        object.__setattr__(self, "covariance", readonly(covariance))

    def ellipse(self, level: float | None = None) -> EllipseAxes:
        """Return the axes of F ellipses that hold the response with this probability, each by itself.

        Parameters
        ----------
        level : float, optional
            Default: `self.level`.

        Returns
        -------
        EllipseAxes
            Half-axes `semi_major` >= `semi_minor` >= 0, (F,) in units of the response, and `direction` (F,),
            complex of modulus 1, along the major one. Half-axes are zero where the covariance is.

        Raises
        ------
        ValueError
            The level does not lie between 0 and 1.
        """
        axes = standard_axes(self.covariance)
        radius = chi2_radius(self.level if level is None else level)
        return EllipseAxes(
            semi_major=radius * axes.major, semi_minor=radius * axes.minor, direction=axes.direction
        )

    def normalised_distance(self, response: npt.ArrayLike) -> RealArray:
        """Return how far a response is from the centre in units of the ellipse, (F,): 1 on its boundary.

        Parameters
        ----------
        response : array-like, shape (F,)
            Complex, at the frequencies of this response.

        Raises
        ------
        ValueError
            Another shape, or a number that is not finite.
        """
        response = self._matching(response)
        magnitude = np.abs(self.centre) + np.abs(response)
        return ellipse_distance(response - self.centre, self.ellipse(), magnitude)

    def contains(self, response: npt.ArrayLike) -> BoolArray:
        """Return whether a response (F,) lies in the ellipse of each frequency, (F,) of bool; so does the
        boundary.

        Raises ValueError for another shape, or a number that is not finite.
        """
        return np.asarray(self.normalised_distance(response) <= 1.0)

    def enclosing_radius(self) -> RealArray:
        """Return the radii (F,) of the smallest discs around the centre that hold the ellipses.

        In units of the response; the level is `self.level`.
        """
        return self.ellipse().semi_major

    def to_control(self) -> Any:
        """Return the centre as `control.FrequencyResponseData`, without the covariances.

        Raises ImportError where python-control is not installed.
        """
        # Here and not above: python-control brings its plotting along.
        import control

        return control.FrequencyResponseData(self.centre, self.omega_rad_s, dt=self.dt_s)

    @classmethod
    def from_csv(cls, path: str | Path, dt_s: float, *, level: float = 0.95) -> Self:
        """Read a frequency response with covariances.

        Parameters
        ----------
        path : path-like
            A table with a frequency (Hz or rad/s by its name, as `omega_rad_s`), the response (`real` and
            `imag`, or gain as factor or dB and phase in rad or degrees; `response_columns` finds them by name
            and unit), and columns `variance_real`, `variance_imag` and, if it is not zero,
            `covariance_real_imag`, in squares of the response's unit.
        dt_s : float
            Sampling time, s; decides nothing but the highest frequency that is taken.
        level : float
            Confidence level of the ellipses; the default is that of the class.

        Raises
        ------
        ValueError
            In one line that begins with the path. Of a cell that is no number it names line and column, of a
            negative variance the line, of frequencies that do not increase, lie above pi / dt_s, or of a
            covariance that is not positive semidefinite the first frequency; else what column or unit lacks.
        """
        table = read_table(path)
        omega, centre = read_response(table)
        variances = table.columns(("variance_real", "variance_imag"))
        variance_re = variances["variance_real"]
        variance_im = variances["variance_imag"]
        negative = np.flatnonzero(np.minimum(variance_re, variance_im) < 0)
        if negative.size:
            raise ValueError(f"{path}, {table.place(int(negative[0]))}: a variance is negative")
        if CROSS_COLUMN in table.names:
            cross = table.columns([CROSS_COLUMN])[CROSS_COLUMN]
        else:
            cross = np.zeros_like(omega)
        first_row = np.stack([variance_re, cross], -1)
        second_row = np.stack([cross, variance_im], -1)
        covariance = np.stack([first_row, second_row], -2)
        try:
            return cls(omega, centre, covariance, dt_s, level, f"given in {table.path.name}")
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def to_csv(self, path: str | Path) -> None:
        """Write a table of the columns that `from_csv` reads; numbers keep all their digits.

        A file of that name is overwritten; OSError where it cannot be written. dt_s, level and method are not
        stored.
        """
        columns = {
            "omega_rad_s": self.omega_rad_s,
            "real": self.centre.real,
            "imag": self.centre.imag,
            "variance_real": self.covariance[:, 0, 0],
            "variance_imag": self.covariance[:, 1, 1],
            CROSS_COLUMN: self.covariance[:, 0, 1],
        }

        # The shortest text that gives the same double again.
        texts = [[repr(number) for number in column.tolist()] for column in columns.values()]
        lines = [",".join(columns)]
        for row in zip(*texts, strict=True):
            lines.append(",".join(row))
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")

    def _matching(self, response: npt.ArrayLike) -> ComplexArray:
        """Return a response as a complex array (F,). Raises ValueError for another shape, or a number that is
        not finite."""
        response = np.asarray(response, dtype=np.complex128)
        if response.shape != self.omega_rad_s.shape:
            raise ValueError(
                f"need a response on this grid, shape {self.omega_rad_s.shape}; got {response.shape}"
            )
        if not np.all(np.isfinite(response)):
            raise ValueError("the response must be finite")
        return response


def _refuse_first(is_refused: BoolArray, omega_rad_s: RealArray, complaint: str) -> None:
    """Raise ValueError with a complaint and the first refused of the frequencies (F,), if there is one.

    is_refused: (F,). omega_rad_s is not checked: a NaN is printed as nan.
    """
    if np.any(is_refused):
        first = int(np.argmax(is_refused))
        raise ValueError(f"{complaint} (first at omega = {omega_rad_s[first]:.6g} rad/s)")
