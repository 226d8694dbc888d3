"""Records in, models with their uncertainty out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from flexlink.keywords import front_door, options_of
from ident import frequency_fit, response_uncertainty, several_outputs
from ident.basis import functions
from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.poles import Poles
from ident.data import nonparametric, signal_filter
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.frf_records import FrfRepeats
from ident.data.record import Record, in_one_unit
from ident.frequency_fit import FrfIdentification
from ident.identification import Identification, MimoIdentification
from ident.one_input import identify as identify_records
from ident.response_uncertainty import Uncertainty
from ident.search.error_surface import ErrorSurface, error_surface as surface_of
from ident.uncertainty import matrix_response, pole_intervals as intervals

__all__ = [
    "EmbeddingOptions",
    "FrequencyUncertainty",
    "FrfRepeats",
    "GobfModel",
    "IdentOptions",
    "Identification",
    "Poles",
    "Record",
    "Uncertainty",
    "band_limited",
    "basis_response",
    "empirical_frf",
    "error_surface",
    "identify",
    "identify_frf",
    "identify_mimo",
    "matrix_posterior",
    "pole_intervals",
    "regressor",
    "uncertainty",
]

# Functions of `ident`, on one thread and with calls refused in a line.
band_limited = front_door(signal_filter.band_limited)
basis_response = front_door(functions.basis_response)
empirical_frf = front_door(nonparametric.empirical_frf)
pole_intervals = front_door(intervals.pole_intervals)
regressor = front_door(functions.regressor)


@front_door
def identify(
    records: Record | Sequence[Record], options: IdentOptions | None = None, **settings: Any
) -> Identification:
    """Identify a model of one input and one output; the data choose the order unless you give it.

    Parameters
    ----------
    records : Record or sequence of Record
        One input and one output, of one machine.
    options : IdentOptions, optional
        Or its fields as settings: `n_real=0, n_pairs=1`. As in `flexlink identify` the data decide about the
        noise unless you state it.

    Returns
    -------
    Identification
        Model, fits in percent and warnings.

    Raises
    ------
    ValueError
        A setting or a record that cannot be used.

    Examples
    --------
    >>> flexlink.identify(example_record(), n_pairs=1, n_real=0)
    GobfModel of order 2, u -> y, dt = 0.01 s: fits 99.0 % of record
      mode at 20 rad/s (3.18 Hz), damping ratio 0.0499
    """
    used = _records(records)
    chosen = options_of(IdentOptions, options, settings) or IdentOptions()
    # As the command does: white noise is a claim, and nobody has made it.
    if "noise" not in chosen.model_fields_set:
        chosen = chosen.model_copy(update={"noise": "auto"})
    # What `compare` says of the time is the fit alone, without reading and checking.
    begin = perf_counter()
    identification = identify_records(used, chosen)
    fit_s = perf_counter() - begin
    return replace(identification, records=used, order_given=chosen.n_pairs is not None, fit_s=fit_s)


@front_door
def identify_frf(
    response: FrequencyUncertainty,
    options: IdentOptions | None = None,
    embedding: EmbeddingOptions | None = None,
    *,
    shared_gain_std: float = 0.0,
    **settings: Any,
) -> FrfIdentification:
    """Fit a GOBF model to a measured frequency response, each frequency weighted by its covariance.

    Parameters
    ----------
    response : FrequencyUncertainty
        (F,) frequencies in rad/s with a covariance at each; their errors are independent.
    options : IdentOptions, optional
        Or its fields as settings: `n_real=0, n_pairs=1`.
    embedding : EmbeddingOptions, optional
        Of the posterior.
    shared_gain_std : float
        Standard deviation of a gain error that all frequencies share, relative to 1.

    Returns
    -------
    FrfIdentification
        The model, its posterior, and what the data say of them; `ident.frequency_fit.identify_frf`.

    Raises
    ------
    ValueError
        A response that holds too little, or options that do not go together.

    Examples
    --------
    >>> response = flexlink.empirical_frf(example_record(), omega_min_rad_s=5.0, omega_max_rad_s=60.0)
    >>> fitted = flexlink.identify_frf(response, n_real=0, n_pairs=1)
    >>> fitted.model.poles.omega_rad_s(response.dt_s).round()
    array([20.])
    """
    chosen = options_of(IdentOptions, options, settings)
    return frequency_fit.identify_frf(response, chosen, embedding, shared_gain_std=shared_gain_std)


@front_door
def identify_mimo(
    records: Record | Sequence[Record],
    options: IdentOptions | None = None,
    *,
    free_shapes: bool = False,
    start: Poles | None = None,
    **settings: Any,
) -> MimoIdentification:
    """Identify one model with shared poles of several inputs, outputs or both.

    Parameters
    ----------
    records : Record or sequence of Record
        Of one machine: inputs (T, U), outputs (T, Y), one sampling time.
    options : IdentOptions, optional
        Or its fields as settings; with several outputs at most one integrator and no relative degree.
    free_shapes : bool
        Leave every residue free, in place of one shape for every mode.
    start : Poles, optional
        Where the search begins.

    Returns
    -------
    MimoIdentification

    Raises
    ------
    ValueError
        As of `identify`.

    Examples
    --------
    >>> found = flexlink.identify_mimo(example_two_joints(), n_real=0, n_pairs=1)
    >>> found.model.poles.omega_rad_s(0.01).round(1), found.rank_one
    (array([30.]), (True,))
    """
    chosen = options_of(IdentOptions, options, settings)
    used = _records(records)
    identification = several_outputs.identify_mimo(used, chosen, free_shapes=free_shapes, start=start)
    return replace(identification, records=used)


@front_door
def matrix_posterior(
    records: Record | Sequence[Record], identification: MimoIdentification, *, level: float = 0.95
) -> matrix_response.MatrixPosterior:
    """Return balls that hold a matrix response with probability `level` at every frequency.

    Parameters
    ----------
    records : Record or sequence of Record
        Those of the identification.
    identification : MimoIdentification
        Of `identify_mimo`.
    level : float
        Between 0 and 1.

    Returns
    -------
    MatrixPosterior
        `at(omega_rad_s)` has the balls.

    Examples
    --------
    >>> found = flexlink.identify_mimo(example_two_joints(), n_real=0, n_pairs=1)
    >>> omega = np.array([10.0, 30.0, 100.0])
    >>> balls = flexlink.matrix_posterior(example_two_joints(), found).at(omega)
    >>> balls.holds(found.model.frequency_response(omega))
    array([ True,  True,  True])
    """
    return matrix_response.matrix_posterior(_records(records), identification, level=level)


@front_door
def uncertainty(
    identification: Identification,
    records: Record | Sequence[Record] | EmbeddingOptions | None = None,
    options: EmbeddingOptions | None = None,
    **settings: Any,
) -> Uncertainty:
    """Posterior of the response around an identified model: noise, pole error and unmodelled dynamics.

    Parameters
    ----------
    identification : Identification
        Of `identify`.
    records : Record or sequence of Record, optional
        Those of the identification; not needed if it came from `flexlink.identify`.
    options : EmbeddingOptions, optional
        Or its fields as settings. The data decide about a noise model unless you state one; `order_given` is
        taken from `flexlink.identify`.

    Returns
    -------
    Uncertainty
        With ellipses at any frequency; of another level than 95 %: `spread.at(omega_rad_s).ellipse(level)`.

    Raises
    ------
    ValueError
        The output does not answer to the input.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> spread = flexlink.uncertainty(found)
    >>> spread
    Response u -> y, 95 % ellipses frequency by frequency: noise 0.01, from 1995 samples
      mode at 20 rad/s: semi-axis 0.084 % of the response
    >>> bool(spread.at([20.0]).contains(found.model.frequency_response([20.0]))[0])
    True
    """
    # Options may stand in the place of records, which the identification has itself.
    if isinstance(records, EmbeddingOptions):
        records, options = None, records
    # Words that are looked for here and stand elsewhere.
    for name, mend in _ELSEWHERE.items():
        if name in settings:
            raise ValueError(f"{name} is no setting of uncertainty: {mend}")
    chosen = options_of(EmbeddingOptions, options, settings) or EmbeddingOptions()
    if "coloured_noise" not in chosen.model_fields_set:
        chosen = chosen.model_copy(update={"coloured_noise": "auto"})
    # An order that was searched for is less certain than one that was given.
    if chosen.order_given is None:
        chosen = chosen.model_copy(update={"order_given": getattr(identification, "order_given", False)})
    used = _records_of(identification, records)
    return response_uncertainty.uncertainty(used, identification, chosen)


@front_door
def error_surface(
    identification: Identification,
    records: Record | Sequence[Record] | None = None,
    *,
    pair: int = 0,
    coordinates: Literal["raw", "log"] = "log",
    first: npt.ArrayLike | None = None,
    second: npt.ArrayLike | None = None,
    n_points: int = 61,
) -> ErrorSurface:
    """Mean square residual with one pole pair of an identified model moved over a grid, its others frozen.

    Parameters
    ----------
    identification : Identification
        Of `identify`.
    records : Record or sequence of Record, optional
        Those of the identification; not needed if it came from `flexlink.identify`.
    pair : int
        Number of the pole pair, from 0.
    coordinates : 'log' or 'raw'
        omega in rad/s and zeta, or beta and gamma of the paper.
    first, second : (n,) array, optional
        Grids of these; by default n_points of each around the identified pair.
    n_points : int
        Points of each default grid.

    Returns
    -------
    ErrorSurface

    Raises
    ------
    ValueError
        There is no such pair, or a grid leaves the stable pairs.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> surface = flexlink.error_surface(found, n_points=21)
    >>> i, j = surface.local_minima()[0]
    >>> surface.names, bool(abs(surface.first[i] - 20) < 2)
    (('omega_rad_s', 'zeta'), True)
    """
    used = _records_of(identification, records)
    return surface_of(
        used,
        identification.model,
        identification.structure,
        pair=pair,
        coordinates=coordinates,
        first=None if first is None else np.asarray(first, dtype=np.float64),
        second=None if second is None else np.asarray(second, dtype=np.float64),
        n_points=n_points,
    )


# Settings that people look for in `uncertainty`, and where to find what they want.
_ELSEWHERE = {
    "level": "spread.at(omega_rad_s).ellipse(level) has ellipses of any level",
    "method": "the paper's recipe is validation.paper.classical.classical(records, model)",
}


def _records(records: Any) -> tuple[Record, ...]:
    """One record or several."""
    used = (records,) if isinstance(records, Record) else records
    if isinstance(used, (str, np.ndarray)) or not all(isinstance(each, Record) for each in used):
        raise ValueError(
            f"expected a flexlink.Record or several, got {type(records).__name__}: "
            "flexlink.Record(u=u, y=y, dt_s=dt_s)"
        )
    return tuple(in_one_unit(used))


def _records_of(identification: Any, records: Any) -> tuple[Record, ...]:
    """These records or those of the identification, of one input and one output."""
    model = getattr(identification, "model", None)
    # The uncertainty of a measured response is that of its measurement.
    if isinstance(identification, FrfIdentification):
        raise ValueError(
            "a fitted response brings its uncertainty: fitted.posterior, "
            "or its ellipses, fitted.posterior.at(omega_rad_s)"
        )
    if isinstance(identification, MimoIdentification):
        raise ValueError("several inputs or outputs: use flexlink.matrix_posterior(records, identification)")
    if not isinstance(model, GobfModel):
        raise ValueError(f"expected the result of flexlink.identify, got {type(identification).__name__}")
    # A model that was read from a file has no records with it.
    used = _records(getattr(identification, "records", ()) if records is None else records)
    if not used:
        raise ValueError("give the records of the identification")
    return used
