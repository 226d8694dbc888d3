"""Sentences on records: how a file was read, what is doubtful in it, and what its signals do not tell.

Each function takes the values of its kind by name. Everywhere `record` is what the log is called, `name` that
of a column, `place` a line or a row of it, `options` what to give the command that speaks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ident.data.finding import FindingKind
from ident.data.foreign_files import as_typed
from workflow.text import formats
from workflow.text.options import setting_name


def time_unit(name: str, in_header: str, dt_s: float, options: str) -> str:
    """in_header: the unit that the file says, '' for none; dt_s: the step, in seconds as it was taken."""
    in_seconds = in_header in ("", "s")
    taken_as = "seconds" if in_seconds else in_header
    unstated = "" if in_header else ", for no unit is stated"
    if in_seconds:
        doubt = "look like integers of a smaller unit"
    else:
        doubt = "s are no machine's, and look like seconds"
    return (
        f"time column '{name}' is taken as {taken_as}{unstated}, but steps of {formats.number(dt_s, 4)} "
        f"{doubt}: check the frequencies below, and give {options}, or {in_header or 's'} if it is right "
        "(time_unit in a configuration)"
    )


def repaired(
    record: str, missing: int, samples: int, jitter: float, faithful_rad_s: float, too_narrow: float
) -> str:
    """missing: rows of all samples; jitter: of stamps, as a share of a step; faithful_rad_s: up to where the
    grid follows the motion; too_narrow: the ellipses, as a share."""
    were = "was" if missing == 1 else "were"
    narrow = ""
    if missing:
        narrow = (
            ", and as filled rows count like measured ones they are too narrow by up to "
            f"{formats.share(too_narrow, 2)}"
        )
    return (
        f"{record}: {formats.count(missing, 'row')} of {samples} {were} missing, and time stamps strayed by "
        f"up to {formats.share(jitter, 2)} of a step. The output was put on a uniform grid by a cubic "
        f"spline. Above {faithful_rad_s:.3g} rad/s that is wrong by more than 1 % of the motion, which the "
        f"ellipses do not hold{narrow}"
    )


def resampled(
    record: str,
    missing: int,
    samples: int,
    jitter: float,
    own_s: float,
    dt_s: float,
    faithful_rad_s: float,
    too_narrow: float,
) -> str:
    """own_s: step of the log; dt_s: of the record made of it; the others as in `repaired`."""
    narrow = ""
    if missing:
        narrow = (
            f". {formats.count(missing, 'step')} of {samples} had no reading: the ellipses are too narrow by "
            f"up to {formats.share(too_narrow, 2)}"
        )
    return (
        f"{record}: resampled from steps of {formats.si(own_s, 's')}, which jitter by up to "
        f"{formats.share(jitter, 2)}, to {formats.si(dt_s, 's')}: outputs on straight lines between the "
        f"readings, inputs averaged over each step. Above {faithful_rad_s:.3g} rad/s that is wrong by more "
        f"than 1 % of the motion, which the ellipses do not hold{narrow}"
    )


def clock_drifts(record: str, samples: float, share: float, dt_s: float) -> str:
    """samples: by which stamps stray; share: of the rate by which it changes; dt_s: of an even grid."""
    return (
        f"{record}: the clock drifts: its stamps stray by up to {formats.number(samples, 2)} samples from a "
        f"uniform grid, and parts of the log are sampled {formats.share(share, 2)} faster or slower. "
        f"Frequencies are known no better than that; {setting_name('resample_s', format(dt_s, 'g'))} puts "
        "the log on a uniform grid"
    )


def skipped_rows(record: str, rows: int, line: int) -> str:
    were = "was" if rows == 1 else "were"
    return f"{record}: {formats.count(rows, 'line')} commented out {were} left out, the first is line {line}"


def cut_row(record: str, line: int) -> str:
    return f"{record}: the file ends inside of line {line}, which was left out"


def footer(record: str, line: int) -> str:
    return f"{record}: line {line}, under the rows, holds words alone and was left out"


def bookkept(record: str, place: str, cell: str, name: str, value: float, rows: int) -> str:
    """cell: the text; value: the number that it was taken for; rows: with such cells."""
    return (
        f"{record}, {place}: '{cell}' in '{name}' is read as {value:.6g}, as bookkeeping writes it "
        f"({formats.count(rows, 'row')} like it)"
    )


def timer_wraps(record: str, name: str, period: float, count: int) -> str:
    return (
        f"{record}: time '{name}' starts again at {period:.10g} ({formats.count(count, 'time')}), as a timer "
        "of so many counts does: it is read as going on there. If these are runs of their own, split the file"
    )


def no_reading(record: str, place: str, name: str, value: float, rows: int) -> str:
    return (
        f"{record}, {place}: '{name}' is {value:.10g} there ({formats.count(rows, 'row')} like it), far from "
        "all its other values: no reading? Delete such rows; with a time column flexlink init fills the gap "
        "that this leaves (repair = true in a configuration)"
    )


def held(record: str, name: str, output: str) -> str:
    return f"{record}: '{name}' has rows of its own: each row of '{output}' holds its last value"


def late_command(name: str, samples: int) -> str:
    rows = formats.count(samples, "row")
    return (
        f"the output answers up to {rows} before '{name}' changes: that column was logged late, and is taken "
        f"{rows} earlier"
    )


def controller_period(step_s: float, repeats: bool, reference: bool) -> str:
    """step_s: of the log; repeats: the law that was read off repeats the command; reference: one is there."""
    if repeats:
        why = (
            "the law that made the logs repeats it, but the signals are so smooth that a controller of half "
            "the period would have, too"
        )
    elif reference:
        why = (
            "no linear law makes it of the rows, so its controller was faster than the log, or the rows "
            "belong to different instants"
        )
    else:
        why = "no reference was recorded"
    return (
        f"what the command did between two rows is not known ({why}): the ellipses hold every period up to "
        f"the log's {formats.si(step_s, 's')}; state {setting_name('controller_period_s')} and they get "
        "narrower"
    )


def wraps(record: str, name: str, period: float) -> str:
    return (
        f"{record}: '{name}' jumps by its whole range: it wraps at {period:.9g}; if that is no motion of the "
        f"machine, give --unwrap {as_typed(name)}={period:.17g} (unwrap in a configuration)"
    )


def spikes(record: str, place: str, name: str, value: float, rows: int) -> str:
    return (
        f"{record}, {place}: '{name}' jumps to {value:.6g} and back ({formats.count(rows, 'row')} like it), "
        "as no machine moves: a sensor without a reading? Delete such rows; with a time column flexlink init "
        "fills the gap that this leaves (repair = true in a configuration)"
    )


def long_steps(record: str, name: str, share: float) -> str:
    """share: of its period that the longest step is."""
    return (
        f"{record}: '{name}' moves by up to {formats.share(share, 2)} of its period from sample to sample. "
        "Near 50 % either way round fits: the one that keeps the speed is taken. Sample faster, or move "
        "slower"
    )


def unit_contradicted(record: str, name: str, units: str) -> str:
    return (
        f"{record}: units of '{name}' contradict each other ({units}): state the right one: --unit "
        f"{as_typed(name)}=UNIT"
    )


def unit_converted(record: str, name: str, unit: str, of: str, times: float) -> str:
    """unit: of this log; of: of the first log; times: what the numbers were multiplied with."""
    return (
        f"{record}: '{name}' is in {unit}, in the first log in {of}: taken times {formats.number(times, 6)}, "
        f"in {of}"
    )


def _in_configuration(options: str) -> str:
    """Keys of a configuration that say what these options of a command line say."""
    units = " and units" if "--unit" in options else ""
    return f"(scale{units} in a configuration)"


def unit_of_loop(reference: str, output: str, times: float, like: str, options: str) -> str:
    """like: two units between which there is such a factor."""
    return (
        f"'{output}' follows the reference '{reference}' but is about {formats.number(times, 3)} times it, "
        f"as between {like}: if a header has the wrong unit, give {options} {_in_configuration(options)}"
    )


def exchanged(reference: str, output: str, name: str, options: str) -> str:
    """name: of the command."""
    return (
        f"the command '{name}' follows the reference '{reference}' in numbers as they stand, the output "
        f"'{output}' does not: if the two headers were exchanged, give {options} (input, output and units in "
        "a configuration)"
    )


def opposite(reference: str, output: str, options: str) -> str:
    return (
        f"'{output}' moves against its reference '{reference}', as a sensor that counts the other way: if "
        f"the loop was closed on the turned signal, give {options} {_in_configuration(options)}"
    )


def reference_still(name: str, value: float, record: str) -> str:
    """record: '' where the reference stands still in all of them."""
    where = f" in {record}" if record else ""
    or_without = ", or leave this log out" if record else ""
    return (
        f"the reference '{name}' stands still{where} (at {value:.6g}) and is not used: what moves the "
        "machine has to show in the command as logged. Record the loop with a reference that "
        f"moves{or_without}"
    )


def unit_of_reference(name: str, unit: str, output: str, of: str, options: str, same: bool) -> str:
    """unit: of the column; of: of the output; same: the output follows it in numbers as they stand."""
    if same:
        advice = (
            "the output follows it in numbers as they stand, so one of the two headers has the wrong unit. "
            f"If it is this one, give {options}; if the other, --unit {as_typed(f'{output}={unit}')} in its "
            "place"
        )
    else:
        advice = f"if it is the reference, give {options} (references and scale in a configuration)"
    return (
        f"'{name}' looks like the reference of '{output}' but is in {unit}, not {of}, and was left out: "
        f"{advice}"
    )


def few_samples(n_samples: int, unknowns: int) -> str:
    return (
        f"only {n_samples} samples for {unknowns} unknowns: record longer, or fit fewer poles; below ten "
        "samples per unknown the choice of the poles is itself uncertain"
    )


def weak_input(limit_rad_s: float) -> str:
    return (
        f"the input is not exciting above {limit_rad_s:.3g} rad/s: the model there is extrapolation; use an "
        "input with power up to the frequency you need"
    )


def alike_inputs(inputs: str, rank: int, count: int, low_rad_s: float, high_rad_s: float) -> str:
    """rank, count: of the matrix of the inputs' spectra, and how many inputs there are."""
    return (
        f"the inputs {inputs} are not independent from {low_rad_s:.3g} to {high_rad_s:.3g} rad/s (rank "
        f"{rank} of {count}): their channels cannot be distinguished there. Move each by its own signal, or "
        "one at a time in records of their own"
    )


