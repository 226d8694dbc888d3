"""Whether a machine is linear as far as its records show, and if not, how the distortion looks.

Two kinds of experiments tell it without a model. Periodic records separate noise, distortion at odd and
distortion at even lines (`ident.data.distortion`, after Pintelon and Schoukens); repeats at several
amplitudes show whether the response depends on the amplitude (`ident.data.repeats`). Of all other records the
coherence bounds noise and distortion together. This file turns these numbers into findings: which verdict,
over which band, in per cent of the response. `distortion_findings` asks all three sources,
`amplitude_effects` the repeats alone. Records have one input and one output.

Types of other files: `Distortion`, periodic records of one amplitude, with levels at their excited, odd and
even lines (`LineLevels`); `BandLevel`, the distortion of a band as a share of the response, 0 .. 1, with its
interval; `Repeats`, experiments that were repeated, at one or several amplitudes; `AmplitudeBand`, what
differs between amplitudes in a band. They were made from records and are not checked again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.checks.early_checks import clipped
from ident.data.arrays import RealArray
from ident.data.distortion import BandLevel, Distortion, LineLevels
from ident.data.finding import Finding, FindingKind, Value, finding
from ident.data.nonparametric import coherence
from ident.data.record import Record
from ident.data.repeats import AmplitudeBand, Repeats, repeats_of

# Share of the response (RMS). Significant distortion below it is not called distortion, as loop shaping with
# usual margins (gain errors of tens of per cent) need not mind 1 %. Chosen; doubled or halved, no test of
# verdicts moves.
LEAST_DISTORTION = 0.01
# Share of the response (RMS). A band in which noise would hide so much distortion says nothing about
# linearity; in records that are not periodic, noise and distortion together are asked to stay below it.
# Chosen; doubled or halved, no test of verdicts moves.
MOST_HIDDEN = 0.05
# Ratio of powers (6 dB). Distortion is called odd, or even, where the power at lines of that parity is so
# many times the power at the others. Chosen; doubled or halved, no test of verdicts moves.
PARITY_POWER_RATIO = 4.0
# Ratio of shares of the response. Distortion is said to fall or grow with the amplitude where its share
# changes by so much. Chosen: Coulomb friction halves its share where the amplitude doubles; at 1.12 or 1.5 no
# test of verdicts moves.
TREND_RATIO = 1.25
# Share of a difference's power. A change of the gain, or a shift of resonances, is named in a band where it
# explains so much of what differs between amplitudes. Chosen; doubled, a resonance that falls by 1 % is no
# longer named in its test, halved nothing moves.
LEAST_EXPLAINED = 0.3
# Coherence that stands for zero: keeps 1 / coherence finite at lines without any answer. Any number far below
# one serves.
LEAST_COHERENCE = 1e-12


def distortion_findings(
    records: Sequence[Record], distortions: Sequence[Distortion], repeated: Sequence[Repeats] = ()
) -> list[Finding]:
    """Findings on linearity, from all that records show without a model.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each.
    distortions : sequence of Distortion
        `distortion_of(records)`: one for each amplitude of periodic records, lowest amplitude first.
    repeated : sequence of Repeats
        `repeats_of(records)`: one for each experiment that was repeated.

    Returns
    -------
    list of Finding
        In this order: for each amplitude the findings of `_amplitude_verdict`; for each repeated experiment
        those of `_repeat_findings`; one NOT_PERIODIC where records are neither periodic nor repeats; one
        CLIPPED for each clipped output where there are periodic records. Empty without records.

    Raises
    ------
    ValueError
        A record that is neither periodic nor a repeat has several inputs or outputs, or is too short for a
        spectrum (`coherence`).
    """
    unit = ""
    if records and records[0].input_units:
        unit = records[0].input_units[0]
    findings: list[Finding] = []
    for distortion in distortions:
        findings += _amplitude_verdict(distortion, distortions, unit)
    for repeats in repeated:
        findings += _repeat_findings(repeats)

    # Records that neither method could use.
    used_names = {name for distortion in distortions for name in distortion.names}
    for repeats in repeated:
        for names in repeats.names:
            used_names |= set(names)
    unused = [record for record in records if record.name not in used_names]
    if unused:
        findings.append(_coherent_band(unused))

    # A clipped output distorts like a machine that saturates: whoever reads of distortion has to know.
    if distortions:
        findings += [item for item in clipped(records) if item.values["signal"] == "output"]
    return findings


def amplitude_effects(records: Sequence[Record]) -> list[Finding]:
    """Findings AMPLITUDE_EFFECT on repeated experiments: what a linear model of these records cannot be.

    Parameters
    ----------
    records : sequence of Record
        One input and one output each; those without a repeat at the same amplitude tell nothing.

    Returns
    -------
    list of Finding
        One for each experiment whose response depends on the amplitude beyond chance; often empty.

    Raises
    ------
    ValueError
        A record has several inputs or outputs.
    """
    findings: list[Finding] = []
    for repeats in repeats_of(records):
        findings += _repeat_findings(repeats)
    return [item for item in findings if item.kind is FindingKind.AMPLITUDE_EFFECT]


def _coherent_band(records: Sequence[Record]) -> Finding:
    """Finding NOT_PERIODIC with the band, Hz, in which noise and distortion together are small.

    Small: below `MOST_HIDDEN` of the response, by the coherence of each record. The band reaches from the
    lowest to the highest such frequency; 0 to 0 Hz where there is none. Raises ValueError without records,
    and where one is too short or has several inputs or outputs (`coherence`).
    """
    omegas: list[RealArray] = []
    coherences: list[RealArray] = []
    for record in records:
        omega_rad_s, squared_coherence = coherence([record])
        omegas.append(omega_rad_s)
        coherences.append(squared_coherence)
    coherent = np.clip(np.concatenate(coherences), LEAST_COHERENCE, 1.0)
    # With coherence c, the power of what is no response over that of the response is (1 - c) / c.
    unexplained_share = np.sqrt(1 / coherent - 1)
    seen_Hz = np.concatenate(omegas)[unexplained_share < MOST_HIDDEN] / (2 * np.pi)
    from_Hz = 0.0
    to_Hz = 0.0
    if seen_Hz.size:
        from_Hz = float(seen_Hz.min())
        to_Hz = float(seen_Hz.max())
    return finding(
        FindingKind.NOT_PERIODIC,
        n_records=len(records),
        percent=100 * MOST_HIDDEN,
        from_Hz=from_Hz,
        to_Hz=to_Hz,
    )


def _repeat_findings(repeats: Repeats) -> list[Finding]:
    """Findings on one repeated experiment: its scatter, then what differs between amplitudes.

    REPEATED always; then AMPLITUDE_EFFECT where the responses of the smallest and the largest amplitude
    differ beyond chance, or AMPLITUDE_HIDDEN where two amplitudes or more show no such difference.
    Frequencies in Hz, sizes in per cent of the response (RMS over a band). `repeats` : one amplitude and two
    records of it at least, as `repeats_of` makes them.
    """
    scatter_percent = [100 * repeats.scatter(index) for index in range(len(repeats.rms))]
    about: dict[str, Value] = {
        "times": repeats.rms[-1] / repeats.rms[0],
        "n_records": min(len(names) for names in repeats.names),
        "n_amplitudes": len(repeats.rms),
        "least_percent": min(scatter_percent),
        "most_percent": max(scatter_percent),
        "from_Hz": repeats.omega_rad_s[0] / (2 * np.pi),
        "to_Hz": repeats.omega_rad_s[-1] / (2 * np.pi),
    }
    findings = [finding(FindingKind.REPEATED, **about)]
    effects = repeats.amplitude_effects
    if effects:
        strongest = max(effects, key=lambda band: band.difference)
        # The band is that of the effects here, not that of the whole experiment.
        values: dict[str, Value] = {
            **about,
            "from_Hz": effects[0].from_rad_s / (2 * np.pi),
            "to_Hz": effects[-1].to_rad_s / (2 * np.pi),
            "most_from_Hz": strongest.from_rad_s / (2 * np.pi),
            "most_to_Hz": strongest.to_rad_s / (2 * np.pi),
            "percent": 100 * strongest.difference,
            "chance_percent": 100 * strongest.chance,
        }
        explained = _explanations(effects)
        findings.append(finding(FindingKind.AMPLITUDE_EFFECT, **values, **explained))
    elif len(repeats.rms) > 1:
        findings.append(finding(FindingKind.AMPLITUDE_HIDDEN, **about))
    return findings


def _explanations(effects: Sequence[AmplitudeBand]) -> dict[str, Value]:
    """Size and band of two simple explanations of an amplitude effect, a shift of resonances and a gain.

    Keys shift_percent, shift_from_Hz, shift_to_Hz and the same three of gain, each of the band where the
    explanation counts most (share explained times difference over chance); zeros where it explains no more
    than `LEAST_EXPLAINED` of every band, and without bands. A chance of zero divides by zero: scatter has
    none.
    """

    def shift_share(band: AmplitudeBand) -> float:
        """Share, 0 .. 1, of the difference's power that a shift of resonances explains."""
        return band.shift_share

    def gain_share(band: AmplitudeBand) -> float:
        """Share, 0 .. 1, of the difference's power that one change of gain and phase explains."""
        return band.level_share

    explained: dict[str, Value] = {}
    for name, share_of in (("shift", shift_share), ("gain", gain_share)):
        percent = 0.0
        from_Hz = 0.0
        to_Hz = 0.0
        bands = [band for band in effects if share_of(band) > LEAST_EXPLAINED]
        if bands:
            weights = [share_of(band) * band.difference / band.chance for band in bands]
            clearest = bands[weights.index(max(weights))]
            percent = 100 * float(getattr(clearest, name))
            from_Hz = clearest.from_rad_s / (2 * np.pi)
            to_Hz = clearest.to_rad_s / (2 * np.pi)
        explained[f"{name}_percent"] = percent
        explained[f"{name}_from_Hz"] = from_Hz
        explained[f"{name}_to_Hz"] = to_Hz
    return explained


