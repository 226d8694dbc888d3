"""What the page of a run begins with: its headline, its numbers, and at most five sentences."""

from __future__ import annotations

from typing import TYPE_CHECKING

from markupsafe import Markup

from control_design.analysis.certificate import Certificate
from workflow.config.run_config import RunConfig
from workflow.describe.closed_loop import lasting_error, loop_numbers, measured_beyond, measured_beyond_text
from workflow.describe.design import any_order, gave_way_text, watch_longer
from workflow.describe.facts import FirstScreen, Picture, State, link
from workflow.describe.friction import beside_recorded, friction_exceeds, stands_still, waits
from workflow.describe.run import lowered_bandwidth, signals_where_scaled
from workflow.describe.uncertainty import USUALLY_INSIDE_PERCENT
from workflow.tasks.giving_way import gave_way
from workflow.tasks.results import RunResults
from workflow.text.findings.sentences import words
from workflow.text.formats import at_most, count, frequency, listing, number, percent, sentence, share
from workflow.text.sentences.certificate import damping_lost, grounds, requirement
from workflow.text.sentences.design import order_advice, tracking_begins
from workflow.text.sentences.friction import certified_for

if TYPE_CHECKING:
    from workflow.figures.subjects import ChannelView, RunView

# Share of the frequencies: with less of them inside, the uncertainty itself is in doubt and says so.
_HARDLY_INSIDE_PERCENT = 50.0


def headline_of(results: RunResults, config: RunConfig) -> str:
    """The verdict on a run of one loop in a few words, what weighs most first."""
    certificate = results.certify.certificate
    check = results.closed_loop.check
    if certificate is None or results.design.controller is None:
        return "Not certified: there is no controller"
    if not certificate.certified:
        missed = sum(not item.met for item in certificate.items)
        if missed:
            return f"Not certified: {missed} of {count(len(certificate.items), 'requirement')} missed"
        return "Not certified: the loop is not robustly stable"
    if check is None:
        return "Certified, but the closed loop was not simulated"
    if check.settled_draws < check.draws:
        return "Certified, but the simulated loop does not settle"
    if damping_lost(certificate, results.identify.modes_rad_s):
        return "Certified, but the loop takes damping from a mode"
    if results.uncertainty.conditions(config):
        return "Certified, but the ellipses are in doubt"
    if waits(check):
        return f"Certified, but {waits(check)}"
    used = results.design.specification
    if gave_way_text(gave_way(config.specification, used)):
        return "Certified, but for less than was asked"
    if used is not None and tracking_begins(config.specification, used):
        return f"Certified, but tracking is asked from {frequency(used.tracking_from_rad_s)} on"
    if lowered_bandwidth(results, config):
        return "Certified, but for a lower bandwidth"
    requirements = len(certificate.items)
    if requirements == 1:
        return "Certified: the requirement is met"
    return f"Certified: all {requirements} requirements are met"


def first_screen(view: RunView) -> FirstScreen:
    """What the page of a run of one loop begins with.

    Its state is "refused" where the run is not certified or a simulated loop does not settle, "plain" where
    the certificate has a reservation, and "certified" without one.
    """
    results = view.results
    headline = headline_of(results, view.config)
    does_not_settle = results.closed_loop.check is not None and not results.settles
    state: State = "plain"
    if not results.certified or does_not_settle:
        state = "refused"
    # "Certified: ..." has no reservation, "Certified, but ..." has one.
    elif headline.startswith("Certified:"):
        state = "certified"
    if results.closed_loop.check is not None:
        picture = Picture(
            "overview",
            "Left: identified response with its uncertainty. Middle: the loop and the uncertainty ellipse "
            "nearest to -1. Right: the reference step, predicted and simulated.",
            (view,),
        )
    else:
        picture = Picture(
            "bode",
            f"Identified response with its {share(view.certified_level)} uncertainty.",
            (view.control, view.control.name),
            "first",
        )
    rows = loop_numbers(results, view.config)
    return FirstScreen(headline, state, rows, tuple(_bullets(view)), picture)