def clipped(record: str, signal: str, name: str, share: float) -> str:
    """signal: 'input' or 'output'; share: of the samples."""
    return (
        f"{record}: {formats.share(share, 3)} of {signal} '{name}' stand at its very limit, as if saturated "
        "or clipped: lower the amplitude, or cut those samples out"
    )


def saturated(record: str, name: str, share: float, low: float, high: float) -> str:
    return (
        f"{record}: in {formats.share(share, 3)} of the samples the command '{name}' stands at {low:.6g} or "
        f"{high:.6g}, the ends of its range, as of a saturated or a switching controller: no linear law can "
        "be read off it. Record the loop with a smaller reference"
    )


def readings_held(record: str, name: str, fewest: int, most: int, from_rad_s: float) -> str:
    """fewest, most: rows over which a reading is held; from_rad_s: where that is no delay any more."""
    return (
        f"{record}: the output '{name}' holds each reading over {fewest} to {most} rows, as the speed of a "
        f"Hall sensor, known anew at each of its edges only: up to {from_rad_s:.3g} rad/s that is a delay, "
        "above it no mode of the machine can be told from it. Record an encoder, or take the sensor's own "
        "edges"
    )


def few_readings(record: str, name: str, count: int) -> str:
    return (
        f"{record}: the output '{name}' takes {count} values only: hardly more than a step of the sensor. "
        "Move further, or log more digits"
    )


