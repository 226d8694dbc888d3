"""What a model of a measured frequency response says: points, poles, fit and warnings."""

from __future__ import annotations

from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.frequency_fit import FrfIdentification
from workflow.describe.facts import Section, worded
from workflow.text.findings.sentences import words
from workflow.text.formats import count, frequency, number, si


def response_sections(fit: FrfIdentification, response: FrequencyUncertainty) -> list[Section]:
    """Model of a measured frequency response: points, poles with standard deviations, fit, warnings."""
    omega = response.omega_rad_s
    points = (
        f"{count(omega.size, 'frequency', 'frequencies')}, {frequency(omega[0])} to {frequency(omega[-1])}"
    )
    model = fit.model
    dt_s = model.dt_s
    pairs = zip(
        model.poles.omega_rad_s(dt_s).tolist(),
        fit.omega_std_rad_s.tolist(),
        model.poles.zeta().tolist(),
        fit.zeta_std.tolist(),
        strict=True,
    )
    rows = [
        worded("order", f"{model.order}, sampled every {si(dt_s, 's', 6)}"),
        *(worded("real pole", si(decay, "1/s")) for decay in model.poles.decay_per_s(dt_s).tolist()),
    ]
    for omega_rad_s, omega_std, zeta, zeta_std in pairs:
        rows.append(
            worded(
                "mode",
                f"{frequency(omega_rad_s, 4)} ± {si(omega_std, 'rad/s', 2)}, damping {number(zeta)} ± "
                f"{number(zeta_std, 2)}",
            )
        )
    verdicts = tuple(worded(f"{n}", words(item)) for n, item in enumerate(fit.verdicts, 1))
    warnings = tuple(worded(f"{n}", words(item)) for n, item in enumerate(fit.warnings, 1))
    sections = [
        Section("response", (worded("points", points),)),
        Section("model", tuple(rows)),
        Section("fit", verdicts),
        Section("warnings", warnings),
    ]
    return [section for section in sections if section.rows]
