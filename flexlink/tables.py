"""Results as tidy tables (pandas): one row per pole, frequency, requirement, effect or sample."""

from __future__ import annotations

from functools import singledispatch

import numpy as np
import pandas as pd

from control_design.analysis.certificate import Certificate
from control_design.analysis.closed_loop import ClosedLoopTrajectory
from control_design.analysis.multivariable_certificate import MultivariableCertificate
from control_design.convex.youla import YoulaBracket
from control_design.synthesis.synthesis_result import SynthesisResult
from diagnosis.answer import Diagnosis
from flexlink.comparison import Comparison
from flexlink.machines import Simulation
from flexlink.pictures import as_response, unknown
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.data.arrays import ComplexArray
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.record import Record
from ident.frequency_fit import FrfIdentification
from ident.identification import Identification, MimoIdentification
from ident.search.error_surface import ErrorSurface
from ident.uncertainty import ResponsePosterior
from workflow.describe.facts import by_key
from workflow.describe.summary import RunSummary
from workflow.figures.bands import response_band

__all__ = ["table"]


@singledispatch
def table(result: object) -> pd.DataFrame:
    """Return a result as `pandas.DataFrame`, with units in the column names; also `result.table()`.

    Record, simulation, closed loop: a row per sample. Model, identification: a row per mode or real pole, of
    a measured response with their standard deviations.
    Uncertainty, measured response: a row per frequency, with the range of gain and phase over the ellipse.
    Certificate: a row per requirement. Synthesis: a row per active constraint. Diagnosis: a row per effect
    and parameter, with its 95 % interval and two probabilities: that the effect is `present`, and that it is
    the `main_cause` (these sum to one). Error surface: a row per grid point. Youla bracket: a row per plant.
    Summary of a run: a row per fact, with its key in the JSON answer.

    Parameters
    ----------
    result : object
        One of these.

    Returns
    -------
    pandas.DataFrame

    Raises
    ------
    TypeError
        For anything else.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> flexlink.table(found)[["kind", "omega_rad_s", "zeta"]].round(3)
       kind  omega_rad_s  zeta
    0  mode         20.0  0.05
    >>> found.records[0].table().columns.to_list()
    ['time_s', 'u', 'y']
    """
    raise TypeError(unknown("table", result, table))


@table.register(Record)
def _record(record: Record) -> pd.DataFrame:
    # Time, then inputs, outputs and references by their names.
    columns = {"time_s": record.dt_s * np.arange(record.n_samples)}
    for names, signals in (
        (record.input_names, record.input),
        (record.output_names, record.output),
        (record.reference_names, record.reference),
    ):
        if signals is not None:
            columns |= dict(zip(names, signals.T, strict=True))
    return pd.DataFrame(columns)


@table.register(ClosedLoopTrajectory)
def _run(run: ClosedLoopTrajectory) -> pd.DataFrame:
    names = ("time_s", "reference", "measured", "command", "limited")
    return pd.DataFrame({name: getattr(run, name) for name in names})


@table.register(GobfModel)
def _model(model: GobfModel) -> pd.DataFrame:
    """zeta and omega of a pair are those of the continuous pole that samples to it; a real pole has the rate
    at which it decays."""
    return _modes(model.stable_poles, model.dt_s, model.unstable_poles)


def _modes(poles: Poles, dt_s: float, unstable: ComplexArray | tuple[()] = ()) -> pd.DataFrame:
    """A row per mode, real pole and unstable pole; columns that a kind does not have are nan."""
    modes = pd.DataFrame({"kind": "mode", "omega_rad_s": poles.omega_rad_s(dt_s), "zeta": poles.zeta()})
    decays = pd.DataFrame({"kind": "real pole", "decay_per_s": poles.decay_per_s(dt_s)})
    # A pole outside the circle grows: its decay is negative.
    outside = np.log(np.asarray(unstable, complex)) / dt_s
    growing = pd.DataFrame(
        {"kind": "unstable pole", "omega_rad_s": np.abs(outside.imag), "decay_per_s": -outside.real}
    )
    # pandas warns of empty parts; a model without any pole has an empty table of modes.
    parts = [part for part in (modes, decays, growing) if len(part)] or [modes]
    rows = pd.concat(parts, ignore_index=True)
    rows = rows.reindex(columns=["kind", "omega_rad_s", "frequency_Hz", "zeta", "decay_per_s"])
    return rows.assign(frequency_Hz=rows["omega_rad_s"] / (2 * np.pi))


