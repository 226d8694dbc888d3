"""Predicted ellipses against measured scatter on two real arms that were measured again and again.

    FLEXLINK_DATA=/path/to/data OMP_NUM_THREADS=1 python -m benchmarks.repeat_scatter [--only slfr|kyoto]

SLFR (slfr_krauss_2009): six closed-loop sweeps, two amplitudes three times each. Predicted: the tangent
posterior of one sweep (two-stage input; settings of examples/slfr_krauss_2009.toml). Measured: scatter of the
sweeps' estimates around the mean of their amplitude. Both RMS over a band, one standard deviation, over |G|.

Kyoto (quanser_rfl_frf): 100 frequencies on four dates (10, 2, 12 and 2 runs), closed loop with gain 1.65,
opened point by point. Predicted from one date, held against the points and means of the other dates. Models
fitted to one date and judged on another: `benchmarks.frequency_fit`.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, data_folder, main, reading
from ident import IdentOptions, Record, band_limited, identify
from ident.checks.validation import repeat_scatter
from ident.closed_loop import two_stage
from ident.data.frf_records import FrfRepeats
from ident.uncertainty import FrequencyUncertainty
from ident.uncertainty.conditions import combine_posteriors, record_posteriors
from ident.uncertainty.embedding import EmbeddingOptions
from workflow.text.templates import words

HZ = 2 * np.pi

SLFR_BANDS_HZ = ((0.8, 2), (2, 4), (4, 8), (8, 16), (16, 17.3), (17.3, 18.6), (18.6, 25), (25, 30))
SLFR_SWEEPS = [(amplitude, repeat) for amplitude in (50, 75) for repeat in (1, 2, 3)]
_COMMON = {"estimate_initial_state": False, "omega_min_rad_s": 6.0, "omega_max_rad_s": 260.0, "n_pairs": 2}
SLFR_CHANNELS = {
    "hub": ("theta_rad", (31.4, 188.5), IdentOptions(integrators=1, n_real=1, **_COMMON)),
    "tip": ("accel_counts", (12.6, 188.5), IdentOptions(feedthrough=True, n_real=2, **_COMMON)),
}
SLFR_BOUNDS = EmbeddingOptions(coloured_noise=True, max_ar_order=20, fir_length=60)
POINTS_PER_BAND = 20

KYOTO_DT_S = 0.002
KYOTO_BANDS = ((0.6, 3), (3, 20), (20, 28), (28, 60), (60, 200), (200, 600), (600, 1200))
KYOTO_HEAD = f"{'':<46}" + "".join(f"{f'{a:g}-{b:g}':>9}" for a, b in KYOTO_BANDS) + "   rad/s"
OUTLIER = 6.0


def slfr(folder: Path, channel: str, say: Print) -> None:
    """One channel of the Krauss arm: table over bands."""
    output, band, options = SLFR_CHANNELS[channel]
    records = [
        Record.from_file(
            folder / f"swept_sine_amp{amplitude}_rep{repeat}.csv",
            ["v_drive_counts"],
            [output],
            time="t_s",
            references=["u_ref_rad"],
        )
        for amplitude, repeat in SLFR_SWEEPS
    ]
    begin = time.process_time()
    stage = two_stage([band_limited(record, 5.03, 188.5) for record in records], options, SLFR_BOUNDS)
    model = identify([band_limited(record, *band) for record in stage.records], options).model
    posteriors = record_posteriors(stage.records, model, SLFR_BOUNDS)
    omega = HZ * np.concatenate([np.linspace(a, b * (1 - 1e-6), POINTS_PER_BAND) for a, b in SLFR_BANDS_HZ])
    estimates = [posterior.at(omega) for posterior in posteriors]
    rows = repeat_scatter(
        [estimates[:3], estimates[3:]],
        [(low * HZ, high * HZ) for low, high in SLFR_BANDS_HZ],
        posterior=posteriors[0],
    )
    first_stage = stage.relative_error(omega)
    left_out = np.array(
        [
            combine_posteriors([p for j, p in enumerate(posteriors) if j != i], small_sample_level=0.95)
            .at(omega)
            .contains(estimates[i].centre)
            for i in range(len(records))
        ]
    )
    modes = ", ".join(
        f"{w / HZ:.2f} Hz (damping {z:.3f})"
        for w, z in zip(model.poles.omega_rad_s(model.dt_s), model.poles.zeta(), strict=True)
    )
    say(f"\nSLFR {channel} ({output} from v_drive_counts): modes {modes}; {words(stage.finding)}")
    say(
        "band Hz        predicted  first stage  measured   predicted/measured  (95 % if honest)  dof   "
        "amplitudes apart   left-out sweep inside"
    )
    say(f"{'':<50}reach: inside the interval{'':<31}reach: 0.95")
    for k, row in enumerate(rows):
        here = slice(k * POINTS_PER_BAND, (k + 1) * POINTS_PER_BAND)
        inside = row.ratio_low <= row.ratio <= row.ratio_high
        stage_error = float(np.sqrt(np.mean(first_stage[here] ** 2)))
        say(
            f"{SLFR_BANDS_HZ[k][0]:>5.1f} - {SLFR_BANDS_HZ[k][1]:<5.1f} {100 * row.predicted:>8.2f} %"
            f" {100 * stage_error:>9.2f} % {100 * row.measured:>8.2f} %  {1 / row.ratio:>8.2f} "
            f"{'met ' if inside else 'FAIL'}      {1 / row.ratio_high:>5.2f} - {1 / row.ratio_low:<5.2f}"
            f"   {row.degrees_of_freedom:>5.1f}   {100 * row.between:>5.1f} %"
            f" = {row.between_ratio:>4.1f} x noise"
            f"      {left_out[:, here].mean():>5.2f}"
        )
    own = [identify([band_limited(record, *band)], options).model for record in stage.records]
    second = [float(np.sort(m.poles.omega_rad_s(m.dt_s))[1]) / HZ for m in own]
    say(
        "second mode of each sweep by itself, Hz: "
        + ", ".join(f"{a} counts {f:.2f}" for (a, _), f in zip(SLFR_SWEEPS, second, strict=True))
        + f"   (CPU {time.process_time() - begin:.0f} s)"
    )
    for said, bands in (
        ("Too small", [b for b, row in zip(SLFR_BANDS_HZ, rows, strict=True) if row.ratio > row.ratio_high]),
        ("Too large", [b for b, row in zip(SLFR_BANDS_HZ, rows, strict=True) if row.ratio < row.ratio_low]),
    ):
        say(f"{said}: {', '.join(f'{low:g}-{high:g} Hz' for low, high in bands) or 'nowhere'}.")
    say("\n" + reading("repeat_scatter_slfr"))


def share(inside: np.ndarray, omega: np.ndarray) -> str:
    """Share inside for each of KYOTO_BANDS, one cell each."""
    bands = [(omega >= low) & (omega < high) for low, high in KYOTO_BANDS]
    return "".join(f"{inside[..., here].mean():>9.2f}" for here in bands)


def runs_of(points: FrfRepeats, omega: np.ndarray) -> np.ndarray:
    """(R, F) points of a date; within a frequency sorted by gain, so a row is a rank and not a run."""
    return np.array([points.response[points.omega_rad_s == w] for w in omega]).T


def kyoto(path: Path, say: Print) -> None:
    """All tables of the Kyoto arm."""
    plant = FrfRepeats.from_csv(path, label="date").open_loop(1.0, 1.65)
    dates = plant.labels
    omega = np.unique(plant.omega_rad_s)
    counts = {date: plant.label.count(date) // omega.size for date in dates}
    long = {date: count for date, count in counts.items() if count >= 10}
    say(f"\nKyoto arm: {', '.join(f'{date}: {counts[date]} runs' for date in dates)}")
    say(
        "\nOne more run, predicted by the runs of one date (Hotelling's region, its outliers dropped):"
        "\nshare of the other date's points inside 95 %, its own outliers kept. Reach 0.95."
    )
    say(KYOTO_HEAD)
    for date in long:
        region = plant.only(date).mean(KYOTO_DT_S, outlier_threshold=OUTLIER, of="next run")
        for other in dates:
            if other != date:
                inside = np.array([region.contains(run) for run in runs_of(plant.only(other), omega)])
                say(f"{f'{date} -> {other} ({counts[other]} runs)':<46}{share(inside, omega)}")
    means = {
        date: plant.only(date).mean(
            KYOTO_DT_S, outlier_threshold=OUTLIER, pool_neighbours=0 if date in long else 3
        )
        for date in dates
    }
    say(
        "\nMean of one date against the mean of another, both with ellipses: share inside 95 %. Reach 0.95 if"
    )
    say("days are alike.")
    say(KYOTO_HEAD)
    for i, date in enumerate(dates):
        for other in dates[i + 1 :]:
            inside = together(means[date], means[other])
            say(f"{f'{date} and {other}':<46}{share(inside, omega)}")
    say("\n" + reading("repeat_scatter_kyoto"))


def together(one: FrequencyUncertainty, other: FrequencyUncertainty) -> np.ndarray:
    """(F,) whether two independent estimates agree within the 95 % ellipse of both covariances."""
    both = replace(one, covariance=one.covariance + other.covariance)
    return both.contains(other.centre)


def run(say: Print, *, only: str = "") -> None:
    folder = data_folder("slfr_krauss_2009", "quanser_rfl_frf")
    if only != "kyoto":
        for channel in SLFR_CHANNELS:
            slfr(folder / "slfr_krauss_2009", channel, say)
    if only != "slfr":
        kyoto(folder / "quanser_rfl_frf" / "frf_repeats.csv", say)


if __name__ == "__main__":
    main(run, seeds="none: measured data")