def _amplitude_verdict(
    distortion: Distortion, all_amplitudes: Sequence[Distortion], unit: str
) -> list[Finding]:
    """Findings on periodic records of one amplitude: what they cannot tell, then at most one verdict.

    Not to be told: ONE_REALISATION (no scatter between realisations), ONE_PERIOD (no noise). Verdict:
    NOISE_HIDES where every band is lost in noise, DISTORTED where a band has significant distortion above
    `LEAST_DISTORTION`, else LINEAR with the largest distortion that the records leave possible; none without
    noise level. Levels in per cent of the response, band in Hz; rms of the input in `unit`. `all_amplitudes`:
    of the same experiment, ascending, for the trend; `distortion` is one of them (not checked).
    """
    findings: list[Finding] = []
    about: dict[str, Value] = {"rms": distortion.rms, "unit": unit}
    if distortion.realisations < 2:
        detection = [lines for lines in (distortion.odd, distortion.even) if lines is not None]
        n_lines = sum(lines.omega_rad_s.size for lines in detection)
        findings.append(finding(FindingKind.ONE_REALISATION, **about, lines=n_lines))
    if distortion.noise_std is None:
        findings.append(finding(FindingKind.ONE_PERIOD, **about))

    # Levels by half decades: from the scatter between realisations, or at the odd detection lines where there
    # is one realisation. Even lines tell nothing of what distorts a model that is fitted at odd ones.
    bands = _levels_in_bands(distortion.excited or distortion.odd, distortion.bands_rad_s)
    if not bands or distortion.noise_std is None:
        return findings

    # Bands in which something can be said: distortion is shown, or an upper limit is small.
    usable = [band for band in bands if band.significant or band.interval[1] <= MOST_HIDDEN]
    if not usable:
        findings.append(finding(FindingKind.NOISE_HIDES, **about, percent=100 * MOST_HIDDEN))
        return findings

    distorted = [band for band in usable if band.significant and band.distortion > LEAST_DISTORTION]
    told_bands = distorted or usable
    ends = {
        "from_Hz": told_bands[0].from_rad_s / (2 * np.pi),
        "to_Hz": told_bands[-1].to_rad_s / (2 * np.pi),
    }
    if not distorted:
        limit_percent = 100 * max(band.interval[1] for band in usable)
        findings.append(finding(FindingKind.LINEAR, **about, percent=limit_percent, **ends))
        return findings
    findings.append(
        finding(
            FindingKind.DISTORTED,
            **about,
            percent=100 * max(band.distortion for band in distorted),
            parity=_parity(distortion, distorted),
            trend=_trend(distortion, all_amplitudes, distorted),
            **ends,
        )
    )
    return findings


