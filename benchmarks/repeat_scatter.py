"""Predicted against measured scatter on three real arms that were measured again and again.

Reach everywhere: measured over predicted, standard deviations, RMS over half a decade, within 0.7 to 1.4.

SLFR (slfr_krauss_2009): six closed-loop sweeps, two amplitudes three times each (two-stage input; settings of
examples/slfr_krauss_2009.toml). Every sweep is held out once. Predicted: its scatter by the two other repeats
(`repeat_posteriors`), beside what each sweep's own residuals say if they are taken for stationary noise
(`record_posteriors`). Measured: around the mean of its amplitude. And what is said of the amplitudes.

DaISy (daisy_robot_arm): the second half is the first with its sign turned, so each half is held out once.
Predicted: level and colour of the noise by the posterior of the other half. Measured: what its response and a
free response leave of the half held out, and of the sum of both halves, which is noise and even distortion.
Both whitened by the noise model, so that its strong bands do not leak into the others.

Kyoto (quanser_rfl_frf): 100 frequencies on four dates (10, 2, 12 and 2 runs), closed loop with gain 1.65,
opened point by point. Predicted from one date: one more run; held against the runs of the other dates.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.harness import Print, data_folder, main, reading
from ident import IdentOptions, Record, band_limited, identify
from ident.basis.functions import nuisance_columns
from ident.basis.options import EmbeddingOptions
from ident.checks.distortion_findings import distortion_findings
from ident.checks.validation import ScatterRow, repeat_scatter
from ident.closed_loop import two_stage
from ident.data.ellipses import hotelling_widening
from ident.data.frf_records import FrfRepeats, inliers
from ident.data.repeats import repeats_of
from ident.uncertainty import FrequencyUncertainty, ResponsePosterior
from ident.uncertainty.autoregression import whitened
from ident.uncertainty.conditions import combine_posteriors, record_posteriors, repeat_posteriors
from ident.uncertainty.embedding import tangent
from workflow.config.run_config import Channel, FileSource, load_config
from workflow.tasks.records import read_record
from workflow.text.templates import words

HZ = 2 * np.pi
REACH = 0.7, 1.4

SLFR = Path(__file__).parents[1] / "examples" / "slfr_krauss_2009.toml"
SLFR_BANDS_HZ = ((1.0, 3.16), (3.16, 10.0), (10.0, 25.0))
POINTS_PER_BAND = 40

DAISY_BANDS = ((0.0316, 0.1), (0.1, 0.316), (0.316, 1.0), (1.0, 3.15))

KYOTO_DT_S = 0.002
KYOTO_BANDS = ((0.6, 2), (2, 6.3), (6.3, 20), (20, 63), (63, 200), (200, 630), (630, 1200))
KYOTO_HEAD = f"{'':<46}" + "".join(f"{f'{a:g}-{b:g}':>9}" for a, b in KYOTO_BANDS) + "   rad/s"
OUTLIER = 6.0


def verdict(ratio: float) -> str:
    return f"{ratio:>5.2f} {'met ' if REACH[0] <= ratio <= REACH[1] else 'FAIL'}"


def slfr(source: FileSource, channel: Channel, say: Print) -> None:
    """One channel of the Krauss arm: table over bands."""
    band, options, bounds = channel.band_rad_s, channel.identification, channel.uncertainty
    sweeps = [entry for entry in source.records if entry.role == "estimation"]
    measured = [read_record(source, entry, (channel,)) for entry in sweeps]
    stage = two_stage([band_limited(one, *channel.bounds_band_rad_s) for one in measured], options)
    model = identify([band_limited(record, *band) for record in stage.records], options).model
    posteriors = record_posteriors(stage.records, model, bounds)
    by_others = repeat_posteriors([stage.records[:3], stage.records[3:]], model, bounds)
    omega = HZ * np.concatenate([np.geomspace(a, b * (1 - 1e-6), POINTS_PER_BAND) for a, b in SLFR_BANDS_HZ])

    def rows(groups: list[list[ResponsePosterior]]) -> list[ScatterRow]:
        return repeat_scatter(
            [[posterior.at(omega) for posterior in group] for group in groups],
            [(low * HZ, high * HZ) for low, high in SLFR_BANDS_HZ],
            posterior=posteriors[0],
        )

    residuals, others = rows([posteriors[:3], posteriors[3:]]), rows(by_others)
    amplitudes = [rows([group]) for group in by_others]
    left_out = np.array(
        [
            combine_posteriors([p for j, p in enumerate(posteriors) if j != i], small_sample_level=0.95)
            .at(omega)
            .contains(posterior.at(omega).centre)
            for i, posterior in enumerate(posteriors)
        ]
    )
    say(f"\nSLFR {channel.name} ({channel.output} from {channel.input}); {words(stage.finding)}")
    say("Scatter of a sweep over the response, measured and predicted; ratios measured over predicted")
    say(f"{'':<39}own residuals      the other repeats    at 50       at 75       left-out sweep")
    say(
        "band Hz       measured  (95 % if right)  predicted  ratio   predicted  ratio     counts      "
        "counts      inside 95 %"
    )
    for k, (own, by) in enumerate(zip(residuals, others, strict=True)):
        here = slice(k * POINTS_PER_BAND, (k + 1) * POINTS_PER_BAND)
        say(
            f"{SLFR_BANDS_HZ[k][0]:>5.2f}-{SLFR_BANDS_HZ[k][1]:<5.2f} {100 * by.measured:>7.2f} %"
            f"  {by.ratio_low:>5.2f} - {by.ratio_high:<5.2f}"
            + "".join(f"  {100 * row.predicted:>7.2f} % {verdict(row.ratio)}" for row in (own, by))
            + "".join(f"  {verdict(each[k].ratio)}" for each in amplitudes)
            + f"  {left_out[:, here].mean():>10.2f}"
        )
    alone = [identify([band_limited(record, *band)], options).model for record in stage.records]
    second = [float(np.sort(m.poles.omega_rad_s(m.dt_s))[1]) / HZ for m in alone]
    say(f"second mode of each sweep by itself, Hz: {', '.join(f'{f:.2f}' for f in second)}")
    for found in distortion_findings(measured, (), repeats_of(measured)):
        say(f"Said: {words(found)}")


def whitened_level(posterior: ResponsePosterior, record: Record) -> np.ndarray:
    """Residual's power over that of the noise model, per band of DAISY_BANDS."""
    report = posterior.report
    assert report is not None
    whitening = np.array([1.0, *report.ar_coefficients])
    free = whitened(nuisance_columns(posterior.poles, record.n_samples, 1, True), whitening)
    rest = whitened(record.output[:, 0] - posterior.simulate(record.input[:, 0]), whitening)
    rest = (rest - free @ np.linalg.lstsq(free, rest, rcond=1e-10)[0])[whitening.size - 1 :]
    power = np.abs(np.fft.rfft(rest)) ** 2 / rest.size / report.noise_std**2
    omega = 2 * np.pi * np.arange(power.size) / rest.size
    return np.array([power[(omega >= low) & (omega < high)].mean() for low, high in DAISY_BANDS])


