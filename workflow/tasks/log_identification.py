"""Records of one channel into its model, ellipses and tests: what `flexlink identify` computes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.checks.distortion_findings import amplitude_effects
from ident.checks.plausible_modes import pairs_outside
from ident.checks.residual_tests import residual_advice, whiteness_test
from ident.closed_loop import two_stage
from ident.data.finding import Finding, distinct
from ident.data.record import Record
from ident.data.signal_filter import band_limited, settling_time_s
from ident.friction import (
    EquivalentFriction,
    FrictionFit,
    fit_friction,
    refuse_unrecorded,
    refuse_unseen_shaft,
    without_friction as behind_friction,
)
from ident.identification import Identification
from ident.uncertainty import ResponsePosterior
from ident.uncertainty.embedding import tangent
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.engine.errors import naming
from workflow.engine.progress import Progress
from workflow.tasks.identification import clipped_as_measured, identified_channel
from workflow.tasks.results import IdentifiedChannel, Tests, UncertainChannel
from workflow.tasks.simulated_rig import TrueMode
from workflow.tasks.uncertainty import (
    N_BANDS,
    described_response,
    display_grid,
    residual_tests,
    uncertain_channel,
)

# Largest orders of the noise model that are tried, until the residuals behind it are white.
_NOISE_ORDERS = (8, 32)


@dataclass(frozen=True, eq=False)
class LogIdentification:
    """Everything that was found in a set of logs.

    `measured` are the records as read, `used` the same as the fit saw them (inside the band; with the input
    that the reference explains, where the logs come from a closed loop). `about` and `spread` are results as
    of a run's stages; `careful` says what to look at. The stabilisation plot is None where nobody asked for
    it. `true_modes`: beside each mode of `about` the true one, known of simulated logs. `described`: what the
    ellipses are about; friction: identified, where that asks for it; equivalent: the viscous friction that
    acts like it, where it asks for amplitudes. input_limit: that the amplifier gives, where it was stated.
    """

    measured: tuple[Record, ...]
    fresh_records: tuple[Record, ...]
    options: IdentOptions
    about: IdentifiedChannel
    spread: UncertainChannel
    careful: tuple[Finding, ...]
    described: UncertaintyOptions
    friction: FrictionFit | None = None
    equivalent: EquivalentFriction | None = None
    true_modes: tuple[TrueMode | None, ...] = ()
    input_limit: float | None = None


def identify_records(
    measured: Sequence[Record],
    fresh_records: Sequence[Record] = (),
    options: IdentOptions | None = None,
    *,
    described: UncertaintyOptions | None = None,
    band_rad_s: tuple[float, float] | None = None,
    noise_order: int | None = None,
    with_plot: bool = True,
    progress: Progress | None = None,
) -> LogIdentification:
    """Identify one channel from records (tangent uncertainty); nothing is written.

    The noise is modelled where the residuals are not white. Records with a reference are taken as made in
    closed loop. described: what the ellipses are about, and their level. Raises InputError.
    """
    options, progress = options or IdentOptions(), progress or Progress()
    described = described or UncertaintyOptions()
    friction, opened, logs_to_validate = None, None, fresh_records
    with naming("identify"), progress.stage("identify") as update:
        used = list(measured)
        if described.friction_identified:
            if band_rad_s is not None:
                raise ValueError(f"'{described.response}' takes logs as measured: no band")
            refuse_unrecorded(used, described.amplitudes)
            friction = fit_friction(used, options, progress=update)
            refuse_unseen_shaft(friction, used)
            used, fresh_records = (
                [friction.taken_off(record) for record in part] for part in (used, fresh_records)
            )
        if band_rad_s is not None:
            options = _searched_around(band_rad_s, options, measured[0].dt_s)
            used, fresh_records = (
                [_inside(band_rad_s, record) for record in part] for part in (used, fresh_records)
            )
        if friction is not None or any(record.reference is not None for record in measured):
            # The arm with friction was fitted without delay, and a closed loop looks like one.
            options = options.with_delay_stated()
        if friction is None and any(record.reference is not None for record in measured):
            opened = two_stage(used, options)
            used = list(opened.records)
        about = identified_channel(
            used[0].output_names[0],
            used,
            [(record, "validation") for record in fresh_records],
            options,
            update,
            with_plot=with_plot,
            two_stage=None if opened is None else opened.finding,
            friction=friction,
        )
        if friction is not None:
            about = clipped_as_measured(about, measured)
        about, found = replace(about, band_rad_s=band_rad_s), about.identification
    with naming("identify"), progress.stage("uncertainty"):
        poles, equivalent = found.model.poles, None
        bounds = EmbeddingOptions(order_given=options.n_pairs is not None)
        if friction is None:
            posterior, tests = _posterior(used, found, noise_order, bounds)
            linear = posterior
        else:
            white = whiteness_test([friction.residual(record) for record in measured]).passed
            coloured = {"coloured_noise": not white, "max_ar_order": noise_order or _NOISE_ORDERS[0]}
            behind = behind_friction(measured, friction, found.model, bounds.model_copy(update=coloured))
            linear = behind.response
            tests = residual_tests(linear, measured, behind.friction)
            posterior, poles, equivalent = described_response(
                behind, poles, friction, measured, described, np.random.default_rng(0)
            )
        omega = display_grid(found.model, used)
        if band_rad_s is not None:
            omega = omega[(omega >= band_rad_s[0]) & (omega <= band_rad_s[1])]
            if omega.size < N_BANDS:
                raise ValueError(
                    f"the band {band_rad_s[0]:g} to {band_rad_s[1]:g} rad/s is too narrow to show"
                )
        spread = uncertain_channel(
            "tangent",
            described.level,
            posterior,
            about,
            omega,
            omega,
            poles=poles,
            linear=linear,
            tests=tests,
        )
    return LogIdentification(
        measured=tuple(measured),
        fresh_records=tuple(fresh_records),
        options=options,
        about=about,
        spread=spread,
        careful=(
            # Time columns that look like another unit, and repaired ones, each said once.
            *distinct([doubt for record in (*measured, *logs_to_validate) for doubt in record.doubts]),
            *amplitude_effects(measured),
            *found.warnings,
            *residual_advice(
                *spread.tests,
                noise_order=spread.noise_order,
                friction=friction is None and band_rad_s is None and opened is None,
            ),
            # Pairs beside the band that was asked for: the search may go an octave further.
            *(
                pairs_outside(found.model.poles, options.fixed(), found.model.dt_s, band_rad_s)
                if band_rad_s
                else ()
            ),
            *(opened.warnings if opened else ()),
        ),
        described=described,
        friction=friction,
        equivalent=equivalent,
    )


def _searched_around(band_rad_s: tuple[float, float], options: IdentOptions, dt_s: float) -> IdentOptions:
    """No pair far outside the band, unless bounds are stated: it could only fit the filter's skirts."""
    low, high = band_rad_s[0] / 2, min(2 * band_rad_s[1], 0.9 * np.pi / dt_s)
    bounds = {"omega_min_rad_s": options.omega_min_rad_s or low}
    return options.model_copy(update=bounds | {"omega_max_rad_s": options.omega_max_rad_s or high})


