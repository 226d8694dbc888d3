"""Sentences on residuals and noise, on friction, on the nominal model, and on records made in closed loop.

Each function takes the values of its kind by name. `lag` counts samples, `correlation` lies between -1 and 1,
`probability` is that of a statistic as large or larger.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ident.data.finding import FindingKind
from workflow.text import formats
from workflow.text.options import setting_in_uncertainty, setting_name

# A smaller probability is not printed as 0, a certainty that nobody has: far out in the tail doubles end.
_SMALLEST_SHOWN = 1e-300
# A larger one is not printed as 1, with two digits less than that.
_LARGEST_SHOWN = 0.999
# From here on a third digit is shown: two would round to 1.
_NEAR_ONE = 0.99
# A peak outside the measured band is told where it is this much higher than both ends, 5 %: chosen.
_PEAK = 1.05


def _probability(probability: float) -> str:
    if probability < _SMALLEST_SHOWN:
        return "p < 1e-300"
    if probability > _LARGEST_SHOWN:
        return "p > 0.999"
    return f"p = {formats.number(probability, 3 if probability > _NEAR_ONE else 2)}"


def coloured_noise(half_power_Hz: float, order: int, unpredictable_share: float) -> str:
    """half_power_Hz: below it lies half of the power that the noise model of that order predicts."""
    return (
        "the noise is coloured, as with dry friction or drift: half of the power of its predictable part "
        f"lies below {half_power_Hz:.2g} Hz. A noise model of order {order} predicts all but "
        f"{100 * unpredictable_share:.2g} % of the residual, and weights the fit"
    )


def coloured_residual(n_samples: int, worth: float) -> str:
    """worth: white samples that would tell as much."""
    return (
        f"the residual is not white ({n_samples} samples are worth {worth:.0f}): poles are missing, or noise "
        "and disturbances are coloured; uncertainties that assume white noise are too small"
    )


def whiteness(passed: bool, probability: float, max_lag: int, lag: int, correlation: float) -> str:
    p = _probability(probability)
    if passed:
        return f"The residuals are white over {max_lag} lags ({p})."
    return f"The residuals are not white ({p}, largest correlation {correlation:+.2f} at lag {lag})."


def independence(passed: bool, probability: float, lag: int, correlation: float, precedes_input: bool) -> str:
    """precedes_input: the residuals also come before the input."""
    p = _probability(probability)
    if passed:
        verdict = f"The residuals are independent of the input ({p})."
    else:
        verdict = (
            f"The residuals depend on the input {formats.count(lag, 'sample')} before "
            f"(correlation {correlation:+.2f}, {p}): "
            "the model lacks dynamics or delay there; allow more poles, a direct term or another delay."
        )
    if precedes_input:
        return f"{verdict} They also precede the input: the record was taken in closed loop."
    return verdict


def not_independent(lag: int) -> str:
    return (
        f"the residuals depend on the input, most {formats.count(lag, 'sample')} after it: allow a pole pair "
        "or a real pole more, a direct term, or another delay; if that does not help, the machine is not "
        "linear at this amplitude (dry friction, saturation), and the ellipses hold for this kind of input "
        "only"
    )


def not_white(
    noise_order: int, independent: bool, friction: bool, observer: bool, predictable_share: float
) -> str:
    """noise_order: of a noise model, 0 without; independent: of the input; friction: the logs look like it;
    observer: the errors are those of one that follows with friction; predictable_share: of their power."""
    if observer:
        dependent = "" if independent else ", and the errors depend on the input"
        verdict = (
            "the prediction errors of the observer are not white: their past predicts "
            f"{formats.share(predictable_share, 2)} of their power. Neither the poles nor the friction law "
            "explain this part. Causes may be friction that depends on position or load, encoder steps, or a "
            f"further mode. No noise model helps{dependent}. The ellipses are widened by what halves of the "
            "logs differ in. Where the share is large, logs over a smaller range, or with larger commands, "
            "say more"
        )
    elif noise_order:
        if independent:
            advice = f"Raise {setting_in_uncertainty('max_ar_order')}, or take the ellipses as lower limits"
        else:
            advice = "First remove the dependence on the input"
        verdict = (
            f"the residuals are not white, even after a noise model of order {noise_order}: the ellipses, "
            f"and what is certified for them, may be too small. {advice}"
        )
    else:
        first = "" if independent else "first remove the dependence on the input, then "
        verdict = (
            "the residuals are not white, but the ellipses, and what is certified for them, assume that they "
            f"are: {first}model the noise ({setting_name('coloured_noise', 'true')})"
        )
    if not friction:
        return verdict
    without_friction = setting_in_uncertainty("response", '"without friction"')
    return (
        f"{verdict}. Friction colours residuals, too: if the output is the position of the driven shaft, try "
        f"{without_friction}, which identifies friction as well"
    )


def nominal_outside(outside_percent: float, at_rad_s: float, times: float) -> str:
    """outside_percent: of its ellipses; at_rad_s, times: where it lies farthest, and how many sizes."""
    return (
        f"the nominal model lies outside {formats.percent(outside_percent)} of its own ellipses, most near "
        f"{formats.frequency(at_rad_s)} ({formats.number(times)} times their size). Margins are those of the "
        "ellipses, closed-loop poles those of the nominal model: allow more poles"
    )


def untried_friction(output: str, speed: bool = False) -> str:
    """speed: the output is a speed, of which friction is not identified."""
    advice = ""
    if not speed:
        without_friction = setting_in_uncertainty("response", '"without friction"')
        advice = f". If '{output}' is the position of the driven shaft, set {without_friction}"
    return (
        "dry friction was not identified, and the residuals of these logs of a loop are coloured as with "
        f"friction: damping and ellipses may be wrong{advice}"
    )


def remote_friction(output: str, unit: str, level: float, level_std: float, ratio: float) -> str:
    """unit: of the command, in which the level is; ratio: inertia of the load over that of the motor, 0 where
    the place of the friction is not told."""
    if not ratio:
        return (
            f"where the dry friction acts is not told: '{output}' seems to be no position of the driven "
            f"shaft. About {formats.si(level, unit)} was taken off the command; the ellipses hold none and "
            "twice as much"
        )
    return (
        f"'{output}' is no position of the driven shaft, but of a load behind a spring, of "
        f"{formats.number(ratio, 2)} times the motor's inertia. The shaft's dry friction, "
        f"{formats.si(level, unit)} within {formats.share(2 * level_std / level, 2)}, was told by inverse "
        "dynamics and taken off the command; the ellipses hold what is not known of it"
    )


def chi_square(chi_square: float, degrees_of_freedom: int, expected_low: float, expected_high: float) -> str:
    numbers = (
        f"chi-square {chi_square:.4g} with {degrees_of_freedom} degrees of freedom, {expected_low:.4g} to "
        f"{expected_high:.4g} expected"
    )
    if chi_square > expected_high:
        return (
            f"The residual is larger than the covariances explain ({numbers}): the order is too low, the "
            "plant is not linear, or the covariances are too small; the posterior is widened accordingly."
        )
    if chi_square < expected_low:
        return f"The residual is smaller than the covariances say ({numbers}): they are on the safe side."
    return f"The covariances explain the residual ({numbers})."


def assumed_outside(
    low_rad_s: float,
    high_rad_s: float,
    nyquist_rad_s: float,
    integrators: int,
    largest_below: float,
    gain_at_high: float,
    gain_at_nyquist: float,
    largest_above: float,
    largest_above_rad_s: float,
) -> str:
    """low_rad_s, high_rad_s: ends of what was measured; the others are gains of the model at them."""
    below = "grows towards zero frequency" if integrators else f"is at most {largest_below:.3g} below"
    peak = ""
    if largest_above > _PEAK * gain_at_high and largest_above > _PEAK * gain_at_nyquist:
        peak = f", with a peak of {largest_above:.3g} at {largest_above_rad_s:.4g} rad/s: measure there"
    return (
        f"Outside {low_rad_s:.4g} to {high_rad_s:.4g} rad/s nothing was measured and the model is an "
        f"assumption: its gain {below}, and above it goes from {gain_at_high:.3g} to {gain_at_nyquist:.3g} "
        f"at {nyquist_rad_s:.4g} rad/s{peak}."
    )


def response_at_once(direct_term: float) -> str:
    return (
        f"The model has a direct term ({direct_term:.3g}): without one the fit needs poles that no measured "
        "point shows. A response measured without the hold of the sampled input looks like this."
    )


def two_stage(
    least_percent: float,
    most_percent: float,
    least_in_loop_percent: float | None = None,
    most_in_loop_percent: float | None = None,
) -> str:
    """Percent of the input that the reference explains, and of the motion that a run in the loop explains."""
    sentence = (
        f"The reference explains {least_percent:.1f} to {most_percent:.1f} % of the input: the rest is noise "
        "and distortion that the loop fed back, and no longer drives the estimate (two-stage identification)."
    )
    if least_in_loop_percent is None:
        return sentence
    return (
        f"{sentence} Run freely in the loop that made the logs, of which it is shown the reference alone, "
        f"the model explains {least_in_loop_percent:.0f} to {most_in_loop_percent:.0f} % of their motion."
    )


def indirect(least_percent: float, most_percent: float) -> str:
    """Percent of the input that the reconstructed reference explains."""
    return (
        "The logs were made in a loop, and the stated controller tells what reference drove it. That "
        f"explains {least_percent:.1f} to {most_percent:.1f} % of the input: the rest is noise and "
        "distortion that the loop fed back, and no longer drives the estimate (indirect identification)."
    )


def direct(why: str, times: float, stated: bool, explained_percent: float | None = None) -> str:
    """why: 'clean', 'small' or another word for a loop that matters; times: by which the response moves, in
    radii of its ellipses; stated: the user chose this; explained_percent: of the input, by the reference."""
    loop = "The logs were made in a loop"
    if not stated and explained_percent is not None:
        loop += f" whose reference explains only {explained_percent:.2g} % of the input"
    elif not stated:
        loop += " without a recorded reference"
    as_specified = ", as specified" if stated else ""
    if why == "clean":
        effect = (
            "the residuals are not found again in later inputs, so that the loop feeds back too little noise "
            "to matter"
        )
    elif why == "small":
        effect = (
            f"what the loop feeds back moves the response by at most {times:.2g} of the radius of its "
            "ellipses"
        )
    else:
        effect = (
            f"what the loop feeds back moves the response by up to {times:.2g} times the radius of its "
            "ellipses: do not rely on them"
        )
    return f"{loop}. The input is used as logged{as_specified}: {effect}"


def direct_with_friction() -> str:
    return (
        "The logs were made in a loop. The input is used as logged, and an observer follows the motion, "
        "because dry friction is identified with the arm."
    )


def unexplained_input(explained_percent: float) -> str:
    return (
        f"the reference explains only {explained_percent:.3g} % of the input: do not rely on the model; "
        "check the reference column, start the records at rest, or fit within a band"
    )


SENTENCES: Mapping[FindingKind, Callable[..., str]] = {
    FindingKind.COLOURED_NOISE: coloured_noise,
    FindingKind.COLOURED_RESIDUAL: coloured_residual,
    FindingKind.WHITENESS: whiteness,
    FindingKind.INDEPENDENCE: independence,
    FindingKind.NOT_WHITE: not_white,
    FindingKind.UNTRIED_FRICTION: untried_friction,
    FindingKind.REMOTE_FRICTION: remote_friction,
    FindingKind.NOMINAL_OUTSIDE: nominal_outside,
    FindingKind.NOT_INDEPENDENT: not_independent,
    FindingKind.CHI_SQUARE: chi_square,
    FindingKind.ASSUMED_OUTSIDE: assumed_outside,
    FindingKind.RESPONSE_AT_ONCE: response_at_once,
    FindingKind.TWO_STAGE: two_stage,
    FindingKind.INDIRECT: indirect,
    FindingKind.DIRECT: direct,
    FindingKind.DIRECT_WITH_FRICTION: direct_with_friction,
    FindingKind.UNEXPLAINED_INPUT: unexplained_input,
}
