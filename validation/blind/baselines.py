"""Two plain methods on the same case: what a diagnosis has to be better than.

parameters only: the stated values are refitted within their tolerances; if the residuals then are no noise by
a chi-square test, the answer is "unknown". It never names a cause.

residual correlation: the residuals left by that refit are correlated with what every effect of a small size
would add to them; the best correlated effect is named if it explains most of what is there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import chi2

from diagnosis.fit.descent import Fit
from diagnosis.fit.residual import ResidualModel, pooled_rms
from diagnosis.machine.case import Case
from diagnosis.search.white import descend_to_end

# A false alarm in a thousand cases without effect, if noise were all there is.
_SIGNIFICANCE = 1e-3
# Share of the energy beyond the noise that one effect has to explain to be named.
_EXPLAINED = 0.8


def baselines(case: Case) -> dict[str, dict[str, Any]]:
    """Answers of both methods, in the form `flexlink diagnose` gives them."""
    model = ResidualModel(case)
    base = descend_to_end(model, (), np.zeros(0), np.zeros(model.nominal.count))
    after = pooled_rms(model.of(base.deviations, (), case.held_out))
    energy = float(base.residual_coefficients @ base.residual_coefficients)
    noise_alone = float(chi2.sf(energy, base.residual_coefficients.size - model.nominal.count))
    quiet = noise_alone > _SIGNIFICANCE
    refit = _document(case, "none" if quiet else "unknown", {}, after)
    if quiet:
        return {"parameters only": refit, "residual correlation": _document(case, "none", {}, after)}
    shares = _shares(case, model, base)
    name = max(shares, key=lambda effect: shares[effect])
    share_beyond_noise = max(1.0 - base.residual_coefficients.size / energy, 1e-12)
    is_explained = shares[name] >= _EXPLAINED * share_beyond_noise
    ranked = dict(sorted(shares.items(), key=lambda item: -item[1]))
    return {
        "parameters only": refit,
        "residual correlation": _document(case, "effect" if is_explained else "unknown", ranked, after),
    }


def _shares(case: Case, model: ResidualModel, base: Fit) -> dict[str, float]:
    """Effect -> largest squared correlation of its change with the residuals, nominals projected out."""
    P = base.deviations.size
    Q = np.linalg.qr(base.jacobian[:, :P])[0] if P else np.zeros((base.residual_coefficients.size, 0))
    left = base.residual_coefficients - Q @ (Q.T @ base.residual_coefficients)
    shares: dict[str, float] = {}
    for candidate in case.machine.candidates(case.experiments):
        for start in candidate.starts:
            change = (
                model.of(base.deviations, (candidate.effect_at(np.array(start)),))
                - base.residual_coefficients
            )
            change = change - Q @ (Q.T @ change)
            size = float(np.linalg.norm(change) * np.linalg.norm(base.residual_coefficients))
            # An effect that is there lowers the residuals: only changes that point against them count.
            cosine = -float(change @ left) / size if size > 0 and np.isfinite(size) else 0.0
            shares[candidate.effect] = max(shares.get(candidate.effect, 0.0), max(cosine, 0.0) ** 2)
    return shares


def _document(case: Case, verdict: str, shares: dict[str, float], gap_after: float) -> dict[str, Any]:
    """An answer in the form of `flexlink diagnose`; shares: of effects, made into probabilities."""
    total = sum(shares.values())
    return {
        "case": case.name,
        "verdict": verdict,
        "effects": [
            {"name": name, "probability": share / total, "parameters": {}, "intervals": {}}
            for name, share in shares.items()
        ]
        if total > 0
        else [],
        "combination": list(shares)[:1] if verdict == "effect" else [],
        "gap_after": gap_after,
    }
