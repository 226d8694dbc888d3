"""The findings of `diagnosis.where.where` in sentences a person can read aloud; silent where nothing is
found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from diagnosis.where.where_energy import evenness
from diagnosis.where.where_records import (
    BandGap,
    CommonFinding,
    EquivalentCurve,
    ExperimentGap,
    PartGap,
    RegimeFinding,
    Where,
)

# A statement about where "most" of the gap lies covers at least this share of it.
_MOST = 0.8
# A missing function is put into the headline if it explains at least this share of the gap.
_MUCH = 0.5
# A sensor with less of the gap than this does not need a sentence about its frequencies.
_LITTLE = 0.05
ROUTES = {"hub_torque": "torque on the hub", "hub_angle": "hub angle error", "tip": "tip sensor error"}
AXES = {
    "speed": "the hub speed",
    "angle": "the hub angle",
    "command": "the voltage",
    "deflection": "the deflection",
    "position": "the tip position",
    "time": "the time since the start",
}


def sentences(found: Where) -> dict[str, str]:
    """One per axis that has something to say, in the order a page shows them."""
    if not is_gap(found):
        return {}
    spoken = {
        "sensors": _sensors(found),
        "experiments": _experiments(found.experiments),
        "frequency": _frequency(found),
        "regimes": _regimes(found.regimes),
        "time": " ".join(d.sentence for d in found.drift if d.sentence),
        "common": _common(found.common),
        "amplitude": _amplitude(found),
        "curves": _curves(found.curves),
        "linear": "" if found.linear is None else found.linear.sentence,
        "periodic": " ".join(p.sentence for p in found.periodic if p.sentence),
        "subsystem": _subsystem(found.subsystem),
    }
    return {axis: sentence for axis, sentence in spoken.items() if sentence}


def is_gap(found: Where) -> bool:
    """Anything beyond noise in the records as a whole, a sensor, an experiment or a band."""
    parts = [found.gap, *(s.gap for s in found.sensors), *(b.gap for b in found.bands)]
    parts += [g for x in found.experiments for g in (x.gap, *x.sensors)]
    return any(part.found for part in parts)


def headline(found: Where) -> str:
    """The whole answer in one sentence."""
    if not is_gap(found):
        return "Nothing lies beyond sensor noise: in no sensor, no experiment and no frequency band."
    places = []
    sensor = _dominant_sensor(found)
    if sensor:
        places.append(f"it lies in the {sensor} sensor")
    band = concentration(found.bands)
    if band is not None:
        places.append(f"{band.words} of its energy {frequencies(band.low_Hz, band.high_Hz, found)}")
    if any(d.sentence for d in found.drift):
        places.append("it grows steadily with time")
    elif any(c.sentence for c in found.common):
        places.append("it is the same in all experiments, whatever the input")
    elif found.linear is not None and found.linear.sentence:
        follows = "follows" if found.linear.share >= 0.9 else "does not follow"
        places.append(f"it {follows} the voltage linearly")
    curve = best_curve(found.curves)
    if curve is not None:
        places.append(
            f"{percent(curve.share)} could come from a {ROUTES[curve.route]} that depends on "
            f"{AXES[curve.axis]}"
        )
    return f"The gap is {times(found.gap)} the sensor noise" + "".join(f"; {p}" for p in places) + "."


def best_curve(curves: Sequence[EquivalentCurve]) -> EquivalentCurve | None:
    """The missing function that explains most, if it explains half of the gap and is beyond chance."""
    usable = [c for c in curves if c.found and c.share >= _MUCH]
    return max(usable, key=lambda c: c.share, default=None)


@dataclass(frozen=True)
class Concentration:
    """Share of a gap's energy between two frequencies, and half the width of its 95 % interval."""

    low_Hz: float
    high_Hz: float
    share: float
    half_width: float

    @property
    def words(self) -> str:
        """The share, or what it is at least where noise leaves more than five points open."""
        if self.half_width <= 0.05:
            return percent(self.share)
        return f"at least {100 * (min(self.share, 1.0) - self.half_width):.0f} %"


