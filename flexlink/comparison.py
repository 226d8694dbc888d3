"""Models of any origin on one validation record: their fits in a table, their free runs in a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
from scipy.signal import lfilter

from control_design.plants.foreign_systems import is_measured, state_space
from flexlink.keywords import front_door
from ident.basis.model import GobfModel
from ident.basis.posterior import ResponsePosterior
from ident.checks.validation import fit_on_fresh_data
from ident.comparators import n4sid as subspace, polynomial_fits
from ident.comparators.innovation_model import InnovationModel, fit_percent
from ident.comparators.polynomial_model import PolynomialModel
from ident.data.arrays import RealArray
from ident.data.keywords import WrongArgumentError, clear_constructor
from ident.data.record import SAME_DT, Record
from ident.data.shown import Shown
from ident.frequency_fit import FrfIdentification
from ident.identification import Identification

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

__all__ = ["Comparison", "armax", "arx", "compare", "n4sid", "oe"]

ModelT = TypeVar("ModelT", PolynomialModel, InnovationModel)

# Samples that are drawn unless times are stated: as many as can be told apart across a page.
_DRAWN_SAMPLES = 400
# Height of a label beside its curve and the gap to the next, in heights of its letters.
_LABEL_HEIGHT = 1.3
# What compare takes, for refusals.
_EXPECTED = (
    "an identification, a model of arx, armax, oe or n4sid, a system of python-control or scipy.signal, "
    "(num, den, dt_s), or an impulse response (n,)"
)


@front_door
def arx(record: Record, na: int, nb: int, *, delay_samples: int = 1) -> PolynomialModel:
    """Fit A y = B u + e by linear least squares: na coefficients in A, nb in B.

    Parameters
    ----------
    record : Record
        One input and one output; means are not removed.
    na, nb : int
        Orders; na = 0 is a finite impulse response.
    delay_samples : int
        1 where the output does not answer within the same sample.

    Returns
    -------
    PolynomialModel
        Biased where the noise is not white noise filtered by 1/A.

    Raises
    ------
    ValueError
        Orders or a record that cannot be used.

    Examples
    --------
    >>> flexlink.arx(example_record(), 2, 2).order
    2
    """
    return _timed(lambda: polynomial_fits.arx(_one(record), na, nb, delay_samples=delay_samples))


@front_door
def armax(record: Record, na: int, nb: int, nc: int, *, delay_samples: int = 1) -> PolynomialModel:
    """Fit A y = B u + C e by prediction errors: na, nb, nc coefficients, C stable.

    Parameters
    ----------
    record : Record
        One input and one output; means are not removed.
    na, nb, nc : int
        Coefficients of A, B and C.
    delay_samples : int
        1 where the output does not answer within the same sample.

    Returns
    -------
    PolynomialModel
        The best of three local searches (from ARX, from two-stage least squares, from Steiglitz-McBride); the
        minimum is local.

    Raises
    ------
    ValueError
        Orders or a record that cannot be used.

    Examples
    --------
    >>> flexlink.armax(example_record(), 2, 2, 1).order
    2
    """
    return _timed(lambda: polynomial_fits.armax(_one(record), na, nb, nc, delay_samples=delay_samples))


@front_door
def oe(record: Record, nb: int, nf: int, *, delay_samples: int = 1) -> PolynomialModel:
    """Fit y = (B / F) u + e by prediction errors: nb coefficients in B, nf in F, F stable.

    Parameters
    ----------
    record : Record
        One input and one output; means are not removed.
    nb, nf : int
        Coefficients of B and F.
    delay_samples : int
        1 where the output does not answer within the same sample.

    Returns
    -------
    PolynomialModel
        The best of two local searches (from Steiglitz-McBride, from ARX); the minimum is local.

    Raises
    ------
    ValueError
        Orders or a record that cannot be used.

    Examples
    --------
    >>> flexlink.oe(example_record(), 2, 2).order
    2
    """
    return _timed(lambda: polynomial_fits.oe(_one(record), nb, nf, delay_samples=delay_samples))


@front_door
def n4sid(
    record: Record, order: int, *, feedthrough: bool = False, block_rows: int | None = None
) -> InnovationModel:
    """Fit a state space with its noise by a subspace method (N4SID with the weighting of MOESP).

    Parameters
    ----------
    record : Record
        One input and one output; means are not removed.
    order : int
        Number of states.
    feedthrough : bool
        The output answers within the same sample.
    block_rows : int, optional
        Past and future samples that are looked at together; by default twice the order, at least 20.

    Returns
    -------
    InnovationModel
        State space with the gain of its noise.

    Raises
    ------
    ValueError
        An order, rows or a record that cannot be used.

    Examples
    --------
    >>> flexlink.n4sid(example_record(), 2).order
    2
    """
    return _timed(lambda: subspace.n4sid(_one(record), order, feedthrough=feedthrough, block_rows=block_rows))


@dataclass(frozen=True, eq=False, repr=False)
class ComparedModel:
    """A model on a validation record of T samples.

    Attributes
    ----------
    name : str
    order : int
        Number of states or poles; of an impulse response its length less one.
    fit_percent : float
        Of the free run, 100 (1 - |y - y_hat| / |y - mean y|).
    one_step_percent : float
        Of the prediction from each sample to the next; nan for a model without noise model.
    fit_s : float
        Seconds that the identification took; nan where it was not made by flexlink.
    simulated : ndarray, shape (T,)
        The free run in output units; nan in rows that nothing of the record drives.
    """

    name: str
    order: int
    fit_percent: float
    one_step_percent: float
    fit_s: float
    simulated: RealArray


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Shown):
    """Models on one validation record: `table()`, `plot()`; `models` has a `ComparedModel` of each.

    Attributes
    ----------
    validation : Record
        One input and one output.
    models : tuple of ComparedModel
        In the order in which they were given.

    Examples
    --------
    >>> beside = flexlink.compare(example_record(), flexlink.oe(example_record(), 2, 2))
    >>> len(beside.models), "fit_percent" in beside.table()
    (1, True)
    """

    table_in_notebook = True

    validation: Record
    models: tuple[ComparedModel, ...]

    def table(self) -> pd.DataFrame:
        """Return a row per model: order, fits in percent, seconds of its identification."""
        import pandas as pd

        columns = ("name", "order", "fit_percent", "one_step_percent", "fit_s")
        return pd.DataFrame([{name: getattr(model, name) for name in columns} for model in self.models])

    def plot(
        self,
        *,
        ax: Any = None,
        title: str | None = None,
        from_s: float | None = None,
        to_s: float | None = None,
    ) -> Figure:
        """Draw the measured output and each free run, its name and fit beside its curve.

        Parameters
        ----------
        ax : axes of matplotlib, optional
            To draw on in place of a new figure; rcParams of the caller hold.
        title : str, optional
            By default the record's name.
        from_s, to_s : float, optional
            Part of the record; by default the liveliest one of 400 samples.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ValueError
            No sample between these times.
        """
        from matplotlib.figure import Figure

        # A figure of the caller's keeps its settings; a new one only makes room for the labels.
        record = self.validation
        rows = self._rows(from_s, to_s)
        axes = Figure(layout="constrained").subplots() if ax is None else ax

        # What was measured is black, the models have the colours of the caller's cycle.
        time_s = record.time_s[rows]
        curves = [axes.plot(time_s, record.output[rows, 0], color="black", label="measured")[0]]
        for model in self.models:
            label = f"{model.name}: {model.fit_percent:.1f} %"
            curves += axes.plot(time_s, model.simulated[rows], label=label)

        # A unit that nobody stated is never guessed.
        unit = (record.output_units or ("",))[0] or "as logged"
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{record.output_names[0]} [{unit}]")
        axes.set_title(record.name if title is None else title)
        axes.margins(x=0)
        _label_beside(axes, curves)
        return cast("Figure", axes.figure)

    def _rows(self, from_s: float | None, to_s: float | None) -> slice:
        """Samples between two times, or the liveliest ones; ValueError where there is none."""
        from workflow.figures.bands import liveliest

        record = self.validation
        if from_s is None and to_s is None:
            return liveliest(record.output[:, 0], min(_DRAWN_SAMPLES, record.n_samples))
        # The samples that lie between the two times, both ends counted.
        begin = 0 if from_s is None else int(np.ceil(from_s / record.dt_s))
        end = record.n_samples if to_s is None else int(np.floor(to_s / record.dt_s)) + 1
        rows = slice(max(begin, 0), min(end, record.n_samples))
        if rows.stop - rows.start < 2:
            raise ValueError(
                f"from_s and to_s: no samples there; {record.label} goes from 0 to {record.time_s[-1]:.6g} s"
            )
        return rows


@front_door
def compare(
    validation: Record,
    *models: Any,
    names: str | Sequence[str] = (),
    ax: Any = None,
    title: str | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
) -> Comparison:
    """Run models of any origin freely on a validation record, and say how much of it each explains.

    Parameters
    ----------
    validation : Record
        One input and one output; better one that no model was fitted to.
    models : object
        Each a result of `identify`, `identify_frf` or `uncertainty`, a `GobfModel`, a model of `arx`,
        `armax`, `oe` or `n4sid`, a system of python-control or scipy.signal (one in continuous time is
        sampled with a held input), numbers (num, den, dt_s) in powers of z, or an impulse response (n,) at
        the record's sampling time.
    names : str or sequence of str
        Of the models, in the same order; by default what made them.
    ax : axes of matplotlib, optional
        Where `Comparison.plot` draws at once.
    title : str, optional
        Of that picture.
    from_s, to_s : float, optional
        Part of the record that it shows, s; by default a part in which single samples can be seen.

    Returns
    -------
    Comparison
        Fits of the free run, where there is a noise model also from sample to sample, orders and times. The
        start of each run and a constant are fitted to the record, as nobody knows what was before it.

    Raises
    ------
    ValueError
        One line: the first argument is no record, a model is none, has another sampling time or several
        signals, or names are not as many as models.

    Examples
    --------
    >>> log = example_record()
    >>> seen, fresh = log.slice(0, 1500), log.slice(1500, 2000)
    >>> found = flexlink.identify(seen, n_pairs=1, n_real=0)
    >>> both = flexlink.compare(fresh, found, flexlink.arx(seen, 2, 2), names=["GOBF", "ARX"])
    >>> both.table()[["name", "order"]]
       name  order
    0  GOBF      2
    1   ARX      2
    >>> bool(both.models[0].fit_percent > both.models[1].fit_percent)
    True
    """
    if not isinstance(validation, Record):
        raise WrongArgumentError(
            f"compare: the first argument is a {type(validation).__name__}; expected a validation record, "
            "flexlink.Record(u=u, y=y, dt_s=dt_s); to draw responses together: flexlink.bode(first, second)"
        )
    validation.refuse_several()

    # Names go with the models one by one; a single one may stand by itself.
    given_names = [names] if isinstance(names, str) else list(names)
    if not models:
        raise WrongArgumentError(f"compare: expected models after the record: {_EXPECTED}")
    if given_names and len(given_names) != len(models):
        raise WrongArgumentError(
            f"compare: expected a name for each model; got {len(given_names)} names of {len(models)} models"
        )

    # Each model is run as what made it runs it, and refused under its number.
    compared = []
    for number, model in enumerate(models, 1):
        result = _on_record(model, validation, f"compare: model {number}")
        compared.append(replace(result, name=given_names[number - 1]) if given_names else result)
    comparison = Comparison(validation, tuple(_numbered(compared)))
    if ax is not None:
        comparison.plot(ax=ax, title=title, from_s=from_s, to_s=to_s)
    return comparison


def _numbered(compared: Sequence[ComparedModel]) -> list[ComparedModel]:
    """The models, with their number before a name that another one has, too."""
    names = [model.name for model in compared]
    return [
        replace(model, name=f"{number}: {model.name}") if names.count(model.name) > 1 else model
        for number, model in enumerate(compared, 1)
    ]


def _on_record(model: Any, record: Record, what: str) -> ComparedModel:
    """A model of any origin on a record; what: its name in a refusal (WrongArgumentError)."""
    if isinstance(model, (Identification, FrfIdentification, GobfModel, ResponsePosterior)):
        return _gobf_on_record(model, record, what)
    if isinstance(model, np.ndarray | list) and np.ndim(model) == 1:
        return _impulse_on_record(np.asarray(model, dtype=np.float64), record, what)
    # Everything else has a state space: one free run and one predictor serve all of them.
    state_model = _innovation_model(model, record, what)
    _refuse_other_step(state_model.dt_s, record, what)
    measured = record.output[:, 0]
    simulated = state_model.free_run(record)
    predicted = state_model.one_step_ahead(record)
    return ComparedModel(
        name=state_model.method,
        order=model.order if isinstance(model, PolynomialModel) else state_model.order,
        fit_percent=fit_percent(measured, simulated),
        one_step_percent=np.nan if predicted is None else fit_percent(measured, predicted),
        fit_s=state_model.fit_s,
        simulated=simulated,
    )


def _innovation_model(model: Any, record: Record, what: str) -> InnovationModel:
    """A comparator's model, a system or (num, den, dt_s) in innovation form; without noise for a system."""
    import control

    if isinstance(model, InnovationModel):
        return model
    if isinstance(model, PolynomialModel):
        return model.innovation_form()
    name = type(model).__name__

    # Numbers and systems of scipy become systems of python-control first.
    if isinstance(model, tuple):
        if len(model) != 3:
            raise WrongArgumentError(f"{what} is a tuple of {len(model)}; expected (num, den, dt_s)")
        numerator, denominator, dt_s = model
        model = control.tf(np.atleast_1d(numerator), np.atleast_1d(denominator), float(dt_s))
    if type(model).__module__.startswith("scipy.signal") and hasattr(model, "to_ss"):
        matrices = model.to_ss()
        model = control.ss(matrices.A, matrices.B, matrices.C, matrices.D, matrices.dt or 0)
    if isinstance(model, control.lti.LTI) and model.dt == 0 and not is_measured(model):
        # The input of a log is held from row to row, so that sampling with a held input is exact.
        model = control.sample_system(control.ss(model), record.dt_s, "zoh")
    if not (is_measured(model) or isinstance(model, control.lti.LTI) or hasattr(model, "to_control")):
        raise WrongArgumentError(f"{what} is a {name}; expected {_EXPECTED}")
    system = state_space(model, what)
    return InnovationModel(system.A, system.B, system.C, system.D, None, float(system.dt), name)


