"""What can be seen in the records before any fit: unusable ones are refused, doubtful ones get advice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.signal

from ident.arrays import RealArray
from ident.record import Record
from ident.regression import Regression

# Above the last frequency with this share of the largest spectral density the input says next to nothing.
_WEAK_INPUT = 1e-4


def refuse_unusable(records: Sequence[Record], data: Regression, order: int) -> None:
    """Raise ValueError for a constant input or output, or too few samples for `order` poles; names the
    record."""
    for record in records:
        for kind, signal, names in (
            ("input", record.input, record.input_names),
            ("output", record.output, record.output_names),
        ):
            if np.ptp(signal[:, 0]) == 0:
                raise ValueError(
                    f"{record.label}: {kind} column '{names[0]}' is constant ({signal[0, 0]:.6g}); "
                    "expected a signal that varies"
                )
    needed = data.n_parameters(order)
    if not data.n_samples > needed:
        labels = records[0].label if len(records) == 1 else f"{len(records)} records"
        raise ValueError(
            f"{labels}: {data.n_samples} samples are too few for order {order}, which has {needed} unknowns; "
            f"expected at least {needed + 1}"
        )


def advice(records: Sequence[Record], data: Regression, order: int) -> list[str]:
    """One sentence per doubt: few samples, narrow input, clipped signals."""
    sentences = []
    needed = data.n_parameters(order)
    if data.n_samples < 10 * needed:
        sentences.append(
            f"only {data.n_samples} samples for {needed} unknowns: record longer, or fit fewer poles; "
            "below ten samples per unknown the choice of the poles is itself uncertain"
        )
    limit = excitation_limit_rad_s(records)
    if limit < 0.6 * np.pi / data.dt_s:
        sentences.append(
            f"the input is not exciting above {limit:.3g} rad/s: the model there is extrapolation; "
            "use an input with power up to the frequency you need"
        )
    for record in records:
        for kind, signal, names in (
            ("input", record.input, record.input_names),
            ("output", record.output, record.output_names),
        ):
            share = clipped_share(signal[:, 0])
            if share > 0:
                sentences.append(
                    f"{record.label}: {share:.1%} of {kind} '{names[0]}' stand at its very limit, as if "
                    "saturated "
                    "or clipped: lower the amplitude, or cut those samples out"
                )
    return sentences


def excitation_limit_rad_s(records: Sequence[Record]) -> float:
    """Highest frequency at which the input of any record still has 1e-4 of its largest spectral density,
    rad/s."""
    highest = 0.0
    for record in records:
        u = record.input[:, 0]
        segment = int(min(u.size, max(64, u.size // 8)))
        frequency, density = scipy.signal.welch(u - u.mean(), fs=1 / record.dt_s, nperseg=segment)
        # Leakage of a window may carry a strong line one bin further, no more.
        strong = np.flatnonzero(density >= _WEAK_INPUT * density.max())
        highest = max(highest, 2 * np.pi * float(frequency[strong[-1]]))
    return highest


def clipped_share(signal: RealArray) -> float:
    """Share of samples that stand at an extreme value which is suspiciously frequent, else 0.

    Suspicious: at least 1 % of the samples, and five times as many as at the next level (a slow sine in a
    converter's steps has 2.4 times). Signals of a few levels (binary, multilevel inputs) are left alone.
    """
    levels, counts = np.unique(signal, return_counts=True)
    if levels.size < 10:
        return 0.0
    share = 0.0
    for count, neighbour in ((counts[0], counts[1]), (counts[-1], counts[-2])):
        if count >= max(0.01 * signal.size, 5, 5 * neighbour):
            share += float(count / signal.size)
    return share
