"""The loop that made some logs, where its control law is known: records that it opens, and free runs in it.

Let a linear law K make the command, u = K (r - y), and S = 1 / (1 + K G), T = K G S. For any model G

    y - T r = S (y - G u),

so that the least squares of a free run in the loop are those of the open loop behind the filter S. That
filter is what a fit of an integrating arm needs: friction and drift, which the integrator of G amplifies
without bound, count by what they do to the motion in the loop. The response r -> y is fitted on the poles of
the loop first (`opened_by_loop`). Then, with the model G0 = T / (K S) that it is,

    u~ = S K S r,    y~ = (y - T r) + S T r    =>    y~ - G u~ = (y - T r) - S (G - G0) K S r,

which is, to first order in G - G0, what a free run of G in the loop leaves. The records (u~, y~) are of the
open loop: u~ is made of the reference alone, which is the instrument. Every search and every ellipse takes
them as they are. An error of T counts to second order only.

Neglected: laws that are not linear in r - y, and references that carry noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter, tf2ss

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.checks.early_checks import refuse_few_lines
from ident.checks.validation import SAME_RESPONSE, FreshFit, fit_on_fresh_data
from ident.closed_loop import TwoStage, reference_to_input
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.least_squares import fit
from ident.fit.regression import prepare
from ident.recorded_law import CANCELS_SHARE, RecordedLaw
from ident.unstable import quick_poles


def opened_by_loop(
    records: Sequence[Record], law: RecordedLaw, options: IdentOptions | None = None
) -> TwoStage:
    """Open-loop records of logs whose command a linear law made of reference less output.

    Parameters
    ----------
    records : sequence of Record
        One input, one output and one reference each, of one sampling time. They may begin in motion and at
        any offset.
    law : RecordedLaw
        That made them, of the error (`on_error`). That it did is not checked.
    options : IdentOptions, optional
        Only the size of the part of long records that is searched counts, and whether the arm integrates:
        then, or where the law does, T is 1 at standstill.

    Returns
    -------
    TwoStage
        One record (u~, y~) of each, in the units of the logs (module's docstring), and the share of its
        command that the reference explains. No model of the plant is made: `plant` is None.

    Raises
    ------
    ValueError
        The law is not one of r - y, a record has not exactly one reference and one input, or the records
        excite few frequencies; other sampling times.
    """
    options = options or IdentOptions()
    numerator, denominator = _on_error(law)
    to_input = [reference_to_input(record) for record in records]
    refuse_few_lines(records)

    # All responses of the loop have its poles.
    poles = quick_poles(to_input, options)
    command_of = _on_poles(to_input, poles)
    rises = bool(options.integrators) or _integrates(numerator, denominator)
    to_error = [_reference_to_error(record, rises=rises) for record in records]
    error_of = _on_poles(to_error, poles)

    def sensitivity(signal: RealArray) -> RealArray:
        """A signal (T,) behind S, from rest."""
        return error_of.simulate(np.diff(signal, prepend=0.0) if rises else signal)

    opened = []
    explained_percent = []
    for record, of_input, of_error in zip(records, to_input, to_error, strict=True):
        # From rest: offset and motion at the start are taken off what the free run leaves.
        motion = of_input.input[:, 0] - of_input.input[0, 0]
        error = sensitivity(motion)
        command = lfilter(numerator, denominator, error)
        left = -fit_on_fresh_data(error_of, of_error).residual
        opened.append(
            replace(
                record,
                input=sensitivity(command)[:, None],
                output=(left + sensitivity(motion - error))[:, None],
                reference=None,
                reference_names=(),
            )
        )
        explained_percent.append(fit_on_fresh_data(command_of, of_input).fit_percent)
    return TwoStage(tuple(opened), tuple(explained_percent), None)


def _on_error(law: RecordedLaw) -> tuple[RealArray, RealArray]:
    """Numerator and denominator in z of K, u = K (r - y). Raises ValueError for a law of other signals."""
    if law.on_error is None:
        raise ValueError("the loop that made the logs needs a law of reference less output")
    return law.on_error


def _integrates(numerator: RealArray, denominator: RealArray) -> bool:
    """Whether a law has a pole at z = 1 that its numerator does not cancel, within `CANCELS_SHARE`."""
    pole = abs(denominator.sum()) <= CANCELS_SHARE * np.abs(denominator).sum()
    zero = abs(numerator.sum()) <= CANCELS_SHARE * np.abs(numerator).sum()
    return bool(pole and not zero)


def fit_in_loop(model: GobfModel, record: Record, law: RecordedLaw) -> FreshFit:
    """Free run of a model in the loop that made a record: of the record it sees the reference alone.

    Parameters
    ----------
    model : GobfModel
        Of the arm, without a direct term; it may integrate, and be unstable.
    record : Record
        One output and one reference, of the sampling time of model and law.
    law : RecordedLaw
        That made the record, of the error (`on_error`).

    Returns
    -------
    FreshFit
        `fit_percent` is of the motion about its mean; minus infinity where the model is unstable in this
        loop. `answers`: it is above zero.

    Raises
    ------
    ValueError
        The law is not one of r - y, the model has a direct term, or the record has no reference, another
        sampling time or a constant output.

    Notes
    -----
    The motion before the first row is unknown: free responses of the loop's states and a constant are fitted
    to the record, and not counted as errors.
    """
    numerator, denominator = _on_error(law)
    if record.reference is None or record.reference.shape[1] != 1:
        raise ValueError(f"{record.label}: a free run in the loop needs one reference column")
    record.refuse_several(model.dt_s, 1)
    measured = record.output[:, 0]
    spread = float(np.linalg.norm(measured - measured.mean()))
    if spread == 0:
        raise ValueError(f"{record.label}: the output is constant")

    loop = _loop_of(model, numerator, denominator)
    # An integrator of the law that cancels has a pole on the circle, up to rounding: what grows by less than
    # a factor of e within the record is not called unstable.
    if np.max(np.abs(np.linalg.eigvals(loop.states)), initial=0.0) > 1 + 1 / measured.size:
        nothing = np.full(measured.size, np.nan)
        return FreshFit(record.name, -np.inf, nothing, nothing, answers=False)
    from_rest, free = loop.answers(record.reference[:, 0] - record.reference[0, 0])
    start = np.column_stack([free, np.ones(measured.size)])
    simulated = from_rest + start @ np.linalg.lstsq(start, measured - from_rest, rcond=SAME_RESPONSE)[0]
    residual = measured - simulated
    fit_percent = 100 * (1 - float(np.linalg.norm(residual)) / spread)
    return FreshFit(record.name, fit_percent, simulated, residual, answers=fit_percent > 0)


class _Loop(NamedTuple):
    """State space of a loop from reference to output, strictly proper.

    states (n, n), drive (n, 1), observed (1, n).
    """

    states: RealArray
    drive: RealArray
    observed: RealArray

    def answers(self, reference: RealArray) -> tuple[RealArray, RealArray]:
        """Output (T,) from rest for a reference (T,), and outputs (T, n) of each state alone, of one at the
        first row."""
        n_samples = reference.size
        state = np.zeros(len(self.states))
        from_rest = np.empty(n_samples)
        row = self.observed[0]
        free = np.empty((n_samples, row.size))
        for k in range(n_samples):
            from_rest[k] = self.observed[0] @ state
            free[k] = row
            state = self.states @ state + self.drive[:, 0] * reference[k]
            row = row @ self.states
        return from_rest, free


def _loop_of(model: GobfModel, numerator: RealArray, denominator: RealArray) -> _Loop:
    """The loop of a model under u = K (r - y), K of this numerator and denominator in z.

    Raises ValueError for a model with a direct term: the loop is
    algebraic then.
    """
    a, b, c, d = model.state_space()
    if d[0, 0] != 0:
        raise ValueError("a free run in the loop needs a model without a direct term")
    a_law, b_law, c_law, d_law = tf2ss(numerator, denominator)
    return _Loop(
        states=np.block([[a - d_law * (b @ c), b @ c_law], [-b_law @ c, a_law]]),
        drive=np.vstack([b * d_law, b_law]),
        observed=np.hstack([c, np.zeros((1, len(a_law)))]),
    )


def _on_poles(records: Sequence[Record], poles: Poles) -> GobfModel:
    """Response with a direct term on given poles, one for all records, which may begin in motion.

    records: one input, one output; by least squares. Raises ValueError as `prepare`.
    """
    structure = Structure(feedthrough=True, estimate_offset=True, estimate_initial_state=True)
    linear = fit(prepare(records, structure), poles)
    direct = float(np.ravel(linear.feedthrough)[0])
    return GobfModel(poles, np.ravel(linear.coefficients), records[0].dt_s, feedthrough=direct)


def _reference_to_error(record: Record, *, rises: bool) -> Record:
    """Record whose input is the reference and whose output is reference less output, both (T, 1).

    rises: the input is the change of the reference from row to row instead, so that a response to it is S
    behind a difference: zero at standstill. `reference_to_input` has refused records without reference.
    """
    reference = np.asarray(record.reference)
    driving = np.diff(reference, axis=0, prepend=reference[:1]) if rises else reference
    return replace(
        record,
        input=driving,
        output=reference - record.output,
        input_names=record.reference_names,
        input_units=(),
        reference=None,
        reference_names=(),
    )