def daisy(path: Path, say: Print) -> None:
    """Noise level of the robot arm, predicted by one half and seen in the other and in the sum of both."""
    arm = Record.from_file(path, ["u_reaction_torque"], ["y_acceleration"], dt_s=1.0)
    halves = [arm.slice(0, 512), arm.slice(512, 1024)]
    # Of unit noise in each half the sum has a variance of two.
    root = np.sqrt(2)
    both = replace(
        halves[0],
        input=(halves[0].input + halves[1].input) / root,
        output=(halves[0].output + halves[1].output) / root,
    )
    say("\nDaISy arm: measured over predicted noise, RMS of both ways round")
    bands = "".join(f"{f'{a:.3g}-{b:.3g}':>12}" for a, b in DAISY_BANDS)
    say(f"pairs  noise model    {bands}   rad/sample")
    for pairs in (2, 3, 4):
        for order in (8, 32):
            levels = []
            for half, held_out in (halves, halves[::-1]):
                model = identify([half], IdentOptions(n_real=0, n_pairs=pairs, feedthrough=True)).model
                noise = EmbeddingOptions(coloured_noise=True, max_ar_order=order)
                posterior = tangent([half], model, noise)
                levels.append([whitened_level(posterior, record) for record in (held_out, both)])
            for what, ratios in zip(("half held out", "sum"), np.sqrt(np.mean(levels, axis=0)), strict=True):
                told = "".join(f"{verdict(ratio):>12}" for ratio in ratios)
                say(f"{pairs:>5}  AR, at most {order:>2} {told}   {what}")


