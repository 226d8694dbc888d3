"""Repeated measurements of one frequency response, point by point: reading, choosing, averaging.

A response that an analyser or a sweep measured several times comes as points: frequency, complex response,
and a label for the condition (date, amplitude). `FrfRepeats` reads and chooses points, opens a loop point by
point, and averages the repeats of each frequency with a covariance from their scatter (`FrfRepeats.mean`),
widened by Hotelling's T-squared for the few repeats there are (T. W. Anderson, An Introduction to
Multivariate Statistical Analysis, chapter 5). Assumed: repeats are independent and Gaussian.
`measured_response` takes whatever a user has: a table with variances, repeated sweeps, or a single one. The
default level of 0.95 is convention: 1 in 20 outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from ident.data.arrays import BoolArray, ComplexArray, IntArray, RealArray, factor_matrices, lock
from ident.data.ellipses import hotelling_widening
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.keywords import clear_constructor
from ident.data.record_files import read_table
from ident.data.response_columns import has_response, read_response

# Neighbours on either side that a hint may propose to pool: beyond, what is pooled is no neighbourhood.
# Chosen; it decides only which advice a complaint ends with.
MOST_NEIGHBOURS = 50
# Degrees of freedom that a 2x2 covariance needs to be more than a line: three repeats.
FEWEST_DEGREES = 2
# Median distance of the points of a circular Gaussian cloud from its centre, in standard deviations of one
# coordinate: that of the Rayleigh distribution, sqrt(2 ln 2).
RAYLEIGH_MEDIAN = 1.1774
# Columns in which a table states the spread of its response.
SPREAD_COLUMNS = ("covariance_real_imag", "variance_imag", "variance_real")


@clear_constructor
@dataclass(frozen=True, eq=False)
class FrfRepeats:
    """Measured points of a frequency response; points of equal frequency are repeats.

    Attributes
    ----------
    omega_rad_s : ndarray, shape (K,)
        Frequencies, rad/s, in any order.
    response : ndarray, shape (K,)
        Complex, in units of the output per unit of the input.
    label : tuple of str
        The condition of each point (date, amplitude); '' for each where none is given.

    Raises
    ------
    ValueError
        Other shapes, no point, or numbers that are not finite.

    Examples
    --------
    >>> omega_rad_s, response = [1.0, 1.0, 10.0, 10.0], [1.0, 1.02, 0.5 - 0.5j, 0.51 - 0.5j]
    >>> repeats = flexlink.FrfRepeats(omega_rad_s, response, ["monday"] * 4)
    >>> repeats.band(5.0, 20.0).omega_rad_s
    array([10., 10.])
    """

    omega_rad_s: RealArray
    response: ComplexArray
    label: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Lock the arrays and check them.

        Raises ValueError for other shapes, no point, or numbers that are not finite; negative frequencies
        pass, and are refused by `mean`.
        """
        lock(self, "omega_rad_s")
        lock(self, "response", dtype=np.complex128)
        size = self.omega_rad_s.size
        object.__setattr__(self, "label", tuple(self.label) or ("",) * size)
        if self.omega_rad_s.shape != (size,) or self.response.shape != (size,) or len(self.label) != size:
            raise ValueError(
                f"need omega, response and label of one length; got {self.omega_rad_s.shape}, "
                f"{self.response.shape} and {len(self.label)}"
            )
        if not (size > 0 and np.all(np.isfinite(self.omega_rad_s)) and np.all(np.isfinite(self.response))):
            raise ValueError("need at least one point, and finite frequencies and responses")

    @classmethod
    def from_csv(cls, path: str | Path, *, label: str | None = None) -> Self:
        """Read one measured point from each row of a table.

        Parameters
        ----------
        path : path-like
            A table with a frequency (Hz, rad/s), and real and imaginary part or gain (factor, dB) and phase
            (rad, degrees), under any usual names that say their units.
        label : str, optional
            The column that holds the condition of each point.

        Raises
        ------
        ValueError
            In one line that begins with the path: no column `label`, no frequency or response (`DoubtError`
            where one is there in part, or a unit has to be asked for), or a cell that is no finite number,
            with line and column.
        """
        table = read_table(path)
        if label is not None and label not in table.names:
            raise ValueError(f"{table.path}, line 1: missing column {label}; found {list(table.names)}")
        # Labels are text even where they look like numbers: a date, an amplitude.
        omega, response = read_response(table)
        if label is None:
            return cls(omega, response)
        return cls(omega, response, tuple(str(cell).strip() for cell in table.raw[label]))

    @property
    def labels(self) -> tuple[str, ...]:
        """The different labels, in the order they come. ('',) where no condition is given."""
        return tuple(dict.fromkeys(self.label))

    def only(self, *labels: str) -> FrfRepeats:
        """Return the points of some conditions. Raises ValueError if one does not occur.

        With no label: ValueError, as no point is left.
        """
        for wanted in labels:
            if wanted not in self.label:
                raise ValueError(f"no point is labelled {wanted!r}; there are {list(self.labels)}")
        return self._chosen(np.array([label in labels for label in self.label]))

    def band(self, omega_min_rad_s: float, omega_max_rad_s: float) -> FrfRepeats:
        """Return the points with omega_min <= omega <= omega_max. Raises ValueError if there is none.

        Ends in rad/s; a NaN leaves none.
        """
        is_above = self.omega_rad_s >= omega_min_rad_s
        is_below = self.omega_rad_s <= omega_max_rad_s
        return self._chosen(is_above & is_below)

    def open_loop(self, reference_gain: float, feedback_gain: float) -> FrfRepeats:
        """Return plant responses from those of a closed loop r -> y, point by point.

        G = T / (a - g T) is T = a G / (1 + g G) solved for G; noise grows where a - g T is small, which is
        not looked at.

        Parameters
        ----------
        reference_gain, feedback_gain : float
            a and g of the loop's law u = a r - g y; a in units of u per r, g of u per y. That they are finite
            is not checked, but a response that is not finite is refused.

        Returns
        -------
        FrfRepeats
            G = T / (a - g T), with T the response of the loop.

        Raises
        ------
        ValueError
            a - g T is zero at a point.
        """
        command_per_reference = reference_gain - feedback_gain * self.response
        is_zero = command_per_reference == 0
        if np.any(is_zero):
            omega = self.omega_rad_s[int(np.argmax(is_zero))]
            raise ValueError(f"at omega = {omega:.6g} rad/s a point of the closed loop is exactly a / g")
        return FrfRepeats(self.omega_rad_s, self.response / command_per_reference, self.label)

    def mean(
        self,
        dt_s: float,
        *,
        level: float = 0.95,
        pool_neighbours: int = 0,
        outlier_threshold: float | None = None,
        of: Literal["mean", "next run"] = "mean",
    ) -> FrequencyUncertainty:
        """Average the points of each frequency, with the covariance of their mean.

        Parameters
        ----------
        dt_s : float
            Sampling time of the controller, s; every frequency has to be at most pi / dt_s.
        level : float
            Confidence level of the ellipses, between 0 and 1.
        pool_neighbours : int
            m: relative covariances are averaged over m frequencies on either side first, which few repeats
            need. 0: each frequency by itself.
        outlier_threshold : float, optional
            Points farther than so many robust standard deviations from the median of their frequency are left
            out (`inliers`).
        of : {'mean', 'next run'}
            Whose region it is: that of the mean, or of one more run (Hotelling's prediction region).

        Returns
        -------
        FrequencyUncertainty
            One frequency for each different one, ascending. Where all repeats are equal it has a covariance
            of zero.

        Raises
        ------
        ValueError
            A frequency is left with too few repeats (the message says what helps), an option is negative, a
            mean is zero where neighbours are pooled, or `FrequencyUncertainty` refuses the frequencies or the
            level.

        Notes
        -----
        The covariance is widened until the ellipse of the chi-square quantile at `level` equals Hotelling's:
        variance times 1.7 with 10 repeats, 9.5 with 4, 133 with 3 (at 0.95). `of` is not checked: any other
        text than 'mean' is one more run.
        """
        if pool_neighbours < 0:
            raise ValueError(f"pool_neighbours must not be negative; got {pool_neighbours}")
        if outlier_threshold is not None and not outlier_threshold > 0:
            raise ValueError(f"outlier_threshold must be positive; got {outlier_threshold}")

        # Mean and scatter matrix (sum of squares and products about it) of the repeats of each frequency.
        grid, group = np.unique(self.omega_rad_s, return_inverse=True)
        centre = np.empty(grid.size, dtype=np.complex128)
        scatter = np.empty((grid.size, 2, 2))
        count = np.empty(grid.size, dtype=np.int64)
        for index in range(grid.size):
            is_of_frequency = group == index
            points = self.response[is_of_frequency]
            # Outliers are left out before anything is averaged: a wild point moves the mean.
            if outlier_threshold is not None:
                points = inliers(points, outlier_threshold)
            centre[index] = points.mean()
            deviation = points - centre[index]
            parts = np.stack([deviation.real, deviation.imag])
            scatter[index] = parts @ parts.T
            count[index] = points.size

        # The mean takes one degree of freedom.
        freedom = count - 1
        if pool_neighbours:
            scatter, freedom = _pooled(scatter, freedom, centre, pool_neighbours)
        if np.any(freedom < FEWEST_DEGREES):
            raise ValueError(_too_few(grid, count, freedom))

        # The mean of n points has 1 / n of the variance of one; a further run differs from it by both.
        if of == "mean":
            share = 1 / count
            method = "repeated measurements"
        else:
            share = 1 + 1 / count
            method = "one more run"
        factor = hotelling_widening(freedom, level) * share / freedom
        covariance = scatter * factor[:, None, None]
        return FrequencyUncertainty(grid, centre, covariance, dt_s, level, method)

    def _chosen(self, is_chosen: BoolArray) -> FrfRepeats:
        """Return the points for which an array (K,) is true. Raises ValueError where none is.

        is_chosen: (K,) of bool; numpy raises IndexError for another length.
        """
        if not np.any(is_chosen):
            raise ValueError("no measured point is left")
        return FrfRepeats(
            self.omega_rad_s[is_chosen],
            self.response[is_chosen],
            tuple(self.label[k] for k in np.flatnonzero(is_chosen)),
        )


