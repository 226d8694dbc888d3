"""A certificate: verdict, margins, requirements, modes of the closed loop, crossovers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import reduce
from typing import TYPE_CHECKING, Any

from control_design.analysis.certificate import Certificate, PlantVerdict
from control_design.analysis.margins import Margins
from workflow.describe.controller import crossover_rows, crossover_table
from workflow.describe.design import calibration, gave_way_beside, sampled
from workflow.describe.facts import (
    Block,
    Bound,
    Code,
    Fold,
    Heading,
    PageSection,
    Quantity,
    Remarks,
    Row,
    Section,
    Table,
    Text,
    said,
    worded,
)
from workflow.tasks.design import joint_numbers
from workflow.tasks.results import CertifyResult, RunResults
from workflow.text.formats import (
    MISSING,
    at_least,
    at_most,
    both_frequencies,
    bound,
    count,
    decibels,
    frequency,
    hertz,
    in_decibels,
    number,
    sentence,
    share,
    si,
    unit,
    yes_no,
)
from workflow.text.sentences.certificate import (
    checked,
    item_value,
    limited_loops,
    met,
    not_checked,
)

if TYPE_CHECKING:
    from workflow.figures.subjects import RunView

# Where the rows of `margins_by_key` stand in the JSON answer.
WORST_AT = "certificate.worst"
NOMINAL_AT = "certificate.nominal"
# Anchor, title and short name of two sections of a page.
UNCHECKED = ("unchecked", "What was not checked", "Not checked")
_MARGINS = ("margins", "Margins and certificate", "Margins")
NOT_ON_THE_MACHINE = "The controller has not run on the real machine."
# Modes of the closed loop with a larger damping ratio need no word: they overshoot by less than 25 %.
_DAMPED = 0.4


def margins_text(found: Margins) -> str:
    """Margins of a loop in one line, each rounded down."""
    gain = phase = delay = "unlimited"
    if math.isfinite(found.gain_up):
        gain = f"{at_least(in_decibels(found.gain_up), 4)} dB"
    if math.isfinite(found.phase_rad):
        phase = f"{at_least(math.degrees(found.phase_rad))} deg"
    if math.isfinite(found.delay_s):
        delay = f"{at_least(1000 * found.delay_s, 4)} ms"
    return f"gain {gain}, phase {phase}, modulus {at_least(found.modulus, 4)}, delay {delay}"


def weakest_plant(certificate: Certificate) -> PlantVerdict:
    """The first plant whose nominal loop is unstable, else that with the least modulus margin."""
    for plant in certificate.plants:
        if not plant.stable:
            return plant
    return min(certificate.plants, key=lambda plant: plant.worst_margins.modulus)


def certified_bandwidth_rad_s(certificate: Certificate) -> float:
    """Up to here every plant has |S| below -3 dB; nan where a nominal loop is unstable."""
    weakest = weakest_plant(certificate)
    if not weakest.stable:
        return weakest.bandwidth_rad_s
    return min(plant.bandwidth_rad_s for plant in certificate.plants)


def least_distance(certificate: Certificate) -> float:
    """Least distance of the loop from -1 over all plants: on the grid and, where it was proved, between."""
    weakest = weakest_plant(certificate)
    proof = weakest.all_frequencies
    # No margin is larger than 1, so what was not proved limits nothing.
    proved = proof.distance if proof.proved else math.inf
    return min(weakest.worst_margins.modulus, proved)


def bandwidth_row(certificate: Certificate, remark: str) -> Row:
    """Certified bandwidth."""
    bandwidth = certified_bandwidth_rad_s(certificate)
    value = Quantity("none", None, "rad/s")
    if bandwidth > 0:
        value = Quantity.of(bandwidth, "rad/s", bound=Bound.AT_LEAST)
    return Row("certificate.bandwidth_rad_s", "bandwidth", value, remark)


def modulus_row(certificate: Certificate, required: float) -> Row:
    """Certified distance from -1, beside the one required."""
    weakest = weakest_plant(certificate)
    value = Quantity("none", None)
    if weakest.worst_margins.modulus > 0:
        value = Quantity.of(least_distance(certificate), bound=Bound.AT_LEAST)
    place_Hz = number(hertz(weakest.worst_margin_omega_rad_s))
    remark = f"required: {number(required)}; smallest at {place_Hz} Hz"
    return Row("certificate.modulus_margin", "modulus margin", value, remark)


def margin_rows(certificate: Certificate) -> tuple[Row, ...]:
    """Worst-case margins of each plant whose nominal loop is stable."""
    return tuple(
        Row("", "margins", Quantity.words(margins_text(plant.worst_margins)), "worst case")
        for plant in certificate.plants
        if plant.stable
    )


def margins_by_key(certificate: Certificate) -> tuple[Row, ...]:
    """Worst-case gamma, and the margins of the worst case and of the nominal loop, for readers by key.

    Keys begin with `WORST_AT` and `NOMINAL_AT`. Of several plants the worst case is the least of each margin,
    the nominal loop that of the first. None: unlimited, or not known since a nominal loop is unstable.
    """
    bound = certificate.gamma_bound
    gamma = certificate.gamma if bound is None else bound
    worst = reduce(Margins.worse, (plant.worst_margins for plant in certificate.plants))
    nominal = certificate.plants[0].nominal_margins
    return (
        Row(f"{WORST_AT}.gamma", "worst-case gamma", Quantity.of(gamma, digits=4, bound=Bound.AT_MOST)),
        *_each_margin(WORST_AT, worst, "worst case"),
        *_each_margin(NOMINAL_AT, nominal, "nominal"),
    )


def _each_margin(place: str, margins: Margins, of: str) -> tuple[Row, ...]:
    """A row for each margin; an infinite one is unlimited."""
    # A gain may rise up to one factor and fall down to another: the margin is the nearer of the two.
    factors = [margins.gain_up] if math.isfinite(margins.gain_up) else []
    if margins.gain_down:
        factors.append(1.0 / margins.gain_down)
    smallest = min(factors, default=0.0)
    gain_dB = 20 * math.log10(smallest) if smallest > 0 else None
    phase_deg = math.degrees(margins.phase_rad) if math.isfinite(margins.phase_rad) else None
    delay_ms = 1e3 * margins.delay_s if math.isfinite(margins.delay_s) else None
    rows = []
    for name, words, value, unit_of_value in (
        ("modulus_margin", "modulus margin", margins.modulus, ""),
        ("gain_margin_dB", "gain margin", gain_dB, "dB"),
        ("phase_margin_deg", "phase margin", phase_deg, "deg"),
        ("delay_margin_ms", "delay margin", delay_ms, "ms"),
    ):
        quantity = Quantity.of(value, unit_of_value, digits=4, bound=Bound.AT_LEAST, missing="unlimited")
        rows.append(Row(f"{place}.{name}", words, quantity, of))
    return tuple(rows)


def certificate_section(
    certify: CertifyResult, shares: Mapping[str, Any] | None, covers: str = "", *, whole: bool = True
) -> Section:
    """Verdict, margins and requirements of a certificate.

    Args:
        certify: Result of the stage.
        shares: Numbers of the sampled responses (`joint_numbers`).
        covers: What it is about; "" where that is said elsewhere.
        whole: Margins, too, and the requirements that are met; a run shows the margins before.
    """
    certificate = certify.certificate
    drawn = sampled(certify.sampled, shares)
    more = calibration(certify.sampled)
    posterior = worded("posterior samples", f"{drawn}; {more}" if more else drawn)
    if certificate is None:
        return Section("certificate", said(worded("none", "there is no controller"), posterior))
    rows: list[Row] = [worded("covers", covers), _verdict_row(certify, certificate)]
    for plant in certificate.plants:
        if plant.stable:
            if whole:
                rows.append(worded("margins, nominal", margins_text(plant.nominal_margins)))
                rows.append(worded("margins, worst case", margins_text(plant.worst_margins)))
            bandwidth = at_least(plant.bandwidth_rad_s, 4)
            rows.append(worded("bandwidth", f"{bandwidth} rad/s (|S| below -3 dB for every plant)"))
        for mode in plant.closed_loop_modes:
            if mode.zeta < _DAMPED:
                place = f"{number(hertz(mode.omega_rad_s), 4)} Hz"
                rows.append(worded("closed-loop mode", f"{place}, damping {number(mode.zeta)}"))
    for item in certificate.items:
        if whole or not item.met:
            rows.append(worded(item.requirement, f"{item_value(item)}: {met(item)}"))
    rows += [worded("at the limits", limited_loops(certificate)), posterior]
    for plant in certificate.plants:
        rows += crossover_rows(plant)
    return Section("certificate", said(*rows))


def not_checked_section(certify: CertifyResult) -> Section:
    """What a certificate leaves open."""
    if certify.certificate is None:
        return Section("not checked")
    left = not_checked(certify.certificate, sampled=certify.sampled.joint is not None)
    return Section("not checked", tuple(worded("", sentence) for sentence in left))


def _verdict_row(certify: CertifyResult, certificate: Certificate) -> Row:
    if certify.certified:
        return worded("verdict", "certified")
    why = ""
    unstable = ", ".join(plant.plant for plant in certificate.plants if not plant.stable)
    if unstable:
        why = f": nominal closed loop unstable ({unstable})"
    elif all(item.met for item in certificate.items):
        why = f": {certify.reason}"
    return worded("verdict", f"NOT certified{why}")


def unchecked_page(results: RunResults) -> PageSection:
    """What neither certificate nor simulation of one loop speaks about."""
    certificate = results.certify.certificate
    check = results.closed_loop.check
    items = ["Without a controller, nothing about a closed loop was checked."]
    if certificate is not None:
        with_friction = check is not None and check.friction is not None
        sampled_too = results.certify.sampled.joint is not None
        left = not_checked(certificate, sampled=sampled_too, friction=with_friction)
        items = [sentence(text) for text in left]
        if check is not None and check.machine != "simulated":
            items.append(NOT_ON_THE_MACHINE)
    return PageSection(*UNCHECKED, (Remarks(tuple(items), "plain"),))


def margins_page(view: RunView, *, is_design: bool) -> PageSection:
    """Margins and requirements of a certificate, and what was checked.

    Args:
        view: The run.
        is_design: The page stands away from the run's files, and names none of them.
    """
    certificate = view.results.certify.certificate
    if certificate is None:
        return PageSection(*_MARGINS, (Text("There is no controller to certify."),))
    blocks: list[Block] = []
    for plant in certificate.plants:
        blocks += _margins_of(plant, view)
    if not is_design and any(plant.stable for plant in certificate.plants):
        blocks.append(_in_python_control(view))
    several = len(certificate.plants) > 1
    blocks.append(_requirements_table(certificate, view, several=several))
    modes = [(plant, mode) for plant in certificate.plants for mode in plant.closed_loop_modes]
    if modes:
        rows = []
        for plant, mode in modes:
            of_plant = f"{plant.plant}: " if several else ""
            rows.append(
                (of_plant + number(hertz(mode.omega_rad_s)), number(mode.omega_rad_s), number(mode.zeta))
            )
        head = ("mode of the nominal closed loop [Hz]", "[rad/s]", "damping ratio [1]")
        blocks.append(Table(head, tuple(rows)))
    blocks += _samples_of(view)
    checked_too = tuple(sentence(text) for text in checked(certificate))
    blocks.append(Remarks(checked_too, "plain", "What was checked"))
    return PageSection(*_MARGINS, tuple(blocks))


def _margins_of(plant: PlantVerdict, view: RunView) -> list[Block]:
    if not plant.stable:
        radius = at_most(plant.pole_radius, 6)
        return [
            Text(
                f"Plant {plant.plant}: the nominal loop is unstable (largest pole radius {radius}), so it "
                "has no margins."
            )
        ]
    delay = view.specification.computational_delay_samples
    in_loop = count(delay, "sample") if delay else "none"
    caption = (
        f"{plant.plant}: closest to -1 at {frequency(plant.worst_margin_omega_rad_s)}; largest closed-loop "
        f"pole radius {at_most(plant.pole_radius, 6)}. Nominal: at the centres of the ellipses. "
        f"Computational delay in the loop: {in_loop}."
    )
    pair = (plant.nominal_margins, plant.worst_margins)
    rows = (
        ("modulus margin [1]", *(at_least(each.modulus) for each in pair)),
        ("gain may rise by", *(decibels(each.gain_up) for each in pair)),
        ("gain may fall to", *(decibels(each.gain_down, False) for each in pair)),
        ("phase margin [deg]", *(at_least(math.degrees(each.phase_rad)) for each in pair)),
        ("delay margin [ms]", *(at_least(1000 * each.delay_s) for each in pair)),
    )
    head = ("margin", "nominal", f"worst case over the {share(view.certified_level)} ellipses")
    return [Table(head, rows, caption), *crossover_table(plant)]


def _in_python_control(view: RunView) -> Fold:
    """The margins by python-control, from the files of the run, and what it prints."""
    delay = view.specification.computational_delay_samples
    about_delay = "Without computational delay both are the same."
    if delay:
        about_delay = "The margins of this page are those of K_with_delay."
    factor = f"{view.loop_factor} * " if view.loop_factor != 1 else ""
    typed = (
        "import control, json, numpy, pathlib; G, K = (json.loads(pathlib.Path(name).read_text()) for name "
        'in ("model.json", "controller.json")); ss = lambda part: control.ss(*map(part.get, ("A", "B", "C", '
        '"D", "dt_s")))\n'
        'for name in ("K_with_delay", "K_without_delay"): print(name, '
        f"*control.stability_margins(control.frd({factor}ss(G) * ss(K[name]), numpy.geomspace(1e-4, 1, 9999) "
        '* numpy.pi / G["dt_s"]))[:3])'
    )
    margins_of = view.model_margins()
    printed = ""
    at_ends = []
    for name, (values, at_end) in margins_of.items():
        digits = " ".join(number(value, 4) for value in values)
        printed += f"{name} {digits}\n"
        if at_end:
            at_ends.append(
                Text(
                    f"{name} has its gain margin, {number(values[0], 4)}, at the end of the frequencies "
                    "(zero or Nyquist). python-control does not look there and prints another."
                )
            )
    blocks: list[Block] = [
        Text(
            "Gain (a factor), phase [deg] and modulus margin of the nominal model (model.json), which "
            f"differs a little from the centres of the ellipses. {about_delay}"
        ),
        Code(typed, typed=True),
        Code(printed),
        *at_ends,
    ]
    if view.loop_factor != 1:
        blocks.append(
            Text(
                f"The factor {number(view.loop_factor, 6)}: the controller's files take and give the columns "
                "as logged, the model is in quantities."
            )
        )
    return Fold("The same in python-control: two lines for the run's directory", tuple(blocks))


def _requirements_table(certificate: Certificate, view: RunView, *, several: bool) -> Table:
    rows = []
    for item in certificate.items:
        name = (f"{item.plant}: " if several else "") + item.requirement
        reached = yes_no(item.met)
        if item.met and item.at_least and item.achieved < item.required:
            reached += " (to the solver's accuracy)"
        concession = gave_way_beside(item.requirement, view.gave_way)
        achieved = bound(item.achieved, item.at_least)
        rows.append(
            (
                f"{name} {concession}".rstrip(),
                si(item.required, item.unit),
                unit(achieved, item.unit),
                both_frequencies(item.omega_rad_s),
                bound(item.bound, item.at_least),
                reached,
            )
        )
    return Table(
        ("requirement", "required", "achieved", "at [rad/s (Hz)]", "proved", "met?"),
        tuple(rows),
        "Achieved: on the dense grid of frequencies. Proved: bound at all frequencies.",
        tuple(item.met for item in certificate.items),
    )


def _samples_of(view: RunView) -> list[Block]:
    """For how many models drawn from the posterior the worst case holds."""
    drawn_models = view.results.certify.sampled
    joint = drawn_models.joint
    if joint is None:
        return [Text(sentence(drawn_models.reason))] if drawn_models.reason else []
    blocks: list[Block] = [Heading("Models drawn from the posterior")]
    calibration_words = sentence(calibration(drawn_models))
    too_few_held = joint.level > joint.given_level and not drawn_models.calibrated
    if too_few_held:
        blocks.append(Remarks((calibration_words,), "warning"))
    elif calibration_words:
        blocks.append(Text(calibration_words))
    shares = joint_numbers(drawn_models)
    held = " to ".join(share(end) for end in shares["held_interval"])
    stable = " to ".join(share(end) for end in shares["stable_interval"])
    given_level = share(joint.given_level)
    rows = (
        (
            f"worst case of the {given_level} ellipses",
            at_most(joint.gamma_given, 4),
            f"{share(joint.coverage_given)} ({held})",
        ),
        (
            f"worst case of ellipses of {share(joint.level)}",
            at_most(joint.gamma, 4),
            share(joint.coverage),
        ),
        ("stable loop", MISSING, f"{share(joint.stable_share)} ({stable})"),
        (f"inside the {given_level} ellipse at every frequency", MISSING, share(joint.simultaneous_given)),
    )
    head = ("statement", "gamma [1]", f"share of {joint.draws} samples")
    return [*blocks, Table(head, rows, "Brackets: 95 % interval.")]