def _levels_in_bands(lines: LineLevels | None, bands_rad_s: Sequence[tuple[float, float]]) -> list[BandLevel]:
    """Distortion levels of lines in each band (low, high) in rad/s; bands without a line are left out.

    Empty where there are no lines at all (None). A band with its ends exchanged has no line.
    """
    if lines is None:
        return []
    levels = [lines.within(low, high) for low, high in bands_rad_s]
    return [level for level in levels if level is not None]


def _parity(distortion: Distortion, distorted: Sequence[BandLevel]) -> str:
    """Parity of the distortion in some bands: "odd", "even", "both" or "unknown".

    Told by the lines without excitation: where only odd lines are excited, odd distortion (a cube, dry
    friction) stands at odd lines, even distortion (a square) at even ones. "unknown" without detection lines
    of both parities; "both" where none of them lies in the bands.
    """
    if distortion.odd is None or distortion.even is None:
        return "unknown"
    bands_rad_s = [(band.from_rad_s, band.to_rad_s) for band in distorted]
    odd_power = sum(level.distortion**2 for level in _levels_in_bands(distortion.odd, bands_rad_s))
    even_power = sum(level.distortion**2 for level in _levels_in_bands(distortion.even, bands_rad_s))
    if odd_power > PARITY_POWER_RATIO * even_power:
        return "odd"
    if even_power > PARITY_POWER_RATIO * odd_power:
        return "even"
    return "both"


def _trend(
    distortion: Distortion, all_amplitudes: Sequence[Distortion], distorted: Sequence[BandLevel]
) -> str:
    """How the share of distortion changes when the amplitude grows: "falls", "grows", "same" or "unknown".

    Median over the distorted bands of the ratio between this amplitude and the one farthest from it: the
    largest, or the smallest for the largest itself. "unknown" with one amplitude, or where the other one
    shows no distortion in any of these bands. `all_amplitudes` : ascending, not empty; `distorted` : bands of
    `distortion` with a level above zero, else it divides by zero.
    """
    other = all_amplitudes[-1]
    if distortion is other:
        other = all_amplitudes[0]
    if distortion is other:
        return "unknown"
    lines = other.excited or other.odd
    if lines is None:
        return "unknown"
    ratios = []
    for band in distorted:
        level = lines.within(band.from_rad_s, band.to_rad_s)
        if level is not None and level.distortion > 0:
            ratios.append(level.distortion / band.distortion)
    if not ratios:
        return "unknown"
    growth = float(np.median(ratios))
    if other.rms <= distortion.rms:
        growth = 1 / growth
    if growth < 1 / TREND_RATIO:
        return "falls"
    if growth > TREND_RATIO:
        return "grows"
    return "same"
