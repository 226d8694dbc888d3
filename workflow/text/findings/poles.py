"""Sentences on poles: at a bound of the search, no modes of the machine, or of a model that explains nothing.

Each function takes the values of its kind by name: frequencies in rad/s, times in s, shares in percent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ident.data.finding import FindingKind
from workflow.text.formats import hertz
from workflow.text.options import setting_name


def no_pole() -> str:
    return (
        "no pole was worth keeping: the output shows no dynamics driven by this input; check the columns, "
        "the delay and the amplitude of the input"
    )


def slow_bound(a: float, integrators: int) -> str:
    """a: the pole in z; integrators: those that are stated."""
    if integrators:
        advice = (
            f"where the mechanics have no more than the {integrators} given, it is drift or friction: fit in "
            "a band above it, or take the trend off the output"
        )
    else:
        advice = (
            f"try {setting_name('integrators', 1)} and compare, or take the trend off an output that only "
            "drifts"
        )
    return (
        f"a real pole went to the slow bound (a = {a:.9g}): it is an integrator as far as the record can "
        f"tell; {advice}"
    )


def fast_bound(a: float) -> str:
    """a: the pole in z."""
    return (
        f"a real pole went to the fast bound (a = {a:.3g}): it stands for a direct term or a delay; try "
        f"{setting_name('feedthrough', 'true')}, another {setting_name('input_delay_samples')}, or one real "
        "pole less"
    )


def overdamped_pair(omega_rad_s: float, zeta: float) -> str:
    return (
        f"a pole pair at {omega_rad_s:.4g} rad/s is overdamped (zeta = {zeta:.2f}): replace the pair by two "
        "real poles"
    )


def damping_bound(omega_rad_s: float, zeta: float) -> str:
    return (
        f"the pole pair at {omega_rad_s:.4g} rad/s sits on its bound of zeta ({zeta:.4g}): it may describe a "
        f"disturbance; fit one pair less, or widen {setting_name('zeta_min')} or {setting_name('zeta_max')} "
        "if you trust it"
    )


def no_decay(omega_rad_s: float) -> str:
    return (
        f"the pole pair at {omega_rad_s:.4g} rad/s does not decay within the record: its damping cannot be "
        "determined; record longer"
    )


def frequency_bound(omega_rad_s: float) -> str:
    return (
        f"a pole pair went to the bound of its frequency ({omega_rad_s:.4g} rad/s): widen the bound, or fit "
        "one pair less"
    )


def no_answer(explained_percent: float) -> str:
    return (
        "the output does not answer to the input: the model explains "
        f"{explained_percent:.2g} % of it, no more than poles fitted to noise would; check columns, wiring "
        "and unit, or fit fewer poles"
    )


def no_answer_there(record: str, fit_percent: float) -> str:
    return (
        f"{record}: the model explains nothing of this log (fit {fit_percent:.2g} %, no better than no "
        "response at all). Check its columns, unit and sign, and whether it is the same machine"
    )


def _no_mode(omega_rad_s: float, zeta: float) -> str:
    """How a sentence on a pole pair that can be no mode begins."""
    return f"the pole pair at {hertz(omega_rad_s):.3g} Hz (damping {zeta:.2g}) is no mode"


def slow_pair(omega_rad_s: float, zeta: float, longest_s: float, fewest_periods: float) -> str:
    """longest_s: of the records; fewest_periods: that a record has to hold of a mode."""
    return (
        f"{_no_mode(omega_rad_s, zeta)}: the longest record lasts {longest_s:.3g} s, fewer than "
        f"{fewest_periods:g} of its periods; such slow poles stand for dry friction or drift; check the unit "
        f"of the time column, and set {setting_name('omega_min_rad_s')} above it"
    )


def damped_pair(omega_rad_s: float, zeta: float, largest_zeta: float) -> str:
    return (
        f"{_no_mode(omega_rad_s, zeta)}: with a damping ratio above {largest_zeta:g} it does not oscillate; "
        "it stands for two real poles, or for dynamics beyond the excited band; fit one pair less, or set "
        f"{setting_name('zeta_max')}"
    )


def outside_band(omega_rad_s: float, low_rad_s: float, high_rad_s: float) -> str:
    """low_rad_s, high_rad_s: ends of the band of the data."""
    return (
        f"the pole pair at {omega_rad_s:.4g} rad/s lies outside the band of the data ({low_rad_s:.4g} to "
        f"{high_rad_s:.4g} rad/s): it stands for whatever is there; widen the band or measure further, or "
        "take the model as extrapolation there"
    )


def unknown_time_constant(time_constant_s: float, longest_s: float) -> str:
    return (
        f"a real pole has a time constant of {time_constant_s:.0f} s, known to a factor of two at best from "
        f"{longest_s:.3g} s of record. Record longer, or give it as known: {setting_name('integrators')}, "
        f"{setting_name('fixed_poles')}"
    )


def unknown_damping(omega_rad_s: float, longest_s: float) -> str:
    return (
        f"the damping of the pole pair at {omega_rad_s:.4g} rad/s is known to a factor of two at best. "
        f"Record longer than {longest_s:.3g} s, drive it harder, or fit one pair less if it is not a mode of "
        "the machine"
    )


SENTENCES: Mapping[FindingKind, Callable[..., str]] = {
    FindingKind.NO_POLE: no_pole,
    FindingKind.SLOW_BOUND: slow_bound,
    FindingKind.FAST_BOUND: fast_bound,
    FindingKind.OVERDAMPED_PAIR: overdamped_pair,
    FindingKind.DAMPING_BOUND: damping_bound,
    FindingKind.NO_DECAY: no_decay,
    FindingKind.FREQUENCY_BOUND: frequency_bound,
    FindingKind.NO_ANSWER: no_answer,
    FindingKind.NO_ANSWER_THERE: no_answer_there,
    FindingKind.SLOW_PAIR: slow_pair,
    FindingKind.DAMPED_PAIR: damped_pair,
    FindingKind.OUTSIDE_BAND: outside_band,
    FindingKind.UNKNOWN_TIME_CONSTANT: unknown_time_constant,
    FindingKind.UNKNOWN_DAMPING: unknown_damping,
}
