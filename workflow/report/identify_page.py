"""The page of `flexlink identify`: what was found, in words first, and the pictures to judge it by."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata

import numpy as np
from matplotlib.figure import Figure

from ident.checks.validation import fit_on_fresh_data
from workflow.figures.bode import EmpiricalResponse, draw_bode
from workflow.figures.order import draw_order
from workflow.figures.poles import draw_poles
from workflow.figures.records import ShownRecord, draw_records
from workflow.figures.residuals import draw_residual_tests
from workflow.figures.style import Picture, render
from workflow.figures.validation import draw_validation
from workflow.report.formats import count, frequency, listing, number, percent, sentence
from workflow.report.model_blocks import (
    STABILISATION_CAPTION,
    band_table,
    band_words,
    order_table,
    pole_tables,
    residual_caption,
    stabilisation_sentence,
    structure_words,
    test_remarks,
    unknown_bands,
    who_chose,
)
from workflow.report.page import Block, Plot, Section, Table, Text, maybe
from workflow.report.rendering import page
from workflow.tasks.log_identification import LogIdentification

_LIGHT = 0.3


@dataclass(frozen=True)
class Findings:
    """A few sentences under one title, at the head of the page."""

    title: str
    items: tuple[str, ...]


def identify_page(
    result: LogIdentification,
    inputs: Mapping[str, str],
    progress: Callable[[float, str], None] | None = None,
) -> str:
    """One self-contained HTML page; inputs are the files with their SHA-256. Same results, same page."""
    pictures: dict[str, Picture] = {}
    drawers = _drawers(result)
    for position, (name, draw) in enumerate(drawers.items()):
        if progress is not None:
            progress(position / len(drawers), name)
        pictures[name] = render(draw())
    about = result.about
    return page(
        "identify.html.j2",
        title=f"{about.input} to {about.output}",
        sections=[
            _modes(result),
            _response(result),
            _order(result),
            _poles(result),
            _fresh(result),
            _residuals(result),
            _records(result),
            _reproduce(result, inputs),
        ],
        pictures=pictures,
        headline=_headline(result),
        findings=[
            Findings("What was found", tuple(_found(result))),
            Findings("How good it is", tuple(_good(result))),
            Findings("What to be careful about", tuple(map(sentence, _careful(result)))),
        ],
    )


# Words


def _headline(result: LogIdentification) -> str:
    light = [mode for mode in result.about.modes if mode.damping < _LIGHT]
    text = f"A model of order {result.about.order} with {count(len(light), 'lightly damped mode')}"
    careful = len(result.careful)
    return text + (f"; {count(careful, 'thing')} to look at before trusting it" if careful else "")


def _found(result: LogIdentification) -> list[str]:
    about, options = result.about, result.options
    sentences = [sentence(structure_words(about))]
    fixed = options.fixed()
    n_real = len(about.real_poles_z) - fixed.real.size
    n_pairs = len(about.modes) - fixed.pairs.size
    sentences[0] = (
        f"{sentences[0][:-1]}: {count(n_real, 'real pole')} and {count(n_pairs, 'pole pair')} were found, "
        f"{_why_this_order(result)}."
    )
    spread = result.spread.intervals
    for index, mode in enumerate(about.modes):
        if mode.damping >= _LIGHT:
            continue
        text = f"Mode at {frequency(mode.omega_rad_s)}, damping {number(mode.damping)}"
        if spread is not None:
            low, high = spread.modes[index].frequency_Hz
            text += f", frequency known to {_plus_minus(low, high)}"
            text += f", damping to {_plus_minus(*spread.modes[index].damping)}"
        sentences.append(text + ".")
    if result.plot is not None:
        sentences.append(stabilisation_sentence(result.plot))
    if about.band_rad_s is not None:
        low, high = about.band_rad_s
        sentences.append(
            f"Fitted inside the band from {number(low)} to {number(high)} rad/s; nothing is said about the "
            "rest."
        )
    known = [] if options.integrators == 0 else [count(options.integrators, "integrator")]
    if options.input_delay_samples:
        known.append(f"a delay of {count(options.input_delay_samples, 'sample')}")
    if known:
        sentences.append(f"Given, not found: {listing(known)}.")
    # What speaks against the model stands among the things to be careful about.
    return sentences + [sentence(text) for text in about.verdicts if text not in result.careful]


def _why_this_order(result: LogIdentification) -> str:
    options, steps = result.options, result.found.order_table
    if options.n_real is not None and options.n_pairs is not None:
        return "as many as were asked for"
    if len(steps) < 2:
        return "the only structure that was tried"
    best, second = sorted(step.criterion for step in steps)[:2]
    return (
        f"chosen by an information criterion from {len(steps)} structures (the next best is "
        f"{number(second - best)} worse, {_odds(second - best)})"
    )


def _odds(difference: float) -> str:
    """A difference of twice the log likelihood in words; 2 ln 150 = 10 is the usual 'very strong'."""
    if difference < 2:
        return "hardly worth mentioning"
    if difference < 6:
        return "a slight advantage"
    return "a clear advantage" if difference < 10 else "a very clear advantage"


def _plus_minus(low: float, high: float) -> str:
    half = 50 * (high / low - 1) if low > 0 else float("inf")
    return f"±{number(half, 2)} %" if half < 100 else "a factor of two at best"


def _good(result: LogIdentification) -> list[str]:
    about, spread = result.about, result.spread
    sentences = []
    fits = about.fit_validation_percent
    if fits:
        each = listing([f"{percent(fit)} ({name})" for name, fit in fits.items()])
        inside = "" if about.band_rad_s is None else " inside the band"
        sentences.append(f"Run freely on fresh records, the model reproduces {each} of the output{inside}.")
    used = listing([f"{percent(fit)} ({name})" for name, fit in about.fit_estimation_percent.items()])
    sentences.append(f"On the records it was fitted to: {used}.")
    level = percent(100 * spread.level, 4)
    sentences.append(f"The {level} ellipses of the response are {band_words(spread.bands)}.")
    if all(test.passed for test in spread.tests):
        sentences.append(
            "The residuals pass both tests, white and independent of the input: nothing linear is left."
        )
    if about.two_stage:
        sentences.append(sentence(about.two_stage))
    return sentences


def _careful(result: LogIdentification) -> list[str]:
    items = list(result.careful)
    if not result.fresh:
        items.append(
            "no record was kept back: how the model does on fresh data is not known; measure one more with "
            "another input and give it as --validation"
        )
    elif (worst := min(result.fresh, key=lambda fit: fit.fit_percent)).fit_percent < 50:
        items.append(
            f"on {worst.name} the model misses more than half of the output: look at the residual below; dry "
            "friction, drift or another operating point are common causes"
        )
    return [
        *items,
        *unknown_bands(result.spread.bands),
        "the level of the ellipses holds at each frequency taken alone, and for the machine as it was in "
        "these records: same amplitude, payload and temperature",
    ]


# Sections


def _modes(result: LogIdentification) -> Section:
    tables = pole_tables(result.about, result.found.model.dt_s, result.spread.intervals)
    caption = "Intervals are those of the ellipses: noise, initial state and unmodelled rest included."
    blocks: list[Block] = [*tables, Text(caption)] if tables else [Text("The model has no pole.")]
    return Section("modes", "Modes and poles", "Modes", tuple(blocks))


def _response(result: LogIdentification) -> Section:
    spread = result.spread
    level = percent(100 * spread.level, 4)
    return Section(
        "response",
        "Frequency response",
        "Response",
        (
            Plot(
                "bode",
                f"Identified response with the range of gain and phase over its {level} ellipses, the size "
                "of the ellipses beside the gain, and what the records say without a model.",
            ),
            band_table(spread.bands),
        ),
    )


def _order(result: LogIdentification) -> Section:
    blocks: list[Block] = []
    if result.plot is not None and result.found.order_table:
        blocks.append(Plot("order", STABILISATION_CAPTION))
    blocks += order_table(result.about, result.options) or [Text(who_chose(result.options))]
    return Section("order", "How many poles", "Order", tuple(blocks))


def _poles(result: LogIdentification) -> Section:
    zeros = result.found.model.zeros()
    outside = int(np.count_nonzero(np.abs(zeros) > 1))
    text = f"The model has {count(zeros.size, 'zero')}"
    if outside:
        text += (
            f", {outside} of them outside the unit circle: the response is of non-minimum phase (or its "
            "samples are), which limits the bandwidth of any loop around it"
        )
    elif zeros.size:
        text += ", none of them outside the unit circle"
    blocks: list[Block] = [
        Plot("poles", "Poles (crosses) and zeros (circles) in the z-plane, and near z = 1."),
        Text(text + "."),
    ]
    log = np.log(zeros[(zeros.imag > 1e-9) & (np.abs(zeros) > 0.05)]) / result.found.model.dt_s
    pairs = sorted((abs(s), -s.real / abs(s)) for s in log if abs(s.real) < _LIGHT * abs(s))
    rows = tuple((number(omega / (2 * np.pi), 4), number(omega, 4), number(zeta)) for omega, zeta in pairs)
    if rows:
        head = ("zero pair (antiresonance): frequency [Hz]", "[rad/s]", "damping ratio [1]")
        blocks.append(Table(head, rows))
    return Section("poles", "Poles and zeros", "Poles", tuple(blocks))


def _fresh(result: LogIdentification) -> Section:
    caption = "Measured output and free run of the model, and the difference."
    if not result.fresh:
        caption += " There is no fresh record; this one was used in the fit."
    blocks: list[Block] = [Plot("validation", caption)]
    if len(result.fresh) > 1:
        rows = tuple((fit.name, number(fit.fit_percent, 4)) for fit in result.fresh)
        blocks.append(Table(("fresh record", "fit [%]"), rows))
    title = "On fresh data" if result.fresh else "On the data of the fit"
    return Section("fresh", title, "Fresh data" if result.fresh else "Fit", tuple(blocks))


def _residuals(result: LogIdentification) -> Section:
    return Section(
        "residuals",
        "What the model leaves",
        "Residuals",
        (Plot("residuals", residual_caption(result.spread)), *test_remarks(result.spread.tests)),
    )


def _records(result: LogIdentification) -> Section:
    rows = tuple(
        (
            str(index),
            item.record.name,
            item.role,
            f"{item.record.n_samples}",
            number(item.record.n_samples * item.record.dt_s),
        )
        for index, item in enumerate(_shown(result), 1)
    )
    blocks: list[Block] = [
        Plot(
            "records", "All records one after another on one time axis; shading says what each is used for."
        ),
        Table(("no.", "record", "used for", "samples", "length [s]"), rows),
    ]
    return Section("records", "Records", "Records", tuple(blocks))


def _reproduce(result: LogIdentification, inputs: Mapping[str, str]) -> Section:
    changed = [
        (name, str(getattr(result.options, name)))
        for name, field in type(result.options).model_fields.items()
        if getattr(result.options, name) != field.default
    ]
    versions = [(name, metadata.version(name)) for name in ("flexlink", "numpy", "scipy", "nlopt")]
    rows = (*changed, *versions, ("python", sys.version.split()[0]))
    blocks: list[Block] = [
        Table(("option or version", "value"), rows, "Options that are not named stand at their defaults."),
        Table(("input file", "SHA-256"), tuple(inputs.items())),
    ]
    blocks += maybe(("The result is deterministic: the same files and options give the same page.",), "note")
    return Section("reproduce", "To reproduce this", "Reproduce", tuple(blocks))


# Pictures


def _drawers(result: LogIdentification) -> dict[str, Callable[[], Figure]]:
    drawers = {
        "bode": lambda: _draw_bode(result),
        "poles": lambda: _draw_poles(result),
        "validation": lambda: _draw_validation(result),
        "residuals": lambda: _draw_residuals(result),
        "records": lambda: _draw_records(result),
    }
    plot, steps = result.plot, result.found.order_table
    if plot is not None and steps:
        drawers["order"] = lambda: draw_order(
            steps, (plot.n_real, plot.chosen), plot, name=result.about.name, response=_empirical(result)
        )
    return drawers


def _empirical(result: LogIdentification) -> EmpiricalResponse | None:
    if result.empirical is None:
        return None
    return EmpiricalResponse(result.empirical.omega_rad_s, result.empirical.centre)


def _draw_bode(result: LogIdentification) -> Figure:
    about = result.about
    return draw_bode(
        result.frequency,
        name="Response",
        input_label=(about.input, ""),
        output_label=(about.output, ""),
        model=result.found.model,
        empirical=_empirical(result),
    )


def _draw_poles(result: LogIdentification) -> Figure:
    model = result.found.model
    return draw_poles(
        model.dt_s,
        identified=model.poles.values,
        integrators=model.integrators,
        zeros=model.zeros(),
        name=result.about.name,
    )


def _draw_validation(result: LogIdentification) -> Figure:
    found = result.found
    if not result.fresh:
        record = result.used[0]
        fit = fit_on_fresh_data(found.model, record)
        return draw_validation(record, fit, kept_as="estimation", noise_std=found.noise_std)
    return draw_validation(
        result.fresh_records[0], result.fresh[0], kept_as="validation", noise_std=found.noise_std
    )


def _draw_residuals(result: LogIdentification) -> Figure:
    white, independent = (result.spread.test(name) for name in ("whiteness", "independence"))
    return draw_residual_tests(white, independent, name=result.about.name)


def _shown(result: LogIdentification) -> list[ShownRecord]:
    return [
        *(ShownRecord(record, "estimation") for record in result.measured),
        *(ShownRecord(record, "validation") for record in result.fresh_records),
    ]


def _draw_records(result: LogIdentification) -> Figure:
    return draw_records(_shown(result), [result.about.input], [result.about.output])
