"""Logs taken in closed loop with a known reference: two-stage identification, its output corrected.

Stage one fits r -> u; u_hat, its fit, is free of the noise v that the loop feeds back. With any model G0

    y - G0 (u - u_hat) = G u_hat + (G - G0) (u - u_hat) + v,

an open-loop record with input u_hat (an instrumental variable; Gilson and Van den Hof, Automatica 41(2),
2005) and noise v. An error of u_hat counts times G - G0 only; with G0 = 0 it is the method of Van den Hof and
Schrama (Automatica 29(6), 1993), where it counts in full.
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

# A first stage that explains less of the input than this has gone wrong.
EXPLAINED_PERCENT = 50.0
# The same for balls: with 89 % they held a response at .90 of the frequencies, not .95, with 70 % at .40.
_ENOUGH_FOR_BALLS = 90.0
_FIRST_STAGE = EmbeddingOptions(coloured_noise=True, prior_missed_mode=0.0, fir_length=1)


@dataclass(frozen=True, eq=False)
class TwoStage:
    """Open-loop records: input u_hat, output y - G0 (u - u_hat); fit_percent (per record) of u by u_hat;
    plant G0."""

    records: tuple[Record, ...]
    fit_percent: tuple[float, ...]
    plant: GobfModel | MimoModel
    enough_percent: float = EXPLAINED_PERCENT

    @property
    def finding(self) -> Finding:
        return finding(
            FindingKind.TWO_STAGE, least_percent=min(self.fit_percent), most_percent=max(self.fit_percent)
        )

    @property
    def warnings(self) -> tuple[Finding, ...]:
        explained = min(self.fit_percent)
        lost = finding(FindingKind.UNEXPLAINED_INPUT, explained_percent=explained)
        return (lost,) if explained < self.enough_percent else ()


def two_stage(
    records: Sequence[Record], options: IdentOptions | None = None, plant: GobfModel | None = None
) -> TwoStage:
    """Turn r -> u -> y into an open-loop problem for `identify` and `tangent` with the same options.

    r -> u: a direct term and as many poles as the data ask for, common to the records, zeros of each. plant:
    G0; default: of a second stage on the direct fit. Raises ValueError when a record has not exactly one
    reference and input, or where the records excite few frequencies. Noise at the plant's input needs a noise
    model of high order (`EmbeddingOptions.max_ar_order`).
    """
    options = options or IdentOptions()
    closed, fixed = [_reference_to_input(record) for record in records], options.fixed()
    refuse_few_lines(records)
    poles = quick_poles(closed, options)
    first = GobfModel(poles, np.zeros(poles.order), records[0].dt_s, feedthrough=1.0)
    # Behind a noise model: what noise of high frequency moved at a low one would pass for excitation there.
    loops = [tangent([loop], first, _FIRST_STAGE) for loop in closed]
    # With its own start and offset: a log may begin in motion, and at any operating point.
    rests = [fit_on_fresh_data(loop, record).residual for loop, record in zip(loops, closed, strict=True)]
    if plant is None:
        options = options.with_delay_stated()
        plant = identify(records, options).model
        # What feedback does to the direct fit would be noise of the second stage.
        n_real, n_pairs = (own - given for own, given in zip(plant.poles.counts, fixed.counts, strict=True))
        again = options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs})
        plant = identify(_opened(records, rests, plant), again).model
    moved = [record.input[:, 0] - record.input.mean() for record in records]
    fits = [
        100 * (1 - float(np.linalg.norm(rest) / np.linalg.norm(u)))
        for rest, u in zip(rests, moved, strict=True)
    ]
    return TwoStage(tuple(_opened(records, rests, plant)), tuple(fits), plant)


def two_stage_several(
    records: Sequence[Record],
    options: IdentOptions | None = None,
    *,
    start: Poles | None = None,
    progress: Progress = silent,
) -> TwoStage:
    """The same for several inputs and outputs: open-loop records for `identify_mimo` and `matrix_posterior`.

    References are set points, or signals added to the commands; as many of them move as there are inputs, or
    more. A record without any is of the open loop and stays as it is. r -> u is fitted record by record, in
    white noise. start: of the plant's search. Raises ValueError as `identify_mimo`, and for few references.
    """
    moved = {
        name
        for record in records
        if record.reference is not None
        for name, signal in zip(record.reference_names, record.reference.T, strict=True)
        if np.ptp(signal)
    }
    names = records[0].input_names
    if len(moved) < len(names) and all(record.reference is not None for record in records):
        raise ValueError(
            f"{records[0].label}: {len(moved)} references move ({sorted(moved)}) for {len(names)} inputs "
            f"{list(names)}: too little to tell a machine from its loop; move every joint's reference by its "
            "own signal"
        )
    options, rests = options or IdentOptions(), []
    for number, record in enumerate(records):
        progress(0.5 * number / len(records), "from references to inputs")
        rests.append(_unexplained(record))
    plant: MimoModel | None = None
    fitted = list(records)
    for share in (0.5, 0.7, 0.9):  # what feedback does to a direct fit would be noise of the second stage
        progress(share, "without what the loop fed back")
        found = identify_mimo(fitted, options, start=plant.poles if plant else start, free_shapes=True)
        plant = found.model
        n_real, n_pairs = (own - given for own, given in zip(plant.poles.counts, found.n_fixed, strict=True))
        if share > 0.5:
            options = options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs})
        fitted = [
            replace(
                record, input=record.input - rest, output=record.output - plant.simulate(rest),
                reference=None, reference_names=(),
            )
            for record, rest in zip(records, rests, strict=True)
        ]  # fmt: skip
    fits = []
    for record, rest in zip(records, rests, strict=True):
        size = np.maximum(np.std(record.input, axis=0), 1e-300)
        fits.append(100 * (1 - float(np.linalg.norm(np.std(rest, axis=0) / size)) / np.sqrt(size.size)))
    assert plant is not None
    return TwoStage(tuple(fitted), tuple(fits), plant, _ENOUGH_FOR_BALLS)


def _unexplained(record: Record) -> RealArray:
    """Inputs (T, U) less what the references that move make of them; zero in the open loop."""
    if record.reference is None:
        return np.zeros_like(record.input)
    moved = np.flatnonzero(np.ptp(record.reference, axis=0))
    if not moved.size:
        return np.asarray(record.input - record.input.mean(axis=0))
    loop = replace(
        record, input=record.reference[:, moved], output=record.input, reference=None, reference_names=(),
        input_names=tuple(record.reference_names[i] for i in moved), output_names=record.input_names,
        input_units=(), output_units=(),
    )  # fmt: skip
    return np.asarray(identify_mimo([loop], IdentOptions(feedthrough=True), free_shapes=True).residuals[0])


def with_controller(record: Record, numerator: Sequence[float], denominator: Sequence[float]) -> Record:
    """The record with a reference made of its known controller K = numerator / denominator, in z, highest
    power first: u = K (r - y) says denominator u + numerator y = numerator r, free of the noise in y;
    delayed, and the record shorter, by the order. Raises ValueError for a controller that is not proper, or
    several channels."""
    order = len(denominator) - 1
    late = order + 1 - len(numerator)
    if late < 0 or not denominator[0] or not any(numerator):
        raise ValueError("the controller needs a denominator of at least the numerator's degree")
    if record.input.shape[1] != 1 or record.output.shape[1] != 1:
        raise ValueError(f"{record.label}: a controller has one input and one output")
    u, y = record.input[:, 0], record.output[:, 0]
    known = np.convolve(u, denominator)[order : u.size]
    known += np.convolve(y, [0.0] * late + list(numerator))[order : u.size]
    return replace(
        record.slice(order, record.n_samples), reference=known[:, None], reference_names=("controller",)
    )


def _opened(records: Sequence[Record], rests: Sequence[RealArray], plant: GobfModel) -> list[Record]:
    """Records without the rests (T,) of their inputs, and without what the plant makes of them."""
    opened = []
    for record, rest in zip(records, rests, strict=True):
        answer = plant.stable_part.simulate(rest)
        # 1/B backwards in time: the bounded answer of an unstable plant to what a loop keeps bounded.
        answer = all_pass_signal(plant.unstable, answer[::-1])[::-1]
        input_, output = record.input - rest[:, None], record.output - answer[:, None]
        opened.append(replace(record, input=input_, output=output, reference=None, reference_names=()))
    return opened


def _reference_to_input(record: Record) -> Record:
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
