"""Make open-loop records of logs that were taken in closed loop with a known reference.

In a loop the command u answers to the noise v in the output y, which biases a fit of y to u. Stage one fits
the command to the reference r: u_hat, what r explains of u, is free of v. With any model G0 of the plant G

    y - G0 (u - u_hat) = G u_hat + (G - G0) (u - u_hat) + v,

an open-loop record with input u_hat (an instrumental variable; Gilson and Van den Hof, Automatica 41(2),
2005) and noise v. An error of u_hat counts times G - G0 only; with G0 = 0 it is the method of Van den Hof and
Schrama (Automatica 29(6), 1993), where it counts in full. G0 is fitted first to the logs as they are, then
again to the records that it opened (`two_stage`, `two_stage_several`). Where no reference was recorded, a
known controller makes one (`with_controller`). Assumed: a linear loop, and references without noise.

A `Record` has an input (T, U), an output (T, Y) and where it was logged a reference (T, R), with their names,
and its sampling time dt_s; its samples are finite, or it could not be made. An empty list of records is
refused nowhere here: it ends in an IndexError.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.basis.functions import all_pass_signal
from ident.basis.mimo_model import MimoModel
from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.poles import Poles
from ident.checks.early_checks import refuse_few_lines
from ident.checks.validation import fit_on_fresh_data
from ident.data.arrays import RealArray
from ident.data.finding import Finding, FindingKind, finding
from ident.data.record import Record
from ident.one_input import identify
from ident.search.order_selection import Progress, silent
from ident.several_outputs import identify_mimo
from ident.uncertainty.embedding import tangent
from ident.unstable import quick_poles

# Percent of a command (`TwoStage.fit_percent`) that the first stage has to explain. Below half, most of what
# the command does comes from noise, or from a reference that is not the one that was recorded; a case that
# leaves the way of identification to the data is then not fitted in two stages.
EXPLAINED_PERCENT = 50.0
# Percent of the commands that the first stage has to explain for balls of several inputs and outputs. Where
# it explained 89 %, 95 % balls held the true response at 90 % of the frequencies, at 70 % at 40 % of them.
EXPLAINED_PERCENT_FOR_BALLS = 90.0
# Settings of the fit from reference to command. Behind a noise model: what noise of high frequency moved at a
# low one would pass for excitation there. With a mode that may be missing (a prior of .5) the fit follows
# noise, and u_hat is further from the true one than a test allows. One tap is the fewest there may be; with
# 20 no test of two stages moves.
FIRST_STAGE = EmbeddingOptions(coloured_noise=True, prior_missed_mode=0.0, fir_length=1)
# Standard deviation of a command that stands still, in place of zero, which could not be divided by: near the
# smallest double.
TINY = 1e-300


@dataclass(frozen=True, eq=False)
class TwoStage:
    """Open-loop records that were made of logs of a loop.

    Attributes
    ----------
    records : tuple of Record
        Input u_hat, output y - G0 (u - u_hat), no reference.
    fit_percent : tuple of float
        Of each record, 100 (1 - |u - u_hat| / |u - mean u|), of several inputs with the root mean square of
        this ratio over them (deviations about means).
    plant : GobfModel, MimoModel or None
        G0; None where the loop's own responses took its place (`ident.recorded_loop`).
    enough_percent : float
        Below this fit of a record there is a warning.
    """

    records: tuple[Record, ...]
    fit_percent: tuple[float, ...]
    plant: GobfModel | MimoModel | None
    enough_percent: float = EXPLAINED_PERCENT

    @property
    def finding(self) -> Finding:
        """What the references explain of the commands, least and most of all records, per cent.

        Raises ValueError without records.
        """
        return finding(
            FindingKind.TWO_STAGE, least_percent=min(self.fit_percent), most_percent=max(self.fit_percent)
        )

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """One finding UNEXPLAINED_INPUT where some record has a `fit_percent` below `enough_percent`; else
        empty.

        Raises ValueError without records; a percentage of nan gives the finding.
        """
        explained = min(self.fit_percent)
        if explained >= self.enough_percent:
            return ()
        return (finding(FindingKind.UNEXPLAINED_INPUT, explained_percent=explained),)


def two_stage(
    records: Sequence[Record], options: IdentOptions | None = None, plant: GobfModel | None = None
) -> TwoStage:
    """Open-loop records of logs with one reference, one input and one output.

    Parameters
    ----------
    records : sequence of Record
        Of one sampling time. They may begin in motion and at any offset.
    options : IdentOptions, optional
        Of the plant; the same are to be used for `identify` and `tangent` afterwards.
    plant : GobfModel, optional
        Model G0 of the plant; default: fitted to the logs as they are, then to the records that this fit
        opened.

    Returns
    -------
    TwoStage
        One open-loop record of each, the share of its command that the reference explains, and G0.

    Raises
    ------
    ValueError
        A record has not exactly one reference and one input, or the records excite few frequencies; below
        (`identify`): an output that is constant, several outputs, other sampling times, too few samples.
        Whether each command moves is not checked before the first fit.

    Notes
    -----
    r -> u has a direct term and as many poles as the data ask for, common to the records, and zeros of each.
    Noise at the plant's input needs a noise model of high order (`EmbeddingOptions.max_ar_order`).
    """
    options = options or IdentOptions()
    to_input = [reference_to_input(record) for record in records]
    fixed = options.fixed()
    refuse_few_lines(records)

    # Stage one: what the reference does not explain of each input.
    poles = quick_poles(to_input, options)
    loop_poles = GobfModel(poles, np.zeros(poles.order), records[0].dt_s, feedthrough=1.0)
    unexplained = []
    for loop_record in to_input:
        loop = tangent([loop_record], loop_poles, FIRST_STAGE)
        # With a start and an offset of its own: a log may begin in motion, and at any operating point.
        unexplained.append(fit_on_fresh_data(loop, loop_record).residual)

    if plant is None:
        options = options.with_delay_stated()
        direct_plant = identify(records, options).model
        # The second fit keeps the order of the direct one: what feedback did is noise in it, which further
        # poles would follow.
        n_real = direct_plant.poles.real.size - fixed.real.size
        n_pairs = direct_plant.poles.pairs.size - fixed.pairs.size
        same_order = options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs})
        plant = identify(_opened(records, unexplained, direct_plant), same_order).model

    fit_percent = []
    for record, remainder in zip(records, unexplained, strict=True):
        motion = record.input[:, 0] - record.input.mean()
        fit_percent.append(100 * (1 - float(np.linalg.norm(remainder) / np.linalg.norm(motion))))
    return TwoStage(tuple(_opened(records, unexplained, plant)), tuple(fit_percent), plant)


def two_stage_several(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    *,
    start: Poles | None = None,
    progress: Progress = silent,
) -> TwoStage:
    """Open-loop records of logs with several references, inputs and outputs.

    Parameters
    ----------
    records : sequence of Record
        Of equal inputs (U), outputs (Y) and sampling time. References are set points, or signals added to the
        commands; over all records at least U of them move. A record without references is of the open loop
        and stays as it is.
    options : IdentOptions, optional
        Of the plant, as for `identify_mimo`.
    start : Poles, optional
        Where the plant's search begins.
    progress : callable
        Called with a share 0 .. 1 and a short message.

    Returns
    -------
    TwoStage
        What `identify_mimo` and `matrix_posterior` take as records of the open loop.

    Raises
    ------
    ValueError
        Fewer references move than there are inputs (asked only where every record has references), or what
        `identify_mimo` refuses: outputs that are dependent, inputs that differ between records, too few
        samples.

    Notes
    -----
    r -> u is fitted record by record, in white noise.
    """
    input_names = records[0].input_names
    moving_references = set()
    for record in records:
        if record.reference is None:
            continue
        for name, signal in zip(record.reference_names, record.reference.T, strict=True):
            if np.ptp(signal):
                moving_references.add(name)
    all_in_loop = all(record.reference is not None for record in records)
    if len(moving_references) < len(input_names) and all_in_loop:
        raise ValueError(
            f"{records[0].label}: {len(moving_references)} references move ({sorted(moving_references)}) for "
            f"{len(input_names)} inputs {list(input_names)}: too little to tell a machine from its loop; "
            "move every joint's reference by its own signal"
        )

    # Stage one: what the references do not explain of the inputs.
    options = options or IdentOptions()
    unexplained = []
    for number, record in enumerate(records):
        # Half of the bar, chosen: a fit of each record here, three of all of them below.
        progress(0.5 * number / len(records), "from references to inputs")
        unexplained.append(_unexplained(record))

    # The plant, three times: of the logs as they are, then twice of records that the plant before has opened.
    # The first fit is biased by what feedback did, and its order with it, so the second one chooses anew; the
    # third one keeps that order, on records that a better plant has opened. A plant of one input and output
    # has its order from its own noise model and is fitted twice (`two_stage`); why once more here is not
    # known: chosen. Free shapes: every output has numerators of its own on the common poles. The numbers are
    # places on the bar of progress; the first marks the fit whose order is not kept.
    opened = list(records)
    for share in (0.5, 0.7, 0.9):
        progress(share, "without what the loop fed back")
        fitted = identify_mimo(opened, options, start=start, free_shapes=True)
        plant = fitted.model
        start = plant.poles
        if share > 0.5:
            n_fixed_real, n_fixed_pairs = fitted.n_fixed
            n_real = plant.poles.real.size - n_fixed_real
            n_pairs = plant.poles.pairs.size - n_fixed_pairs
            options = options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs})
        opened = []
        for record, remainder in zip(records, unexplained, strict=True):
            input_ = record.input - remainder
            output = record.output - plant.simulate(remainder)
            opened.append(replace(record, input=input_, output=output, reference=None, reference_names=()))

    # Root mean square, over the inputs, of what is unexplained of each as a share of its motion.
    fit_percent = []
    for record, remainder in zip(records, unexplained, strict=True):
        input_std = np.maximum(np.std(record.input, axis=0), TINY)
        shares = np.std(remainder, axis=0) / input_std
        fit_percent.append(100 * (1 - float(np.linalg.norm(shares)) / np.sqrt(input_std.size)))
    return TwoStage(tuple(opened), tuple(fit_percent), plant, EXPLAINED_PERCENT_FOR_BALLS)


def _unexplained(record: Record) -> RealArray:
    """Inputs (T, U) of a record less what its moving references explain of them, in their units.

    Zero in the open loop, where nothing was fed back; the inputs about their means where no reference moves.
    Raises ValueError where `identify_mimo` refuses the fit: inputs that are dependent, too few samples,
    moving references that are one signal.
    """
    if record.reference is None:
        return np.zeros_like(record.input)
    moving = np.flatnonzero(np.ptp(record.reference, axis=0))
    if not moving.size:
        return np.asarray(record.input - record.input.mean(axis=0))
    reference_to_input = replace(
        record,
        input=record.reference[:, moving],
        output=record.input,
        reference=None,
        reference_names=(),
        input_names=tuple(record.reference_names[index] for index in moving),
        output_names=record.input_names,
        input_units=(),
        output_units=(),
    )
    # A controller answers in the same sample.
    options = IdentOptions(feedthrough=True)
    return np.asarray(identify_mimo([reference_to_input], options, free_shapes=True).residuals[0])


def with_controller(record: Record, numerator: Sequence[float], denominator: Sequence[float]) -> Record:
    """Record with a reference that is made of its known controller.

    Parameters
    ----------
    record : Record
        Of one input u and one output y.
    numerator, denominator : sequence of float
        Of K in z, highest power first: u = K (r - y).

    Returns
    -------
    Record
        Shorter by the order of the controller, with the reference numerator r, delayed by that order.

    Raises
    ------
    ValueError
        The controller is not proper, or zero, or the record has several inputs or outputs; below
        (`Record.slice`, `Record`): no more rows than the controller's order, or a coefficient that is not
        finite.

    Notes
    -----
    u = K (r - y) says denominator u + numerator y = numerator r: the left side is known, and free of the
    noise in y.
    """
    order = len(denominator) - 1
    relative_degree = order + 1 - len(numerator)
    if relative_degree < 0 or not denominator[0] or not any(numerator):
        raise ValueError("the controller needs a denominator of at least the numerator's degree")
    if record.input.shape[1] != 1 or record.output.shape[1] != 1:
        raise ValueError(f"{record.label}: a controller has one input and one output")
    command = record.input[:, 0]
    output = record.output[:, 0]
    n_samples = command.size
    # Filters of the same length, so that both sums end at the same sample; the first ones are incomplete.
    long_numerator = [0.0] * relative_degree + list(numerator)
    reference = np.convolve(command, denominator)[order:n_samples]
    reference += np.convolve(output, long_numerator)[order:n_samples]
    return replace(
        record.slice(order, record.n_samples),
        reference=reference[:, None],
        reference_names=("controller",),
    )


def _opened(records: Sequence[Record], unexplained: Sequence[RealArray], plant: GobfModel) -> list[Record]:
    """Open-loop records: inputs without their unexplained part, outputs without what the plant makes of it.

    `unexplained` : of each record, (T,), units of the input; `plant` : G0, which may be unstable. Raises
    ValueError where the numbers of both differ; that they are equally long, the caller has seen to.
    """
    opened = []
    for record, remainder in zip(records, unexplained, strict=True):
        answer = plant.stable_part.simulate(remainder)
        # 1/B backwards in time: the bounded answer of an unstable plant to what a loop keeps bounded.
        answer = all_pass_signal(plant.unstable, answer[::-1])[::-1]
        input_ = record.input - remainder[:, None]
        output = record.output - answer[:, None]
        opened.append(replace(record, input=input_, output=output, reference=None, reference_names=()))
    return opened


def reference_to_input(record: Record) -> Record:
    """Record whose input is the reference and whose output is the input, both (T, 1).

    Raises ValueError where a record has not exactly one of each.
    """
    if record.reference is None or record.reference.shape[1] != 1:
        raise ValueError(f"{record.label}: closed-loop identification needs exactly one reference column")
    if record.input.shape[1] != 1:
        raise ValueError(f"{record.label}: need one input; got {list(record.input_names)}")
    return Record(
        name=record.name,
        input=record.reference,
        output=record.input,
        dt_s=record.dt_s,
        input_names=record.reference_names,
        output_names=record.input_names,
        source=record.source,
    )