def concentration(bands: Sequence[BandGap]) -> Concentration | None:
    """Narrowest run of bands (both sensors) with at least 80 % of the gap.

    None if only the whole range has it, no band is found, or it may be less than half.
    """
    if not any(b.gap.found for b in bands):
        return None
    edges = sorted({b.low_Hz for b in bands} | {b.high_Hz for b in bands})
    shares = [sum(b.gap.share for b in bands if b.low_Hz == low) for low in edges[:-1]]
    runs = [
        (j - i, -sum(shares[i:j]), edges[i], edges[j])
        for i in range(len(shares))
        for j in range(i + 1, len(shares) + 1)
        if sum(shares[i:j]) >= _MOST
    ]
    if not runs:
        return None
    length, share, low, high = min(runs)
    if length == len(shares):
        return None
    halves = [np.ptp(b.gap.share_interval) / 2 for b in bands if low <= b.low_Hz < high]
    half = float(np.sqrt(np.sum(np.square(halves))))
    return Concentration(low, high, -share, half) if min(-share, 1.0) - half >= 0.5 else None


def percent(share: float) -> str:
    value = 100 * min(max(share, 0.0), 1.0)
    return "practically all" if value >= 99.5 else f"{value:.0f} %"


def times(gap: PartGap) -> str:
    low, high = gap.interval
    if high - low < 0.1 * gap.gap_rms:
        return f"{gap.gap_rms:.2g} times"
    return f"{gap.gap_rms:.2g} times (95 % interval {low:.2g} to {high:.2g})"


def frequencies(low: float, high: float, found: Where) -> str:
    if low == 0:
        return f"below {high:g} Hz"
    if high >= max(b.high_Hz for b in found.bands):
        return f"above {low:g} Hz"
    return f"between {low:g} and {high:g} Hz"


def sensor_word(sensor: str) -> str:
    return sensor.replace("_", " ")


def _dominant_sensor(found: Where) -> str:
    """The sensor that alone shows the gap, if the other one shows none or next to none of it."""
    shown = [s for s in found.sensors if s.gap.found]
    for s in shown:
        if s.gap.share_interval[0] > 0.95 or (len(shown) == 1 and s.gap.share > 0.9):
            return sensor_word(s.sensor)
    return ""


def _sensors(found: Where) -> str:
    only = _dominant_sensor(found)
    if only:
        others = [sensor_word(s.sensor) for s in found.sensors if sensor_word(s.sensor) != only]
        silent = all(not s.gap.found for s in found.sensors if sensor_word(s.sensor) != only)
        rest = "shows nothing beyond noise" if silent else "shows next to nothing of it"
        return f"The gap lies in the {only} sensor; the {' and '.join(others)} sensor {rest}."
    shown = [s for s in found.sensors if s.gap.found]
    if not shown:
        return ""
    parts = [f"{times(s.gap)} the noise in the {sensor_word(s.sensor)} sensor" for s in shown]
    return f"The gap is {' and '.join(parts)}."


def _experiments(gaps: Sequence[ExperimentGap]) -> str:
    shown = [x for x in gaps if x.gap.found or any(g.found for g in x.sensors)]
    if not shown:
        return ""
    if len(shown) < len(gaps):
        names = [short(x.experiment) for x in shown]
        quiet = [short(x.experiment) for x in gaps if x not in shown]
        if len(shown) > len(quiet):
            return f"All experiments but {listed(quiet)} show a gap; there it stays within the noise."
        verb = "shows" if len(shown) == 1 else "show"
        return f"Only {listed(names)} {verb} a gap; the others stay within the noise."
    top = max(shown, key=lambda x: x.gap.gap_rms)
    least = min(shown, key=lambda x: x.gap.gap_rms)
    if top.gap.interval[0] <= 1.5 * least.gap.interval[1]:
        return f"All {len(gaps)} experiments show the gap, about equally."
    return (
        f"All {len(gaps)} experiments show the gap, {short(top.experiment)} most ({top.gap.gap_rms:.2g} "
        f"noise deviations), {short(least.experiment)} least ({least.gap.gap_rms:.2g})."
    )


