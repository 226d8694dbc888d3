"""Uncertainty: ellipses around every identified response, and what the residuals say about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from control_design.frequency_grid import frequency_grid
from control_design.plant_set import Mode
from ident.conditions import combine_posteriors, record_posteriors
from ident.embedding import EmbeddingOptions, classical, common_fir_length, tangent
from ident.model import GobfModel
from ident.nominal import nominal_near
from ident.nonparametric import empirical_frf
from ident.record import Record
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from ident.validation import independence_test, repeat_scatter, whiteness_test
from workflow.config import Channel, RunConfig, UncertaintyOptions
from workflow.errors import naming
from workflow.run_directory import StageData
from workflow.stages.base import StageInput
from workflow.stages.identify import increments
from workflow.stages.results import ChannelResult, RunRecord, channel_result, load_records
from workflow.storage import AnyArray

N_BANDS = 6
"""Bands of equal width on the log axis in which radii and scatter are summarised."""


def settings(config: RunConfig) -> Mapping[str, Any]:
    """Uncertainty options of the channels."""
    return {"channels": [channel.uncertainty.model_dump(mode="json") for channel in config.channels]}


def find_uncertainty(stage: StageInput) -> StageData:
    """Posterior, ellipses on a display grid, residual tests and repeat scatter of every channel."""
    records = load_records(stage.results)
    identified = stage.results.load_stage("identify")
    arrays: dict[str, AnyArray] = {}
    about = []
    for k, channel in enumerate(stage.config.channels):
        stage.progress.update("uncertainty", k / len(stage.config.channels), channel.label)
        result = channel_result(identified, k)
        model = result.identification.model
        with naming(f"channel {channel.label!r}"):
            posterior = posterior_of(result, channel.uncertainty, records)
            omega = display_grid(model, result.used)
            frequency = posterior.at(omega, channel.uncertainty.level)
            nominal = nominal_near(posterior, model.poles, omega)
            empirical = empirical_response(result.used, channel.uncertainty.level)
            scatter = scatter_of(channel, model, records, bands_of(omega))
        at = f"channel/{k}/"
        arrays |= {f"{at}posterior/{key}": value for key, value in posterior.to_arrays().items()}
        arrays |= {f"{at}frequency/{key}": value for key, value in frequency.to_arrays().items()}
        arrays |= {f"{at}nominal/{key}": value for key, value in nominal.to_arrays().items()}
        if empirical is not None:
            arrays |= {f"{at}empirical/{key}": value for key, value in empirical.to_arrays().items()}
        about.append(
            {
                "name": channel.label,
                "method": channel.uncertainty.method,
                "level": channel.uncertainty.level,
                "report": posterior.report.to_dict() if posterior.report is not None else None,
                "bands": [band_row(frequency, low, high) for low, high in bands_of(omega)],
                "tests": residual_tests(result, posterior),
                "repeat_scatter": scatter,
                "nominal": nominal_row(frequency, nominal),
            }
        )
    return StageData(arrays, {"channels": about})


def posterior_of(
    result: ChannelResult, options: UncertaintyOptions, records: Sequence[RunRecord]
) -> ResponsePosterior:
    """One library call, by method."""
    model = result.identification.model
    if options.method == "classical":
        return classical(result.used, model, options)
    if options.method == "tangent":
        return tangent(result.used, model, options)
    condition = {item.record.name: item.condition for item in records}
    groups: dict[str, list[Record]] = {}
    for record in result.used:
        groups.setdefault(condition[record.name] or record.name, []).append(record)
    if len(groups) < 2:
        raise ValueError(
            "uncertainty.method = 'conditions' needs estimation records of at least two conditions; "
            f"found {len(groups)}"
        )
    return conditions_posterior(list(groups.values()), model, options)


def conditions_posterior(
    groups: Sequence[Sequence[Record]], model: GobfModel, options: EmbeddingOptions
) -> ResponsePosterior:
    """Tangent posterior per condition with one kernel length, combined with the scatter between
    conditions."""
    length = min(common_fir_length(group, model.poles.doubled(), options) for group in groups)
    shared = options.model_copy(update={"fir_length": length})
    return combine_posteriors([tangent(group, model, shared) for group in groups])


def display_grid(model: GobfModel, records: Sequence[Record]) -> npt.NDArray[np.float64]:
    """Frequencies (F,) for pictures: from one period per longest record to Nyquist, denser around the
    modes."""
    longest_s = max(record.n_samples for record in records) * model.dt_s
    poles = model.poles
    modes = [
        Mode(float(omega), float(zeta))
        for omega, zeta in zip(poles.omega_rad_s(model.dt_s), poles.zeta(), strict=True)
        if zeta < 0.4
    ]
    low, high = 2 * np.pi / longest_s, np.pi / model.dt_s
    return frequency_grid(high, modes, omega_min_rad_s=low, n_log=300, n_mode=41 * len(modes))


def bands_of(omega: npt.NDArray[np.float64]) -> list[tuple[float, float]]:
    """`N_BANDS` bands of equal ratio over the grid."""
    edges = np.geomspace(omega[0], omega[-1] * (1 + 1e-9), N_BANDS + 1).tolist()
    return list(pairwise(edges))


def band_row(frequency: FrequencyUncertainty, low: float, high: float) -> dict[str, float]:
    """Size of the ellipses in a band: major semi-axis over |G|, in percent."""
    inside = (frequency.omega_rad_s >= low) & (frequency.omega_rad_s < high)
    relative = 100 * frequency.ellipse().semi_major[inside] / np.abs(frequency.centre[inside])
    return {
        "from_rad_s": low,
        "to_rad_s": high,
        "median_radius_percent": float(np.median(relative)),
        "largest_radius_percent": float(np.max(relative)),
    }


def nominal_row(frequency: FrequencyUncertainty, nominal: GobfModel) -> dict[str, float]:
    """How far the nominal model of the design is from the ellipses' centres, in ellipses."""
    distance = frequency.normalised_distance(nominal.frequency_response(frequency.omega_rad_s))
    worst = int(np.argmax(distance))
    return {
        "share_inside_percent": 100 * float(np.mean(distance <= 1)),
        "largest_distance": float(distance[worst]),
        "at_rad_s": float(frequency.omega_rad_s[worst]),
    }


