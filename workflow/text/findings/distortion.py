"""Sentences on noise and nonlinear distortion: what multisines, repeats and amplitudes tell of linearity.

Each function takes the values of its kind by name. `rms` is the size of the input in its `unit`; frequencies
are in Hz, sizes in percent of the response.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ident.data.finding import FindingKind
from workflow.text import formats

# What makes distortion of one parity change so with the amplitude.
_CAUSE = {
    ("odd", "falls"): ", as that of dry friction does",
    ("odd", "grows"): ", as that of saturation or a hardening spring does",
}


def linear(rms: float, unit: str, percent: float, from_Hz: float, to_Hz: float) -> str:
    return (
        f"At {formats.si(rms, unit)} rms nonlinear distortion is at most {percent:.2g} % of the response "
        f"from {from_Hz:.2g} to {to_Hz:.2g} Hz (95 % confidence)."
    )


def distorted(
    rms: float, unit: str, percent: float, from_Hz: float, to_Hz: float, parity: str, trend: str
) -> str:
    """parity: 'odd', 'even', 'both' or '' where it is not told; trend: 'falls' or 'grows' with the "
    "amplitude."""
    kinds = {"odd": "; it is odd", "even": "; it is even", "both": "; it is odd and even"}
    kind = kinds.get(parity, "")
    change = ""
    if trend in ("falls", "grows"):
        subject = " and" if parity in ("odd", "even") else "; its share"
        change = f"{subject} {trend} with the amplitude{_CAUSE.get((parity, trend), '')}"
    return (
        f"At an input of {formats.si(rms, unit)} rms nonlinear distortion reaches {percent:.2g} % of the "
        f"response between {from_Hz:.2g} and {to_Hz:.2g} Hz{kind}{change}."
    )


def noise_hides(rms: float, unit: str, percent: float) -> str:
    return (
        f"At an input of {formats.si(rms, unit)} rms the noise would hide distortion of {percent:.2g} % "
        "everywhere: more periods, or a larger input."
    )


def one_realisation(rms: float, unit: str, lines: int) -> str:
    """lines: frequencies without excitation, at which distortion shows."""
    if lines:
        size = f"the {lines} lines without excitation show its size"
    else:
        size = "without detection lines nothing shows it"
    return (
        f"One realisation at {formats.si(rms, unit)} rms: distortion at the excited lines cannot be "
        f"separated from the response; {size}. Record two realisations or more to separate it. The ellipses "
        "do not need this."
    )


def one_period(rms: float, unit: str) -> str:
    return (
        f"One whole period at {formats.si(rms, unit)} rms: noise cannot be separated from distortion; the "
        "curve shows both together."
    )


def not_periodic(n_records: int, percent: float, from_Hz: float, to_Hz: float) -> str:
    """to_Hz: 0 where no frequency is below that size."""
    if to_Hz:
        size = (
            f"below {percent:.2g} % of the response at single frequencies between {from_Hz:.2g} and "
            f"{to_Hz:.2g} Hz"
        )
    else:
        size = f"above {percent:.2g} % of the response everywhere"
    return (
        f"{formats.count(n_records, 'record')} without a period: noise and distortion cannot be "
        "distinguished there. Together, and with what leaks between neighbouring frequencies, they are "
        f"{size}. flexlink excite plans records that tell them."
    )


def repeated(
    n_records: int,
    n_amplitudes: int,
    times: float,
    from_Hz: float,
    to_Hz: float,
    least_percent: float,
    most_percent: float,
) -> str:
    """times: the largest of the amplitudes over the smallest."""
    amplitudes = ""
    scatter = f"{least_percent:.2g}"
    if n_amplitudes > 1:
        amplitudes = f" at each of {n_amplitudes} amplitudes, the largest {times:.2g} times the smallest"
        scatter += f" to {most_percent:.2g}"
    return (
        f"The same experiment was made {n_records} times or more{amplitudes}: from {from_Hz:.2g} to "
        f"{to_Hz:.2g} Hz one record's response scatters by {scatter} % in the median over frequency. This "
        "does not include distortion that is the same in every repeat."
    )


def amplitude_effect(
    times: float,
    from_Hz: float,
    to_Hz: float,
    percent: float,
    most_from_Hz: float,
    most_to_Hz: float,
    chance_percent: float,
    shift_percent: float,
    gain_percent: float,
    shift_from_Hz: float = 0.0,
    shift_to_Hz: float = 0.0,
    gain_from_Hz: float = 0.0,
    gain_to_Hz: float = 0.0,
) -> str:
    """times: the largest amplitude over the smallest; shift_percent, gain_percent: by which resonances, and
    the gain, are higher at the larger one (0: not told)."""
    shift = ""
    if shift_percent:
        if shift_percent > 0:
            cause = "higher at the larger amplitude, as a hardening spring makes them"
        else:
            cause = "lower at the larger amplitude, as a joint or clamp that gives or slips makes them"
        shift = (
            f". Between {shift_from_Hz:.2g} and {shift_to_Hz:.2g} Hz it looks like resonances or zeros that "
            f"lie {abs(shift_percent):.2g} % {cause}"
        )
    gain = ""
    if gain_percent:
        if gain_percent > 0:
            cause = (
                "higher at the larger amplitude, as under dry friction, which takes a smaller share of a "
                "larger drive"
            )
        else:
            cause = "lower at the larger amplitude, as under saturation or a damping that grows with speed"
        gain = (
            f". Between {gain_from_Hz:.2g} and {gain_to_Hz:.2g} Hz the gain is {abs(gain_percent):.2g} % "
            f"{cause}"
        )
    return (
        "the response depends on amplitude: between the smallest and the largest, "
        f"{times:.2g} times as large, it differs from {from_Hz:.2g} to {to_Hz:.2g} Hz. The largest "
        f"difference, {percent:.2g} %, lies between {most_from_Hz:.2g} and {most_to_Hz:.2g} Hz, where the "
        f"repeats scatter by {chance_percent:.2g} %{shift}{gain}. Ellipses of one amplitude do not hold at "
        "the other."
    )


def amplitude_hidden(times: float) -> str:
    return (
        f"Between the smallest and the largest amplitude, {times:.2g} times as large, the response does not "
        "differ by more than the repeats scatter."
    )


SENTENCES: Mapping[FindingKind, Callable[..., str]] = {
    FindingKind.LINEAR: linear,
    FindingKind.DISTORTED: distorted,
    FindingKind.NOISE_HIDES: noise_hides,
    FindingKind.ONE_REALISATION: one_realisation,
    FindingKind.ONE_PERIOD: one_period,
    FindingKind.NOT_PERIODIC: not_periodic,
    FindingKind.REPEATED: repeated,
    FindingKind.AMPLITUDE_EFFECT: amplitude_effect,
    FindingKind.AMPLITUDE_HIDDEN: amplitude_hidden,
}
