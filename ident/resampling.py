"""An identified response for a controller that runs at another rate than the log.

A model tells the output at its samples for a command that is held between them. Held for N of its steps and
read at every N-th, the same arm has the response

    G_N(e^{jwNT}) = 1/N sum_i G(e^{j(wT + 2 pi i / N)}) sum_{l < N} e^{-j l (wT + 2 pi i / N)},   i < N,

whose poles are the N-th powers: that is exact. Held for an N-th of a step, it has to first order the response
of the model over the mean S of N commands (`ident.command_timing`), on the N-th roots of the poles. Neglected
there: what the log folds back from above its Nyquist frequency, where the ellipses are opened.
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
from ident.response_coefficients import coefficients_of

# Whole multiples and parts of a step agree within this share of it.
SAME_RATIO = 1e-3
# Steps of one rate in one of the other, at most: a log at 10 kHz beside a controller at 100 Hz. Beyond that a
# log shows hardly any of the controller's band, and a computation takes minutes.
MOST_STEPS = 100
# Taps beyond those of the posterior: what a delay of a part of a step leaves behind the poles.
TAPS = 6
# Power of sin(w Td / 2) with which ellipses open towards the log's Nyquist frequency, where they are as wide
# as the response: 1 % of it at .3 of that frequency. A filter of few taps; a steeper one ripples above, and
# proofs between grid points do not get through.
OPENING_POWER = 4
# Ellipses hold so many times (w T / 2 pi)^2 of the response for what was folded back: an arm that falls with
# 1/w has 1.4 of it at .3 of the log's Nyquist frequency.
FOLDED_BACK = 1.5
# Share of a response below which what was folded back does not count: a tenth of what most logs tell.
LEAST_FOLDED = 1e-4
# Weight of a response of this size above the log's Nyquist frequency, beside relative errors below: it
# decides only what the data leave open.
FALLS_WEIGHT = 0.02
# Lowest frequency that is fitted, times the longer step: a motion of a day in a log at 10 Hz.
LOWEST_ANGLE_RAD = 1e-6
# Taps at most: kernels decay within a hundred steps, and each tap costs the proofs between grid points.
MOST_TAPS = 240


def ratio_of(model_dt_s: float, controller_dt_s: float) -> tuple[int, int]:
    """Steps of the model in one of the controller, and the reverse; one of the two is 1.

    Raises
    ------
    ValueError
        Neither is a whole multiple of the other, or there are more than `MOST_STEPS`.
    """
    longer = controller_dt_s / model_dt_s
    if max(longer, 1 / longer) > MOST_STEPS * (1 + SAME_RATIO):
        raise ValueError(
            f"controller_dt_s = {controller_dt_s:.6g} s beside a log every {model_dt_s:.6g} s: expected "
            f"{model_dt_s / MOST_STEPS:.6g} to {model_dt_s * MOST_STEPS:.6g}"
        )
    if longer >= 1 and abs(longer - round(longer)) <= SAME_RATIO * longer:
        return round(longer), 1
    if longer < 1 and abs(1 / longer - round(1 / longer)) <= SAME_RATIO / longer:
        return 1, round(1 / longer)
    nearest = model_dt_s * round(longer) if longer >= 1 else model_dt_s / round(1 / longer)
    raise ValueError(
        f"controller_dt_s = {controller_dt_s:.6g} s beside a log every {model_dt_s:.6g} s: expected a whole "
        f"multiple or a whole part of the log's step, such as {nearest:.6g}"
    )


def resampled_poles(poles: Poles, model_dt_s: float, controller_dt_s: float) -> Poles:
    """The poles in z of a step that is a whole multiple or part of the model's."""
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
    """The posterior of the response that a controller with another period sees.

    Parameters
    ----------
    posterior : ResponsePosterior
        Of a command held from row to row of the log.
    controller_dt_s : float
        Period of the new controller, s: a whole multiple or part of the posterior's step.

    Returns
    -------
    ResponsePosterior
        With dt_s = controller_dt_s. Of a faster controller the ellipses above the log's Nyquist frequency are
        wider than the response, which continues as the modes do: nothing was measured there.

    Raises
    ------
    ValueError
        Other ratios; unstable plants, whose all-pass has no root.
    """
    down, up = ratio_of(posterior.dt_s, controller_dt_s)
    if down == up:
        return posterior
    if posterior.unstable.order:
        raise ValueError(
            "controller_dt_s: an arm with unstable poles is designed for at the rate of its log; leave "
            "controller_dt_s out"
        )
    power = down / up
    delay_s = posterior.input_delay_samples * posterior.dt_s
    delay = int(np.floor(delay_s / controller_dt_s * (1 + 1e-9)))
    n_taps = int(np.ceil(posterior.fir_length / power)) + TAPS
    # The last taps are left to what is not known of a faster controller's response: a filter of the rest.
    n_left = OPENING_POWER + up if up > 1 else 0
    n_taps = min(n_taps, MOST_TAPS) + n_left
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
        input_delay_samples=delay,
        input_name=posterior.input_name,
        output_name=posterior.output_name,
        report=posterior.report,
    )
    known = np.column_stack([posterior.mean, posterior.covariance_factor])
    slower_dt_s = max(posterior.dt_s, controller_dt_s)
    slow = np.geomspace(LOWEST_ANGLE_RAD, 0.98 * np.pi, 600) / slower_dt_s
    # Between two of these no tap turns round.
    even = np.linspace(0.0, 0.99 * np.pi, 4 * n_taps + 200)[1:] / slower_dt_s
    omega = np.union1d(np.union1d(slow, even), _around_modes(posterior))
    omega = omega[omega < 0.99 * np.pi / slower_dt_s]
    if up == 1:
        wanted = _held(posterior, omega, down) @ known
    else:
        # Held for a part of a step: its mean over the step is what the model was given.
        shorter = Hold(1 / up).response(omega * posterior.dt_s)
        wanted = (posterior.frequency_rows(omega) @ known) * shorter[:, None]
        omega, wanted = _falling_above(omega, wanted, posterior.dt_s, up)
    weight = 1 / np.abs(wanted[:, 0])
    if up > 1:
        # Exact where nothing was folded back; elsewhere as exact as what was.
        weight /= np.maximum((omega * posterior.dt_s / (2 * np.pi)) ** 2, LEAST_FOLDED)
        above = omega > np.pi / posterior.dt_s
        weight[above] *= FALLS_WEIGHT
        wanted[above] = 0.0
    solved = coefficients_of(empty.frequency_rows(omega)[:, : size - n_left], wanted, weight)
    solved = np.pad(solved, ((0, n_left), (0, 0)))
    found = replace(empty, mean=solved[:, 0], covariance_factor=solved[:, 1:])
    if up == 1:
        return found
    unknown = _unknown_above(found, posterior.dt_s, up)
    return replace(found, covariance_factor=np.hstack([found.covariance_factor, unknown]))


