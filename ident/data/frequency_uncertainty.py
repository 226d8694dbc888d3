"""A frequency response with a 2x2 covariance at every frequency: what identification hands to control."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from ident.data.arrays import BoolArray, ComplexArray, RealArray, lock, readonly
from ident.data.ellipses import EllipseAxes, chi2_radius, ellipse_distance, relative_deficit, standard_axes
from ident.data.record_files import read_table
from ident.data.response_columns import read_response
from ident.data.table import LARGEST

# A product of factors can miss symmetry or semidefiniteness by rounding, not by more.
_PSD_TOLERANCE = 1e-9
# Of a grid of our own: a hundred a decade over four decades.
FREQUENCIES = 400

_COLUMNS = ("real", "imag", "variance_real", "variance_imag")
_CROSS = "covariance_real_imag"


@dataclass(frozen=True, eq=False)
class FrequencyUncertainty:
    """G(e^{j omega dt}) ~ N(centre, covariance) over (Re, Im), frequency by frequency.

    omega_rad_s (F,) strictly increasing, 0 <= omega <= pi / dt_s; centre (F,) complex; covariance (F,2,2),
    symmetric and positive semidefinite (zero = exactly known); level: of each frequency's ellipse taken
    alone; method: where the numbers come from. Raises ValueError, naming the first frequency at fault.
    """

    omega_rad_s: RealArray
    centre: ComplexArray
    covariance: RealArray
    dt_s: float
    level: float = 0.95
    method: str = "given"

    def __post_init__(self) -> None:
        lock(self, "omega_rad_s")
        lock(self, "centre", dtype=np.complex128)
        omega, centre, covariance = self.omega_rad_s, self.centre, np.array(self.covariance, dtype=np.float64)
        if (
            omega.ndim != 1
            or omega.size == 0
            or centre.shape != omega.shape
            or covariance.shape != (omega.size, 2, 2)
        ):
            raise ValueError(
                "need omega (F,), centre (F,) and covariance (F,2,2) with F >= 1; "
                f"got {omega.shape}, {centre.shape}, {covariance.shape}"
            )
        if not (0 < self.dt_s < np.inf):
            raise ValueError(f"dt_s must be positive and finite; got {self.dt_s}")
        chi2_radius(self.level)
        _refuse_first(~np.isfinite(omega), omega, "omega is not finite")
        _refuse_first(~(np.diff(omega) > 0), omega[1:], "omega must be strictly increasing; it is not")
        _refuse_first(omega < 0, omega, "omega must not be negative")
        nyquist = np.pi / self.dt_s
        _refuse_first(omega > nyquist * (1 + 1e-9), omega, f"omega is above pi / dt_s = {nyquist:.6g} rad/s")
        _refuse_first(~(np.abs(centre) < LARGEST), omega, f"the centre is not finite, or beyond {LARGEST:g}")
        _refuse_first(~np.all(np.isfinite(covariance), axis=(1, 2)), omega, "the covariance is not finite")
        skew = np.abs(covariance[:, 0, 1] - covariance[:, 1, 0])
        largest = np.abs(covariance).max(axis=(1, 2))
        _refuse_first(skew > _PSD_TOLERANCE * largest, omega, "the covariance is not symmetric")
        _refuse_first(
            relative_deficit(covariance) > _PSD_TOLERANCE,
            omega,
            "the covariance is not positive semidefinite",
        )
        covariance[:, 0, 1] = covariance[:, 1, 0] = 0.5 * (covariance[:, 0, 1] + covariance[:, 1, 0])
        object.__setattr__(self, "dt_s", float(self.dt_s))
        object.__setattr__(self, "level", float(self.level))
        object.__setattr__(self, "covariance", readonly(covariance))

    def ellipse(self, level: float | None = None) -> EllipseAxes:
        """Axes of the ellipses that hold the response with probability `level` (default: the record's)."""
        s1, s2, u1 = standard_axes(self.covariance)
        radius = chi2_radius(self.level if level is None else level)
        return EllipseAxes(semi_major=radius * s1, semi_minor=radius * s2, direction=u1)

    def normalised_distance(self, response: npt.ArrayLike) -> RealArray:
        """Distance (F,) of a response (F,) from the centre in units of the ellipse: 1 on its boundary."""
        response = self._matching(response)
        return ellipse_distance(
            response - self.centre, self.ellipse(), np.abs(self.centre) + np.abs(response)
        )

    def contains(self, response: npt.ArrayLike) -> BoolArray:
        """(F,) whether a response (F,) lies in the ellipse of its frequency."""
        return np.asarray(self.normalised_distance(response) <= 1.0)

    def enclosing_radius(self) -> RealArray:
        """(F,) radius of the smallest disc around the centre that holds the ellipse."""
        return self.ellipse().semi_major

    def to_control(self) -> Any:
        """The centre as `control.FrequencyResponseData`, without the covariances."""
        # Here and not above: python-control brings its plotting along.
        import control

        return control.FrequencyResponseData(self.centre, self.omega_rad_s, dt=self.dt_s)

    @classmethod
    def from_csv(cls, path: str | Path, dt_s: float, *, level: float = 0.95) -> Self:
        """Read a frequency response with covariances.

        Frequency and response as `FrfRepeats.from_csv` reads them, and columns `variance_real`,
        `variance_imag` and, if it is not zero, `covariance_real_imag`. Raises ValueError in one line naming
        file, line and column.
        """
        table = read_table(path)
        omega, centre = read_response(table)
        variance_re, variance_im = table.columns(_COLUMNS[2:]).values()
        negative = np.flatnonzero((variance_re < 0) | (variance_im < 0))
        if negative.size:
            raise ValueError(f"{path}, {table.place(int(negative[0]))}: a variance is negative")
        cross = table.columns([_CROSS])[_CROSS] if _CROSS in table.names else np.zeros_like(omega)
        covariance = np.stack([np.stack([variance_re, cross], -1), np.stack([cross, variance_im], -1)], -2)
        try:
            return cls(omega, centre, covariance, dt_s, level, f"given in {table.path.name}")
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def to_csv(self, path: str | Path) -> None:
        """Write the columns `from_csv` reads; numbers keep all their digits."""
        parts = (self.centre.real, self.centre.imag, self.covariance[:, 0, 0], self.covariance[:, 1, 1])
        columns = {"omega_rad_s": self.omega_rad_s, **dict(zip(_COLUMNS, parts, strict=True))}
        columns[_CROSS] = self.covariance[:, 0, 1]
        rows = zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True)
        text = "\n".join(",".join(row) for row in (tuple(columns), *rows)) + "\n"
        Path(path).write_text(text, encoding="utf-8", newline="\n")

    def _matching(self, response: npt.ArrayLike) -> ComplexArray:
        response = np.asarray(response, dtype=np.complex128)
        if response.shape != self.omega_rad_s.shape:
            raise ValueError(
                f"need a response on this grid, shape {self.omega_rad_s.shape}; got {response.shape}"
            )
        if not np.all(np.isfinite(response)):
            raise ValueError("the response must be finite")
        return response


def _refuse_first(bad: BoolArray, omega: RealArray, complaint: str) -> None:
    if np.any(bad):
        index = int(np.argmax(bad))
        raise ValueError(f"{complaint} (first at omega = {omega[index]:.6g} rad/s)")
