"""Measured signals of one experiment: sampled uniformly, checked once, and read from files of any format.

`Record` is what every estimator takes: inputs, outputs and references as arrays with names and units, and
what is known of how they were read. Whoever makes one is told at once, in one line, what does not fit, so
that later code need not check. `Record.from_file` makes one from columns of a log: it chooses a run, unwraps
and scales signals, finds the sampling time or a uniform grid, and notes what looks doubtful
(`reading_notes`). `in_one_unit` converts the records of a set to common units. Nothing is corrected without
being asked for or noted. A number in `shown(text, 40)` is how many characters of a name a complaint quotes;
it decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from ident.data.arrays import RealArray, readonly
from ident.data.finding import Finding, FindingKind, finding
from ident.data.foreign_files import as_typed, distinct, shown
from ident.data.keywords import clear_call, clear_constructor
from ident.data.record_files import read_table
from ident.data.shown import Shown
from ident.data.signals import (
    is_time_response,
    listed,
    of_time_response,
    once,
    refuse_other_rows,
    signals_of,
)
from ident.data.table import LARGEST, Table
from ident.data.text_numbers import is_bookkept, number
from ident.data.time_grid import CoarseGrid, Repair, TimeGrid, clock_doubts, sampling_time
from ident.data.units import TimeColumn, contradicted_by_loop, per, refuse_step
from ident.data.wrapping import no_reading, spikes_in, unwrapped, wraps_at

T = TypeVar("T")

# Relative difference of sampling times up to which they are those of one clock: clocks of hosts differ by
# less. It is a thousandth of every frequency, below what most records tell.
SAME_CLOCK = 1e-3
# Relative difference up to which the sampling times of a record and of a model are equal: rounding.
SAME_DT = 1e-9
# Readings may span this share more than the period at which they wrap: rounding of decimals written with
# seven digits or more.
BEYOND_PERIOD = 1e-6


@clear_constructor
@dataclass(frozen=True, eq=False, repr=False, init=False)
class Record(Shown):
    """One uniformly sampled experiment: T samples of U inputs, Y outputs and R references.

    Made of arrays, pandas columns, a time response of python-control, or (with `from_file`, `from_table`) of
    a log. Arguments that are not listed here are the attributes of that name.

    Parameters
    ----------
    u, y : array-like, shape (T,) or (T, n), or a pandas column or table
        Input and output, one row per sample; `input` and `output` are accepted, too. Names of pandas columns
        become signal names; the default is u and y (u1, u2, ... if several). u may be a time response of
        python-control (`control.forced_response`): its inputs, outputs and times.
    dt_s : float
        Sampling time, s.
    reference : as y, optional
        Set points of a closed loop.
    input_names, output_names, reference_names : str or sequence of str
        A single name may stand by itself.

    Attributes
    ----------
    name : str
        Shown to the user.
    input : ndarray, shape (T, U)
        In the units of `input_units`; U at least 1.
    output : ndarray, shape (T, Y)
        In the units of `output_units`; Y at least 1.
    dt_s : float
        Sampling time, s.
    input_names, output_names : tuple of str
        Of the columns, distinct.
    reference : ndarray, shape (T, R), or None
        Set points of a closed loop, in their units, which are not kept.
    reference_names : tuple of str
        Empty without a reference.
    input_units, output_units : tuple of str
        Free text; empty, or one per column.
    source : str
        The file, named in error messages; '' where there is none.
    time_column : TimeColumn or None
        What time stamps were taken for (its `unit`, and whether that is `doubtful`); None where dt_s was
        given without.
    repair : Repair or None
        What was done to rows that jittered or were missing: how many samples, and how far off stamps were.
    cut : int
        Samples of the commanded input beyond what the amplifier gives (`limited`).
    notes : tuple of Finding
        What is to be known of the way the file was read: a kind and the values of its sentence, each.
    own_units : mapping of str to str
        By column, the unit that the file says, before anything is stated; with a scale, '0.1 * deg'.

    Raises
    ------
    ValueError
        A shape or a name does not fit (nothing is transposed to make it fit), dt_s is not positive or no
        machine's, or a sample is not finite or above 1e100 (names the first one).

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

    name: str
    input: RealArray
    output: RealArray
    dt_s: float
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    reference: RealArray | None = None
    reference_names: tuple[str, ...] = ()
    input_units: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    source: str = ""
    time_column: TimeColumn | None = None
    repair: Repair | None = None
    cut: int = 0
    notes: tuple[Finding, ...] = ()
    own_units: Mapping[str, str] = field(default_factory=dict, metadata={"since": 2})

    def __init__(
        self,
        u: Any = None,
        y: Any = None,
        dt_s: float | None = None,
        *,
        name: str = "record",
        input: Any = None,  # noqa: A002 (the attribute's name)
        output: Any = None,
        reference: Any = None,
        input_names: str | Sequence[str] = (),
        output_names: str | Sequence[str] = (),
        reference_names: str | Sequence[str] = (),
        input_units: Sequence[str] = (),
        output_units: Sequence[str] = (),
        source: str = "",
        time_column: TimeColumn | None = None,
        repair: Repair | None = None,
        cut: int = 0,
        notes: Sequence[Finding] = (),
        own_units: Mapping[str, str] | None = None,
    ) -> None:
        """Take the signals, lock them, and check that everything fits together (ValueError)."""
        if y is None and is_time_response(u):
            u, y, dt_s = of_time_response(u, dt_s)
        if dt_s is None:
            raise ValueError("a record needs dt_s, the sampling time in seconds")
        if isinstance(dt_s, bool) or not isinstance(dt_s, (int, float, np.integer, np.floating)):
            found = repr(dt_s) if np.ndim(dt_s) == 0 else f"values of shape {np.shape(dt_s)}"
            raise ValueError(f"dt_s must be a positive number of seconds; got {found}")
        u = once("u", u, "input", input)
        y = once("y", y, "output", output)
        refuse_other_rows(u, y, reference)
        inputs, input_names = signals_of("u", u, input_names)
        outputs, output_names = signals_of("y", y, output_names)
        if reference is not None:
            reference, reference_names = signals_of("r", reference, reference_names)
        values = {
            "name": name,
            "input": inputs,
            "output": outputs,
            "dt_s": dt_s,
            "input_names": tuple(input_names),
            "output_names": tuple(output_names),
            "reference": reference,
            "reference_names": listed(reference_names),
            "input_units": tuple(input_units),
            "output_units": tuple(output_units),
            "source": source,
            "time_column": time_column,
            "repair": repair,
            "cut": cut,
            "notes": tuple(notes),
            "own_units": {} if own_units is None else own_units,
        }
        # Fields of a frozen class are set through `object`.
        for key, value in values.items():
            object.__setattr__(self, key, value)
        self._refuse_misfits()
        refuse_step(self.label, self.dt_s, self.output, self.time_column)

    def _refuse_misfits(self) -> None:
        """Lock the arrays and check them against names, units and one another. Raises ValueError."""
        if not (np.isfinite(self.dt_s) and self.dt_s > 0):
            raise ValueError(f"{self.label}: dt_s must be a positive number of seconds; got {self.dt_s}")
        self._check("input", self.input_names)
        self._check("output", self.output_names)
        if self.reference is not None:
            self._check("reference", self.reference_names)
        elif self.reference_names:
            raise ValueError(f"{self.label}: reference_names given without a reference")
        for key, names in (("input_units", self.input_names), ("output_units", self.output_names)):
            units = getattr(self, key)
            if len(units) not in (0, len(names)):
                raise ValueError(f"{self.label}: {key} must be empty or one per column; got {units}")

    def _check(self, key: str, names: tuple[str, ...]) -> None:
        """Replace a signal ('input', 'output' or 'reference') by a locked copy (T, C) with these C names.

        Raises ValueError where shape, length, names or a sample does not fit.
        """
        signal = readonly(getattr(self, key))
        object.__setattr__(self, key, signal)
        if signal.ndim != 2 or signal.shape[1] != len(names) or not names:
            raise ValueError(
                f"{self.label}: {key} must be (T, {len(names)}), one column per name {list(names)}; got "
                f"shape {signal.shape}"
            )
        if len(set(names)) != len(names):
            raise ValueError(f"{self.label}: {key} names must be distinct; got {list(names)}")
        n_samples = signal.shape[0]
        n_input_samples = np.shape(self.input)[0]
        if n_samples != n_input_samples or n_samples < 1:
            raise ValueError(
                f"{self.label}: {key} has {n_samples} samples and input {n_input_samples}; "
                "they must be equally long, at least one"
            )
        # NaN compares as false, so it is among those that are not small enough.
        refused = np.argwhere(~(np.abs(signal) <= LARGEST))
        if refused.size:
            k, column = refused[0]
            raise ValueError(
                f"{self.label}: {key} column '{names[column]}' is {signal[k, column]:.6g} at index {k}; "
                f"expected finite numbers, magnitudes up to {LARGEST:g} (else choose another unit)"
            )

    @property
    def label(self) -> str:
        """How error messages call this record: the file if there is one, else the name.

        Neither has to be there: '' is quoted as it is.
        """
        return self.source or f"record '{self.name}'"

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What to know of the record before trusting a frequency: its time base, repairs, and notes.

        Empty where nothing is.
        """
        doubts: list[Finding] = []
        if self.time_column is not None and self.time_column.doubtful:
            doubts.append(self.time_column.doubt(self.dt_s))
        if self.repair is not None:
            doubts.append(self.repair.finding(self.label, self.dt_s))
        return (*doubts, *self.notes)

    @property
    def n_samples(self) -> int:
        """T, samples of each signal."""
        return int(self.input.shape[0])

    @property
    def time_s(self) -> RealArray:
        """Sampling instants (T,), s, starting at 0."""
        return np.arange(self.n_samples, dtype=np.float64) * self.dt_s

    def sampled_like(self, other: Record) -> bool:
        """Whether the sampling times of two records are one but for the clocks of hosts, to 0.1 %.

        Relative to the other's. Both are positive, as records are checked.
        """
        return abs(self.dt_s - other.dt_s) <= SAME_CLOCK * other.dt_s

    def refuse_several(self, dt_s: float | None = None, inputs: int = 1) -> None:
        """Refuse another number of inputs, several outputs, or another sampling time.

        Parameters
        ----------
        dt_s : float, optional
            The sampling time of a model, s, which the record has to have.
        inputs : int
            Inputs that are expected.

        Raises
        ------
        ValueError
            The record does not fit; a dt_s that is NaN fits none.
        """
        if self.input.shape[1] != inputs or self.output.shape[1] != 1:
            expected = f"{inputs} inputs" if inputs > 1 else "one input"
            raise ValueError(
                f"{self.label}: need {expected} and one "
                f"output, got {list(self.input_names)} and {list(self.output_names)}; choose with Record.siso"
            )
        # A model of another sampling time would be another plant.
        if dt_s is not None and not abs(self.dt_s - dt_s) <= SAME_DT * dt_s:
            raise ValueError(f"{self.label}: dt_s = {self.dt_s}, the model has {dt_s}")

    def only(self, output: int) -> Record:
        """Return the record with one output alone, given by its index; the inputs stay.

        IndexError for an index that is none; a negative one counts from the end.
        """
        # A list as the index keeps the column two-dimensional.
        return replace(
            self,
            output=self.output[:, [output]],
            output_names=(self.output_names[output],),
            output_units=self.output_units[output : output + 1],
        )

    def siso(self, input_name: str | None = None, output_name: str | None = None) -> Record:
        """Return the record with one input and one output.

        The reference stays as it is, with all its columns.

        Parameters
        ----------
        input_name, output_name : str, optional
            May be left out where there is only one column.

        Raises
        ------
        ValueError
            No column of that name, or none named among several.
        """
        i = self._column("input", self.input_names, input_name)
        o = self._column("output", self.output_names, output_name)
        return replace(
            self.only(o),
            input=self.input[:, [i]],
            input_names=(self.input_names[i],),
            input_units=self.input_units[i : i + 1],
        )

    def _column(self, key: str, names: tuple[str, ...], name: str | None) -> int:
        """Return the index of a name among those of the columns of a signal (key: 'input' or 'output').

        Raises ValueError where it is not there, or None among several.
        """
        if name is None and len(names) == 1:
            return 0
        if name not in names:
            raise ValueError(f"{self.label}: no {key} column {name!r}; there is {list(names)}")
        return names.index(name)

    def slice(self, start: int, stop: int) -> Record:
        """Return samples start <= k < stop; the new record's time starts at 0 again.

        Raises
        ------
        ValueError
            Unless 0 <= start < stop <= T.
        """
        if not 0 <= start < stop <= self.n_samples:
            raise ValueError(
                f"{self.label}: samples {start} to {stop}: expected 0 <= start < stop <= "
                f"{self.n_samples}, the number there are"
            )
        return self.each(lambda signal: signal[start:stop])

    def limited(self, limit: float) -> Record:
        """Return the record with inputs cut off at a limit, both signs, as an amplifier does.

        Parameters
        ----------
        limit : float
            In units of the inputs, one for all of them.

        Raises
        ------
        ValueError
            The limit is not positive, or NaN.
        """
        if not limit > 0:
            raise ValueError(f"the limit of the input must be positive; got {limit:g}")
        n_beyond = int(np.sum(np.abs(self.input) > limit))
        return replace(self, input=np.clip(self.input, -limit, limit), cut=n_beyond)

    def each(self, change: Callable[[RealArray], RealArray]) -> Record:
        """Return the record with its input, output and reference, (T, .) each, changed alike.

        change: takes and returns an array of two dimensions, columns kept; what it makes of them is checked
        as any record is (ValueError).
        """
        reference = None if self.reference is None else change(self.reference)
        return replace(self, input=change(self.input), output=change(self.output), reference=reference)

    @classmethod
    @clear_call
    def from_file(
        cls,
        path: str | PathLike[str] | Table,
        inputs: str | Sequence[str],
        outputs: str | Sequence[str],
        *,
        time: str | None = None,
        dt_s: float | None = None,
        time_unit: str | None = None,
        references: str | Sequence[str] = (),
        name: str | None = None,
        scale: Mapping[str, float] | None = None,
        offset: Mapping[str, float] | None = None,
        units: Mapping[str, str] | None = None,
        repair: bool = False,
        resample_s: float | None = None,
        unwrap: Mapping[str, float] | None = None,
        decimal: str | None = None,
        run: int | None = None,
    ) -> Self:
        """Read columns of a log file.

        Parameters
        ----------
        path : path-like or Table
            The file, or a table that was read before; formats: `ident.data.record_files`.
        inputs, outputs, references : str or sequence of str
            Names of columns; a single one may stand by itself.
        time : str, optional
            The column of time stamps. The sampling time comes from it, from `dt_s`, or from both if they
            agree.
        dt_s : float, optional
            Sampling time, s.
        time_unit : str, optional
            Of the time column; default: the unit in the column's name ('t_ms', 'Zeit [ms]'), else seconds.
        name : str, optional
            Of the record; default: the file's name without its ending, and the run.
        scale, offset : mapping of str to float, optional
            By column: the quantity is scale * column + offset. Defaults 1 and 0. That they are finite is not
            checked here, but samples that are not are refused.
        units : mapping of str to str, optional
            By column: the unit of that quantity.
        repair : bool
            Stamps that jitter, and single missing rows, are put on a uniform grid (`TimeGrid`).
        resample_s : float, optional
            All rows are put on a grid of this step, s (`CoarseGrid`).
        unwrap : mapping of str to float, optional
            By column, the period at which its readings wrap (4096, 360), before scale and offset.
        decimal : str, optional
            'point' or 'comma', where the numbers leave a doubt.
        run : int, optional
            Of a table in which time starts again (`Table.runs`), from 0.

        Raises
        ------
        ValueError
            In one line that begins with the file: it cannot be read, names of columns are missing or used
            twice, cells are no finite numbers (with their line), time does not increase or keeps to no grid,
            no machine has that sampling time, or an option is of a column that is no signal. The message says
            what helps. `units` are free text and not checked.
        """
        table = path if isinstance(path, Table) else read_table(path)
        table = _one_run(table.with_decimal(decimal), time, run)
        label = str(table.path)
        inputs = listed(inputs)
        outputs = listed(outputs)
        references = listed(references)
        _refuse_roles(table, inputs, outputs, references, time, time_unit)
        scale = scale or {}
        offset = offset or {}
        units = units or {}
        unwrap = unwrap or {}

        # Columns that have rows of their own are taken on those of the output: what drives it is held between
        # its rows, as in a bag.
        signal_names = [*inputs, *outputs, *references]
        base = outputs[0] if table.sparse else None
        columns = table.columns(signal_names if time is None else [time, *signal_names], base)
        stamps: RealArray | None = None
        time_column: TimeColumn | None = None
        if time is not None:
            stamps, time_column = table.seconds(time, columns[time], time_unit)
        # A statement about a column that is not used is a misspelt name, and would be ignored in silence.
        for column in (*scale, *offset, *units, *unwrap):
            if column not in signal_names:
                raise ValueError(
                    f"{label}: scale, offset, unit or unwrap of column {column!r}, which is not used as a "
                    "signal"
                )

        # Readings go on where they are said to wrap; then the file is looked at for what else is doubtful.
        notes: list[Finding] = []
        for column, period in unwrap.items():
            columns[column], longest_share = _unwrapped(columns[column], column, period, label)
            if longest_share:
                notes.append(finding(FindingKind.LONG_STEPS, record=label, name=column, share=longest_share))
        if time_column is not None and time_column.wraps:
            notes.append(time_column.timer(label))
        notes += reading_notes(table, columns, inputs, outputs, references)
        usual_step_s = dt_s
        if stamps is not None:
            usual_step_s = float(np.median(np.diff(stamps))) if stamps.size > 1 else None
        if usual_step_s is not None and 0 < usual_step_s < np.inf:
            moved = np.column_stack([columns[column] for column in outputs])
            refuse_step(label, usual_step_s, moved, time_column)

        # The sampling time, of the stamps or of the grid that they are put on.
        grid: TimeGrid | CoarseGrid | None = None
        if resample_s is not None:
            if time is None or stamps is None or dt_s is not None:
                raise ValueError(f"{label}: resample_s needs a time column, and no dt_s beside it")
            grid = CoarseGrid.of(table, time, stamps, resample_s)
        elif repair and time is not None and stamps is not None:
            grid = TimeGrid.of(table, time, stamps)
        if grid is not None:
            stamps = np.asarray(grid.dt_s * np.arange(grid.n_samples), dtype=np.float64)
        step_s = sampling_time(table, stamps, time, dt_s)
        if grid is None and stamps is not None:
            notes += clock_doubts(stamps, label)

        def quantities(names: Sequence[str], *, held: bool) -> RealArray:
            """Return columns (T, C) in their units, on the grid; held: from row to row, as a command is.

            (0, 0) for no names, which `Record` then refuses.
            """
            if not names:
                return np.zeros((0, 0))
            signals = []
            for column in names:
                signal = columns[column] * scale.get(column, 1.0) + offset.get(column, 0.0)
                if grid is not None:
                    signal = grid.held(signal) if held else grid.sampled(signal)
                signals.append(signal)
            return np.column_stack(signals)

        # A stated unit counts, else the file's; of a scaled column nobody knows it. What the file says itself
        # is kept beside, with the scale, to compare the logs of a set (`in_one_unit`).
        unit_of = {}
        own_units = {}
        for column in signal_names:
            file_unit = table.unit(column)
            unit_of[column] = units.get(column, "" if column in scale else file_unit)
            if file_unit and column in scale:
                own_units[column] = f"{scale[column]:g} * {file_unit}"
            elif file_unit:
                own_units[column] = unit_of[column]

        def units_of(names: Sequence[str]) -> tuple[str, ...]:
            """Return the units of columns; none where no column has one.

            names: of columns that are used (KeyError else); a column without a unit has ''.
            """
            stated = tuple(unit_of[column] for column in names)
            return stated if any(stated) else ()

        # Outputs are read at instants; commands and references are held from one row to the next. A loop
        # shows whether units are right: its output follows its reference.
        command = quantities(inputs, held=True)
        output = quantities(outputs, held=False)
        reference = quantities(references, held=True) if references else None
        if reference is not None and len(references) == len(outputs) == 1 and inputs:
            loop_names = (references[0], outputs[0], inputs[0])
            loop_units = [unit_of[column] for column in loop_names]
            notes += contradicted_by_loop(
                reference[:, 0], output[:, 0], command[:, 0], loop_names, loop_units, scale
            )
        if name is None:
            name = f"{table.path.stem}, {table.run}" if table.run else table.path.stem
        return cls(
            name=name,
            input=command,
            output=output,
            dt_s=step_s,
            input_names=tuple(inputs),
            output_names=tuple(outputs),
            reference=reference,
            reference_names=tuple(references),
            input_units=units_of(inputs),
            output_units=units_of(outputs),
            source=label,
            time_column=time_column,
            repair=None if grid is None else grid.repair,
            notes=tuple(notes),
            own_units=own_units,
        )

    @classmethod
    @clear_call
    def from_table(
        cls,
        table: Any,
        input: str | Sequence[str],  # noqa: A002 (as in the command line)
        output: str | Sequence[str],
        *,
        time: str | None = None,
        **more: Any,
    ) -> Self:
        """Columns of a `pandas.DataFrame`, checked like those of a file.

        Parameters
        ----------
        table : pandas.DataFrame
            A row per sample.
        input, output : str or sequence of str
            Names of columns.
        time : str, optional
            Column of numbers (unit from its name, else seconds) or of date-times. Default: the index, if it
            holds times; otherwise give dt_s.
        more : object
            As in `from_file`.

        Raises
        ------
        ValueError
            As `from_file`; and where neither time nor dt_s is given and the index holds no times.

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
            index = table.index.to_numpy()
            if index.dtype.kind not in "mM":
                raise ValueError("give time, the name of a column, or dt_s: the table's index holds no times")
            columns["index"] = index
            time = "index"
        return cls.from_file(Table(Path("table"), columns), input, output, time=time, **more)