def share(inside: np.ndarray, omega: np.ndarray) -> str:
    """Share inside for each of KYOTO_BANDS, one cell each."""
    bands = [(omega >= low) & (omega < high) for low, high in KYOTO_BANDS]
    return "".join(f"{inside[..., here].mean():>9.2f}" for here in bands)


def runs_of(points: FrfRepeats, omega: np.ndarray) -> np.ndarray:
    """(R, F) points of a date; within a frequency sorted by gain, so a row is a rank and not a run."""
    return np.array([points.response[points.omega_rad_s == w] for w in omega]).T


def scatter_ratio(date: FrfRepeats, other: FrfRepeats) -> str:
    """Scatter of the other date's runs around the mean of a date over what is predicted for one more run."""
    omega = np.unique(date.omega_rad_s)
    one, mean = (date.mean(KYOTO_DT_S, outlier_threshold=OUTLIER, of=of) for of in ("next run", "mean"))
    sizes = [np.trace(each.covariance, axis1=1, axis2=2) for each in (one, mean)]
    count = np.rint(sizes[0] / sizes[1]) - 1  # (1 + 1 / n) over 1 / n
    predicted = sizes[0] / np.array([hotelling_widening(int(n) - 1, one.level) for n in count])
    points = [inliers(other.response[other.omega_rad_s == w], OUTLIER) for w in omega]
    measured = np.array([np.mean(np.abs(p - c) ** 2) for p, c in zip(points, one.centre, strict=True)])
    size = np.abs(one.centre) ** 2
    bands = [(omega >= low) & (omega < high) for low, high in KYOTO_BANDS]
    ratios = [np.sqrt(np.mean((measured / size)[b]) / np.mean((predicted / size)[b])) for b in bands]
    return "".join(f"{ratio:>9.2f}" for ratio in ratios)


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
        "\nThe same as a ratio of standard deviations, gross errors of either date dropped. Reach 0.7 to 1.4."
    )
    say(KYOTO_HEAD)
    for date in long:
        for other in dates:
            if other != date:
                ratios = scatter_ratio(plant.only(date), plant.only(other))
                say(f"{f'{date} -> {other} ({counts[other]} runs)':<46}{ratios}")
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
    folder = data_folder("slfr_krauss_2009", "daisy_robot_arm", "quanser_rfl_frf")
    if only in ("", "slfr"):
        config, _ = load_config(SLFR)
        for channel in config.channels:
            slfr(config.source, channel, say)
        say("\n" + reading("repeat_scatter_slfr"))
    if only in ("", "daisy"):
        daisy(folder / "daisy_robot_arm" / "robot_arm.csv", say)
        say("\n" + reading("repeat_scatter_daisy"))
    if only in ("", "kyoto"):
        kyoto(folder / "quanser_rfl_frf" / "frf_repeats.csv", say)


if __name__ == "__main__":
    main(run, seeds="none: measured data")
