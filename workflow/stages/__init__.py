"""The stages of a run, in order, and what each leaves in `stages/`.

Every stage reads typed objects of the stages before it (`workflow.stages.results` loads them), makes one library
call per channel, and saves typed objects. All files are read with `RunDirectory.load_stage(name)`, which gives a
`StageData`: `.arrays` (flat names, parts separated by '/') and `.document` (JSON-able). k counts channels in the order
of the configuration, i records in the order of the configuration. Complex numbers stay complex arrays; in documents
non-finite floats survive.

records.npz
    document  records: list of {name, role (estimation|validation|repeat), condition|null, remark, kind (prbs ... |
              file), file|null, samples, dt_s, duration_s, closed_loop: bool, units: {signal: unit}}
              source: "simulated"|"files"; effects: list of effect tables as in the configuration
    arrays    record/<i>/...          ident.Record.to_arrays(): the record as measured, all columns
              noise_free/<i>/output   (T, Y), simulated source only

identify.npz
    document  channels: list of {name, input, output, purpose, fit_estimation_percent: {record: %},
              fit_validation_percent: {record: %}, fit_repeat_percent, modes: list of {frequency_Hz, damping},
              real_poles_rad_s: list (decay rates), order, integrators, feedthrough: bool, input_delay_samples,
              noise_std, tangent_optimality, warnings: list of str, order_table: list of {...}}
              two_stage: null or the report of the first stage
    arrays    channel/<k>/identification/...        ident.Identification.to_arrays()
              channel/<k>/used/<i>/...              Record.to_arrays() of the SISO records the fit used (after the
                                                    two-stage step and cut to this channel), estimation records only

uncertainty.npz
    document  channels: list of {name, method, level, report (embedding report), bands: list of {from_rad_s, to_rad_s,
              median_radius_percent (major semi-axis over |G|)}, verdicts: list of str, whiteness / independence
              tests as dicts, repeat_scatter: null or dict}
    arrays    channel/<k>/posterior/...             ident.ResponsePosterior.to_arrays()
              channel/<k>/frequency/...             ident.FrequencyUncertainty.to_arrays() on the display grid
              channel/<k>/tests/<i>/...             residual test curves of validation (or estimation) records
              channel/<k>/empirical/omega_rad_s, response   non-parametric response from the records

design.npz
    document  outcome, gamma, met: bool, blocking: list of {omega_rad_s, item, excess}, controller: Controller JSON
              document, starts: list of dicts
    arrays    synthesis/...                         control_design.SynthesisResult.to_arrays()

certify.json
    document  Certificate.to_dict()

closed_loop.npz
    document  machine, reference_step, disturbance, draws, metrics predicted / achieved, verdict lines
    arrays    time_s (T,), reference (T,), disturbance (T,)
              predicted/output, predicted/command, predicted/performance
              achieved/output (draws, T), achieved/command (draws, T), achieved/performance (draws, T)

report.json
    document  sha256 of report.html
"""