def _one_run(table: Table, time: str | None, run: int | None) -> Table:
    """Return a table, or the chosen run of it where time starts again.

    time: name of the time column; run: from 0. Raises ValueError where there are several runs and none is
    chosen, or no such run. A table without time column, or whose stamps cannot be read, is one run.
    """
    # Runs are called by the column that numbers them, 'run 3'; they are chosen by their place.
    runs = table.runs(time)
    if run is None and len(runs) == 1:
        return table
    if run is None or not 0 <= run < len(runs):
        what = f"{len(runs)} runs, {runs[0].run} to {runs[-1].run}" if runs[0].run else "one run"
        raise ValueError(f"{table.path}: holds {what}; expected one of them: run = 0 to {len(runs) - 1}")
    return runs[run]


def _refuse_roles(
    table: Table,
    inputs: Sequence[str],
    outputs: Sequence[str],
    references: Sequence[str],
    time: str | None,
    time_unit: str | None,
) -> None:
    """Raise ValueError where the names of columns, or of the time column, do not go together.

    No column is two things, a unit of time needs a time column, and a table
    whose columns have rows of their own needs one, too. That the columns are there is not asked here but by
    `Table.columns`.
    """
    if time in (*inputs, *outputs, *references):
        raise ValueError(f"{table.path}: column {time!r} is named as time and as a signal; expected two")
    if time is None and time_unit is not None:
        raise ValueError(f"{table.path}: time_unit = '{time_unit}' without a time column; name it (time)")
    for name in inputs:
        if name in outputs:
            raise ValueError(f"{table.path}: column {name!r} is named as input and output; expected two")
    if table.sparse and time is None:
        raise ValueError(
            f"{table.path}: columns have rows of their own (other cells are empty); name the time column "
            "(--time)"
        )


