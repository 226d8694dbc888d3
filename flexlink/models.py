"""Records in, models with their uncertainty out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from flexlink.keywords import one_line, options_of
from ident import response_uncertainty, several_outputs
from ident.basis.functions import basis_response, regressor
from ident.basis.model import GobfModel
from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.basis.poles import Poles
from ident.data.foreign_files import distinct
from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.frf_records import FrfRepeats
from ident.data.nonparametric import empirical_frf
from ident.data.record import Record as PlainRecord, in_one_unit
from ident.data.signal_filter import band_limited
from ident.data.table import Table
from ident.data.units import refuse_step
from ident.frequency_fit import FrfIdentification, identify_frf
from ident.identification import Identification, MimoIdentification
from ident.one_input import identify as identify_records
from ident.response_uncertainty import Uncertainty
from ident.search.error_surface import ErrorSurface, error_surface as surface_of
from ident.uncertainty import matrix_response
from ident.uncertainty.pole_intervals import pole_intervals

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


class Record(PlainRecord):
    """One uniformly sampled experiment, from arrays, pandas columns or (with `from_file`) a file.

    u, y : (T,) or (T, n), or a pandas column or table
        Input and output, one row per sample; `input` and `output` are accepted, too. Names of pandas columns
        become signal names; the default is u and y (u1, u2, ... if several).
    dt_s : float. Sampling time in seconds.
    reference : as y, optional. Closed-loop reference.

    input_names, output_names, reference_names : a name or several.

    u may be a time response of python-control (`control.forced_response`): its inputs, outputs and times. The
    other arguments are the attributes of `ident.Record`. Raises ValueError where shapes do not fit;
    nothing is transposed to make them.

    Examples
    --------
    >>> import numpy as np, pandas as pd, flexlink
    >>> flexlink.Record(u=np.ones(4), y=np.arange(4.0), dt_s=0.01)
    Record 'record': 4 samples, every 0.01 s, 0.04 s in all
      u -> y
    >>> log = pd.DataFrame({"voltage_V": [1.0, 1.0, 1.0], "angle_rad": [0.0, 0.1, 0.3]})
    >>> flexlink.Record(u=log["voltage_V"], y=log["angle_rad"], dt_s=0.01, name="first try")
    Record 'first try': 3 samples, every 0.01 s, 0.03 s in all
      voltage_V -> angle_rad
    >>> flexlink.Record(u=np.ones((1, 4)), y=np.arange(4.0), dt_s=0.01)
    Traceback (most recent call last):
    ValueError: u has 1 samples of 4 signals; expected one row per sample
    """

    def __init__(
        self,
        u: Any = None,
        y: Any = None,
        dt_s: float | None = None,
        *,
        name: str = "record",
        reference: Any = None,
        input: Any = None,  # noqa: A002 (the attribute's name)
        output: Any = None,
        input_names: str | Sequence[str] = (),
        output_names: str | Sequence[str] = (),
        reference_names: str | Sequence[str] = (),
        **more: Any,
    ) -> None:
        if y is None and all(hasattr(u, part) for part in ("time", "inputs", "outputs")):
            u, y, dt_s = _time_response(u, dt_s)
        if dt_s is None:
            raise ValueError("a record needs dt_s, the sampling time in seconds")
        if isinstance(dt_s, bool) or not isinstance(dt_s, (int, float, np.integer, np.floating)):
            raise ValueError(f"dt_s must be a positive number of seconds; got {dt_s!r}")
        u, y = (_either(*pair) for pair in (("u", u, "input", input), ("y", y, "output", output)))
        # Columns of pandas have to have the same rows: nothing is put in line by its index.
        indices = [getattr(one, "index", None) for one in (u, y, reference)]
        rows: list[Any] = [index for index in indices if hasattr(index, "equals")]
        if any(not index.equals(rows[0]) for index in rows):
            raise ValueError(
                "u and y have rows of different index; put them in line first: "
                "u, y = u.align(y, join='inner')"
            )
        inputs, input_names = _signals("u", u, input_names)
        outputs, output_names = _signals("y", y, output_names)
        if reference is not None:
            reference, reference_names = _signals("r", reference, reference_names)
        super().__init__(
            name=name,
            input=inputs,
            output=outputs,
            dt_s=dt_s,
            input_names=tuple(input_names),
            output_names=tuple(output_names),
            reference=reference,
            reference_names=_listed(reference_names),
            **more,
        )
        refuse_step(self.label, self.dt_s, self.output, self.time_column)

    @classmethod
    @one_line
    def from_file(cls, path: Any, inputs: Any, outputs: Any, *, references: Any = (), **more: Any) -> Self:
        """Columns of a log file, as `ident.Record.from_file`; a single name may stand by itself."""
        named = _listed(inputs), _listed(outputs)
        return super().from_file(path, *named, references=_listed(references), **more)

    @classmethod
    @one_line
    def from_table(
        cls,
        table: Any,
        input: str | Sequence[str],  # noqa: A002 (as in the command line)
        output: str | Sequence[str],
        *,
        time: str | None = None,
        **more: Any,
    ) -> Record:
        """Columns of a `pandas.DataFrame`, checked like those of a file.

        time: column of numbers (unit from its name, else seconds) or of date-times. Default: the index, if it
        holds times; otherwise give dt_s. Other arguments as in `from_file`.

        Examples
        --------
        >>> import pandas as pd
        >>> log = pd.DataFrame({"t_ms": [0, 5, 10, 15], "u_V": [1.0, 1, 0, 0], "hub_rad": [0, 0.1, 0.2, 0.2]})
        >>> flexlink.Record.from_table(log, "u_V", "hub_rad", time="t_ms")
        Record 'table': 4 samples, every 0.005 s, 0.02 s in all
          u_V -> hub_rad
          time column 't_ms' in ms
        >>> log.index = pd.date_range("2024-03-01", periods=4, freq="5ms")
        >>> flexlink.Record.from_table(log, "u_V", "hub_rad").dt_s
        0.005
        """
        names = distinct([str(name) for name in table.columns])
        columns = {name: table.iloc[:, k].to_numpy() for k, name in enumerate(names)}
        if time is None and "dt_s" not in more:
            columns["index"], time = table.index.to_numpy(), "index"
            if columns["index"].dtype.kind not in "mM":
                raise ValueError("give time, the name of a column, or dt_s: the table's index holds no times")
        return cls.from_file(Table(Path("table"), columns), input, output, time=time, **more)


def _listed(names: str | Sequence[str]) -> tuple[str, ...]:
    """One name or several."""
    return (names,) if isinstance(names, str) else tuple(names)


def _time_response(response: Any, dt_s: float | None) -> tuple[Any, Any, float]:
    """Input (T, n), output (T, n) and sampling time of a `control.TimeResponseData` (a row per signal)."""
    time = np.asarray(response.time, dtype=np.float64)
    step = float(time[-1] - time[0]) / max(time.size - 1, 1)
    if not step > 0 or not np.allclose(np.diff(time), step, rtol=0, atol=1e-6 * step):
        raise ValueError("the time response is not evenly sampled: give control.forced_response even times")
    if dt_s is not None and not np.isclose(dt_s, step, rtol=1e-6, atol=0):
        raise ValueError(
            f"dt_s is {dt_s:.6g} s, the times of the response are {step:.6g} s apart: leave dt_s out"
        )
    signals = [np.atleast_2d(np.asarray(part)) for part in (response.inputs, response.outputs)]
    if response.inputs is None or any(part.ndim != 2 for part in signals):
        raise ValueError(
            "the time response needs one input signal per row: control.forced_response(system, T, U)"
        )
    return signals[0].T, signals[1].T, step if dt_s is None else dt_s


def _either(short: str, first: Any, long: str, second: Any) -> Any:
    if (first is None) == (second is None):
        raise ValueError(f"give {short} (or, under its long name, {long}), once")
    return second if first is None else first


def _signals(
    default: str, values: Any, names: str | Sequence[str]
) -> tuple[npt.NDArray[np.float64], Sequence[str]]:
    """(T, n) and n names, from a vector, a table or their pandas forms."""
    names = _listed(names)
    if not names:  # pandas: a column has a name, a table has columns
        named = getattr(values, "columns", None)
        names = [str(c) for c in named] if named is not None else [str(getattr(values, "name", None) or "")]
    signals = _real(default, values)
    if signals.ndim == 1:
        signals = signals[:, None]
    if signals.ndim != 2:
        raise ValueError(f"{default} must be (T,) or (T, n); got shape {signals.shape}")
    if signals.shape[1] > max(signals.shape[0], 1):
        raise ValueError(
            f"{default} has {signals.shape[0]} samples of {signals.shape[1]} signals; "
            "expected one row per sample"
        )
    if not any(names):
        count = signals.shape[1]
        names = [default] if count == 1 else [f"{default}{i + 1}" for i in range(count)]
    return signals, names


def _real(name: str, values: Any) -> npt.NDArray[np.float64]:
    """As doubles, where nothing is lost."""
    found = np.asarray(values)
    if found.dtype.kind == "c":
        raise ValueError(
            f"{name} holds complex numbers; expected real ones: give {name}.real if that is meant"
        )
    if np.ma.is_masked(values):
        row = int(np.argwhere(np.ma.getmaskarray(values))[0][0])
        raise ValueError(f"{name} has no value at index {row} (masked); expected a number in every row")
    if found.dtype.kind not in "fiubO":
        raise ValueError(f"{name} holds {found.dtype}; expected real numbers")
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} holds what is no number; expected real numbers") from None


def identify(
    records: PlainRecord | Sequence[PlainRecord], options: IdentOptions | None = None, **settings: Any
) -> Identification:
    """Identify a model of one input and one output; the data choose the order unless you give it.

    settings: fields of `IdentOptions`, instead of `options`; as in `flexlink identify` the data decide about
    the noise unless you state it. Raises ValueError for a setting or a record that cannot be used.

    Examples
    --------
    >>> flexlink.identify(example_record(), n_pairs=1, n_real=0)
    GobfModel of order 2, u -> y, dt = 0.01 s: fits 99.0 % of record
      mode at 20 rad/s (3.18 Hz), damping ratio 0.0499
    """
    used, chosen = _records(records), options_of(IdentOptions, options, settings) or IdentOptions()
    if "noise" not in chosen.model_fields_set:
        chosen = chosen.model_copy(update={"noise": "auto"})
    found = identify_records(used, chosen)
    return replace(found, records=used, order_given=chosen.n_pairs is not None)


def identify_mimo(
    records: PlainRecord | Sequence[PlainRecord],
    options: IdentOptions | None = None,
    *,
    free_shapes: bool = False,
    start: Poles | None = None,
    **settings: Any,
) -> MimoIdentification:
    """Identify one model with shared poles of several inputs, outputs or both.

    settings: fields of `IdentOptions`, instead of `options`; with several outputs at most one integrator and
    no relative degree. free_shapes: leave every residue free, in place of one shape for every mode. start:
    poles where the search begins. Raises ValueError as `identify`.
    """
    chosen, used = options_of(IdentOptions, options, settings), _records(records)
    found = several_outputs.identify_mimo(used, chosen, free_shapes=free_shapes, start=start)
    return replace(found, records=used)


def matrix_posterior(
    records: PlainRecord | Sequence[PlainRecord], identification: MimoIdentification, *, level: float = 0.95
) -> matrix_response.MatrixPosterior:
    """Uncertainty of a matrix response: balls that hold it with probability `level` at every frequency."""
    return matrix_response.matrix_posterior(_records(records), identification, level=level)


def uncertainty(
    identification: Identification,
    records: PlainRecord | Sequence[PlainRecord] | EmbeddingOptions | None = None,
    options: EmbeddingOptions | None = None,
    **settings: Any,
) -> Uncertainty:
    """Posterior of the response around an identified model: noise, pole error and unmodelled dynamics.

    records: those of the identification; not needed if it came from `flexlink.identify`. settings: fields of
    `EmbeddingOptions`, instead of `options`; the data decide about a noise model unless you state one.
    `order_given` is taken from `flexlink.identify`. Ellipses of another level than 95 %:
    `spread.at(omega_rad_s).ellipse(level)`. Raises ValueError where the output does not answer to the input.

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
    if isinstance(records, EmbeddingOptions):
        records, options = None, records
    for name, mend in _ELSEWHERE.items():
        if name in settings:
            raise ValueError(f"{name} is no setting of uncertainty: {mend}")
    chosen = options_of(EmbeddingOptions, options, settings) or EmbeddingOptions()
    if "coloured_noise" not in chosen.model_fields_set:
        chosen = chosen.model_copy(update={"coloured_noise": "auto"})
    if chosen.order_given is None:
        chosen = chosen.model_copy(update={"order_given": getattr(identification, "order_given", False)})
    used = _records_of(identification, records)
    return response_uncertainty.uncertainty(used, identification, chosen)