def _gobf_on_record(model: Any, record: Record, what: str) -> ComparedModel:
    """A GOBF model, its posterior, or an identification that has one, on a record, as validation runs it.

    what: its name in a refusal. one_step_percent is nan where no noise model was found.
    """
    # A result of an identification has the model, and the noise that was found beside it.
    bare_model = getattr(model, "model", model)
    _refuse_other_step(bare_model.dt_s, record, what)
    fresh = fit_on_fresh_data(bare_model, record)
    # The first rows answer to an input before the record, where the model has a delay.
    simulated = np.full(record.n_samples, np.nan)
    simulated[record.n_samples - fresh.simulated.size :] = fresh.simulated
    one_step = np.nan
    noise_filter = getattr(model, "noise_filter", np.ones(1))
    if noise_filter.size > 1:
        # Behind the noise model what is left of the residual cannot be predicted from its past.
        measured = record.output[record.n_samples - fresh.residual.size :, 0]
        innovation = lfilter(noise_filter, [1.0], fresh.residual)
        one_step = fit_percent(measured, measured - innovation)
    return ComparedModel(
        name="GOBF posterior" if isinstance(model, ResponsePosterior) else "GOBF",
        # Those of a posterior are doubled where it is of the tangent method.
        order=bare_model.poles.order,
        fit_percent=fresh.fit_percent,
        one_step_percent=one_step,
        fit_s=getattr(model, "fit_s", np.nan),
        simulated=simulated,
    )