def slow_pole_is_drift(time_constant_s: float, output: str) -> str:
    return (
        f"a real pole with a time constant of {time_constant_s:.3g} s describes a drift of '{output}'; a "
        "straight line does as well. Remove the trend of the output"
    )


def drift(record: str, output: str, drift: float, share: float) -> str:
    """drift: in all, in units of the output; share: of the residual's power."""
    return (
        f"{record}: output '{output}' drifts by {drift:+.3g} in all, not caused by the input "
        f"({formats.share(share, 2)} of the residual). Remove the trend, or fit within a band above it"
    )


def far_from_zero(record: str, input: str, mean: float, std: float) -> str:  # noqa: A002 (the value's name)
    return (
        f"{record}: input '{input}' stands at {mean:.4g} and moves by {std:.2g} only, but the fit starts "
        "from rest at zero. Subtract the operating point from input and output"
    )


SENTENCES: Mapping[FindingKind, Callable[..., str]] = {
    FindingKind.TIME_UNIT: time_unit,
    FindingKind.REPAIRED: repaired,
    FindingKind.RESAMPLED: resampled,
    FindingKind.CLOCK_DRIFTS: clock_drifts,
    FindingKind.SKIPPED_ROWS: skipped_rows,
    FindingKind.CUT_ROW: cut_row,
    FindingKind.FOOTER: footer,
    FindingKind.BOOKKEPT: bookkept,
    FindingKind.TIMER_WRAPS: timer_wraps,
    FindingKind.HELD: held,
    FindingKind.WRAPS: wraps,
    FindingKind.LATE_COMMAND: late_command,
    FindingKind.CONTROLLER_PERIOD: controller_period,
    FindingKind.SPIKES: spikes,
    FindingKind.NO_READING: no_reading,
    FindingKind.LONG_STEPS: long_steps,
    FindingKind.UNIT_CONTRADICTED: unit_contradicted,
    FindingKind.UNIT_CONVERTED: unit_converted,
    FindingKind.UNIT_OF_LOOP: unit_of_loop,
    FindingKind.EXCHANGED: exchanged,
    FindingKind.OPPOSITE: opposite,
    FindingKind.UNIT_OF_REFERENCE: unit_of_reference,
    FindingKind.REFERENCE_STILL: reference_still,
    FindingKind.FEW_SAMPLES: few_samples,
    FindingKind.WEAK_INPUT: weak_input,
    FindingKind.ALIKE_INPUTS: alike_inputs,
    FindingKind.CLIPPED: clipped,
    FindingKind.SATURATED: saturated,
    FindingKind.FEW_READINGS: few_readings,
    FindingKind.READINGS_HELD: readings_held,
    FindingKind.SLOW_POLE_IS_DRIFT: slow_pole_is_drift,
    FindingKind.DRIFT: drift,
    FindingKind.FAR_FROM_ZERO: far_from_zero,
}
