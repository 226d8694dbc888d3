"""Blocks about one identified model, shared by the report of a run and the page of `flexlink identify`.

`about` and `spread` are the results of the identification and of its uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ident.basis.options import IdentOptions
from ident.checks.validation import ResidualTest
from ident.stabilisation import Stabilisation
from workflow.report.formats import count, frequency, listing, number, percent
from workflow.report.page import Block, Remarks, Table, maybe
from workflow.tasks.results import Band, IdentifiedChannel, Intervals, UncertainChannel
from workflow.tasks.summary import between


def structure_words(about: IdentifiedChannel) -> str:
    """order 6, 1 integrator given as known and 1 sample of input delay."""
    parts = [f"order {about.order}"]
    if about.integrators:
        parts.append(f"{count(about.integrators, 'integrator')} given as known")
    if about.input_delay_samples:
        parts.append(f"{count(about.input_delay_samples, 'sample')} of input delay")
    if about.feedthrough:
        parts.append("a direct term")
    return listing(parts)


def pole_tables(about: IdentifiedChannel, dt_s: float, intervals: Intervals | None) -> list[Block]:
    """Pairs and real poles, with the intervals of the posterior where there are any."""
    blocks: list[Block] = []
    known = intervals.modes if intervals is not None else None
    level = "" if intervals is None else f"{percent(100 * intervals.level, 4)}"
    rows: list[tuple[str, ...]]
    head: tuple[str, ...] = ("pole pair: frequency [Hz]", "[rad/s]", "damping ratio [1]")
    rows = [(number(m.frequency_Hz, 4), number(m.omega_rad_s, 4), number(m.damping)) for m in about.modes]
    if rows and known is not None:
        head = (*head, f"{level} interval of the frequency [Hz]", "of the damping [1]")
        rows = [
            (*row, between(*b.frequency_Hz), between(*b.damping)) for row, b in zip(rows, known, strict=True)
        ]
    if rows:
        blocks.append(Table(head, tuple(rows)))
    reals = about.real_poles_z
    if reals:
        rates = iter(() if intervals is None else intervals.real_poles_per_s)
        cells = [
            (number(z, 6), decay_words(z, dt_s), between(*next(rates)) if intervals and z > 0 else "–")
            for z in reals
        ]
        if intervals is None:
            blocks.append(Table(("real pole z [1]", "decay rate [1/s]"), tuple(cell[:2] for cell in cells)))
        else:
            blocks.append(Table(("real pole z [1]", "decay rate [1/s]", f"{level} interval"), tuple(cells)))
    return blocks


def decay_words(z: float, dt_s: float) -> str:
    """Decay rate of a real pole; one at or left of the origin has no counterpart in continuous time."""
    if z > 0:
        return number(-math.log(z) / dt_s, 4)
    return "gone after one sample" if z == 0 else "changes sign every sample"


def order_table(about: IdentifiedChannel, options: IdentOptions) -> list[Block]:
    """Every structure that was tried, if there was a choice at all."""
    if len(about.order_table) < 2:
        return []
    best = min(step.criterion for step in about.order_table)
    steps = tuple(
        (
            str(step.n_real),
            str(step.n_pairs),
            number(step.rss, 4),
            f"{step.criterion - best:.1f}",
        )
        for step in about.order_table
    )
    head = ("real poles", "pairs", "residual sum of squares", "criterion above the best")
    return [Table(head, steps, who_chose(options))]


def who_chose(options: IdentOptions) -> str:
    """Who decided on the order: the criterion decides only what the options leave open."""
    fixed = [
        f"{name} = {value}"
        for name, value in (("n_real", options.n_real), ("n_pairs", options.n_pairs))
        if value is not None
    ]
    if not fixed:
        return "Structures tried; the smallest criterion wins."
    if len(fixed) == 2:
        return (
            f"Structures passed on the way. {listing(fixed)} was asked for; the criterion, "
            "which would take the structure with 0, did not decide."
        )
    return f"Structures tried; {fixed[0]} was asked for, the smallest criterion decides the rest."


def stabilisation_sentence(plot: Stabilisation) -> str:
    """What the stabilisation plot says about the modes, and about those of the model that it does not
    confirm."""
    modes = plot.columns()
    if not modes:
        return "No pole pair stays from fit to fit and is needed by the data."
    at = listing([frequency(mode.omega_rad_s) for mode in modes])
    if len(modes) == 1:
        text = f"One mode stays where it is when more pole pairs are allowed, and the data need it: {at}."
    else:
        text = (
            f"{len(modes)} modes stay where they are when more pole pairs are allowed, and the data need "
            f"them: {at}."
        )
    here = plot.n_pairs == plot.chosen
    unconfirmed = [
        float(omega)
        for omega in plot.omega_rad_s[here]
        if not any(abs(omega / mode.omega_rad_s - 1) < 0.02 for mode in modes)
    ]
    if unconfirmed:
        words = listing([frequency(omega) for omega in unconfirmed])
        text += (
            f" The model's pair at {words} is not among them: "
            "call it a mode of the machine only with another "
            "reason."
        )
    return text


STABILISATION_CAPTION = (
    "Left: the information criterion of every structure that was tried, above the best. Right: pole pairs of "
    "fits with 0, 1, 2 ... pairs; a pair stays when it moves by less than 1 % in frequency and 5 % in "
    "damping, and is needed when the data would miss it. Modes of the machine are columns of full dots on "
    "peaks of the response behind them."
)


def band_table(bands: Sequence[Band]) -> Table:
    """Size of the ellipses by band."""
    return Table(
        ("from [rad/s]", "to [rad/s]", "median ellipse / gain [%]", "largest [%]"),
        tuple(
            (
                number(band.from_rad_s),
                number(band.to_rad_s),
                number(band.median_radius_percent),
                number(band.largest_radius_percent),
            )
            for band in bands
        ),
    )


def unknown_bands(bands: Sequence[Band]) -> tuple[str, ...]:
    """One sentence for every band whose ellipses are larger than the response."""
    return tuple(
        f"Between {number(band.from_rad_s)} and {number(band.to_rad_s)} rad/s the ellipses are larger "
        "than the response itself: gain and phase are not known there. Advice: excite this band, or keep the "
        "controller out of it."
        for band in bands
        if band.median_radius_percent > 100
    )


def band_words(bands: Sequence[Band]) -> str:
    """Where the ellipses are narrowest and where widest."""
    narrow = min(bands, key=lambda band: band.median_radius_percent)
    wide = max(bands, key=lambda band: band.median_radius_percent)
    return (
        f"narrowest between {number(narrow.from_rad_s)} and {number(narrow.to_rad_s)} rad/s (median "
        f"radius {percent(narrow.median_radius_percent)} of the gain) and widest between "
        f"{number(wide.from_rad_s)} and {number(wide.to_rad_s)} rad/s "
        f"({percent(wide.median_radius_percent)})"
    )


def residual_caption(spread: UncertainChannel) -> str:
    order = spread.noise_order
    behind = f" (behind the noise model of order {order})" if order else ""
    return (
        f"Correlation of the residuals with themselves{behind} and with the past "
        "input. The verdict takes all lags together; single lags outside their own band are expected "
        "now and then."
    )


def test_remarks(tests: Sequence[ResidualTest]) -> list[Remarks]:
    """The verdicts of the residual tests, those that fail first."""

    def said(wanted: bool) -> tuple[str, ...]:
        return tuple(f"Records of the fit: {test.verdict}" for test in tests if test.passed is wanted)

    return [
        *maybe(said(False), "warning", "Residual tests that fail"),
        *maybe(said(True), "good", "Residual tests that pass"),
    ]
