"""What noise, distortion and repeats at several amplitudes say: linear, and how far, or distorted, and
how."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter

import numpy as np

from ident.checks.early_checks import clipped
from ident.data.distortion import BandLevel, Distortion
from ident.data.finding import Finding, FindingKind, Value, finding
from ident.data.nonparametric import coherence
from ident.data.record import Record
from ident.data.repeats import AmplitudeBand, Repeats, repeats_of

# Distortion above this share of the response is told where it is; a linear design need not mind less.
_WORTH_TELLING = 0.01
# A band in which noise would hide this much says nothing.
_HIDDEN = 0.05
# One kind is told where its power is this many times the other's; a trend where the level changes so much.
_CLEARLY, _TREND = 4.0, 1.25
# A change of the gain, or of resonances, is named where it explains this much of a difference.
_NAMED = 0.3


def distortion_findings(
    records: Sequence[Record], found: Sequence[Distortion], repeated: Sequence[Repeats] = ()
) -> list[Finding]:
    """Verdicts about records with one input and output, from `distortion_of` them and `repeats_of` them.

    Of records that are neither periodic nor repeats: noise and distortion together, by their coherence.
    """
    periodic = {name for levels in found for name in levels.names}
    periodic |= {name for each in repeated for names in each.names for name in names}
    rest = [record for record in records if record.name not in periodic]
    unit = "".join(records[0].input_units[:1]) if records else ""
    told = [item for levels in found for item in _verdict(levels, found, unit)]
    told += [item for each in repeated for item in _of_repeats(each)]
    if rest:
        omega, coherent = (np.concatenate(part) for part in zip(*(coherence([r]) for r in rest), strict=True))
        seen = omega[np.sqrt(1 / np.clip(coherent, 1e-12, 1.0) - 1) < _HIDDEN] / (2 * np.pi)
        values = {"from_Hz": seen.min(), "to_Hz": seen.max()} if seen.size else {"from_Hz": 0.0, "to_Hz": 0.0}
        told.append(finding(FindingKind.NOT_PERIODIC, n_records=len(rest), percent=100 * _HIDDEN, **values))
    if found:
        told += [item for item in clipped(records) if item.values["signal"] == "output"]
    return told


def amplitude_effects(records: Sequence[Record]) -> list[Finding]:
    """What a linear model of records at several amplitudes is not: for those who look at no distortion."""
    told = (item for each in repeats_of(records) for item in _of_repeats(each))
    return [item for item in told if item.kind is FindingKind.AMPLITUDE_EFFECT]


def _of_repeats(repeats: Repeats) -> list[Finding]:
    """What scatters, and what differs between the smallest and the largest amplitude."""
    scatter = [100 * repeats.scatter(k) for k in range(len(repeats.rms))]
    about: dict[str, Value] = {
        "times": repeats.rms[-1] / repeats.rms[0],
        "n_records": min(len(names) for names in repeats.names),
        "n_amplitudes": len(repeats.rms),
        "least_percent": min(scatter),
        "most_percent": max(scatter),
        "from_Hz": repeats.omega_rad_s[0] / (2 * np.pi),
        "to_Hz": repeats.omega_rad_s[-1] / (2 * np.pi),
    }
    told = [finding(FindingKind.REPEATED, **about)]
    effects = repeats.amplitude_effects
    if effects:
        most = max(effects, key=lambda band: band.difference)
        values: dict[str, Value] = {
            **about,
            "from_Hz": effects[0].from_rad_s / (2 * np.pi),
            "to_Hz": effects[-1].to_rad_s / (2 * np.pi),
            "most_from_Hz": most.from_rad_s / (2 * np.pi),
            "most_to_Hz": most.to_rad_s / (2 * np.pi),
            "percent": 100 * most.difference,
            "chance_percent": 100 * most.chance,
        }
        told.append(finding(FindingKind.AMPLITUDE_EFFECT, **values, **_looks(effects)))
    elif len(repeats.rms) > 1:
        told.append(finding(FindingKind.AMPLITUDE_HIDDEN, **about))
    return told


def _looks(effects: Sequence[AmplitudeBand]) -> dict[str, Value]:
    """Where a shift of resonances, and where a change of the whole band, explains most; 0 where none does."""
    named: dict[str, Value] = {}
    for what, share in (("shift", attrgetter("shift_share")), ("gain", attrgetter("level_share"))):
        like = [band for band in effects if share(band) > _NAMED]
        band = max(like, key=lambda band: share(band) * band.difference / band.chance, default=None)
        named |= {
            f"{what}_percent": 0.0 if band is None else 100 * getattr(band, what),
            f"{what}_from_Hz": 0.0 if band is None else band.from_rad_s / (2 * np.pi),
            f"{what}_to_Hz": 0.0 if band is None else band.to_rad_s / (2 * np.pi),
        }
    return named


def _verdict(levels: Distortion, all_levels: Sequence[Distortion], unit: str) -> list[Finding]:
    told: list[Finding] = []
    about: dict[str, Value] = {"rms": levels.rms, "unit": unit}
    if levels.realisations < 2:
        detection = [lines.omega_rad_s.size for lines in (levels.odd, levels.even) if lines is not None]
        told.append(finding(FindingKind.ONE_REALISATION, **about, lines=sum(detection)))
    if levels.noise_std is None:
        told.append(finding(FindingKind.ONE_PERIOD, **about))
    # Distortion in every band: between realisations, or at the odd detection lines where there is one.
    lines = levels.excited or levels.odd
    found = [] if lines is None else [lines.within(*band) for band in levels.bands_rad_s]
    bands = [band for band in found if band is not None]
    usable = [band for band in bands if band.significant or band.interval[1] <= _HIDDEN]
    if not bands or levels.noise_std is None:
        return told
    if not usable:
        return [*told, finding(FindingKind.NOISE_HIDES, **about, percent=100 * _HIDDEN)]
    distorted = [band for band in usable if band.significant and band.distortion > _WORTH_TELLING]
    where = distorted or usable
    ends = {"from_Hz": where[0].from_rad_s / (2 * np.pi), "to_Hz": where[-1].to_rad_s / (2 * np.pi)}
    if not distorted:
        limit = 100 * max(band.interval[1] for band in usable)
        return [*told, finding(FindingKind.LINEAR, **about, percent=limit, **ends)]
    percent = 100 * max(band.distortion for band in distorted)
    kind, trend = _kind(levels, distorted), _trend(levels, all_levels, distorted)
    return [*told, finding(FindingKind.DISTORTED, **about, percent=percent, parity=kind, trend=trend, **ends)]


def _kind(levels: Distortion, distorted: Sequence[BandLevel]) -> str:
    """odd, even or both, by the detection lines; unknown without them."""
    if levels.odd is None or levels.even is None:
        return "unknown"
    found = (
        [lines.within(band.from_rad_s, band.to_rad_s) for band in distorted]
        for lines in (levels.odd, levels.even)
    )
    odd, even = (sum(one.distortion**2 for one in each if one is not None) for each in found)
    # Even lines are the only place of even distortion where only odd lines are excited.
    return "odd" if odd > _CLEARLY * even else "even" if even > _CLEARLY * odd else "both"


def _trend(levels: Distortion, every: Sequence[Distortion], distorted: Sequence[BandLevel]) -> str:
    """How its share of the response changes when the amplitude grows: falls, grows, same, or unknown."""
    other = every[0] if levels is every[-1] else every[-1]
    if other is levels:
        return "unknown"
    lines = other.excited or other.odd
    there = [] if lines is None else [lines.within(one.from_rad_s, one.to_rad_s) for one in distorted]
    both = zip(there, distorted, strict=False)
    ratios = [found.distortion / band.distortion for found, band in both if found and found.distortion > 0]
    if not ratios:
        return "unknown"
    ratio = float(np.median(ratios)) if other.rms > levels.rms else 1 / float(np.median(ratios))
    return "falls" if ratio < 1 / _TREND else "grows" if ratio > _TREND else "same"