def _frequency(found: Where) -> str:
    parts: list[str] = []
    runs: dict[tuple[float, float], list[tuple[str, str]]] = {}
    for s in found.sensors:
        word = sensor_word(s.sensor)
        own = [b for b in found.bands if b.sensor == s.sensor]
        if not s.gap.found:
            # Concentrated gaps can hide in the sum over all frequencies; a band on its own still speaks.
            parts += [
                f"The {word} sensor stands out of the noise {frequencies(b.low_Hz, b.high_Hz, found)}, by "
                f"{b.gap.gap_rms:.2g} times the noise in that band."
                for b in own
                if b.gap.found
            ]
        elif s.gap.share < _LITTLE:
            continue
        elif all(b.gap.found for b in own) and _even(own):
            parts.append(
                f"The gap of the {word} sensor is spread evenly over all frequencies, as more sensor noise "
                f"or coarse resolution would be."
            )
        else:
            run = concentration(own_shares(own))
            if run is not None:
                runs.setdefault((run.low_Hz, run.high_Hz), []).append((word, run.words))
    for (low, high), members in runs.items():
        different = list(dict.fromkeys(words for _, words in members))
        shares = listed(different)
        sensors = f"{listed([word for word, _ in members])} sensor{'s' if len(members) > 1 else ''}"
        verb = "lie" if len(different) > 1 else "lies"
        parts.append(
            f"{shares[0].upper()}{shares[1:]} of the gap energy of the {sensors} {verb} "
            f"{frequencies(low, high, found)}."
        )
    return " ".join(parts)


def _even(bands: Sequence[BandGap]) -> bool:
    statistic, freedom = evenness(bands)
    return bool(statistic < chi2.ppf(0.95, freedom))


def own_shares(bands: Sequence[BandGap]) -> list[BandGap]:
    """The bands of one sensor with shares of that sensor's gap."""
    whole = sum(b.gap.share for b in bands)
    if whole <= 0:
        return list(bands)
    return [
        BandGap(
            b.sensor,
            b.low_Hz,
            b.high_Hz,
            PartGap(
                b.gap.gap_rms,
                b.gap.interval,
                b.gap.share / whole,
                (b.gap.share_interval[0] / whole, b.gap.share_interval[1] / whole),
                b.gap.p_value,
                b.gap.found,
            ),
        )
        for b in bands
    ]


def _regimes(regimes: Sequence[RegimeFinding]) -> str:
    """The clearest regime of every axis, at most three axes."""
    best: dict[str, RegimeFinding] = {}
    for r in regimes:
        if r.sentence and (r.axis not in best or r.contrast > best[r.axis].contrast):
            best[r.axis] = r
    ordered = sorted(best.values(), key=lambda r: -r.contrast)[:3]
    return " ".join(r.sentence for r in ordered)


def _curves(curves: Sequence[EquivalentCurve]) -> str:
    best = best_curve(curves)
    if best is None:
        return ""
    near = [c for c in curves if c.found and c is not best and c.share >= 0.8 * min(best.share, 1.0)]
    if not near:
        return best.sentence
    others = [f"{ROUTES[c.route]} over {AXES[c.axis]} ({percent(c.share)})" for c in near]
    return f"{best.sentence} Not far behind: {listed(others)}."


def _common(findings: Sequence[CommonFinding]) -> str:
    """The sentence of the sensor with the larger share; the other one is named with it."""
    spoken = sorted((c for c in findings if c.sentence), key=lambda c: -c.share)
    if not spoken:
        return ""
    others = [f"the {sensor_word(c.sensor)} sensor ({percent(c.share)})" for c in spoken[1:]]
    return spoken[0].sentence + (f" The same holds for {listed(others)}." if others else "")


def _amplitude(found: Where) -> str:
    """Silent where a linear correction explains the gap: two inputs never excite it quite alike."""
    if found.amplitude is None or (
        found.amplitude.growth != "linear" and found.linear is not None and found.linear.share >= 0.9
    ):
        return ""
    return found.amplitude.sentence


def _subsystem(mass: dict[str, float]) -> str:
    if not mass:
        return ""
    name = max(mass, key=mass.__getitem__)
    sure = f"{100 * mass[name]:.0f} %"
    if name == "none":
        return f"With {sure} probability nothing is missing in the model."
    if name == "unknown":
        return f"With {sure} probability the cause is none that is known here."
    place = {"environment": "outside the machine", "sensor": "in the tip sensor"}.get(name, f"in the {name}")
    second = max((n for n in mass if n != name), key=mass.__getitem__)
    other = f"; {second} has {100 * mass[second]:.0f} %" if mass[second] >= 0.05 else ""
    return f"With {sure} probability the cause lies {place}{other}."


def listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def short(name: str) -> str:
    return name.rsplit("/", 1)[-1].removesuffix(".csv")