def is_response(*paths: Path) -> bool:
    """Whether the files are frequency responses; False where one cannot be read, which others will say.

    True for no file.
    """
    try:
        return all(has_response(read_table(path)) for path in paths)
    except ValueError:
        return False


def measured_response(
    paths: Sequence[Path],
    dt_s: float,
    *,
    level: float = 0.95,
    pool_neighbours: int = 0,
    outlier_threshold: float | None = None,
) -> FrequencyUncertainty | FrfRepeats:
    """Return the measured frequency response in one file or several.

    Parameters
    ----------
    paths : sequence of Path
        One table that states variances, or tables of points: sweeps of one response. At least one (numpy's
        ValueError else).
    dt_s : float
        Sampling time of the controller, s.
    level : float
        Confidence level of the ellipses.
    pool_neighbours, outlier_threshold
        Of repeats, see `FrfRepeats.mean`: neighbours that share their scatter, and robust standard deviations
        beyond which a point is left out. Not looked at where variances are stated.

    Returns
    -------
    FrequencyUncertainty or FrfRepeats
        The points themselves where each frequency is measured once, so that the spread is not known.

    Raises
    ------
    ValueError
        Naming the file: what cannot be read, or a column that seems to state the spread under another name.
        Without a file's name: too few repeats at a frequency.
    """
    if len(paths) == 1:
        names = read_table(paths[0]).names
        if "variance_real" in names:
            # A covariance under another name would be left out in silence, and the ellipses be wrong.
            for name in names:
                states_spread = "covar" in name.lower() or "varian" in name.lower()
                if states_spread and name not in SPREAD_COLUMNS:
                    raise ValueError(
                        f"{paths[0]}, line 1: unknown column {name!r}; the spread stands in "
                        f"{', '.join(SPREAD_COLUMNS)}"
                    )
            return FrequencyUncertainty.from_csv(paths[0], dt_s, level=level)

    sweeps = [FrfRepeats.from_csv(path) for path in paths]
    omega = np.concatenate([sweep.omega_rad_s for sweep in sweeps])
    response = np.concatenate([sweep.response for sweep in sweeps])
    points = FrfRepeats(omega, response)
    if np.unique(omega).size == omega.size:
        return points
    return points.mean(
        dt_s, level=level, pool_neighbours=pool_neighbours, outlier_threshold=outlier_threshold
    )


