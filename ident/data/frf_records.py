"""Repeated measurements of one frequency response, point by point: reading, choosing, opening the loop."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from ident.data.arrays import ComplexArray, RealArray, readonly_complex, readonly_real
from ident.data.frequency_data import FREQUENCY_COLUMNS, mean_of_repeats, number_of_cell
from ident.data.frequency_uncertainty import FrequencyUncertainty

_PARTS = (("real", "imag"), ("gain", "phase_rad"))


@dataclass(frozen=True, eq=False)
class FrfRepeats:
    """Measured points of a frequency response: omega_rad_s (K,), response (K,), label (K,) of each point.

    Points of equal frequency are repeats; the label says under which condition (date, amplitude) they were
    taken. Runs within a condition need not be told apart. Raises ValueError for other shapes or numbers that
    are not finite.
    """

    omega_rad_s: RealArray
    response: ComplexArray
    label: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "omega_rad_s", readonly_real(self.omega_rad_s))
        object.__setattr__(self, "response", readonly_complex(self.response))
        object.__setattr__(self, "label", tuple(self.label))
        size = self.omega_rad_s.size
        if self.omega_rad_s.shape != (size,) or self.response.shape != (size,) or len(self.label) != size:
            raise ValueError(
                f"need omega, response and label of one length; got {self.omega_rad_s.shape}, "
                f"{self.response.shape} and {len(self.label)}"
            )
        if not (size > 0 and np.all(np.isfinite(self.omega_rad_s)) and np.all(np.isfinite(self.response))):
            raise ValueError("need at least one point, and finite frequencies and responses")

    @classmethod
    def from_csv(cls, path: str | Path, *, label: str | None = None) -> Self:
        """One row per measured point: a column `omega_rad_s`, `omega_rad_per_s` or `frequency_Hz`, the
        columns `real`, `imag` or `gain`, `phase_rad`, and the column named by `label`.

        Raises ValueError in one line naming file, line and column.
        """
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except FileNotFoundError as error:
            raise ValueError(f"{path}: there is no such file") from error
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: cannot be read as text ({error})") from error
        rows = csv.reader(lines)
        header = [name.strip() for name in next(rows, [])]
        frequency = [name for name in FREQUENCY_COLUMNS if name in header]
        parts = [pair for pair in _PARTS if set(pair) <= set(header)]
        if len(frequency) != 1 or len(parts) != 1:
            raise ValueError(
                f"{path}, line 1: need one of {', '.join(FREQUENCY_COLUMNS)} and either real, imag or gain, "
                f"phase_rad; found {header}"
            )
        if label is not None and label not in header:
            raise ValueError(f"{path}, line 1: missing column {label}; found {header}")
        omega, response, labels = [], [], []
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                raise ValueError(
                    f"{path}, line {rows.line_num}: {len(row)} cells where the header has {len(header)}"
                )
            numbers = [
                number_of_cell(row[header.index(name)], path, rows.line_num, name)
                for name in (frequency[0], *parts[0])
            ]
            omega.append(numbers[0] * FREQUENCY_COLUMNS[frequency[0]])
            polar = parts[0] == _PARTS[1]
            response.append(numbers[1] * np.exp(1j * numbers[2]) if polar else complex(*numbers[1:]))
            labels.append("" if label is None else row[header.index(label)].strip())
        if not omega:
            raise ValueError(f"{path}: no rows under the header")
        return cls(np.array(omega), np.array(response), tuple(labels))

    @property
    def labels(self) -> tuple[str, ...]:
        """The different labels, in the order they come."""
        return tuple(dict.fromkeys(self.label))

    def only(self, *labels: str) -> FrfRepeats:
        """Points of the given conditions. Raises ValueError if one does not occur."""
        for wanted in labels:
            if wanted not in self.label:
                raise ValueError(f"no point is labelled {wanted!r}; there are {list(self.labels)}")
        return self._chosen(np.array([name in labels for name in self.label]))

    def band(self, omega_min_rad_s: float, omega_max_rad_s: float) -> FrfRepeats:
        """Points with omega_min <= omega <= omega_max."""
        return self._chosen((self.omega_rad_s >= omega_min_rad_s) & (self.omega_rad_s <= omega_max_rad_s))

    def open_loop(self, reference_gain: float, feedback_gain: float) -> FrfRepeats:
        """Plant responses from those of the closed loop r -> y under u = reference_gain r - feedback_gain y.

        G = T / (a - g T) point by point, so that repeats keep their own, bent distribution where 1 - g T / a
        is small; `ident.closed_loop.indirect` maps ellipses, to first order. Raises ValueError where a - g T
        is zero.
        """
        rest = reference_gain - feedback_gain * self.response
        if np.any(rest == 0):
            at = self.omega_rad_s[int(np.argmax(rest == 0))]
            raise ValueError(f"at omega = {at:.6g} rad/s a point of the closed loop is exactly a / g")
        return FrfRepeats(self.omega_rad_s, self.response / rest, self.label)

    def mean(
        self,
        dt_s: float,
        *,
        level: float = 0.95,
        pool_neighbours: int = 0,
        outlier_threshold: float | None = None,
    ) -> FrequencyUncertainty:
        """Mean over all points of each frequency; as `FrequencyUncertainty.from_frf_repeats`."""
        return FrequencyUncertainty.from_frf_repeats(
            self.omega_rad_s,
            self.response,
            dt_s,
            level=level,
            pool_neighbours=pool_neighbours,
            outlier_threshold=outlier_threshold,
        )

    def next_run(
        self,
        dt_s: float,
        *,
        level: float = 0.95,
        pool_neighbours: int = 0,
        outlier_threshold: float | None = None,
    ) -> FrequencyUncertainty:
        """The same centre with the region of one more run: scatter of a run plus error of the mean, widened
        to Hotelling's prediction region at `level`."""
        omega, centre, covariance = mean_of_repeats(
            self.omega_rad_s,
            self.response,
            level=level,
            pool_neighbours=pool_neighbours,
            outlier_threshold=outlier_threshold,
            of="next run",
        )
        return FrequencyUncertainty(omega, centre, covariance, dt_s, level, "one more run")

    def _chosen(self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> FrfRepeats:
        if not np.any(keep):
            raise ValueError("no measured point is left")
        return FrfRepeats(
            self.omega_rad_s[keep],
            self.response[keep],
            tuple(name for name, kept in zip(self.label, keep, strict=True) if kept),
        )