def _impulse_on_record(impulse: RealArray, record: Record, what: str) -> ComparedModel:
    """An impulse response (n,) on a record, in the rows whose inputs are all recorded."""
    if not 0 < impulse.size < record.n_samples:
        raise WrongArgumentError(
            f"{what} is an impulse response of {impulse.size} samples; expected 1 to fewer than the "
            f"{record.n_samples} of {record.label}"
        )
    # Before this row it asks for inputs that were not recorded. A constant is fitted, as for other models.
    first = impulse.size - 1
    measured = record.output[first:, 0]
    response = lfilter(impulse, [1.0], record.input[:, 0])[first:]
    response = response + (measured - response).mean()
    simulated = np.full(record.n_samples, np.nan)
    simulated[first:] = response
    fit = fit_percent(measured, response)
    return ComparedModel("impulse response", impulse.size - 1, fit, np.nan, np.nan, simulated)


def _refuse_other_step(dt_s: float, record: Record, what: str) -> None:
    """Raise WrongArgumentError where a model has another sampling time than the record."""
    if not abs(dt_s - record.dt_s) <= SAME_DT * record.dt_s:
        raise WrongArgumentError(
            f"{what} has dt_s = {dt_s:.6g}, {record.label} has {record.dt_s:.6g}: identify it from records "
            "of the same sampling time"
        )


