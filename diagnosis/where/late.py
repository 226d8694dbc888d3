"""Whether a simulation answers its input later than the machine does, by whole samples.

A simulation that is stepped before it reads its input, as in a co-simulation, or that returns the state after
a step in the row before it, is late by a sample. No missing effect makes a simulation earlier: the error that
this leaves is a cause on no list, and sizes of others are wrong beside it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from diagnosis.machine.machine_protocol import CaseOfMachine, Real

# Samples later that are looked for: a coupling of simulations has one or two, and one more to see that the
# error grows again.
_LATEST = 3
# Part of the error's energy that a shift leaves at most. Chosen: a stated inertia or lag that is off by a few
# tolerances acts like a shift, too, but leaves more than this once values are re-estimated; with twice as
# much such a model is called late.
_LEAVES = 0.1
# Times the energy of the noise that the error has to have before a share of it means anything. Chosen; with
# half of it a shift takes off noise.
_ABOVE_NOISE = 4.0


def is_noise(residuals: Iterable[Real]) -> bool:
    """Whether residuals (T, Y) over the noise have no more energy than four times that of noise."""
    squares = 0.0
    values = 0
    for error in residuals:
        squares += float(np.sum(error**2))
        values += error.size
    return squares < _ABOVE_NOISE * values


def samples_late(case: CaseOfMachine, residuals: Mapping[str, Real]) -> int:
    """By how many samples the simulation follows its inputs later than the machine; 0 where it does not.

    Parameters
    ----------
    case : CaseOfMachine
    residuals : record -> (T, Y) array
        (measured - model) / noise of every record.

    Returns
    -------
    int
        0 to 3: the shift at which the error is least, where that leaves a tenth of the error's energy at
        most, and less in every record. Records whose error is noise do not count.
    """
    energies = []  # of every record, (shifts + 1,)
    for record in case.experiments:
        error = residuals[record.name]
        rows = len(error) - _LATEST
        if rows <= 0 or is_noise([error]):
            continue
        measured = record.output / case.noise
        simulated = measured - error
        energies.append(
            [float(np.sum((measured[:rows] - simulated[k : k + rows]) ** 2)) for k in range(_LATEST + 1)]
        )
    if not energies:
        return 0
    of_records = np.array(energies)
    best = int(np.argmin(np.sum(of_records, axis=0)))
    left = np.sum(of_records[:, best]) / np.sum(of_records[:, 0])
    in_every_record = bool(np.all(of_records[:, best] < of_records[:, 0]))
    return best if left < _LEAVES and in_every_record else 0