def error_surface(
    identification: Identification,
    records: PlainRecord | Sequence[PlainRecord] | None = None,
    **settings: Any,
) -> ErrorSurface:
    """Mean square residual with one pole pair of an identified model moved over a grid, its others frozen.

    records: those of the identification, taken from it if it came from `flexlink.identify`. settings: `pair`
    (number of the pole pair, 0), `coordinates` ("log": omega and zeta, "raw": beta and gamma), `first` and
    `second` (grids), `n_points` of each grid (61). Raises ValueError if there is no such pair or a grid
    leaves the stable pairs.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> surface = flexlink.error_surface(found, n_points=21)
    >>> i, j = surface.local_minima()[0]
    >>> surface.names, bool(abs(surface.first[i] - 20) < 2)
    (('omega_rad_s', 'zeta'), True)
    """
    used = _records_of(identification, records)
    for name in {"first", "second"} & set(settings):
        settings[name] = np.asarray(settings[name], dtype=np.float64)
    return surface_of(used, identification.model, identification.structure, **settings)


_ELSEWHERE = {
    "level": "spread.at(omega_rad_s).ellipse(level) has ellipses of any level",
    "method": "the paper's recipe is validation.paper.classical.classical(records, model)",
}


def _records(records: Any) -> tuple[PlainRecord, ...]:
    """One record or several."""
    used = (records,) if isinstance(records, PlainRecord) else records
    if isinstance(used, (str, np.ndarray)) or not all(isinstance(each, PlainRecord) for each in used):
        raise ValueError(
            f"expected a flexlink.Record or several, got {type(records).__name__}: "
            "flexlink.Record(u=u, y=y, dt_s=dt_s)"
        )
    return tuple(in_one_unit(used))


def _records_of(identification: Any, records: Any) -> tuple[PlainRecord, ...]:
    """These records or those of the identification, of one input and one output."""
    model = getattr(identification, "model", None)
    if isinstance(identification, FrfIdentification):
        raise ValueError(
            "a fitted response brings its uncertainty: fitted.posterior, "
            "or its ellipses, fitted.posterior.at(omega_rad_s)"
        )
    if isinstance(identification, MimoIdentification):
        raise ValueError("several inputs or outputs: use flexlink.matrix_posterior(records, identification)")
    if not isinstance(model, GobfModel):
        raise ValueError(f"expected the result of flexlink.identify, got {type(identification).__name__}")
    used = _records(getattr(identification, "records", ()) if records is None else records)
    if not used:
        raise ValueError("give the records of the identification")
    return used
