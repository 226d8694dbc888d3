"""Write an identified response for a controller that runs at another rate than the log.

A model tells the output at its samples for a command that is held between them. Held for N of its steps and
read at every N-th, the same arm has the response

    G_N(e^{jwNT}) = 1/N sum_i G(e^{j(wT + 2 pi i / N)}) sum_{l < N} e^{-j l (wT + 2 pi i / N)},   i < N,

whose poles are the N-th powers: that is exact. Held for an N-th of a step, it has to first order the response
of the model over the mean S of N commands (`ident.command_timing`), on the N-th roots of the poles. Neglected
there: what the log folds back from above its Nyquist frequency, where the ellipses are opened.

`resampled` fits the new response by the basis of the new poles and a few taps; `resampled_poles` and
`resampled_friction` do what their names say for poles and for an arm with friction.

A `ResponsePosterior` is a Gaussian over coefficients: mean (P,), covariance factor (P, P'), of its poles, a
direct term and `fir_length` taps; `frequency_rows` (F, P) takes coefficients to the response. `Poles` has
real poles and of each pair the one above the axis, all inside the unit circle.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.command_timing import Hold
from ident.data.arrays import ComplexArray, RealArray
from ident.data.ellipses import LEVEL, chi2_radius
from ident.friction import FrictionFit
from ident.response_coefficients import coefficients_of, slow_angles

# Whole multiples and parts of a step agree within this share of it: steps are stated with three digits or
# more.
SAME_RATIO = 1e-3
# Steps of one rate in one of the other, at most: a log at 10 kHz beside a controller at 100 Hz. Beyond that a
# log shows hardly any of the controller's band, and a computation takes minutes.
MOST_STEPS = 100
# Taps beyond those of the posterior: what a delay of a part of a step leaves behind the poles. With 3 or 12
# no test of resampling moves.
TAPS = 6
# Power of sin(w Td / 2) with which ellipses open towards the log's Nyquist frequency, where they are as wide
# as the response: 1 % of it at .3 of that frequency. A filter of few taps; a steeper one ripples above, and
# proofs between grid points do not get through. With 2 or 8 no test of resampling moves.
OPENING_POWER = 4
# Ellipses hold so many times (w T / pi)^2 of the response for what was folded back, T the step of the log. An
# arm that falls with 1/w has .35 of it at .3 of the log's Nyquist frequency. Halved, no test of resampling
# moves; doubled, ellipses are wider at low frequencies than a test allows.
FOLDED_BACK = 1.5
# Share of a response below which what was folded back does not count: a tenth of what most logs tell. Halved
# or doubled, no test of resampling moves.
LEAST_FOLDED = 1e-4
# Weight of a response of this size above the log's Nyquist frequency, beside relative errors below: it
# decides only what the data leave open. Halved or doubled, no test of resampling moves.
FALLS_WEIGHT = 0.02
# Highest frequency that is fitted, as a share of pi over the longer step: at the Nyquist frequency itself
# responses are real, so that a complex one may not be met.
HIGHEST_SHARE = 0.99
# Frequencies of a linear grid from zero to the highest one, beside those for the taps. Chosen: enough without
# any tap.
EVEN_POINTS = 200
# Further ones of that grid for each tap: the last tap, which turns round half as often as there are taps up
# to the Nyquist frequency, then has eight of them in each of its turns.
EVEN_POINTS_PER_TAP = 4
# Frequencies around each mode: eight in its half-power width, which shows the turn of its phase. Chosen.
MODE_POINTS = 33
# They reach so many halves of that width to both sides: there a mode has a quarter of its peak, and turns
# slowly.
MODE_HALF_WIDTHS = 4
# Frequencies above the log's Nyquist frequency for each multiple of it: about as dense as the linear grid.
ABOVE_POINTS = 400
# Taps at most: kernels decay within a hundred steps, and each tap costs the proofs between grid points.
MOST_TAPS = 240
# A delay that is a whole number of steps but for this share stays that number: rounding of the steps.
ROUNDING = 1e-9


def ratio_of(model_dt_s: float, controller_dt_s: float) -> tuple[int, int]:
    """Steps of the model in one of the controller, and steps of the controller in one of the model.

    Parameters
    ----------
    model_dt_s : float
        Step of the log, s.
    controller_dt_s : float
        Period of the controller, s.

    Returns
    -------
    tuple of int
        (N, 1) for a controller N times as slow, (1, N) for one N times as fast.

    Raises
    ------
    ValueError
        Neither is a whole multiple of the other, or there are more than `MOST_STEPS`; of nan `round`
        raises it. A step of zero divides by zero: callers have them above zero.
    """
    longer = controller_dt_s / model_dt_s
    if max(longer, 1 / longer) > MOST_STEPS * (1 + SAME_RATIO):
        raise ValueError(
            f"controller_dt_s = {controller_dt_s:.6g} s beside a log every {model_dt_s:.6g} s: expected "
            f"{model_dt_s / MOST_STEPS:.6g} to {model_dt_s * MOST_STEPS:.6g}"
        )
    if longer >= 1:
        steps = round(longer)
        nearest_s = model_dt_s * steps
        if abs(longer - steps) <= SAME_RATIO * longer:
            return steps, 1
    else:
        steps = round(1 / longer)
        nearest_s = model_dt_s / steps
        if abs(1 / longer - steps) <= SAME_RATIO / longer:
            return 1, steps
    raise ValueError(
        f"controller_dt_s = {controller_dt_s:.6g} s beside a log every {model_dt_s:.6g} s: expected a whole "
        f"multiple or a whole part of the log's step, such as {nearest_s:.6g}"
    )


def resampled_poles(poles: Poles, model_dt_s: float, controller_dt_s: float) -> Poles:
    """Poles in z of a step that is a whole multiple or part of the model's.

    Parameters
    ----------
    poles : Poles
        Of the step `model_dt_s`.
    model_dt_s, controller_dt_s : float
        Both steps, s.

    Returns
    -------
    Poles
        Powers p^(controller_dt_s / model_dt_s), as many real ones and pairs as before.

    Raises
    ------
    ValueError
        Neither step is a whole multiple of the other (`ratio_of`).
    """
    down, up = ratio_of(model_dt_s, controller_dt_s)
    real = []
    for pole in poles.real.tolist():
        if pole > 0:
            real.append(pole ** (down / up))
        elif up == 1:
            real.append(pole**down)
        else:
            # A pole at zero or below has no root in an arm: it decays within a step, and stays what it is.
            real.append(pole)
    pairs = poles.pairs ** (down / up)
    # A mode above half the controller's rate is folded below it: its pair is named by the other of its poles.
    pairs = pairs.real + 1j * np.abs(pairs.imag)
    return Poles(np.array(real), pairs)


def resampled(posterior: ResponsePosterior, controller_dt_s: float) -> ResponsePosterior:
    """Posterior of the response that a controller with another period sees.

    Parameters
    ----------
    posterior : ResponsePosterior
        Of a command held from row to row of the log: poles, mean (P,) and covariance factor (P, P') of the
        coefficients, taps, integrators and delay.
    controller_dt_s : float
        Period of the new controller, s: a whole multiple or part of the posterior's step.

    Returns
    -------
    ResponsePosterior
        With dt_s = controller_dt_s; the posterior itself where the periods are the same. Of a faster
        controller the ellipses above the log's Nyquist frequency are wider than the response, which continues
        as the modes do: nothing was measured there.

    Raises
    ------
    ValueError
        Other ratios (`ratio_of`); unstable plants, whose all-pass has no root. A mean response of zero is not
        looked for: weights are then infinite, and the least squares fail.

    Notes
    -----
    Mean and every column of the covariance factor are responses (module's docstring). Their coefficients on
    the new basis are fitted by least squares over frequency, errors relative to the response.
    """
    down, up = ratio_of(posterior.dt_s, controller_dt_s)
    if down == up:
        return posterior
    if posterior.unstable.order:
        raise ValueError(
            "controller_dt_s: an arm with unstable poles is designed for at the rate of its log; leave "
            "controller_dt_s out"
        )
    is_faster = up > 1

    # The new basis: powers of the poles, as long a kernel in seconds, and the whole steps of the delay.
    period_ratio = down / up
    delay_s = posterior.input_delay_samples * posterior.dt_s
    delay_samples = int(np.floor(delay_s / controller_dt_s * (1 + ROUNDING)))
    n_fitted_taps = min(int(np.ceil(posterior.fir_length / period_ratio)) + TAPS, MOST_TAPS)
    # The last taps are left to what is not known of a faster controller's response: the fitted one times
    # filters of up to so many taps (`_unknown_above`).
    n_opening_taps = 0
    if is_faster:
        n_opening_taps = OPENING_POWER + up
    n_taps = n_fitted_taps + n_opening_taps
    poles = resampled_poles(posterior.poles, posterior.dt_s, controller_dt_s)
    size = poles.order + int(posterior.has_feedthrough) + n_taps
    empty = ResponsePosterior(
        poles,
        np.zeros(size),
        np.zeros((size, 1)),
        controller_dt_s,
        fir_length=n_taps,
        has_feedthrough=posterior.has_feedthrough,
        integrators=posterior.integrators,
        input_delay_samples=delay_samples,
        input_name=posterior.input_name,
        output_name=posterior.output_name,
        report=posterior.report,
    )

    # Frequencies up to the lower of both Nyquist frequencies, dense where responses turn.
    slower_dt_s = max(posterior.dt_s, controller_dt_s)
    # Just below the highest frequency, where the linear grid is the denser one.
    slow_angle = slow_angles(posterior.poles, 0.98 * np.pi)
    slow = slow_angle / slower_dt_s
    n_even = EVEN_POINTS_PER_TAP * n_taps + EVEN_POINTS
    even_angle = np.linspace(0.0, HIGHEST_SHARE * np.pi, n_even)[1:]
    even = even_angle / slower_dt_s
    omega = np.union1d(np.union1d(slow, even), _around_modes(posterior))
    is_below = omega < HIGHEST_SHARE * np.pi / slower_dt_s
    omega = omega[is_below]

    # What the controller sees there of the mean and of every column of the factor, (F, 1 + P').
    known = np.column_stack([posterior.mean, posterior.covariance_factor])
    if is_faster:
        # Held for a part of a step: its mean over the step is what the model was given.
        shorter_hold = Hold(1 / up).response(omega * posterior.dt_s)
        wanted = (posterior.frequency_rows(omega) @ known) * shorter_hold[:, None]
        omega, wanted = _falling_above(omega, wanted, posterior.dt_s, up)
    else:
        wanted = _held(posterior, omega, down) @ known
    weight = 1 / np.abs(wanted[:, 0])
    if is_faster:
        # Exact where nothing was folded back; elsewhere as exact as what was.
        turns_per_step = omega * posterior.dt_s / (2 * np.pi)
        weight /= np.maximum(turns_per_step**2, LEAST_FOLDED)
        is_above = omega > np.pi / posterior.dt_s
        weight[is_above] *= FALLS_WEIGHT
        wanted[is_above] = 0.0

    rows = empty.frequency_rows(omega)[:, : size - n_opening_taps]
    solution = coefficients_of(rows, wanted, weight)
    solution = np.pad(solution, ((0, n_opening_taps), (0, 0)))
    at_new_rate = replace(empty, mean=solution[:, 0], covariance_factor=solution[:, 1:])
    if not is_faster:
        return at_new_rate
    unknown = _unknown_above(at_new_rate, posterior.dt_s, up)
    return replace(at_new_rate, covariance_factor=np.hstack([at_new_rate.covariance_factor, unknown]))


def _falling_above(
    omega: RealArray, wanted: ComplexArray, log_dt_s: float, up: int
) -> tuple[RealArray, ComplexArray]:
    """Frequencies (F',) and responses (F', N) with further ones above the log's Nyquist frequency.

    `omega` (F,), rad/s, ascending, and `wanted` (F, N) : those below it, one at least (IndexError without).
    `log_dt_s` : step of the log, s, of `up` periods of the controller. Above it the mean, which is the first
    response, has the size that an inertia has: it falls with 1/w^2 from the last one below. All others are
    zero.
    """
    multiples = np.linspace(1.0, HIGHEST_SHARE * up, ABOVE_POINTS * up)[1:]
    above = multiples * np.pi / log_dt_s
    last_size = np.abs(wanted[-1:, :1])
    fall = (omega[-1] / above) ** 2
    falling = np.zeros((above.size, wanted.shape[1]), dtype=np.complex128)
    falling[:, :1] = last_size * fall[:, None]
    return np.concatenate([omega, above]), np.vstack([wanted, falling])


def _around_modes(posterior: ResponsePosterior) -> RealArray:
    """Frequencies (F,), rad/s, at and beside the pole pairs, where a response turns fastest; above zero.

    Empty without pairs; those of a badly damped pair may lie above the Nyquist frequency.
    """
    rates = np.log(posterior.poles.pairs) / posterior.dt_s
    half_widths = np.linspace(-MODE_HALF_WIDTHS, MODE_HALF_WIDTHS, MODE_POINTS)
    around = rates.imag[:, None] + half_widths * np.abs(rates.real[:, None])
    # A response of an integrator has no value at zero: 1e-12 rad/s is nothing beside any other frequency.
    return np.abs(around.ravel()) + 1e-12


def _held(posterior: ResponsePosterior, omega: RealArray, steps: int) -> ComplexArray:
    """Rows (F, P) of the response to a command held for so many steps, read once in as many.

    `omega` (F,), rad/s, up to the Nyquist frequency of the longer step. A sum over the frequencies that the
    slower rate folds onto each other (module's docstring). Raises ValueError (`frequency_rows`) where one of
    them is zero and there are integrators; that `steps` is at least 1 the caller knows.
    """
    total = np.zeros((omega.size, posterior.mean.size), dtype=np.complex128)
    nyquist = np.pi / posterior.dt_s
    for image in range(steps):
        angle = omega * posterior.dt_s + 2 * np.pi * image / steps
        # Rows are known from 0 to Nyquist; beyond it the response is the conjugate of its mirror image.
        folded = np.mod(angle + np.pi, 2 * np.pi) - np.pi
        folded_rad_s = np.minimum(np.abs(folded) / posterior.dt_s, nyquist)
        rows = posterior.frequency_rows(folded_rad_s)
        is_mirrored = folded < 0
        rows = np.where(is_mirrored[:, None], rows.conj(), rows)
        turns = np.outer(angle, np.arange(steps))
        commands = np.exp(-1j * turns).sum(axis=1)
        total += rows * commands[:, None] / steps
    return total


def _unknown_above(posterior: ResponsePosterior, log_dt_s: float, up: int) -> RealArray:
    """Directions (P, 4) of what the log does not show of a faster controller's response.

    `posterior` : of the new rate; `log_dt_s` : step of the log, s, of `up` periods, 2 or more. They are
    columns for its covariance factor, in units of its coefficients; where its mean response is zero they are
    not defined (not checked). Two are as wide as the response at the log's Nyquist frequency, wider above,
    and close below. Two hold what was folded back: at w the log has seen what the arm does at 2 pi / T - w,
    too, which is up to (w T / 2 pi)^2 of the response where it falls with 1/w or faster. The response times a
    few taps lies in the span of poles and taps; the same a sample later is the other direction of an ellipse.
    """
    n_even = EVEN_POINTS_PER_TAP * posterior.fir_length + EVEN_POINTS
    even = np.linspace(0.0, HIGHEST_SHARE * np.pi, n_even)[1:]
    angle = np.union1d(slow_angles(posterior.poles, HIGHEST_SHARE * np.pi), even)
    omega = angle / posterior.dt_s
    delay = np.exp(-1j * omega * posterior.dt_s)
    change = 1 - delay
    # One in size at the log's Nyquist frequency.
    change_at_nyquist = 2 * np.sin(np.pi / (2 * up))
    opening = (change / change_at_nyquist) ** OPENING_POWER
    # |1 - delay| is w T / up at low frequency, T the step of the log.
    folded = FOLDED_BACK * (up / np.pi) ** 2 * change**2
    directions = np.column_stack([opening, opening * delay, folded, folded * delay**up])
    wanted = directions / chi2_radius(LEVEL)
    centre = posterior.centre(omega)
    return coefficients_of(posterior.frequency_rows(omega), wanted * centre[:, None], 1 / np.abs(centre))


def resampled_friction(found: FrictionFit, controller_dt_s: float) -> FrictionFit:
    """Fit of an arm with friction, stepped at the rate of a controller.

    Parameters
    ----------
    found : FrictionFit
        Its `arm` (step dt_s, delay in samples) and `lag` of the drive, in samples; nothing else is looked at.
    controller_dt_s : float
        Period of the controller, s.

    Returns
    -------
    FrictionFit
        The arm is stepped in continuous time, so only its samples change. Dead time that is no whole number
        of the controller's samples is rounded up; a lag of the drive is one of as many seconds. `found`
        itself where both steps agree.

    Raises
    ------
    ValueError
        Neither step is a whole multiple of the other (`ratio_of`).
    """
    arm = found.arm
    if abs(arm.dt_s - controller_dt_s) <= SAME_RATIO * arm.dt_s:
        return found
    ratio_of(arm.dt_s, controller_dt_s)
    periods_per_step = arm.dt_s / controller_dt_s
    delay_samples = arm.structure.input_delay_samples * periods_per_step
    structure = replace(arm.structure, input_delay_samples=int(np.ceil(delay_samples - SAME_RATIO)))
    return replace(
        found,
        arm=replace(arm, dt_s=controller_dt_s, structure=structure),
        lag=found.lag * periods_per_step,
    )
