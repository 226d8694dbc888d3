"""Predicted ellipses against measured scatter on two real arms that were measured again and again.

    FLEXLINK_DATA=/path/to/data OMP_NUM_THREADS=1 python -m benchmarks.repeat_scatter [--only slfr|kyoto]

SLFR (slfr_krauss_2009): six closed-loop sweeps, two amplitudes three times each. Predicted: the tangent
posterior of one sweep (two-stage input; settings of examples/slfr_krauss_2009.toml). Measured: scatter of the
sweeps' estimates around the mean of their amplitude. Both RMS over a band, one standard deviation, over |G|.

Kyoto (quanser_rfl_frf): 100 frequencies on four dates (10, 2, 12 and 2 runs), closed loop with gain 1.65,
opened point by point. Predicted from one date, held against the points and means of the other dates.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import f as f_distribution

from benchmarks.harness import Print, data_folder, main, reading
from ident import IdentOptions, Record, band_limited, identify
from ident.checks.validation import repeat_scatter
from ident.closed_loop import indirect, two_stage
from ident.data.frf_records import FrfRepeats
from ident.frequency_fit import FrfIdentification, identify_frf
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


def per_band(omega: np.ndarray, cell: Callable[[np.ndarray], str]) -> str:
    """cell(frequencies of the band (F,) bool) for each of KYOTO_BANDS, a dash where there are none."""
    bands = [(omega >= low) & (omega < high) for low, high in KYOTO_BANDS]
    return "".join(f"{cell(here) if np.any(here) else '-':>9}" for here in bands)


def share(inside: np.ndarray, omega: np.ndarray) -> str:
    """Share inside per band, one cell each."""
    return per_band(omega, lambda here: f"{inside[..., here].mean():.2f}")


def row_median(runs: np.ndarray) -> np.ndarray:
    """Median of real and imaginary parts over the runs: (R, F) -> (F,)."""
    return np.asarray(np.median(runs.real, axis=0) + 1j * np.median(runs.imag, axis=0))


def outlying(runs: np.ndarray) -> np.ndarray:
    """Points (R, F) that Hampel's rule drops: `OUTLIER` robust deviations from the median of the runs."""
    distance = np.abs(runs - row_median(runs))
    return distance > OUTLIER * np.median(distance, axis=0) / 1.1774


def runs_of(points: FrfRepeats, omega: np.ndarray) -> np.ndarray:
    """(R, F) points of a date; within a frequency sorted by gain, so a row is a rank and not a run."""
    return np.array([points.response[points.omega_rad_s == w] for w in omega]).T


def run_gain_std(points: FrfRepeats, omega: np.ndarray) -> float:
    """Relative standard deviation of the gain of a run, robust (median absolute deviation), median above 3
    rad/s."""
    runs = runs_of(points, omega)
    centre = row_median(runs)
    along = (runs / centre).real
    deviation = 1.4826 * np.median(np.abs(along - np.median(along, axis=0)), axis=0)
    return float(np.median(deviation[omega > 3]))