@table.register(FrfIdentification)
def _fitted_response(fit: FrfIdentification) -> pd.DataFrame:
    # Standard deviations go to the rows of their kind; the others stay nan.
    rows = _modes(fit.model.poles, fit.model.dt_s)
    is_mode = rows["kind"] == "mode"
    rows.loc[is_mode, "omega_std_rad_s"] = fit.omega_std_rad_s
    rows.loc[is_mode, "zeta_std"] = fit.zeta_std
    rows.loc[~is_mode, "decay_std_per_s"] = fit.decay_std_per_s
    return rows


@table.register(ErrorSurface)
def _surface(surface: ErrorSurface) -> pd.DataFrame:
    first, second = np.meshgrid(surface.first, surface.second, indexing="ij")
    columns = {surface.names[0]: first.ravel(), surface.names[1]: second.ravel()}
    return pd.DataFrame({**columns, "mean_square": surface.mean_square.ravel()})


@table.register(MultivariableCertificate)
def _joints(certificate: MultivariableCertificate) -> pd.DataFrame:
    rows = []
    # The bound between the grid's points decides, not the value on it.
    for verdict in certificate.verdicts:
        for name, bound in verdict.bounds.items():
            row = {
                "plant": verdict.plant,
                "requirement": name,
                "achieved": verdict.worst[name],
                "bound": bound,
                "met": verdict.stable and bound <= 1,
                "omega_rad_s": verdict.worst_at[name],
            }
            rows.append(row)
    return pd.DataFrame(rows)


@table.register(SynthesisResult)
def _synthesis(result: SynthesisResult) -> pd.DataFrame:
    # Of one loop no joint is named.
    return pd.DataFrame([vars(point) for point in result.blocking]).dropna(axis=1, how="all")


@table.register(Diagnosis)
def _diagnosis(diagnosis: Diagnosis) -> pd.DataFrame:
    rows: list[dict[str, object]] = []
    for effect in diagnosis.effects:
        # An effect without parameters has a row, too: it has a probability.
        parameters: list[tuple[str | None, float]] = list(effect.parameters.items()) or [(None, np.nan)]
        for name, value in parameters:
            low, high = effect.intervals.get(str(name), (np.nan, np.nan))
            row = {
                "effect": effect.name,
                "present": effect.presence,
                "main_cause": effect.probability,
                "parameter": name,
                "value": value,
                "low": low,
                "high": high,
                "gap_after": effect.gap_after,
            }
            rows.append(row)
    return pd.DataFrame(rows)


@table.register(RunSummary)
def _facts(summary: RunSummary) -> pd.DataFrame:
    rows = []
    for key, fact in by_key(summary.sections).items():
        values = fact.value.plain if isinstance(fact.value.plain, dict) else {"value": fact.value.plain}
        rows.append({"key": key, "name": fact.name, "unit": fact.value.unit, **values, "text": fact.text})
    return pd.DataFrame(rows)


# Those whose rows are there already.
table.register(Simulation, lambda result: pd.DataFrame(vars(result)))
table.register(Comparison, lambda result: result.table())
table.register(Identification, lambda result: _model(result.model))
table.register(MimoIdentification, lambda result: _modes(result.model.poles, result.model.dt_s))
table.register(YoulaBracket, lambda result: pd.DataFrame([vars(plant) for plant in result.plants]))
table.register(Certificate, lambda result: pd.DataFrame([vars(item) for item in result.items]))
for kind in (ResponsePosterior, FrequencyUncertainty):
    table.register(kind, lambda result: pd.DataFrame(vars(response_band(as_response(result)))))