def _inside(band_rad_s: tuple[float, float], record: Record) -> Record:
    """The record within the band, without the start that the filter spoils; of a short one half is kept."""
    filtered = band_limited(record, *band_rad_s)
    settled = round(settling_time_s(record.dt_s, *band_rad_s) / record.dt_s)
    return filtered.slice(min(settled, record.n_samples // 2), record.n_samples)


def _posterior(
    used: Sequence[Record], found: Identification, noise_order: int | None, bounds: EmbeddingOptions
) -> tuple[ResponsePosterior, Tests]:
    """Tangent posterior and its residual tests, with as much of a noise model as the residuals ask for.

    White-noise bounds around coloured residuals are far too narrow, so the data decide, unless noise_order
    asks for a noise model.
    """
    if noise_order is None and whiteness_test(found.residuals).passed:
        posterior = tangent(used, found.model, bounds)
        return posterior, residual_tests(posterior, used)
    tried = []
    for order in _NOISE_ORDERS if noise_order is None else (noise_order,):
        coloured = bounds.model_copy(update={"coloured_noise": True, "max_ar_order": order})
        posterior = tangent(used, found.model, coloured)
        tests = residual_tests(posterior, used)
        whiteness, _ = tests
        tried.append((whiteness.probability, posterior, tests))
        if whiteness.passed:
            break
    # A longer noise model has to make the residuals whiter: inside a band it can also turn upon itself.
    _, posterior, tests = max(tried, key=itemgetter(0))
    return posterior, tests
