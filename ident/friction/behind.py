"""The arm behind the friction of logs of a loop, identified as a linear one from whitened records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.validation import fit_in_windows
from ident.data.arrays import real_rows
from ident.data.record import Record
from ident.friction.gauss_newton import FrictionFit, lag_steps
from ident.friction.observer import ObserverFilter
from ident.friction.structures import above_noise, moving, of_order, without_slow_pairs
from ident.identification import Identification
from ident.one_input import identify
from ident.response_uncertainty import NOISE_ORDERS
from ident.search.order_selection import Progress
from ident.uncertainty.autoregression import fit_autoregression

# Frequencies over which a drive's lag joins an arm, from where the arm is slow to near the Nyquist frequency,
# as shares of that: enough for twenty poles. The product is in the span of the poles.
_JOINED_SHARES = (1e-4, 0.98)
# Their number. Chosen: many more than poles.
_N_JOINED = 300


def behind_drive(fit: FrictionFit) -> GobfModel:
    """Model from the command to the shaft of an arm behind its friction, the lag of its drive in it.

    Parameters
    ----------
    fit : FrictionFit
        With an observer.

    Returns
    -------
    GobfModel
        The arm of the fit; with a lag, one more real pole. Output units per unit of the input.
    """
    if not fit.lag:
        return fit.model
    pole = lag_steps(fit.lag)[0]
    poles = fit.model.poles.appended(Poles(np.array([pole])))
    empty = replace(fit.model, poles=poles, coefficients=np.zeros(poles.order))
    omega = np.geomspace(*_JOINED_SHARES, _N_JOINED) * np.pi / fit.model.dt_s
    wanted = fit.model.frequency_response(omega) * fit.drive_response(omega)
    columns = []
    for unit in np.eye(poles.order):
        columns.append(replace(empty, coefficients=unit).frequency_response(omega) / wanted)
    basis = real_rows(np.column_stack(columns))
    target = real_rows(np.ones(omega.size, np.complex128))
    coefficients = np.asarray(np.linalg.lstsq(basis, target, rcond=None)[0])
    return replace(empty, coefficients=coefficients)


def with_bias_of_free_runs(fit: FrictionFit, records: Sequence[Record]) -> FrictionFit:
    """A fit whose bias is the one with which free runs of its arm follow the records best.

    Parameters
    ----------
    fit : FrictionFit
        With an observer; in its prediction errors a bias stands for what the start of a record leaves as
        well, for an observer corrects what a wrong constant force does.
    records : sequence of Record
        One input, and the shaft's position as the one output.

    Returns
    -------
    FrictionFit
        The same but for the bias, by least squares over windows (`fit_in_windows`), which are linear in it.
        The fit itself for an arm that does not integrate: there a constant force is an offset of the
        position.
    """
    if not fit.arm.structure.integrators:
        return fit
    model = behind_drive(fit)
    free = [fit.taken_off(record) for record in records]
    before = np.concatenate([fit_in_windows(model, record).residual for record in free])
    change = max(fit.level, float(np.std(records[0].input)))
    pushed = [replace(record, input=record.input + change) for record in free]
    moved = np.concatenate([fit_in_windows(model, record).residual for record in pushed]) - before
    # A force that is missing in the free run is a bias that was taken off too much.
    missing = -change * float(moved @ before) / float(moved @ moved)
    return replace(fit, bias=fit.bias - missing)


def identify_behind(
    found: FrictionFit,
    records: Sequence[Record],
    options: IdentOptions | None = None,
    progress: Progress | None = None,
) -> Identification:
    """The arm behind the friction of logs of a loop.

    Parameters
    ----------
    found : FrictionFit
        Of these logs, with an observer.
    records : sequence of Record
        With the friction taken off.
    options : IdentOptions, optional
        Of the search for poles; their number is that of the fit of the friction.
    progress : callable, optional
        Called with a share of the work (0 to 1) and a message.

    Returns
    -------
    Identification
        With the arm of the fit, whose poles, friction and noise were found together; a search on records with
        the friction taken off would not find them as well. Its search is one of as many poles on records
        whitened by the observer; residuals and fit are over windows (`fit_in_windows`).
    """
    options = moving(above_noise(records, options or IdentOptions()))
    options = of_order(found, without_slow_pairs(found, options))
    if found.lag > 0:
        # The drive's lag is one more real pole between command and position.
        options = options.model_copy(update={"n_real": (options.n_real or 0) + 1})
    whiten = ObserverFilter.of(found)
    behind = identify([whiten.filtered(record) for record in records], options, progress=progress)
    model = replace(
        behind_drive(found), input_name=behind.model.input_name, output_name=behind.model.output_name
    )
    fits = [fit_in_windows(model, record) for record in records]
    residuals = tuple(fit.residual for fit in fits)
    rss = float(sum(residual @ residual for residual in residuals))
    return replace(
        behind,
        model=model,
        residuals=residuals,
        fit_percent=np.array([fit.fit_percent for fit in fits]),
        rss=rss,
        noise_std=float(np.sqrt(rss / sum(residual.size for residual in residuals))),
        noise_filter=fit_autoregression(residuals, NOISE_ORDERS[-1]).a_polynomial,
    )
