"""The stages of a run of one loop before its page, in order: each is a task on what those before it left.

What each leaves behind is a type of `workflow.tasks.results`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from control_design.convex.youla import UNKNOWN_TO_BOUND
from control_design.specification import Specification
from ident.resampling import resampled_friction
from workflow.engine.errors import naming
from workflow.tasks.closed_loop import run_closed_loop
from workflow.tasks.design import certify_asked, find_bracket, find_design, find_filter
from workflow.tasks.friction_loop import friction_feedforward, soonest
from workflow.tasks.identification import identify_channels
from workflow.tasks.records import make_records
from workflow.tasks.results import (
    AchievablePerformance,
    CertifyResult,
    DesignResult,
    ReferenceFilterResult,
    RunResults,
)
from workflow.tasks.stage import RunKind, Stage, StageInput
from workflow.tasks.uncertainty import find_uncertainty
from workflow.text.sentences.design import no_filter


def design_controller(stage: StageInput) -> DesignResult:
    """Best controller found for the plant that was identified."""
    config = stage.config

    def design_for(asked: Specification, *, advise: bool) -> DesignResult:
        """The best controller for a specification; advise: with what would be met instead."""
        report = partial(stage.progress.update, "design")
        return find_design(
            stage.plants,
            asked,
            config.synthesis,
            config.certificate,
            stage.rng("design"),
            report,
            advise=advise,
        )

    with naming("design"):
        # What a further try misses is not the user's to mend.
        return soonest(
            stage, design_for(config.specification, advise=True), partial(design_for, advise=False)
        )


def find_achievable(stage: StageInput) -> AchievablePerformance:
    """What a controller of any order could reach, or the reason why that is not known."""
    config = stage.config
    report = partial(stage.progress.update, "achievable_performance")
    with naming("achievable performance"):
        return find_bracket(stage.plants, stage.specification, config.achievable_performance, report)


def certify_controller(stage: StageInput) -> CertifyResult:
    """The controller checked independently of the optimiser that made it, or why there is none."""
    design = stage.results.design
    config = stage.config
    law = design.controller
    rng = stage.rng("certify")
    if law is None:
        return CertifyResult(None, certified=False, reason=design.reason)
    with naming("certify"):
        return certify_asked(law, stage.plants, stage.specification, config.certificate, rng)


def design_filter(stage: StageInput) -> ReferenceFilterResult:
    """Filter and friction feed-forward, where asked for; nothing where no controller is there."""
    settings = stage.config.reference_filter
    law = stage.results.design.controller
    if law is None:
        return ReferenceFilterResult(reason=None if settings is None else no_filter())
    with naming("reference filter"):
        result = find_filter(law, stage.plants, settings)
    friction = stage.results.identify.friction
    if stage.config.closed_loop.friction_feedforward and friction is not None:
        result = replace(
            result, feedforward=friction_feedforward(law, resampled_friction(friction, law.dt_s))
        )
    return result


# Stages of the uncertain plant behind its records.
_PLANT = ("identify", "uncertainty")
# Which channel is fed back and which one must not swing.
_PURPOSES = {"channels": {"__all__": {"purpose"}}}
# Columns that records are read for.
_COLUMNS = {"__all__": {"input", "output"}}

# Stages in order. What a stage does not use it does not depend on: another value of it leaves its result as
# it is.
STAGES: tuple[Stage, ...] = (
    Stage(
        "records",
        (),
        make_records,
        1.0,
        uses={"source": True, "channels": _COLUMNS},
    ),
    Stage(
        "identify",
        ("records",),
        identify_channels,
        2.0,
        uses={"channels": True, "closed_loop_data": True},
        except_for={"channels": {"__all__": {"uncertainty", "purpose"}}},
    ),
    Stage(
        "uncertainty",
        ("records", "identify"),
        find_uncertainty,
        2.0,
        uses={"channels": {"__all__": {"uncertainty"}}},
    ),
    Stage(
        "design",
        ("records", *_PLANT),
        design_controller,
        15.0,
        uses={
            "specification": True,
            "synthesis": True,
            "certificate": {"calibrate"},
            # The step that is to settle has this length.
            "closed_loop": {"reference_step", "measurement_step"},
            **_PURPOSES,
        },
    ),
    Stage(
        "achievable_performance",
        # The design chooses the bandwidth.
        (*_PLANT, "design"),
        find_achievable,
        2.5,
        uses={"specification": True, "achievable_performance": True, **_PURPOSES},
        # Another order leaves the bracket as it is.
        except_for={"specification": set(UNKNOWN_TO_BOUND)},
    ),
    Stage(
        "certify",
        (*_PLANT, "design"),
        certify_controller,
        1.0,
        uses={"certificate": True},
    ),
    Stage(
        "reference_filter",
        (*_PLANT, "design", "certify"),
        design_filter,
        0.1,
        uses={"reference_filter": True, "closed_loop": {"friction_feedforward"}},
    ),
    Stage(
        "closed_loop",
        ("records", *_PLANT, "design", "certify", "reference_filter"),
        run_closed_loop,
        5.0,
        uses={"closed_loop": True, "source": True},
        except_for={"source": {"records"}},
    ),
)

# A run of one loop.
ONE_LOOP = RunKind(STAGES, RunResults)
