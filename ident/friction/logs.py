"""Logs of a loop as a fit of friction sees them, whole or thinned, and the scales of what is fitted to them.

A fit needs no more samples than its highest mode asks for. `LoopLogs.thinned` takes the mean of the command
over each longer step, which moves the arm as far, and the position at the end of each. The dead time stays
whole, in samples of the records: the position is taken later by it, so that the thinned logs have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.friction.gauss_newton import FrictionFit
from ident.friction.inverse_dynamics import presliding_of, rms_speed
from ident.friction.observer import command_per_noise

# Smallest level, as a share of the rms command. A level of a millionth is none: only logarithms and shares of
# it need a number.
_LEAST_LEVEL_SHARE = 1e-6
# Prediction errors count behind this part (one in so many) of a record, where the observer has found the
# state. Chosen.
_START = 20


@dataclass(frozen=True, eq=False)
class LoopLogs:
    """Records without their references, and the scales of what is fitted to them.

    Attributes
    ----------
    records : tuple of Record
        One input, and the shaft's position as the one output.
    presliding : float
        Expected deflection before sliding, units of the position.
    least_level : float
        Smallest level, units of the input.
    input_rms : float
        Units of the input.
    centre : float
        Mean of the positions.
    """

    records: tuple[Record, ...]
    presliding: float
    least_level: float
    input_rms: float
    centre: float

    @classmethod
    def of(cls, records: Sequence[Record]) -> LoopLogs:
        """Logs of records with one input, and the shaft's position as the one output."""
        input_rms = float(np.sqrt(np.mean([np.mean(record.input**2) for record in records])))
        plain = tuple(replace(record, reference=None, reference_names=()) for record in records)
        centre = float(np.mean([np.mean(record.output) for record in records]))
        return cls(plain, presliding_of(records), _LEAST_LEVEL_SHARE * input_rms, input_rms, centre)

    @cached_property
    def largest_ratio(self) -> float:
        """Largest ratio of force to noise of the position that means anything (`command_per_noise`)."""
        return command_per_noise(self.records)

    @cached_property
    def rms_speed(self) -> float:
        """Root mean square speed of the position, output units per second."""
        return rms_speed(self.records)

    @cached_property
    def rows_of_a_reading(self) -> int:
        """Rows over which the sensor reads the same while the shaft moves: in the record where these are the
        fewest, the median over its readings."""
        return min(_rows_of_a_reading(record.output[:, 0]) for record in self.records)

    @property
    def dt_s(self) -> float:
        """Step of the records, s."""
        return self.records[0].dt_s

    def thinned(self, steps: int, delay_samples: int) -> LoopLogs:
        """Logs at a step so many times as long, without dead time.

        Parameters
        ----------
        steps : int
            Of the records in one of the thinned logs, 1 or more.
        delay_samples : int
            Dead time of the input, samples of these records.

        Returns
        -------
        LoopLogs
            With the scales of the whole ones. Raises ValueError for records shorter than dead time and step.
        """
        thinned = []
        for record in self.records:
            n = (record.n_samples - delay_samples) // steps
            command = record.input[: n * steps].reshape(n, steps, -1).mean(axis=1)
            position = record.output[delay_samples : delay_samples + n * steps : steps]
            thinned.append(replace(record, input=command, output=position, dt_s=steps * record.dt_s))
        return replace(self, records=tuple(thinned))

    def prediction_errors(self, fit: FrictionFit) -> RealArray:
        """Prediction errors (N,) of a fit on all logs, output units, without the start of each; not finite
        where the simulation is lost."""
        parts = []
        with np.errstate(over="ignore", invalid="ignore"):
            for record in self.records:
                residual = fit.residual(record)
                parts.append(residual[residual.size // _START :])
        return np.concatenate(parts)


def _rows_of_a_reading(position: RealArray) -> int:
    """Median number of rows in which a position (T,) stays the same, at least 1. A shaft that sticks makes
    few long ones."""
    changes = np.flatnonzero(np.diff(position)) + 1
    lengths = np.diff(np.concatenate([[0], changes, [position.size]]))
    return int(np.median(lengths))
