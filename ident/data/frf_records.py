"""Repeated measurements of one frequency response, point by point: reading, choosing, opening the loop."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import numpy as np

from ident.data.arrays import ComplexArray, RealArray, readonly_complex, readonly_real
from ident.data.frequency_data import frequencies
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record_files import read_table

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
        table = read_table(path)
        parts = [pair for pair in _PARTS if set(pair) <= set(table.names)]
        if len(parts) != 1:
            raise ValueError(
                f"{table.path}, line 1: need one of real, imag and gain, phase_rad; found {list(table.names)}"
            )
        if label is not None and label not in table.names:
            raise ValueError(f"{table.path}, line 1: missing column {label}; found {list(table.names)}")
        first, second = table.columns(parts[0]).values()
        response = first + 1j * second if parts[0] == _PARTS[0] else first * np.exp(1j * second)
        labels = [""] * response.size if label is None else [str(cell).strip() for cell in table.raw[label]]
        return cls(frequencies(table), response, tuple(labels))

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
        of: Literal["mean", "next run"] = "mean",
    ) -> FrequencyUncertainty:
        """Mean over all points of each frequency, as `FrequencyUncertainty.from_frf_repeats`."""
        return FrequencyUncertainty.from_frf_repeats(
            self.omega_rad_s,
            self.response,
            dt_s,
            level=level,
            pool_neighbours=pool_neighbours,
            outlier_threshold=outlier_threshold,
            of=of,
        )

    def _chosen(self, keep: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> FrfRepeats:
        if not np.any(keep):
            raise ValueError("no measured point is left")
        return FrfRepeats(
            self.omega_rad_s[keep],
            self.response[keep],
            tuple(name for name, kept in zip(self.label, keep, strict=True) if kept),
        )
