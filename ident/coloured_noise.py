"""Poles behind coloured noise (dry friction, drift): the search on records that a noise model has whitened.

Generalised least squares: input and output go through one filter A(q), that of a long ARX model (Ljung,
System Identification, 2nd ed., section 10.4; Wahlberg, IEEE TAC 34(3), 1989). It needs no poles, so that a
mode which a first fit has missed is not taken for noise. `identify_in_noise` fits with and without it and
decides which to keep: behind the filter the fast modes are found, without it the output itself is fitted
better.

Neglected: a filter that differs from record to record. A `Record` has an input (T, 1), an output (T, 1),
finite numbers, and a sampling time dt_s; `Identification` is a fit with its model, its residuals (T - delay,)
and rss.
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

# Orders of the ARX model that are tried, one chosen by BIC. They have to hold the memory of the noise and
# that of the arm: two rows for each mode. Chosen: steps of four, wider at the end, up to what ten modes and
# some noise take.
_ARX_ORDERS = (4, 8, 12, 16, 20, 24, 30)
# Rows of the shortest record per order of the ARX model, which has two coefficients an order: six rows for
# each. Chosen.
_ROWS_PER_ORDER = 13
# Largest order of the noise model of the residuals that are reported. BIC takes 1 to 6 of it for drift and
# friction beside sensor noise.
_RESIDUAL_ORDER = 12
# Level over the median of a smoothed spectrum from which on a line is no white noise: a mean over twelve
# independent lines, as many as there are among 25 of a spectrum padded to twice its length, exceeds twice its
# median in 0.4 % of places. Halved or doubled, both modes are still found under dry friction
# (tests/ident/test_coloured_noise.py).
_FLOOR_OVER_MEDIAN = 2


def identify_in_noise(records: Sequence[Record], options: IdentOptions, identify: Identify) -> Identification:
    """The fit in white noise, or behind a model of coloured noise where only that shows the modes.

    Parameters
    ----------
    records : sequence of Record
        One input, one output each.
    options : IdentOptions
        Where the dead time is left to the data, that of the fit in white noise is used throughout.
    identify : Identify
        The fit that takes the noise as white; it is called once or twice.

    Returns
    -------
    Identification
        The fit in white noise if its residuals are white, or unless more than half of what they have beyond a
        white floor lies below the lowest mode found behind a noise model; else the fit behind that model,
        with a verdict COLOURED_NOISE.

    Raises
    ------
    ValueError
        What `identify` refuses. Records of fewer than 13 rows for each of 4 + delay lags get the fit in white
        noise.
    """
    # Each of both fits takes half of the bar of progress.
    plain = identify(records, options, 0.0, 0.5)
    options = options.model_copy(update={"input_delay_samples": plain.model.input_delay_samples})
    noise = long_arx_filter(records, options)
    if noise.is_white or plain.rss == 0 or whiteness_test(plain.residuals).passed:
        return plain

    # Without its first rows a record starts in motion.
    starts_in_motion = options.model_copy(update={"estimate_initial_state": True})
    filtered = [prewhitened(record, noise) for record in records]
    behind = identify(filtered, starts_in_motion, 0.5, 1.0)

    # Behind the filter fast modes weigh more and slow ones less: the fit is the better one where what the
    # noise has is slower than every mode.
    poles = behind.model.poles
    modes = poles.pairs[poles.zeta() <= LARGEST_DAMPING]
    lowest_rad = np.min(np.abs(np.log(modes)), initial=np.inf)
    lowest_Hz = lowest_rad / (2 * np.pi * behind.model.dt_s)
    if not _half_power_Hz(plain) < lowest_Hz < np.inf:
        return plain
    dead_time = tuple(verdict for verdict in plain.verdicts if verdict.kind is FindingKind.DEAD_TIME)
    return _on_records(records, replace(behind, verdicts=(*dead_time, *behind.verdicts)), noise)


def prewhitened(record: Record, noise: NoiseModel) -> Record:
    """The record with input and output through the filter that whitens the noise, without a reference.

    The first `noise.n_start` rows, which have no recorded past, are left out: of a record without further
    rows nothing would be left, which `Record` refuses with ValueError. White noise gives back the record
    itself.
    """
    if noise.is_white:
        return record
    return replace(
        record,
        input=noise.without_start(record.input),
        output=noise.without_start(record.output),
        reference=None,
        reference_names=(),
    )


def long_arx_filter(records: Sequence[Record], options: IdentOptions) -> AutoregressiveNoise:
    """Noise model of a long ARX model of the records, its order by BIC.

    Parameters
    ----------
    records : sequence of Record
        One input, one output each. Long ones are thinned to `options.search_samples`.
    options : IdentOptions
        Of it input_delay_samples and search_samples matter.

    Returns
    -------
    AutoregressiveNoise
        A(q) of A y = B u + c + white by least squares, c a constant of each record; white noise where the
        records are too short for the least order.

    Raises
    ------
    ValueError
        Without records. That input and output move is not checked: the caller's fit has refused still ones.
    """
    part, _ = thinned(records, options.search_samples)
    delay = options.input_delay_samples
    longest_order = min(record.n_samples for record in part) // _ROWS_PER_ORDER - delay
    orders = [order for order in _ARX_ORDERS if order <= longest_order]
    if not orders:
        return WHITE_NOISE

    # Rows of the largest order: -y_(k-1) .. -y_(k-n), then u_(k-d) .. u_(k-d-n+1), d the dead time. Both in
    # units of their own: a rank is told from how large the columns are.
    longest = orders[-1]
    input_size = max(float(np.std(record.input)) for record in part)
    output_size = max(float(np.std(record.output)) for record in part)
    lags = np.arange(1, longest + 1)
    blocks = []
    targets = []
    for record in part:
        u = record.input[:, 0] / input_size
        centred = record.output[:, 0] - record.output[:, 0].mean()
        y = centred / output_size
        rows = np.arange(longest + delay, y.size)
        past_outputs = -y[rows[:, None] - lags]
        past_inputs = u[rows[:, None] - delay - lags + 1]
        blocks.append(np.hstack([past_outputs, past_inputs]))
        targets.append(y[rows])
    rows_per_record = [block.shape[0] for block in blocks]
    offsets = np.repeat(np.eye(len(part)), rows_per_record, axis=0)
    n = offsets.shape[0]

    # All orders from one factorisation: their columns, and what they leave of y, are columns of the triangle.
    everything = np.column_stack([np.vstack(blocks), offsets, np.concatenate(targets)])
    triangle = np.asarray(np.linalg.qr(everything, mode="r"))
    target = triangle[:, -1]
    best = WHITE_NOISE
    least = np.inf
    for order in orders:
        of_order = np.arange(order)
        of_offsets = 2 * longest + np.arange(len(part))
        columns = np.concatenate([of_order, longest + of_order, of_offsets])
        theta, *_ = np.linalg.lstsq(triangle[:, columns], target, rcond=None)
        error = target - triangle[:, columns] @ theta
        variance = max(float(error @ error) / n, np.finfo(np.float64).tiny)
        criterion = float(n * np.log(variance) + columns.size * np.log(n))
        if criterion < least:
            best = AutoregressiveNoise(np.concatenate([[1.0], theta[:order]]))
            least = criterion
    return best


def _on_records(
    records: Sequence[Record], behind: Identification, noise: AutoregressiveNoise
) -> Identification:
    """The model found behind the filter, with residuals, fit and noise on the records as they are.

    behind: the fit to the filtered records; its model and verdicts stay, and a verdict COLOURED_NOISE is
    added: half_power_Hz, order of the noise model, and the share 0 .. 1 of the residuals' variance that their
    past does not predict. Raises ValueError where `fit_on_fresh_data` does: a constant output, no rows behind
    the delay.
    """
    fits = [fit_on_fresh_data(behind.model, record) for record in records]
    residuals = tuple(fit.residual for fit in fits)
    rss = float(sum(residual @ residual for residual in residuals))
    n_samples = sum(residual.size for residual in residuals)
    # Poles and coefficients, and of each record its offset and its initial state.
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

    # Variance of the residuals behind an autoregressive model of their own, as a share of all. That model
    # needs records of twice its order, and has it from four times as many rows.
    shortest = min(residual.size for residual in residuals)
    order = min(_RESIDUAL_ORDER, (shortest - 1) // 4)
    residual_noise = fit_autoregression(residuals, order)
    innovations = np.concatenate([residual_noise.without_start(residual) for residual in result.residuals])
    unpredictable_share = float(np.mean(innovations**2)) / (rss / n_samples)
    verdict = finding(
        FindingKind.COLOURED_NOISE,
        half_power_Hz=_half_power_Hz(result),
        unpredictable_share=unpredictable_share,
        order=noise.order,
    )
    return replace(result, verdicts=(*behind.verdicts, verdict))


def _half_power_Hz(fit: Identification) -> float:
    """Frequency, Hz, below which lies half of what the longest residual has beyond a white floor.

    0 Hz where nothing is beyond the floor. `fit` : its residuals, of at least one sample, and its model's
    dt_s.
    """
    longest = max(fit.residuals, key=len)
    # Twice the length: lines lie half a resolution apart, so that a peak is not missed between two.
    n_fft = 2 * longest.size
    power = np.abs(np.fft.rfft(longest - longest.mean(), n_fft)) ** 2
    # Lines of white noise scatter by as much as their mean: means over neighbours show what stands out.
    power = over_lines(power)
    floor = _FLOOR_OVER_MEDIAN * np.median(power)
    beyond_floor = np.cumsum(np.maximum(power - floor, 0.0))
    line = np.searchsorted(beyond_floor, 0.5 * beyond_floor[-1])
    return float(line / (n_fft * fit.model.dt_s))
