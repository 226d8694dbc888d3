"""Poles behind coloured noise (dry friction, drift): the same search on records that a noise model has
whitened.

Generalised least squares: input and output go through one filter A(q), that of a long ARX model (Ljung,
System Identification, 2nd ed., section 10.4; Wahlberg, IEEE TAC 34(3), 1989). It needs no poles, so that a
mode which a first fit has missed is not taken for noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ident.basis.autoregressive_noise import WHITE_NOISE, AutoregressiveNoise
from ident.basis.noise_model import NoiseModel
from ident.basis.options import IdentOptions
from ident.checks.early_checks import clipped
from ident.checks.plausible_modes import LARGEST_DAMPING
from ident.checks.residual_tests import whiteness_test
from ident.checks.validation import fit_on_fresh_data
from ident.data.finding import FindingKind, finding
from ident.data.nonparametric import over_lines
from ident.data.record import Record
from ident.fit.regression import thinned
from ident.identification import Identification
from ident.uncertainty.autoregression import fit_autoregression

Identify = Callable[[Sequence[Record], IdentOptions, float, float], Identification]
"""Records, options, and the part of the progress (from, to): a fit that takes the noise as white."""

_ARX_ORDERS = (4, 8, 12, 16, 20, 24, 30)  # tried, one chosen by BIC
# Rows of the shortest record per order of the noise model.
_ROWS_PER_ORDER = 13
_RESIDUAL_ORDER = 12  # BIC takes 1 to 6 of it for drift and friction beside sensor noise


def identify_in_noise(records: Sequence[Record], options: IdentOptions, identify: Identify) -> Identification:
    """The fit in white noise if its residuals are white, or if less than half of what they have beyond a
    white floor lies below the lowest mode found behind a noise model; else the fit behind that model."""
    plain = identify(records, options, 0.0, 0.5)
    options = options.model_copy(update={"input_delay_samples": plain.model.input_delay_samples})
    noise = long_arx_filter(records, options)
    if noise.is_white or plain.rss == 0 or whiteness_test(plain.residuals).passed:
        return plain
    # Without its first rows a record starts in motion.
    inside = options.model_copy(update={"estimate_initial_state": True})
    behind = identify([prewhitened(record, noise) for record in records], inside, 0.5, 1.0)
    modes = behind.model.poles.pairs[behind.model.poles.zeta() <= LARGEST_DAMPING]
    lowest_Hz = np.min(np.abs(np.log(modes)), initial=np.inf) / (2 * np.pi * behind.model.dt_s)
    if not _half_power_Hz(plain) < lowest_Hz < np.inf:
        return plain
    sought = tuple(said for said in plain.verdicts if said.kind is FindingKind.DEAD_TIME)
    return _on_records(records, replace(behind, verdicts=(*sought, *behind.verdicts)), noise)


def prewhitened(record: Record, noise: NoiseModel) -> Record:
    """Input and output through the filter that whitens the noise, without the first rows, which have no
    recorded past."""
    if noise.is_white:
        return record
    input_, output = (noise.without_start(signal) for signal in (record.input, record.output))
    return replace(record, input=input_, output=output, reference=None, reference_names=())


def long_arx_filter(records: Sequence[Record], options: IdentOptions) -> AutoregressiveNoise:
    """A(q) of A y = B u + c + white by least squares, its order by BIC; white where the records are too
    short for the shortest."""
    part, _ = thinned(records, options.search_samples)
    delay = options.input_delay_samples
    most = min(record.n_samples for record in part) // _ROWS_PER_ORDER - delay
    orders = [order for order in _ARX_ORDERS if order <= most]
    best, least = WHITE_NOISE, np.inf
    if not orders:
        return best
    longest = orders[-1]
    blocks, targets = [], []
    signals = [record.input for record in part], [record.output for record in part]
    sizes = [max(float(np.std(signal)) for signal in each) for each in signals]
    for record in part:
        # In units of their own: a rank is told from how large the columns are.
        u, y = record.input[:, 0] / sizes[0], (record.output[:, 0] - record.output[:, 0].mean()) / sizes[1]
        rows = np.arange(longest + delay, y.size)
        lags = np.arange(1, longest + 1)
        blocks.append(np.hstack([-y[rows[:, None] - lags], u[rows[:, None] - delay - lags + 1]]))
        targets.append(y[rows])
    offsets = np.repeat(np.eye(len(part)), [block.shape[0] for block in blocks], axis=0)
    n = offsets.shape[0]
    # All orders from one factorisation: their columns, and what they leave of y, are columns of the triangle.
    everything = np.column_stack([np.vstack(blocks), offsets, np.concatenate(targets)])
    triangle = np.asarray(np.linalg.qr(everything, mode="r"))
    for order in orders:
        lags = np.arange(order)
        kept = np.concatenate([lags, longest + lags, 2 * longest + np.arange(len(part))])
        theta, *_ = np.linalg.lstsq(triangle[:, kept], triangle[:, -1], rcond=None)
        error = triangle[:, -1] - triangle[:, kept] @ theta
        variance = max(float(error @ error) / n, np.finfo(np.float64).tiny)
        criterion = float(n * np.log(variance) + kept.size * np.log(n))
        if criterion < least:
            best, least = AutoregressiveNoise(np.concatenate([[1.0], theta[:order]])), criterion
    return best


def _on_records(
    records: Sequence[Record], behind: Identification, noise: AutoregressiveNoise
) -> Identification:
    """The model found behind the filter with its residuals on the records as they are."""
    fits = [fit_on_fresh_data(behind.model, record) for record in records]
    residuals = tuple(fit.residual for fit in fits)
    rss = float(sum(residual @ residual for residual in residuals))
    n_samples = sum(residual.size for residual in residuals)
    unknowns = 2 * behind.model.order + len(records) * (1 + behind.model.order)
    result = replace(
        behind,
        residuals=residuals,
        fit_percent=np.array([fit.fit_percent for fit in fits]),
        rss=rss,
        noise_std=float(np.sqrt(rss / max(n_samples - unknowns, 1))),
        noise_filter=noise.a_polynomial,
        # The filter hides where a signal was cut off.
        advise=lambda: [*clipped(records), *behind.advise()],
    )
    # Variance of the residuals behind an autoregressive model of their own.
    order = min(_RESIDUAL_ORDER, (min(part.size for part in result.residuals) - 1) // 4)
    own = fit_autoregression(result.residuals, order)
    errors = [own.without_start(part) for part in result.residuals]
    share = float(np.mean(np.concatenate(errors) ** 2)) / (rss / n_samples)
    said = finding(
        FindingKind.COLOURED_NOISE,
        half_power_Hz=_half_power_Hz(result),
        unpredictable_share=share,
        order=noise.order,
    )
    return replace(result, verdicts=(*behind.verdicts, said))


def _half_power_Hz(found: Identification) -> float:
    """Below this frequency lies half of what the longest residual has beyond a white floor."""
    longest = max(found.residuals, key=len)
    power = np.abs(np.fft.rfft(longest - longest.mean(), 2 * longest.size)) ** 2
    # Lines of white noise scatter by as much as their mean: means over neighbours show what stands out.
    power = over_lines(power)
    beyond = np.cumsum(np.maximum(power - 2 * np.median(power), 0.0))
    return float(np.searchsorted(beyond, 0.5 * beyond[-1]) / (2 * longest.size * found.model.dt_s))