def kyoto(path: Path, say: Print) -> None:
    """All tables of the Kyoto arm."""
    closed = FrfRepeats.from_csv(path, label="date")
    plant = closed.open_loop(1.0, 1.65)
    dates = plant.labels
    omega = np.unique(plant.omega_rad_s)
    counts = {date: plant.label.count(date) // omega.size for date in dates}
    long = {date: count for date, count in counts.items() if count >= 10}
    say(f"\nKyoto arm: {', '.join(f'{date}: {counts[date]} runs' for date in dates)}")
    dropped_points(plant, long, omega, say)
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
    scatter_ratios(plant, long, omega, say)
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
    say("\nDays as conditions (scatter of the other three dates; widening for few needs four):")
    for date in dates:
        others = conditions([means[other] for other in dates if other != date])
        inside = together(others, means[date])
        say(f"{f'three dates -> {date}':<46}{share(inside, omega)}")
    days(plant, say)
    parametric(plant, long, means, omega, say)
    say(
        "\nOpening the loop: largest semi-axis by the delta method (ident.closed_loop.indirect) over that of"
        "\npoints mapped one by one, median and largest in the band."
    )
    for date in long:
        mapped = indirect(closed.only(date).mean(KYOTO_DT_S, outlier_threshold=OUTLIER), 1.0, 1.65)
        ratio = mapped.enclosing_radius() / means[date].enclosing_radius()
        cells = per_band(omega, lambda here, r=ratio: f"{np.median(r[here]):.2f}/{r[here].max():.1f}")
        say(f"{date:<46}{cells}")
    say("\n" + reading("repeat_scatter_kyoto"))


def days(plant: FrfRepeats, say: Print) -> None:
    """What differs between the dates: mode, zero and gain of a small model of each."""
    say("\nEach date by itself, 3-80 rad/s, integrator + 1 real pole + 1 pair:")
    for date in plant.labels:
        points = plant.only(date).band(3, 80)
        few = points.label.count(date) < 10 * np.unique(points.omega_rad_s).size
        frf = points.mean(
            KYOTO_DT_S, outlier_threshold=None if few else OUTLIER, pool_neighbours=3 if few else 0
        )
        found = identify_frf(frf, IdentOptions(integrators=1, n_real=1, n_pairs=1))
        poles = found.model.poles
        fine = np.linspace(15, 40, 5001)
        zero = fine[int(np.argmin(np.abs(found.model.frequency_response(fine))))]
        gain = float(np.abs(found.model.frequency_response(np.array([10.0])))[0])
        say(
            f"{date}: mode {poles.omega_rad_s(KYOTO_DT_S)[0]:.2f} +- {found.omega_std_rad_s[0]:.2f} rad/s, "
            f"damping {poles.zeta()[0]:.3f}, smallest gain at {zero:.2f} rad/s, gain at 10 rad/s {gain:.4f}"
        )


def dropped_points(plant: FrfRepeats, dates: Iterable[str], omega: np.ndarray, say: Print) -> None:
    """How many points the outlier rule drops, and how many gross ones it leaves."""
    for date in dates:
        runs = runs_of(plant.only(date), omega)
        dropped = outlying(runs)
        gross = np.abs(np.log(np.abs(runs) / np.abs(row_median(runs)))) > np.log(2)
        say(
            f"{date}: {dropped.sum()} of {dropped.size} points dropped (Hampel's rule across repeats, "
            f"{OUTLIER:g} robust deviations), {dropped[:, omega < 600].sum()} below 600 rad/s; off by "
            f"more than a factor of two: {gross.sum()}, of which kept: {(gross & ~dropped).sum()} "
            f"({(gross & ~dropped)[:, omega < 600].sum()} below 600 rad/s)"
        )


def scatter_ratios(plant: FrfRepeats, dates: Mapping[str, int], omega: np.ndarray, say: Print) -> None:
    """Standard deviation of a run predicted by one date over that measured on the other; runs by date."""
    say("\nStandard deviation of a run, one date over the other (outliers dropped on both).")
    say(KYOTO_HEAD)
    size = []
    for date in dates:
        points = plant.only(date)
        mean = points.mean(KYOTO_DT_S, outlier_threshold=OUTLIER)
        runs = runs_of(points, omega)
        spread = np.nanvar(np.where(outlying(runs), np.nan, runs), axis=0, ddof=1)
        size.append(spread / np.abs(mean.centre) ** 2)
    cells = per_band(omega, lambda here: f"{np.sqrt(size[0][here].mean() / size[1][here].mean()):.2f}")
    say(f"{' / '.join(dates):<46}{cells}")
    low, high = np.sqrt(f_distribution.ppf([0.025, 0.975], *(count - 1 for count in dates.values())))
    say(
        f"expected 1; 95 % interval {low:.2f} - {high:.2f} if a run's error is one gain for all frequencies "
        "(F with one degree of freedom per run and date), narrower the less frequencies move together"
    )


def conditions(means: Sequence[FrequencyUncertainty]) -> FrequencyUncertainty:
    """What `combine_posteriors` makes of posteriors, frequency by frequency."""
    centres, count = np.stack([mean.centre for mean in means]), len(means)
    apart = centres - centres.mean(axis=0)
    pair = np.stack([apart.real, apart.imag])
    between = (1 + 1 / count) / (count - 1) * np.einsum("akf,bkf->fab", pair, pair)
    within = np.mean([mean.covariance for mean in means], axis=0) / count
    return replace(means[0], centre=centres.mean(axis=0), covariance=between + within)


def together(one: FrequencyUncertainty, other: FrequencyUncertainty) -> np.ndarray:
    """(F,) whether two independent estimates agree within the 95 % ellipse of both covariances."""
    both = replace(one, covariance=one.covariance + other.covariance)
    return both.contains(other.centre)


def parametric(
    plant: FrfRepeats,
    dates: Mapping[str, int],
    means: dict[str, FrequencyUncertainty],
    omega: np.ndarray,
    say: Print,
) -> None:
    """Ellipses of a GOBF model fitted to one date, held against the means of all others; runs by date."""
    say(
        "\nGOBF model fitted to one date up to 600 rad/s (one integrator, order from data): its ellipses and"
        "\nthose of the other date's mean together, share inside 95 %; semi-axes over |G|. With 'gain', the"
        "\nerror the runs of a date share (deviation of a gain / sqrt(runs)) is added to the posterior."
    )
    say(KYOTO_HEAD)
    limited = omega <= 600
    for date, count in dates.items():
        points = plant.only(date)
        gain = run_gain_std(points, omega)
        frf = points.band(0, 600).mean(KYOTO_DT_S, outlier_threshold=OUTLIER)
        for name, shared in (("", 0.0), (", gain", gain / np.sqrt(count))):
            found = identify_frf(frf, IdentOptions(integrators=1), shared_gain_std=shared)
            ellipses = found.posterior.at(omega)
            if not shared:
                describe(date, found, gain, say)
            for other in means:
                if other != date:
                    inside = together(ellipses, means[other])[limited]
                    say(f"{f'{date}{name} -> {other}':<46}{share(inside, omega[limited])}")
            relative = 100 * ellipses.enclosing_radius() / np.abs(ellipses.centre)
            cells = per_band(omega[limited], lambda here, r=relative[limited]: f"{np.median(r[here]):.1f} %")
            say(f"{f'{date}{name}: median semi-axis / |G|':<46}{cells}")


def describe(date: str, found: FrfIdentification, gain: float, say: Print) -> None:
    """Poles with standard deviations, order and fit, in one line each."""
    poles = found.model.poles
    pairs = ", ".join(
        f"{w:.2f} +- {sw:.2f} rad/s damping {z:.4f} +- {sz:.4f}"
        for w, z, sw, sz in zip(
            poles.omega_rad_s(KYOTO_DT_S),
            poles.zeta(),
            found.omega_std_rad_s,
            found.zeta_std,
            strict=True,
        )
    )
    real = ", ".join(f"{d:.2f}" for d in poles.decay_per_s(KYOTO_DT_S)[1:])
    say(
        f"{date}: integrator, {poles.real.size - 1} real ({real} 1/s), {poles.pairs.size} pairs: {pairs}; "
        f"run gain std {100 * gain:.1f} %"
    )
    say(f"    {words(found.verdicts[0])}")


def run(say: Print, *, only: str = "") -> None:
    folder = data_folder("slfr_krauss_2009", "quanser_rfl_frf")
    if only != "kyoto":
        for channel in SLFR_CHANNELS:
            slfr(folder / "slfr_krauss_2009", channel, say)
    if only != "slfr":
        kyoto(folder / "quanser_rfl_frf" / "frf_repeats.csv", say)


if __name__ == "__main__":
    main(run, seeds="none: measured data")