def _unwrapped(values: RealArray, name: str, period: float, label: str) -> tuple[RealArray, float]:
    """Return readings (T,) of a column going on, and the share of the period that their longest step is where
    it may go the wrong way, else 0 (`wrapping.unwrapped`).

    period: in units of the readings; label: the file, for complaints. Raises ValueError where the period is
    not positive, or the readings span more than it. values: finite, at least one.
    """
    if not (np.isfinite(period) and period > 0):
        raise ValueError(f"{label}: column {name!r} wraps at a positive number; got {period}")
    span = float(np.ptp(values))
    if span > period * (1 + BEYOND_PERIOD):
        raise ValueError(
            f"{label}: column {name!r} spans {span:.9g}, more than the {period:g} at which it is said to wrap"
        )
    return unwrapped(values, period)


def reading_notes(
    table: Table,
    columns: Mapping[str, RealArray],
    inputs: Sequence[str],
    outputs: Sequence[str],
    references: Sequence[str] = (),
) -> tuple[Finding, ...]:
    """Return what a user should know of the way a file was read.

    Parameters
    ----------
    table : Table
        Of it matter here: the layout of a text file (rows that were skipped or cut), clocks, cells and units.
    columns : mapping of str to ndarray, shape (T,) each
        Inputs, outputs and references as they are used, before scale and offset; finite. KeyError where one
        is missing.
    inputs, outputs, references : sequence of str
        Names of columns.

    Returns
    -------
    tuple of Finding
        Rows left out, inputs held between their rows, units that contradict the name, numbers in brackets,
        outputs that seem to wrap, spikes, and numbers that stand for no reading.
    """
    # Of a text file: lines that are no rows, and a last row that the file cuts.
    record = str(table.path)
    notes = list[Finding]()
    layout = table.layout
    if layout is not None and layout.commented:
        first = layout.skipped[0]
        notes.append(finding(FindingKind.SKIPPED_ROWS, record=record, rows=layout.commented, line=first))
    if layout is not None and layout.cut:
        notes.append(finding(FindingKind.CUT_ROW, record=record, line=layout.cut))
    if layout is not None and layout.footer:
        notes.append(finding(FindingKind.FOOTER, record=record, line=layout.footer))

    # Inputs that have rows of their own are held between them.
    if table.sparse:
        for name in inputs:
            if not np.array_equal(table.clocks[name], table.clocks[outputs[0]]):
                notes.append(finding(FindingKind.HELD, record=record, name=name, output=outputs[0]))
    # The name of a column and what stands beside it may say two units.
    for name in (*inputs, *outputs):
        contradicting_units = table.contradiction(name)
        if contradicting_units:
            notes.append(
                finding(FindingKind.UNIT_CONTRADICTED, record=record, name=name, units=contradicting_units)
            )
    for name in (*inputs, *outputs):
        bookkept = _bookkept(table, name)
        if bookkept is not None:
            notes.append(bookkept)

    # Readings that wrap also jump: they are not looked at for spikes below.
    wrapping = set()
    for name in outputs:
        period = wraps_at(columns[name])
        if period:
            wrapping.add(name)
            notes.append(finding(FindingKind.WRAPS, record=record, name=name, period=period))

    # An output that jumps away and comes back has spikes; a command may be a pulse, which is meant, and so
    # only numbers that stand for no reading count there.
    for name in (*inputs, *references, *outputs):
        if name in wrapping:
            continue
        values = columns[name]
        is_output = name in outputs
        kind = FindingKind.SPIKES
        rows = spikes_in(values) if is_output else np.zeros(0, dtype=np.int64)
        if not rows.size:
            kind = FindingKind.NO_READING
            rows = no_reading(values, command=not is_output)
        if rows.size:
            first_row = int(rows[0])
            notes.append(
                finding(
                    kind,
                    record=record,
                    name=name,
                    value=values[first_row],
                    place=table.place(first_row, name),
                    rows=rows.size,
                )
            )
    return tuple(notes)


