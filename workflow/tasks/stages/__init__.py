"""The stages of a run, in order, and what each leaves in `stages/`.

Every stage reads typed results of the stages before it, makes one library call per channel, and saves typed
results. Read them back with `workflow.tasks.stages.results` (load_records, load_identification,
load_posterior, load_frequency, load_empirical, load_plant, load_synthesis, load_certificate, load_document),
or raw with `RunDirectory.load_stage(name)`, which gives a `StageData`: `.arrays` (flat names, parts separated
by '/') and `.document` (JSON-able; non-finite floats survive). Below, k counts channels and i records, both
from 0 in the order of the configuration unless said otherwise.

records.npz
    document  source "simulated"|"files"; effects: list of effect tables as in the configuration; records:
              list of {name, role "estimation"|"validation"|"repeat", condition|null, remark, kind (prbs,
              multisine, log_chirp, doublet, bang_bang, file), file|null, samples, dt_s, duration_s,
              closed_loop (has a reference), units {signal: unit}}
    arrays    record/<i>/...                  ident.Record, as measured, all columns
              noise_free/<i>/output           (T, Y) before sensor effects and noise, simulated source only

identify.npz
    document  channels: list of {name, input, output, purpose "control"|"performance", increments,
              band_rad_s, bounds_band_rad_s, n_used, n_fresh, fit_estimation_percent {record: %},
              fit_validation_percent {record: %}, fit_repeat_percent {record: %}, order, integrators,
              input_delay_samples, feedthrough, modes: list of {frequency_Hz, omega_rad_s, damping}
              ascending, real_poles_per_s: decay rates, real_poles_z, noise_std (output units),
              tangent_optimality, warnings: list of str, verdicts: list of str, order_table: list of
              {n_real, n_pairs, rss, criterion}, search_evaluations, two_stage: null or a sentence}
    arrays    channel/<k>/identification/...  ident.identify.Identification (model, residuals, search trace)
              channel/<k>/used/<i>/...        ident.Record, SISO: what the fit saw; i counts estimation ones
              channel/<k>/bounded/<i>/...     ident.Record, SISO: what the ellipses see, if other
              channel/<k>/fresh/<i>/...       ident.checks.validation.FreshFit; i counts the other records in
              order

uncertainty.npz
    document  channels: list of {name, method, level, report: EmbeddingReport.to_dict()|null, bands: list
              of {from_rad_s, to_rad_s, median_radius_percent, largest_radius_percent} (major semi-axis
              over |G|), tests: list of {data "estimation"|record name, ...ResidualTest.to_dict()},
              repeat_scatter: null or list of ScatterRow.to_dict(), nominal {share_inside_percent,
              largest_distance, at_rad_s}}
    arrays    channel/<k>/posterior/...       ident.ResponsePosterior
              channel/<k>/nominal/...         ident.GobfModel: the identified poles, nearest to the posterior
              channel/<k>/frequency/...       ident.FrequencyUncertainty on the display grid
              channel/<k>/empirical/...       ident.FrequencyUncertainty without a model; may be absent

design.json
    document  synthesis: SynthesisResult.to_dict(), or null where the specification is impossible from the
              start; met (bool); reason (one line: met, or how far, and which frequency and requirement
              block it); jointly: null, or with certificate.calibrate a line on the stable share

achievable_performance.json
    document  bracket: YoulaBracket.to_dict() (what a controller of any order could reach), or null; reason
              null or why there is none

certify.json
    document  certificate: Certificate.to_dict(), or null with nothing to certify; certified (bool);
              reason (one line); whole: {joint: JointCoverage.to_dict()|null, calibrated (bool), reason:
              null or why no responses were drawn}, empty with nothing to certify

prefilter.json
    document  prefilter: Prefilter.to_dict(), or null; reason: null (none asked for) or why there is none

closed_loop.npz, or closed_loop.json when there was nothing to run
    document  skipped: null or the reason; machine "simulated"|"identified"; if not skipped also tracking
              (asked for), draws, settled_draws, reference_step, disturbance, quantisation,
              measurement_step, input_limit|null, prefiltered (bool), predicted: {StepMetrics.to_dict(),
              disturbance_peak, disturbance_left, settled}, achieved: list of the same, one per draw
    arrays    time_s, reference, disturbance  (T,); the disturbance adds to the plant's input from T // 2 on
              model                           (T,): answer of the prefilter's reference model, if there is one
              predicted/output, /command, /limited, /performance  (1, T): on the posterior mean
              achieved/...                    (R, T): R runs on the machine
              performance is absent without a performance channel
    on a simulated arm, where asked for (else sensitivity null, conditions empty)
    document  sensitivity: {nominal_peak, nominal_omega_rad_s, certified_peak, band_rad_s, measured: [{name,
              reference_rms, peak, peak_std, omega_rad_s, off_nominal_percent, off_certified_percent,
              peak_command, limited_fraction}]}; conditions: [Condition.row()]
    arrays    sensitivity/<k>/omega_rad_s, /magnitude, /std  (F,): measurement k of the document
              conditions/reference, /predicted, /achieved, /predicted_command, /achieved_command  (C, T)

report.json
    document  report_sha256
"""

from __future__ import annotations

from workflow.tasks.stages import (
    achievable_performance,
    certify,
    closed_loop,
    design,
    identify,
    prefilter,
    records,
    report,
    uncertainty,
)
from workflow.tasks.stages.base import Stage, StageInput

__all__ = ["STAGES", "Stage", "StageInput"]

STAGES: tuple[Stage, ...] = (
    Stage("records", (), records.settings, records.make_records, expected_s=1.0),
    Stage("identify", ("records",), identify.settings, identify.identify_channels, expected_s=2.0),
    Stage(
        "uncertainty",
        ("records", "identify"),
        uncertainty.settings,
        uncertainty.find_uncertainty,
        expected_s=2.0,
    ),
    Stage("design", ("identify", "uncertainty"), design.settings, design.design_controller, expected_s=15.0),
    Stage(
        "yardstick",
        ("identify", "uncertainty"),
        achievable_performance.settings,
        achievable_performance.find_yardstick,
        expected_s=2.5,
    ),
    Stage(
        "certify",
        ("identify", "uncertainty", "design"),
        certify.settings,
        certify.certify_controller,
        expected_s=1.0,
    ),
    Stage(
        "prefilter",
        ("identify", "uncertainty", "design", "certify"),
        prefilter.settings,
        prefilter.design_filter,
        expected_s=0.1,
    ),
    Stage(
        "closed_loop",
        ("records", "identify", "uncertainty", "design", "certify", "prefilter"),
        closed_loop.settings,
        closed_loop.run_closed_loop,
        expected_s=5.0,
    ),
    Stage(
        "report",
        (
            "records",
            "identify",
            "uncertainty",
            "design",
            "yardstick",
            "certify",
            "prefilter",
            "closed_loop",
        ),
        report.settings,
        report.write_page,
        expected_s=7.0,
        also_writes=report.page,
    ),
)
