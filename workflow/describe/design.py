"""A design: what came out, what gave way, what any order could reach, the reference filter, the verdicts."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from control_design.analysis.certificate import Certificate
from control_design.specification import Specification
from control_design.synthesis.synthesis_result import SynthesisResult
from ident.data.finding import Finding
from workflow.describe.controller import controller_blocks
from workflow.describe.facts import (
    Block,
    Copy,
    Heading,
    PageSection,
    Picture,
    Remarks,
    Section,
    Table,
    Text,
    said,
    worded,
)
from workflow.describe.friction import settling_range, waits
from workflow.tasks.design_source import DesignSource
from workflow.tasks.giving_way import GaveWay, gave_way
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    ClosedLoopResult,
    DesignResult,
    LoopCheck,
    ReferenceFilterResult,
    SampledResponses,
)
from workflow.text.findings.sentences import words
from workflow.text.formats import at_least, at_most, count, frequency, number, sentence, share, si
from workflow.text.sentences import design as sentences
from workflow.text.sentences.certificate import damping_lost, requirement

if TYPE_CHECKING:
    from workflow.figures.subjects import RunView

NO_STABLE_LOOP = (
    "No start led to a stable loop: nothing is certified or simulated. Lower bandwidth_rad_s, raise "
    "controller_order (of a PID: fix less of it), or improve the model where its ellipses are widest."
)
# Quotient of two model-matching errors up to which a reference filter is no improvement: it reads 1.00.
_NO_IMPROVEMENT = 1.005


def any_order(achievable: AchievablePerformance, gamma: float | None, order: int | str) -> str:
    """How far the order chosen is from what a controller of any order is known to reach."""
    return sentences.any_order(achievable.bracket, achievable.reason, gamma, order)


def gave_way_text(found: Sequence[GaveWay]) -> str:
    """What gave way beside the bandwidth: "effort_limit = 2.31 in place of 2.2"."""
    concessions = []
    for item in found:
        # The sentence on the bandwidth says its own.
        if item.key != "bandwidth_rad_s":
            concessions.append(f"{item.key} = {number(item.used)} in place of {number(item.asked)}")
    return ", ".join(concessions)


def gave_way_beside(caption: str, found: Sequence[GaveWay]) -> str:
    """What of a requirement gave way, behind its caption in a certificate."""
    concessions = []
    for item in found:
        if item.caption == caption:
            values = f"{number(item.used)} in place of {number(item.asked)}"
            concessions.append(f"({item.key} gave way: {values})")
    return " ".join(concessions)


def sampled(found: SampledResponses, shares: Mapping[str, Any] | None) -> str:
    """For how many sampled responses the worst case of the ellipses holds.

    Args:
        found: Of the certificate.
        shares: Intervals of the shares (`joint_numbers`), to be said, too; None: not.
    """
    if found.joint is None:
        return found.reason or ""
    if shares is None:
        return sentences.held_by_samples(found.joint)
    return sentences.held_by_samples(found.joint, shares["held_interval"], shares["stable_interval"])


def calibration(found: SampledResponses) -> str:
    """What was done about sampled responses beyond the worst case, or could be."""
    joint = found.joint
    if joint is None or not math.isfinite(joint.gamma_given):
        return ""
    worst = f"γ = {at_most(joint.gamma, 4)}"
    if found.calibrated and joint.level <= joint.given_level:
        return f"the ellipses were certified as they are: {share(joint.level)} would do"
    if found.calibrated:
        return (
            f"certified over ellipses of {share(joint.level)}, whose worst case {at_most(joint.gamma, 4)} "
            f"holds for {share(joint.coverage)}"
        )
    if joint.level > joint.given_level:
        return (
            f"fewer than {share(joint.coverage)} stay within this worst case: {worst} (ellipses of "
            f"{share(joint.level)}) would hold for that many ([certificate] calibrate = true)"
        )
    return ""


def reference_filter(result: ReferenceFilterResult) -> str:
    """What a reference filter gains, or why there is none."""
    designed = result.filter
    if designed is None:
        return result.reason or ""
    gained = ""
    if designed.error_after > 0:
        gain = designed.error_before / designed.error_after
        gained = ": no improvement" if gain < _NO_IMPROVEMENT else f", {number(gain)} times smaller"
    after = number(designed.error_after, 4)
    before = number(designed.error_before, 4)
    return (
        f"reference filter of order {designed.order}: largest weighted model-matching error {after} with it, "
        f"{before} without{gained} (largest at {frequency(designed.worst_rad_s, 4)})"
    )


def filter_section(result: ReferenceFilterResult) -> Section:
    """The reference filter."""
    name = "none" if result.filter is None else "model matching"
    return Section("reference filter", said(worded(name, reference_filter(result))))


def plants_section(sources: Sequence[DesignSource]) -> Section:
    """Plants from files, with where each comes from and what is to know of it."""
    rows = []
    for source in sources:
        rows.append(worded(source.plant.name, source.origin))
        rows += [worded("", remark) for remark in source.remarks]
    return Section("plants", said(*rows))


def design_section(
    design: DesignResult,
    achievable: AchievablePerformance,
    order: int | str,
    *,
    bandwidth: str = "",
    given_way: Sequence[GaveWay] = (),
    tracking: str = "",
    files: str = "",
    advice: str = "",
) -> Section:
    """Outcome of a design, and what it was designed for where that is less than asked.

    Args:
        design: Result of the stage.
        achievable: What any order reaches.
        order: Of the controller.
        bandwidth: What `lowered` says.
        given_way: What else gave way.
        tracking: What `tracking_begins` says.
        files: Columns and units of the controller's files, where they are not plain.
        advice: Whether a higher order helps.
    """
    return Section(
        "design",
        said(
            worded("outcome", design.reason),
            worded("posterior samples", design.jointly or ""),
            worded("controller order", any_order(achievable, design.gamma, order)),
            worded("order", advice),
            worded("bandwidth", bandwidth),
            worded("gave way", gave_way_text(given_way)),
            worded("tracking", tracking),
            worded("controller files", files),
        ),
    )


def run_verdict(
    design: DesignResult,
    certify: CertifyResult,
    loop: ClosedLoopResult,
    achievable: AchievablePerformance | None = None,
    order: int | str | None = None,
    untold_rad_s: float = 0.0,
    conditions: Iterable[Finding] = (),
    asked: Specification | None = None,
    modes_rad_s: Sequence[float] | None = None,
) -> str:
    """The verdict on a run in one line: certified, or what is missed, by how much and where.

    Args:
        design: Result of its stage.
        certify: Result of its stage.
        loop: Result of its stage.
        achievable: Where it is given, it is said whether a higher order would help.
        order: Of the controller.
        untold_rad_s: Up to here the ellipses are wider than the gain; 0: nowhere.
        conditions: What the certificate stands or falls with.
        asked: The specification as it was asked, where less was designed for.
        modes_rad_s: Of the identified models, whose lost damping is said; None: all of the plant.
    """
    untold = sentences.untold(untold_rad_s)
    advice = ""
    if achievable is not None and order is not None and design.gamma is not None:
        structure = "biquads" if asked is None else asked.structure
        advice = sentences.order_advice(achievable.bracket, design.gamma, order, structure)
    check = loop.check
    if not design.met:
        said_of = _joined(f"specification not met: {design.reason}", untold or advice)
    elif not certify.certified:
        said_of = _joined(f"not certified: {certify.reason}", untold)
    elif check is None:
        said_of = f"not simulated in closed loop: {loop.skipped}"
    elif check.settled_draws != check.draws:
        unsettled = check.draws - check.settled_draws
        said_of = (
            f"the closed loop did not settle in {unsettled} of {check.draws} runs; {watch_longer(check)}"
        )
    else:
        said_of = _met(design, check, asked)
        doubts = ". Also, ".join(words(doubt) for doubt in conditions)
        if doubts:
            said_of += f". But {doubts}"
    lost = "" if certify.certificate is None else damping_lost(certify.certificate, modes_rad_s)
    return _joined(said_of, lost)


def _met(design: DesignResult, check: LoopCheck, asked: Specification | None) -> str:
    """Everything is met: for what, and how the closed loop behaves."""
    used = design.specification
    said_of = "certified: every requirement is met"
    given_way = ""
    begins = ""
    if asked is not None:
        if used is not None and sentences.lowered(asked, used, (), 0):
            low, high = number(asked.lowest_bandwidth_rad_s), number(asked.bandwidth_rad_s)
            said_of += (
                f" for a bandwidth of {number(used.bandwidth_rad_s)} rad/s (specified: {low} to {high})"
            )
        given_way = gave_way_text(gave_way(asked, used))
        begins = sentences.tracking_begins(asked, used)
    if given_way:
        said_of += f", with {given_way}"
    settles = "the closed-loop run settles"
    if check.draws > 1:
        settles = f"all {check.draws} closed-loop runs settle"
    said_of += f", and {settles}"
    if check.friction is not None and check.machine != "simulated":
        settling = check.friction.settling
        within = f"not in {si(settling.watched_s, 's', 2)}"
        if settling.settled_s:
            within = f"in {settling_range(settling)}"
        said_of += f" (linear; with dry friction {within})"
    return _joined(said_of, waits(check), begins)


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)


def watch_longer(check: LoopCheck) -> str:
    """What to do where a run did not settle in the time that was simulated."""
    return (
        f"{si(check.time_s[-1], 's', 2)} were simulated: if a slow mode needs longer, set "
        "closed_loop.duration_s, or fit one pair less if the machine has no such mode"
    )


def never_settles(check: LoopCheck) -> str:
    """A certified run whose closed loop stops beside the reference."""
    missed = sum(row.settling_time_s is None for row in check.achieved)
    never = "never settles" if missed == 1 else "never settle"
    return f"certified, but {missed} of {check.draws} runs {never} to 2 % of the step"


def design_verdict(
    design: DesignResult,
    certificate: Certificate | None,
    advice: str | None,
    asked: Specification | None = None,
    given_way: Sequence[GaveWay] = (),
) -> str:
    """The verdict on a design for plants from files in one line."""
    if certificate is None:
        if design.synthesis is None:
            return design.reason
        return (
            f"{design.reason}: there is no controller. Lower bandwidth_rad_s, raise controller_order (of a "
            "PID: fix less of it), or improve the model where its ellipses are widest"
        )
    if certificate.certified:
        concessions = gave_way_text(given_way)
        parts = [design.reason]
        if asked is not None:
            parts.append(sentences.lowered(asked, design.specification, (), 0))
        if concessions:
            parts.append(f"with {concessions}")
        if asked is not None:
            parts.append(sentences.tracking_begins(asked, design.specification))
        said_of = "; ".join(part for part in parts if part)
    else:
        unstable = "".join(
            f"{plant.plant}: nominal closed loop unstable; "
            for plant in certificate.plants
            if not plant.stable
        )
        missed = "; ".join(requirement(item) for item in certificate.items if not item.met)
        said_of = f"not certified: {unstable}{missed or 'unstable, or an ellipse reaches -1'}"
        said_of = _joined(said_of, advice or "")
    lost = damping_lost(certificate)
    return f"{said_of}; {lost}" if lost else said_of


def guard_verdict(
    certify: CertifyResult,
    worse: Sequence[tuple[str, str, float, float, str]],
    baseline: object,
    written: object,
    conditions: str,
) -> str:
    """The verdict on a controller that was there before: its certificate, and what is worse than it was.

    Args:
        certify: Its certificate.
        worse: Plant, name, value and value held of every number that is worse than in the baseline.
        baseline: The file; None without one.
        written: File of the new baseline; None: none is written.
        conditions: What the certificate stands or falls with.
    """
    if not certify.certified:
        return _joined(f"not certified: {certify.reason}", f"{written} is not written" if written else "")
    if worse:
        numbers = []
        for plant, name, value, held, _ in worse:
            numbers.append(f"{plant} {name} {number(value, 4)} ({number(held, 4)})")
        is_written = f"written to {written}" if written else ""
        return _joined(f"certified, but worse than {baseline}: {', '.join(numbers)}", is_written)
    said_of = "certified: every requirement is met"
    if baseline:
        said_of += f", and nothing is worse than in {baseline}"
    if written:
        said_of += f", written to {written}"
    return f"{said_of}. But {conditions}" if conditions else said_of


def design_page(view: RunView) -> PageSection:
    """What was asked of the controller of a run of one loop, and what came out."""
    results = view.results
    design = results.design
    synthesis = design.synthesis
    asked = view.specification
    delay = count(asked.computational_delay_samples, "sample")
    stated = asked.model_dump(exclude_defaults=True)
    to_be = "to be " if synthesis is None else ""
    starts = ""
    if isinstance(synthesis, SynthesisResult):
        stable = sum(start.stable for start in synthesis.starts)
        starts = f" from {count(len(synthesis.starts), 'start')} ({stable} stable)"
    stated_rows = tuple((key, json.dumps(value)) for key, value in stated.items())
    blocks: list[Block] = [
        Text(
            f"A controller of order {asked.controller_order} ({asked.structure}) with {delay} of "
            f"computational delay was {to_be}optimised over the ellipses{starts}."
        ),
        Table(("specified", "value"), stated_rows),
    ]
    if synthesis is None:
        blocks.append(Remarks((sentence(design.reason),), "warning", "No controller was designed"))
    elif design.controller is None:
        blocks.append(Remarks((NO_STABLE_LOOP,), "warning"))
        blocks += _any_order_blocks(results.achievable_performance, None, asked.controller_order)
    else:
        blocks += _loop_pictures(view)
        blocks += _any_order_blocks(results.achievable_performance, design.gamma, asked.controller_order)
        as_logged = view.signals if "as logged" in view.signals else ""
        blocks += controller_blocks(view.engineers_numbers, asked.computational_delay_samples, as_logged)
        blocks.append(
            Copy(
                "Controller K to copy: zeros and poles, transfer function, second-order sections (limits and "
                "anti-windup: controller.json)",
                view.forms(view.logged_controller),
                view.plant.dt_s,
                delay=asked.computational_delay_samples,
            )
        )
        blocks += _filter_blocks(view)
    return PageSection("design", "Controller design", "Design", tuple(blocks))


def _loop_pictures(view: RunView) -> list[Block]:
    """Controller and loop gain, Nyquist curve, closed-loop gains."""
    delay = view.specification.computational_delay_samples
    law = "K_with_delay" if delay else "K, without computational delay"
    part = f", {view.control.spread.about}" if view.control.spread.others else ""
    nyquist = f"Loop gain with its {share(view.level)} ellipses: Nyquist curve and Nichols chart{part}."
    return [
        Picture(
            "bode-loop",
            f"Controller ({law}) and loop gain, with the margins at the centres of the ellipses.",
            (view,),
        ),
        Picture("nyquist", nyquist, (view,)),
        Picture("sensitivities", "Closed-loop gains.", (view,)),
    ]


def _any_order_blocks(
    achievable: AchievablePerformance, gamma: float | None, order: int | str
) -> list[Block]:
    """What a controller of any order could reach; the first screen has compared this one with it."""
    compared = any_order(achievable, gamma, order)
    if not compared:
        return []
    bracket = achievable.bracket
    text = sentence(compared) if bracket is None or gamma is None else ""
    if bracket is not None:
        best_known = "no controller was found"
        if math.isfinite(bracket.ellipse):
            best_known = f"a controller with γ = {number(bracket.ellipse, 4)} was found"
        text += (
            " Of any order, structure, pole damping and delay margin: γ is at least "
            f"{at_least(bracket.floor)} (Youla, within a basis); {best_known}."
        )
    return [Text(text.strip())]


def _filter_blocks(view: RunView) -> list[Block]:
    """The reference filter, or why there is none; nothing where none was asked for."""
    result = view.results.reference_filter
    text = sentence(reference_filter(result))
    if not text:
        return []
    blocks: list[Block] = [Heading("Reference filter")]
    if result.filter is None:
        return [*blocks, Remarks((text,), "warning")]
    copy = Copy("Reference filter to copy", view.forms(result.filter), view.plant.dt_s, "reference")
    return [*blocks, Text(text), copy]