def _one(record: Any) -> Record:
    """A record, refused in one line where it is none."""
    if not isinstance(record, Record):
        raise WrongArgumentError(
            f"expected a flexlink.Record, got {type(record).__name__}: flexlink.Record(u=u, y=y, dt_s=dt_s)"
        )
    return record


def _timed(fit: Callable[[], ModelT]) -> ModelT:
    """The model that a fit returns, with the seconds that it took."""
    # An unstable ARX model, tried as a start, can leave the range of doubles; the search then drops it.
    with np.errstate(over="ignore", invalid="ignore"):
        begin = perf_counter()
        model = fit()
        return replace(model, fit_s=perf_counter() - begin)


def _label_beside(axes: Any, curves: Sequence[Any]) -> None:
    """Write the label of each curve to the right of its end, in its colour, none over another."""
    # Where each curve ends, as a share of the height of the axes.
    low, high = axes.get_ylim()
    figure = axes.figure
    height_in = axes.get_position().height * figure.get_size_inches()[1]
    ends = []
    for curve in curves:
        values = np.asarray(curve.get_ydata(), dtype=float)
        finite = values[np.isfinite(values)]
        last = finite[-1] if finite.size else low
        ends.append(float(np.clip((last - low) / (high - low), 0.0, 1.0)))

    # Two labels need a line of text between them.
    letters_in = _font_points() / 72
    step = _LABEL_HEIGHT * letters_in / height_in
    order = np.argsort(ends)
    places = np.array(ends)
    # From below upwards each is at least a label's height above the one before it. Then all move down by what
    # they were raised in the mean, as far as the axes reach.
    for lower, upper in pairwise(order):
        places[upper] = max(places[upper], places[lower] + step)
    places -= min(np.mean(places - ends), places.min())
    places -= max(0.0, places.max() - 1.0)
    for curve, place in zip(curves, places, strict=True):
        axes.annotate(
            curve.get_label(),
            (1.0, place),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            color=curve.get_color(),
            annotation_clip=False,
        )


def _font_points() -> float:
    """Size of letters in points, as the caller's rcParams have it."""
    import matplotlib as mpl

    return float(mpl.rcParams["font.size"])