def _too_few(grid: RealArray, count: IntArray, freedom: IntArray) -> str:
    """Return what is missing for a covariance at every frequency, and only what mends it.

    grid: frequencies (F,), rad/s; count: repeats (F,); freedom: degrees of freedom (F,), somewhere below 2.
    Nothing is raised here: `FrfRepeats.mean` does.
    """
    state_spread = "give variance_real, variance_imag or a stated uncertainty"
    if np.all(count == 1):
        return f"one sweep: every frequency is measured once, so its spread is not known; {state_spread}"
    first = int(np.argmax(freedom < FEWEST_DEGREES))
    times = "is 1 measurement" if count[first] == 1 else f"are {count[first]} repeats"
    complaint = f"at omega = {grid[first]:.6g} rad/s there {times}: a 2x2 covariance needs at least 3"

    # The fewest neighbours whose repeats suffice everywhere, each frequency giving one less than it has.
    for neighbours in range(1, MOST_NEIGHBOURS + 1):
        window = np.ones(2 * neighbours + 1, dtype=np.int64)
        pooled_freedom = np.convolve(count - 1, window)[neighbours:-neighbours]
        if np.all(pooled_freedom >= FEWEST_DEGREES):
            return f"{complaint}, or pool_neighbours = {neighbours}"
    return f"{complaint}; {state_spread}"