def _bookkept(table: Table, name: str) -> Finding | None:
    """Return the finding on a column of text with negative numbers like '(3.25)' and '3.25-', or None.

    Book-keepers write minus signs so. The finding names the first such cell and what it was read as. None,
    too, for a column that is no text; KeyError for a name that is no column.
    """
    cells = table.raw[name]
    if table.layout is None or not isinstance(cells, tuple):
        return None
    decimal = table.layout.decimal
    rows = [row for row, cell in enumerate(cells) if is_bookkept(cell, decimal)]
    if not rows:
        return None
    first_cell = cells[rows[0]]
    return finding(
        FindingKind.BOOKKEPT,
        record=str(table.path),
        name=name,
        place=table.place(rows[0], name),
        cell=first_cell,
        value=number(first_cell, decimal),
        rows=len(rows),
    )


def in_one_unit(records: Sequence[Record]) -> list[Record]:
    """Return records of one set with each column in the unit that it has in the first one that says a unit.

    Parameters
    ----------
    records : sequence of Record
        Columns of one name are of one quantity. Where a record says no unit, its numbers stay. None: none
        come back.

    Returns
    -------
    list of Record
        Those that were converted have a note of it for each column.

    Raises
    ------
    ValueError
        One line: units of a column that are not of one quantity.
    """
    # By column: the unit that counts, and the record that says it.
    first_said = dict[str, tuple[str, str]]()
    converted = list[Record]()
    for record in records:
        # Each side by itself: one that says no unit has an empty tuple, and would take over the other one's.
        units = dict(zip(record.input_names, record.input_units, strict=False))
        units |= zip(record.output_names, record.output_units, strict=False)
        units |= record.own_units

        # What a number in this record's unit is to be multiplied with.
        factors = dict[str, float]()
        notes = list[Finding]()
        for name, unit in list(units.items()):
            if not unit:
                continue
            wanted, whose = first_said.setdefault(name, (unit, record.label))
            factor = 1.0 if unit == wanted else per(unit, wanted)
            if factor is None:
                raise ValueError(
                    f"{record.label}: '{shown(name, 40)}' is in {shown(unit, 30)}, in {whose} in "
                    f"{shown(wanted, 30)}; expected one unit in all logs that are read together: convert "
                    f"one, or state --unit {as_typed(f'{name}=UNIT')} if a header is wrong"
                )
            if factor != 1.0:
                factors[name] = factor
                units[name] = wanted
                note = finding(
                    FindingKind.UNIT_CONVERTED,
                    record=record.label,
                    name=name,
                    unit=unit,
                    of=wanted,
                    times=factor,
                )
                notes.append(note)

        if factors:
            changed: dict[str, Any] = {"own_units": units, "notes": (*record.notes, *notes)}
            for key in ("input", "output", "reference"):
                signal = getattr(record, key)
                names = getattr(record, f"{key}_names")
                if signal is not None:
                    changed[key] = signal * [factors.get(name, 1.0) for name in names]
                if key != "reference" and any(units.get(name) for name in names):
                    changed[f"{key}_units"] = tuple(units.get(name, "") for name in names)
            record = replace(record, **changed)
        converted.append(record)
    return converted


def in_groups(items: Iterable[T], alike: Callable[[T, T], bool]) -> list[list[T]]:
    """Return items in groups, in the order they come: each in the first group whose first item it is like.

    alike: whether two items are; it need not be transitive, as only the first of a group is asked. No items:
    no groups.
    """
    groups: list[list[T]] = []
    for item in items:
        for group in groups:
            if alike(item, group[0]):
                group.append(item)
                break
        else:
            groups.append([item])
    return groups