def _bullets(view: RunView) -> list[str]:
    """Sentences on a run, the weightiest first; empty ones are left out by whoever shows them."""
    results = view.results
    config = view.config
    certificate = results.certify.certificate
    if certificate is None or results.design.controller is None:
        return [results.design.reason]
    check = results.closed_loop.check
    asked = view.specification
    output_unit = view.output_unit
    gamma = results.design.gamma
    order = asked.controller_order
    bullets = [
        measured_beyond_text(contradiction, config.closed_loop.effects)
        for contradiction in measured_beyond(results, config)
    ]
    scaled = signals_where_scaled(config, results)
    if scaled:
        bullets.append(
            f"The controller's files take and give the columns as logged, this page does not. "
            f"{sentence(scaled)}"
        )
    bullets += _what_fails(view, certificate)
    narrower = lowered_bandwidth(results, config)
    if narrower:
        bullets.append(f"Bandwidth: {narrower}.")
    given_way = gave_way_text(view.gave_way)
    if given_way:
        bullets.append(
            f"What was asked could not all be met, so it gave way by as little as was needed: {given_way}."
        )
    begins = tracking_begins(config.specification, results.design.specification)
    if begins:
        bullets.append(f"Tracking: {begins}.")
    bullets.append(damping_lost(certificate, results.identify.modes_rad_s))
    friction = None if check is None else check.friction
    if friction is not None:
        bullets.append(beside_recorded(friction, output_unit))
    bullets += [sentence(words(doubt)) for doubt in results.uncertainty.conditions(config)]
    advice = ""
    if gamma is not None and gamma > 1:
        advice = order_advice(results.achievable_performance.bracket, gamma, order, asked.structure)
    bullets.append(advice)
    if check is not None:
        bullets.append(lasting_error(check, asked))
    if friction is not None:
        feedforward = config.closed_loop.friction_feedforward
        bullets.append(stands_still(friction.tracking, output_unit, feedforward=feedforward))
        bullets.append(friction_exceeds(friction, output_unit))
    for channel in view.channels:
        bullets += _doubts_about(channel, designed=results.design.synthesis is not None)
    if certificate.certified:
        about = certified_for(
            config.control_channel.uncertainty.response, results.uncertainty.equivalent, view.input_unit
        )
        level = share(view.certified_level)
        unchecked = link("unchecked", "What was not checked")
        bullets.append(
            Markup("The certificate covers {}: the {} ellipses. {}.").format(about, level, unchecked)
        )
        which = link("margins", "Which")
        bullets.append(Markup("Requirements met: {}. {}.").format(grounds(certificate), which))
    bullets.append(_all_settle(view))
    if not advice and results.achievable_performance.bracket is not None:
        bullets.append(any_order(results.achievable_performance, gamma, order))
    return bullets


def _machine(view: RunView) -> str:
    check = view.results.closed_loop.check
    if check is not None and check.machine == "simulated":
        return "on the simulated arm"
    return "of plants drawn from the uncertainty set"


def _what_fails(view: RunView, certificate: Certificate) -> list[str]:
    """Why a run is not certified, or what its closed loop does not do."""
    results = view.results
    check = results.closed_loop.check
    if certificate.certified:
        if check is None:
            return ["The closed loop was not simulated."]
        if check.settled_draws < check.draws:
            failed = check.draws - check.settled_draws
            return [
                f"{failed} of {count(check.draws, 'run')} {_machine(view)} did not settle. "
                f"{sentence(watch_longer(check))} The certificate covers the linear model and its "
                "uncertainty set only."
            ]
        return []
    bullets = []
    for plant in certificate.plants:
        if not plant.stable:
            radius = at_most(plant.pole_radius, 6)
            bullets.append(
                f"{plant.plant}: the nominal closed loop is unstable (largest pole radius {radius})."
            )
        if not plant.nyquist.matches:
            bullets.append(
                f"{plant.plant}: the Nyquist count is {number(plant.nyquist.half_turns)} half turns; a "
                f"stable loop needs {number(plant.nyquist.required)}."
            )
        if plant.worst_margins.modulus <= 0:
            place = frequency(plant.worst_margin_omega_rad_s)
            bullets.append(f"{plant.plant}: a {share(view.certified_level)} ellipse reaches -1 at {place}.")
    bullets += [requirement(item) for item in certificate.items if not item.met]
    gamma = results.design.gamma
    synthesis = results.design.synthesis
    if gamma is not None and gamma > 1 and synthesis is not None and synthesis.blocking:
        active = synthesis.blocking[0]
        bullets.append(
            f"The design reaches γ = {at_most(gamma, 4)} (needed: 1 or less); {active.weight} at "
            f"{frequency(active.omega_rad_s)} is the active constraint."
        )
    return bullets


def _doubts_about(channel: ChannelView, *, designed: bool) -> list[str]:
    """Warnings about the model of a channel and failed tests, and a nominal model outside its ellipses."""
    bullets: list[str] = []
    warned = channel.found.identification.warnings
    failed = [test for test in channel.spread.tests if not test.passed]
    doubts = []
    if warned:
        doubts.append(f"{count(len(warned), 'warning')} about the model")
    if failed:
        doubts.append(count(len(failed), "failed residual test"))
    if doubts:
        where = link("identification", "Identification") if warned else link("uncertainty", "Uncertainty")
        bullets.append(Markup("{}: {}; see {}.").format(channel.name, listing(doubts), where))
    inside = channel.spread.agreement.share_inside_percent
    if designed and _HARDLY_INSIDE_PERCENT <= inside < USUALLY_INSIDE_PERCENT:
        bullets.append(
            f"{channel.name}: the nominal model lies outside its ellipse at {percent(100 - inside)} of the "
            "frequencies. Margins are those of the ellipses, closed-loop poles those of the nominal model."
        )
    return bullets


def _all_settle(view: RunView) -> str:
    """Says that every run settles; "" where one does not."""
    check = view.results.closed_loop.check
    if check is None or check.settled_draws != check.draws:
        return ""
    runs = "The run" if check.draws == 1 else f"All {check.draws} runs"
    return f"{runs} {_machine(view)} {'settles' if check.draws == 1 else 'settle'}."
