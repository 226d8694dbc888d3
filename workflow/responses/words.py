"""What a model of a measured frequency response says: points, poles, fit and warnings."""

from __future__ import annotations

from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.frequency_fit import FrfIdentification
from workflow.describe.facts import Section, worded
from workflow.text.findings.sentences import words
from workflow.text.formats import count, frequency, number, si


def response_sections(fit: FrfIdentification, response: FrequencyUncertainty) -> list[Section]:
    """Model of a measured frequency response: points, poles with standard deviations, fit, warnings."""
    # What was measured.
    omega = response.omega_rad_s
    frequencies = count(omega.size, "frequency", "frequencies")
    lowest = frequency(omega[0])
    highest = frequency(omega[-1])
    points = worded("points", f"{frequencies}, {lowest} to {highest}")

    # The model, its modes with standard deviations: the posterior is Gaussian near them.
    model = fit.model
    poles = model.poles
    dt_s = model.dt_s
    step = si(dt_s, "s", 6)
    rows = [worded("order", f"{model.order}, sampled every {step}")]
    for decay_per_s in poles.decay_per_s(dt_s).tolist():
        rows.append(worded("real pole", si(decay_per_s, "1/s")))
    frequency_std = fit.omega_std_rad_s.tolist()
    damping_std = fit.zeta_std.tolist()
    for k, omega_rad_s in enumerate(poles.omega_rad_s(dt_s).tolist()):
        zeta = float(poles.zeta()[k])
        frequency_words = f"{frequency(omega_rad_s, 4)} ± {si(frequency_std[k], 'rad/s', 2)}"
        damping_words = f"{number(zeta)} ± {number(damping_std[k], 2)}"
        rows.append(worded("mode", f"{frequency_words}, damping {damping_words}"))

    verdicts = [worded(f"{place}", words(item)) for place, item in enumerate(fit.verdicts, 1)]
    warnings = [worded(f"{place}", words(item)) for place, item in enumerate(fit.warnings, 1)]
    sections = [
        Section("response", (points,)),
        Section("model", tuple(rows)),
        Section("fit", tuple(verdicts)),
        Section("warnings", tuple(warnings)),
    ]
    # A fit without a warning has no section of them.
    return [section for section in sections if section.rows]