def inliers(points: ComplexArray, threshold: float) -> ComplexArray:
    """Return the points within so many robust standard deviations of their median.

    Parameters
    ----------
    points : ndarray, shape (K,)
        Complex repeats of one frequency.
    threshold : float
        In standard deviations of one coordinate, estimated by the median distance from the median.

    Returns
    -------
    ndarray, shape (L,)
        All points where half of them are equal, and then for any threshold. In one pass: repeated, the cloud
        shrinks by chance. Not checked: no points come back as none, with a warning of numpy; a threshold
        below the median distance leaves few points or none.
    """
    median = np.median(points.real) + 1j * np.median(points.imag)
    distance = np.abs(points - median)
    spread = float(np.median(distance)) / RAYLEIGH_MEDIAN
    # Half of the points or more are equal: nothing says how far the others may be.
    if not spread > 0:
        return points
    is_near = distance <= threshold * spread
    return points[is_near]


def _pooled(
    scatter: RealArray, freedom: IntArray, centre: ComplexArray, neighbours: int
) -> tuple[RealArray, IntArray]:
    """Return the scatter (F, 2, 2) and the degrees of freedom (F,) of each frequency and its neighbours.

    scatter: sums of squares and products about each centre (F,), complex. They are added up relative to the
    response, as a gain error scatters it everywhere alike, and turned back to each centre. neighbours: on
    either side, at least 1 (0 leaves all as it is); fewer at the ends. Raises ValueError where a centre is
    zero.
    """
    if np.any(centre == 0):
        raise ValueError("pooling uses relative scatter, but a mean response is exactly zero")
    # Division by the centre, a complex number, is a matrix on (Re, Im) that turns and scales.
    rotation = factor_matrices(centre)
    inverse = np.linalg.inv(rotation)
    relative = inverse @ scatter @ inverse.transpose(0, 2, 1)
    total = np.empty_like(relative)
    total_freedom = np.empty_like(freedom)
    for index in range(centre.size):
        window = slice(max(0, index - neighbours), index + neighbours + 1)
        total[index] = relative[window].sum(axis=0)
        total_freedom[index] = freedom[window].sum()
    return rotation @ total @ rotation.transpose(0, 2, 1), total_freedom
