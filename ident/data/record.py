"""Measured signals: sampled uniformly, checked once, and read from CSV, npz and MATLAB files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any, Self, TypeVar

import numpy as np

from ident.data.arrays import RealArray, readonly
from ident.data.finding import Finding, FindingKind, Value, finding
from ident.data.foreign_files import as_typed, shown
from ident.data.record_files import read_table
from ident.data.shown import Shown
from ident.data.table import LARGEST, Table
from ident.data.text_numbers import is_bookkept, number
from ident.data.time_grid import CoarseGrid, Repair, TimeGrid, clock_doubts, sampling_time
from ident.data.units import TimeColumn, contradicted_by_loop, per, refuse_step
from ident.data.wrapping import no_reading, spikes_in, unwrapped, wraps_at

T = TypeVar("T")

# Clocks of one machine differ by less: a thousandth of every frequency, below what most records tell.
SAME_CLOCK = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class Record(Shown):
    """One uniformly sampled experiment.

    input (T, U), output (T, Y), reference (T, R) or None, with distinct names each; units are free text,
    empty or one per column. name: shown to the user; source: the file, named in error messages. time_column:
    what time stamps were taken for, None where dt_s was given without. repair: what was done to rows that
    jittered or were missing. cut: samples of the commanded input beyond what the amplifier gives (`limited`).
    notes: how the file was read. own_units: by column, what the file says, before anything is stated.

    Raises ValueError if a shape or a name does not fit, dt_s is not positive, or a sample is not finite or
    above 1e100 (names the first one).
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

    def __post_init__(self) -> None:
        for key in ("input_names", "output_names", "reference_names", "input_units", "output_units"):
            object.__setattr__(self, key, tuple(getattr(self, key)))
        if not (np.isfinite(self.dt_s) and self.dt_s > 0):
            raise ValueError(f"{self.label}: dt_s must be a positive number of seconds; got {self.dt_s}")
        self._check("input", self.input_names)
        self._check("output", self.output_names)
        if self.reference is not None:
            self._check("reference", self.reference_names)
        elif self.reference_names:
            raise ValueError(f"{self.label}: reference_names given without a reference")
        for key, names in (("input_units", self.input_names), ("output_units", self.output_names)):
            if len(getattr(self, key)) not in (0, len(names)):
                raise ValueError(
                    f"{self.label}: {key} must be empty or one per column; got {getattr(self, key)}"
                )

    def _check(self, key: str, names: tuple[str, ...]) -> None:
        signal = readonly(getattr(self, key))
        object.__setattr__(self, key, signal)
        if signal.ndim != 2 or signal.shape[1] != len(names) or not names:
            raise ValueError(
                f"{self.label}: {key} must be (T, {len(names)}), one column per name {list(names)}; got "
                f"shape {signal.shape}"
            )
        if len(set(names)) != len(names):
            raise ValueError(f"{self.label}: {key} names must be distinct; got {list(names)}")
        if signal.shape[0] != np.shape(self.input)[0] or signal.shape[0] < 1:
            raise ValueError(
                f"{self.label}: {key} has {signal.shape[0]} samples and input {np.shape(self.input)[0]}; "
                "they must be equally long, at least one"
            )
        bad = np.argwhere(~(np.abs(signal) <= LARGEST))
        if bad.size:
            k, column = bad[0]
            raise ValueError(
                f"{self.label}: {key} column '{names[column]}' is {signal[k, column]:.6g} at index {k}; "
                f"expected finite numbers, magnitudes up to {LARGEST:g} (else choose another unit)"
            )

    @property
    def label(self) -> str:
        """How error messages call this record: the file if there is one, else the name."""
        return self.source or f"record '{self.name}'"

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What to know of the time base before trusting a frequency."""
        column, repair = self.time_column, self.repair
        found = [column.doubt(self.dt_s)] if column is not None and column.doubtful else []
        repaired = [repair.finding(self.label, self.dt_s)] if repair is not None else []
        return (*found, *repaired, *self.notes)

    @property
    def n_samples(self) -> int:
        return int(self.input.shape[0])

    @property
    def time_s(self) -> RealArray:
        """Sampling instants (T,), starting at 0."""
        return np.arange(self.n_samples, dtype=np.float64) * self.dt_s

    def sampled_like(self, other: Record) -> bool:
        """Whether the sampling times are one but for the clocks of hosts, to 0.1 %."""
        return abs(self.dt_s - other.dt_s) <= SAME_CLOCK * other.dt_s

    def refuse_several(self, dt_s: float | None = None, inputs: int = 1) -> None:
        """Raise ValueError unless there are so many inputs and one output, sampled at dt_s where given."""
        if self.input.shape[1] != inputs or self.output.shape[1] != 1:
            raise ValueError(
                f"{self.label}: need {inputs if inputs > 1 else 'one'} input{'s' * (inputs > 1)} and one "
                f"output, got {list(self.input_names)} and {list(self.output_names)}; choose with Record.siso"
            )
        if dt_s is not None and not abs(self.dt_s - dt_s) <= 1e-9 * dt_s:
            raise ValueError(f"{self.label}: dt_s = {self.dt_s}, the model has {dt_s}")

    def only(self, output: int) -> Record:
        """The record with this output alone."""
        units = self.output_units[output : output + 1]
        return replace(
            self,
            output=self.output[:, [output]],
            output_names=(self.output_names[output],),
            output_units=units,
        )

    def siso(self, input_name: str | None = None, output_name: str | None = None) -> Record:
        """The record with one input and one output; a name may be left out where there is only one column."""
        i = self._column("input", self.input_names, input_name)
        o = self._column("output", self.output_names, output_name)
        return replace(
            self.only(o),
            input=self.input[:, [i]],
            input_names=(self.input_names[i],),
            input_units=self.input_units[i : i + 1],
        )

    def _column(self, key: str, names: tuple[str, ...], name: str | None) -> int:
        if name is None and len(names) == 1:
            return 0
        if name not in names:
            raise ValueError(f"{self.label}: no {key} column {name!r}; there is {list(names)}")
        return names.index(name)

    def slice(self, start: int, stop: int) -> Record:
        """Samples start <= k < stop, 0 <= start < stop <= T; the new record's time starts at 0 again."""
        if not 0 <= start < stop <= self.n_samples:
            raise ValueError(
                f"{self.label}: samples {start} to {stop}: expected 0 <= start < stop <= "
                f"{self.n_samples}, the number there are"
            )
        return self.each(lambda signal: signal[start:stop])

    def limited(self, limit: float) -> Record:
        """The record with an input cut off at a limit, both signs, as of an amplifier. Raises ValueError
        unless > 0."""
        if not limit > 0:
            raise ValueError(f"the limit of the input must be positive; got {limit:g}")
        cut = int(np.sum(np.abs(self.input) > limit))
        return replace(self, input=np.clip(self.input, -limit, limit), cut=cut)

    def each(self, change: Callable[[RealArray], RealArray]) -> Record:
        """The record with its input, output and reference, (T, .) each, changed alike."""
        reference = None if self.reference is None else change(self.reference)
        return replace(self, input=change(self.input), output=change(self.output), reference=reference)

    @classmethod
    def from_file(
        cls,
        path: str | PathLike[str] | Table,
        inputs: Sequence[str],
        outputs: Sequence[str],
        *,
        time: str | None = None,
        dt_s: float | None = None,
        time_unit: str | None = None,
        references: Sequence[str] = (),
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
        """Read columns of a log file, or of a table that is there; readers: `ident.data.record_files`.

        The sampling time comes from the column `time`, from dt_s, or from both if they agree. Time has the
        unit time_unit, else that in the column's name ('t_ms', 'Zeit [ms]'), else seconds. scale, offset,
        units: by column, quantity = scale * column + offset in that unit. repair: stamps that jitter, and
        single missing rows, are put on a uniform grid (`TimeGrid`). resample_s: all rows are put on a grid of
        this step (`CoarseGrid`). unwrap: by column, the period at which its readings wrap (4096, 360), before
        scale and offset. decimal: 'point' or 'comma', where the numbers leave a doubt. run: of a table in
        which time starts again (`Table.runs`), from 0. Raises ValueError in one line naming file and place.
        """
        table = (path if isinstance(path, Table) else read_table(path)).with_decimal(decimal)
        runs = table.runs(time)
        if run is not None or len(runs) > 1:
            if run is None or not 0 <= run < len(runs):
                what = f"{len(runs)} runs, {runs[0].run} to {runs[-1].run}" if runs[0].run else "one run"
                raise ValueError(
                    f"{table.path}: holds {what}; expected one of them: run = 0 to {len(runs) - 1}"
                )
            table = runs[run]
        for key, names in (("inputs", inputs), ("outputs", outputs), ("references", references)):
            if isinstance(names, str):
                raise ValueError(
                    f"{table.path}: {key} must be a list of column names; got the single string {names!r}"
                )
        wanted = [*inputs, *outputs, *references]
        if time in wanted:
            raise ValueError(f"{table.path}: column {time!r} is named as time and as a signal; expected two")
        if time is None and time_unit is not None:
            raise ValueError(f"{table.path}: time_unit = '{time_unit}' without a time column; name it (time)")
        both = [item for item in inputs if item in outputs]
        if both:
            raise ValueError(f"{table.path}: column {both[0]!r} is named as input and output; expected two")
        if table.sparse and time is None:
            raise ValueError(
                f"{table.path}: columns have rows of their own (other cells are empty); name the time column "
                "(--time)"
            )
        # Of a text table the rows of the output: what drives it is held, as in a bag.
        base = outputs[0] if table.sparse else None
        columns = table.columns(wanted if time is None else [time, *wanted], base)
        stamps, time_column = (None, None) if time is None else table.seconds(time, columns[time], time_unit)
        scale, offset, units, unwrap = scale or {}, offset or {}, units or {}, unwrap or {}
        for item in (*scale, *offset, *units, *unwrap):
            if item not in wanted:
                raise ValueError(
                    f"{table.path}: scale, offset, unit or unwrap of column {item!r}, which is not used as a "
                    "signal"
                )
        doubtful = list[Finding]()
        for item, period in unwrap.items():
            if not (np.isfinite(period) and period > 0):
                raise ValueError(f"{table.path}: column {item!r} wraps at a positive number; got {period}")
            if (span := float(np.ptp(columns[item]))) > period * (1 + 1e-6):
                raise ValueError(
                    f"{table.path}: column {item!r} spans {span:.9g}, more than the {period:g} at which it "
                    "is said to wrap"
                )
            columns[item], longest = unwrapped(columns[item], period)
            if longest:
                doubtful.append(
                    finding(FindingKind.LONG_STEPS, record=str(table.path), name=item, share=longest)
                )
        if time_column is not None and time_column.wraps:
            doubtful.append(time_column.timer(str(table.path)))
        notes = (*doubtful, *reading_notes(table, columns, inputs, outputs, references))
        step = dt_s if stamps is None else float(np.median(np.diff(stamps))) if stamps.size > 1 else None
        if step is not None and 0 < step < np.inf:
            moved = np.column_stack([columns[item] for item in outputs])
            refuse_step(str(table.path), step, moved, time_column)
        grid: TimeGrid | CoarseGrid | None = None
        if resample_s is not None:
            if time is None or stamps is None or dt_s is not None:
                raise ValueError(f"{table.path}: resample_s needs a time column, and no dt_s beside it")
            grid = CoarseGrid.of(table, time, stamps, resample_s)
        elif repair and time is not None and stamps is not None:
            grid = TimeGrid.of(table, time, stamps)
        if grid is not None:
            stamps = np.asarray(grid.dt_s * np.arange(grid.n_samples), dtype=np.float64)
        step = sampling_time(table, stamps, time, dt_s)
        if grid is None and stamps is not None:
            notes += clock_doubts(stamps, str(table.path))

        def stack(names: Sequence[str], held: bool = False) -> RealArray:
            if not names:
                return np.zeros((0, 0))
            found = [columns[item] * scale.get(item, 1.0) + offset.get(item, 0.0) for item in names]
            if grid is None:
                return np.column_stack(found)
            return np.column_stack([grid.held(item) if held else grid.sampled(item) for item in found])

        def stated(names: Sequence[str]) -> tuple[str, ...]:
            found = tuple(units.get(item, "" if item in scale else table.unit(item)) for item in names)
            return found if any(found) else ()

        command, output = stack(inputs, held=True), stack(outputs)
        reference = stack(references, held=True) if references else None
        if reference is not None and len(references) == len(outputs) == 1 and inputs:
            names = (*references, *outputs, inputs[0])
            of = [units.get(item, "" if item in scale else table.unit(item)) for item in names]
            notes += contradicted_by_loop(reference[:, 0], output[:, 0], command[:, 0], names, of, scale)
        return cls(
            name=", ".join(filter(None, (table.path.stem, table.run))) if name is None else name,
            input=command,
            output=output,
            dt_s=step,
            input_names=tuple(inputs),
            output_names=tuple(outputs),
            reference=reference,
            reference_names=tuple(references),
            input_units=stated(inputs),
            output_units=stated(outputs),
            source=str(table.path),
            time_column=time_column,
            repair=None if grid is None else grid.repair,
            notes=notes,
            own_units={
                item: f"{scale[item]:g} * {table.unit(item)}"
                if item in scale
                else units.get(item, table.unit(item))
                for item in wanted
                if table.unit(item)
            },
        )


def reading_notes(
    table: Table,
    columns: Mapping[str, RealArray],
    inputs: Sequence[str],
    outputs: Sequence[str],
    references: Sequence[str] = (),
) -> tuple[Finding, ...]:
    """What is said of the way a file was read; columns: inputs, outputs and references as they are used."""
    found, record = list[Finding](), str(table.path)
    if table.layout is not None and table.layout.commented:
        first = table.layout.skipped[0]
        found.append(
            finding(FindingKind.SKIPPED_ROWS, record=record, rows=table.layout.commented, line=first)
        )
    if table.layout is not None and table.layout.cut:
        found.append(finding(FindingKind.CUT_ROW, record=record, line=table.layout.cut))
    if table.layout is not None and table.layout.footer:
        found.append(finding(FindingKind.FOOTER, record=record, line=table.layout.footer))
    if table.sparse:
        others = [name for name in inputs if not np.array_equal(table.clocks[name], table.clocks[outputs[0]])]
        found += [finding(FindingKind.HELD, record=record, name=name, output=outputs[0]) for name in others]
    for name in (*inputs, *outputs):
        if units := table.contradiction(name):
            found.append(finding(FindingKind.UNIT_CONTRADICTED, record=record, name=name, units=units))
    for name in (*inputs, *outputs):
        if told := _bookkept(table, name):
            found.append(told)
    for name in outputs:
        if period := wraps_at(columns[name]):
            found.append(finding(FindingKind.WRAPS, record=record, name=name, period=period))
    wrapping = {item.values["name"] for item in found if item.kind is FindingKind.WRAPS}
    for name in (*inputs, *references, *outputs):
        if name in wrapping:
            continue
        values = columns[name]
        kind = FindingKind.SPIKES
        rows = spikes_in(values) if name in outputs else np.zeros(0, dtype=np.int64)
        if not rows.size:
            kind = FindingKind.NO_READING
            rows = no_reading(values, command=name not in outputs)
        if rows.size:
            first = int(rows[0])
            place = table.place(first, name)
            found.append(
                finding(kind, record=record, name=name, value=values[first], place=place, rows=rows.size)
            )
    return tuple(found)


def _bookkept(table: Table, name: str) -> Finding | None:
    """The finding on a column of text with numbers like '(3.25)' and '3.25-'."""
    cells = table.raw[name]
    if table.layout is None or not isinstance(cells, tuple):
        return None
    decimal = table.layout.decimal
    rows = [k for k, cell in enumerate(cells) if is_bookkept(cell, decimal)]
    if not rows:
        return None
    return finding(
        FindingKind.BOOKKEPT,
        record=str(table.path),
        name=name,
        place=table.place(rows[0], name),
        cell=cells[rows[0]],
        value=number(cells[rows[0]], decimal),
        rows=len(rows),
    )


def in_one_unit(records: Sequence[Record]) -> list[Record]:
    """Records of one set, each column in the unit that it has in the first that says one; a note says what
    was converted. Raises ValueError, one line, for units that are not of one quantity."""
    first, found = dict[str, tuple[str, str]](), list[Record]()
    for record in records:
        named = (*record.input_names, *record.output_names)
        units = dict(zip(named, (*record.input_units, *record.output_units), strict=False))
        units |= record.own_units
        factors, notes = dict[str, float](), list[Finding]()
        for name, unit in ((name, unit) for name, unit in units.items() if unit):
            wanted, whose = first.setdefault(name, (unit, record.label))
            factor = 1.0 if unit == wanted else per(unit, wanted)
            if factor is None:
                raise ValueError(
                    f"{record.label}: '{shown(name, 40)}' is in {shown(unit, 30)}, in {whose} in "
                    f"{shown(wanted, 30)}; expected one unit in all logs that are read together: convert "
                    f"one, or state --unit {as_typed(f'{name}=UNIT')} if a header is wrong"
                )
            if factor != 1.0:
                factors[name], units[name] = factor, wanted
                told: dict[str, Value] = {"name": name, "unit": unit, "of": wanted, "times": factor}
                notes.append(finding(FindingKind.UNIT_CONVERTED, record=record.label, **told))
        if factors:
            changed: dict[str, Any] = {"own_units": units, "notes": (*record.notes, *notes)}
            for key in ("input", "output", "reference"):
                names, signal = getattr(record, f"{key}_names"), getattr(record, key)
                changed[key] = None if signal is None else signal * [factors.get(name, 1.0) for name in names]
                if key != "reference" and any(map(units.get, names)):
                    changed[f"{key}_units"] = tuple(units.get(name, "") for name in names)
            record = replace(record, **changed)
        found.append(record)
    return found


def in_groups(items: Iterable[T], alike: Callable[[T, T], bool]) -> list[list[T]]:
    """Items in groups, in the order they come: each in the first group whose first item it is like."""
    groups: list[list[T]] = []
    for item in items:
        group = next((group for group in groups if alike(item, group[0])), None)
        if group is None:
            groups.append(group := [])
        group.append(item)
    return groups