def _falling_above(
    omega: RealArray, wanted: ComplexArray, log_dt_s: float, up: int
) -> tuple[RealArray, ComplexArray]:
    """Frequencies (F,) and responses (F, N) with more above the log's Nyquist frequency, of the size that an
    inertia has there: it falls with 1/w^2."""
    above = np.linspace(1.0, 0.99 * up, 400 * up)[1:] * np.pi / log_dt_s
    last = np.abs(wanted[-1:, :1])
    falling = np.zeros((above.size, wanted.shape[1]), dtype=np.complex128)
    falling[:, :1] = last * ((omega[-1] / above) ** 2)[:, None]
    return np.concatenate([omega, above]), np.vstack([wanted, falling])


def _around_modes(posterior: ResponsePosterior) -> RealArray:
    """Frequencies at and beside the poles, where a response turns fastest."""
    rates = np.log(posterior.poles.pairs) / posterior.dt_s
    beside = np.linspace(-4, 4, 33)
    return np.abs((rates.imag[:, None] + beside * np.abs(rates.real[:, None])).ravel()) + 1e-12


def _held(posterior: ResponsePosterior, omega: RealArray, steps: int) -> ComplexArray:
    """Rows (F, P) of the response to a command held for so many steps, read once in as many."""
    total = np.zeros((omega.size, posterior.mean.size), dtype=np.complex128)
    nyquist = np.pi / posterior.dt_s
    for image in range(steps):
        angle = omega * posterior.dt_s + 2 * np.pi * image / steps
        # Rows are known from 0 to Nyquist; beyond it the response is the conjugate of its mirror image.
        folded = np.mod(angle + np.pi, 2 * np.pi) - np.pi
        rows = posterior.frequency_rows(np.minimum(np.abs(folded) / posterior.dt_s, nyquist))
        rows = np.where(folded[:, None] < 0, rows.conj(), rows)
        commands = np.exp(-1j * np.outer(angle, np.arange(steps))).sum(axis=1)
        total += rows * commands[:, None] / steps
    return total


def _unknown_above(posterior: ResponsePosterior, log_dt_s: float, up: int) -> RealArray:
    """(P, 4) directions of what the log does not show of a faster controller's response.

    Two are as wide as the response at the log's Nyquist frequency, wider above, and close below. Two hold
    what was folded back: at w the log has seen what the arm does at 2 pi / T - w, too, which is up to
    (w T / 2 pi)^2 of the response where it falls with 1/w or faster. The response times a few taps lies in
    the span of poles and taps; the same a sample later is the other direction of an ellipse.
    """
    even = np.linspace(0.0, 0.99 * np.pi, 4 * posterior.fir_length + 200)[1:]
    angle = np.union1d(np.geomspace(LOWEST_ANGLE_RAD, 0.99 * np.pi, 600), even)
    omega = angle / posterior.dt_s
    later = np.exp(-1j * omega * posterior.dt_s)
    opening = ((1 - later) / (2 * np.sin(np.pi / (2 * up)))) ** OPENING_POWER
    folded = FOLDED_BACK * (up / np.pi) ** 2 * (1 - later) ** 2
    wanted = np.column_stack([opening, opening * later, folded, folded * later**up]) / chi2_radius(LEVEL)
    centre = posterior.centre(omega)
    return coefficients_of(posterior.frequency_rows(omega), wanted * centre[:, None], 1 / np.abs(centre))


def resampled_friction(found: FrictionFit, controller_dt_s: float) -> FrictionFit:
    """The fit of an arm with friction, stepped at the rate of a controller.

    The arm is stepped in continuous time, so only its samples change. Dead time that is no whole number of
    the controller's samples is rounded up; a lag of the drive is one of as many seconds.
    """
    arm = found.arm
    if abs(arm.dt_s - controller_dt_s) <= SAME_RATIO * arm.dt_s:
        return found
    ratio_of(arm.dt_s, controller_dt_s)
    share = arm.dt_s / controller_dt_s
    late = int(np.ceil(arm.structure.input_delay_samples * share - SAME_RATIO))
    structure = replace(arm.structure, input_delay_samples=late)
    return replace(
        found,
        arm=replace(arm, dt_s=controller_dt_s, structure=structure),
        lag=found.lag * share,
    )