def residual_tests(result: ChannelResult, posterior: ResponsePosterior) -> list[dict[str, Any]]:
    """Whiteness and independence on the estimation records, whiteness on each record that was not fitted.

    Where the bounds have a noise model, whiteness is that of the residuals behind it: they rest on those.
    """
    found = result.identification
    colour = () if posterior.report is None else posterior.report.ar_coefficients
    filter_of_noise = np.array([1.0, *colour])
    whitened = [lfilter(filter_of_noise, np.ones(1), residual)[len(colour) :] for residual in found.residuals]
    delay = found.model.input_delay_samples
    inputs = [record.input[delay:, 0] for record in result.used]
    tests = [
        {"data": "estimation", **whiteness_test(whitened).to_dict()},
        {"data": "estimation", **independence_test(inputs, found.residuals).to_dict()},
    ]
    tests += [
        {"data": fit.name, **whiteness_test([fit.residual]).to_dict()}
        for fit in result.fresh
        if np.any(fit.residual)
    ]
    return tests


def empirical_response(records: Sequence[Record], level: float) -> FrequencyUncertainty | None:
    """Response without a model from the largest set of equally long records, or None if they are too
    short."""
    by_length: dict[int, list[Record]] = {}
    for record in records:
        by_length.setdefault(record.n_samples, []).append(record)
    alike = max(by_length.values(), key=len)
    try:
        return empirical_frf(alike, level=level)
    except ValueError:
        return None  # a picture the records are too short for; the identification stands without it


def scatter_of(
    channel: Channel,
    model: GobfModel,
    records: Sequence[RunRecord],
    bands: Sequence[tuple[float, float]],
) -> list[dict[str, Any]] | None:
    """Predicted ellipses against the scatter of repeats, or None without repeats."""
    groups: dict[str, list[Record]] = {}
    for item in records:
        if item.condition is not None and item.role != "validation":
            record = item.record.siso(channel.input, channel.output)
            groups.setdefault(item.condition, []).append(increments(record) if channel.increments else record)
    repeated = [group for group in groups.values() if len(group) >= 2]
    if not repeated:
        return None
    flat = record_posteriors([record for group in repeated for record in group], model, channel.uncertainty)
    omega = np.geomspace(bands[0][0], bands[-1][1] * (1 - 1e-6), 20 * len(bands))
    estimates = iter([posterior.at(omega, channel.uncertainty.level) for posterior in flat])
    return [
        row.to_dict()
        for row in repeat_scatter([[next(estimates) for _ in group] for group in repeated], bands)
    ]
