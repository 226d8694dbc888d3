"""A script that reads one file of a compiled format from standard input, in a process of its own.

The libraries that read HDF5, parquet, xlsx, MATLAB, MCAP and ROS bags are compiled, and a file can be made to
end their process or to fill the memory. `foreign_files.read_in_child` therefore runs this file alone, as
`python -I child_reader.py KIND`, with limits of memory and time, and without anything else of the package.
On standard output comes an npz archive (arrays 0, 1, ..., and `about`: names and units, or the tree of
variables, as JSON) or, of a spreadsheet, JSON: the text of each table, with tabs, by the name of its sheet.
Exit code 2: one line on standard error says what is wrong with the file; 3: the library it names is not
there. `main` chooses the reader. Each reader imports its library itself: the others need not be installed.
"""

import io
import json
import re
import resource
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

# Largest size of a file, and of what it unpacks to, bytes: some hundred channels at 1 kHz for twenty minutes
# as doubles. Whoever has more is asked to split the file.
LARGEST_BYTES = 2**30
# Processor time that a file may take, s: chosen, a hundred times what the logs of the tests take. It is less
# than `foreign_files` waits, so that the limit here ends the process.
CPU_SECONDS = 120
# Address space of this process, bytes: the file, its columns, the archive of them, and copies that the
# libraries make, each of the largest size. Eight of them, chosen.
MEMORY_BYTES = 8 * LARGEST_BYTES
# Largest text of a spreadsheet or of a text table, bytes: cells take several times as much memory. Of XML it
# is a million rows of four cells.
LARGEST_TEXT_BYTES = 2**28
# Cells of all sheets together that are read; of twenty characters each they are 400 MB of text.
MOST_CELLS = 20_000_000
# Empty cells in one piece after which a sheet is refused: somebody formatted it to its end (2^20 rows), or it
# is a trap. Chosen so that the refusal comes within seconds.
MOST_EMPTY_CELLS = 500_000
# Entries of a vector in a message or a cell that become columns; longer ones are pictures and point clouds.
# Chosen: more than any arm has joints or gauges.
LONGEST_FIELD = 256
# Characters of text that are kept of a cell of parquet: as much as tells one run from another.
LONGEST_TEXT = 32
# Kinds of numpy arrays that hold real numbers: floats, signed and unsigned integers, booleans.
NUMBER_KINDS = "fiub"
# Exit code where the file is refused, or damaged.
REFUSED = 2
# Exit code where the library that reads it is not installed.
NO_LIBRARY = 3


class RefusedError(ValueError):
    """A refusal of something in the file that is not read; the message is for the user."""


class Column(NamedTuple):
    """A named array of a file.

    Attributes
    ----------
    name : str
        A name may be there twice.
    values : array, or str
        An array whose first axis counts rows; or words that say why there is none.
    unit : str
        Empty where the file says none.
    """

    name: str
    values: Any
    unit: str


def hdf5_columns(content: bytes) -> list[Column]:
    """Return the datasets of an HDF5 file by their path, group/signal; tables by field, group/table.field.

    Parameters
    ----------
    content : bytes
        The file. In one of MATLAB (version 7.3) names are those that variables have there, and arrays are
        turned round, since MATLAB stores column by column.

    Returns
    -------
    list of Column
        Arrays of one and two dimensions. Left out are what lies in other files, text, dimensions without
        values (netCDF), and empty ones.

    Raises
    ------
    RefusedError
        More than `LARGEST_BYTES`, or a scale that is no number.
    """
    import h5py
    import numpy as np

    columns: list[Column] = []
    with h5py.File(io.BytesIO(content), "r") as file:
        datasets: list[tuple[str, Any]] = []

        def collect(name: str, item: Any) -> None:
            """Keep an item if it is a dataset; the walk over the file stops at any answer but None.

            name: its path in the file.
            """
            if isinstance(item, h5py.Dataset):
                datasets.append((name, item))

        file.visititems(collect)
        of_matlab = any("MATLAB_class" in data.attrs for _, data in datasets)
        total_bytes = 0
        for path, data in datasets:
            # What other files hold is none of this log's business. MATLAB keeps the cells of cell arrays
            # under '#refs#'.
            if path.startswith("#") or data.external or data.is_virtual or "MATLAB_empty" in data.attrs:
                continue
            # netCDF writes a dimension without a variable as zeros.
            netcdf_name = _words(data.attrs.get("NAME", ""))
            if netcdf_name.startswith("This is a netCDF dimension but not a netCDF variable"):
                continue
            if data.shape is None or not 0 < data.ndim <= 2:
                continue
            # Sizes are stated before anything is unpacked, so a small file cannot fill the memory.
            total_bytes += data.size * data.dtype.itemsize
            if total_bytes > LARGEST_BYTES:
                raise RefusedError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")

            name = path.replace("/", ".") if of_matlab else path
            is_text = data.attrs.get("MATLAB_class", b"") == b"char"
            if data.dtype.kind in NUMBER_KINDS and not is_text:
                unit = _words(data.attrs.get("unit", data.attrs.get("units", "")))
                values = _unpacked(path, np.asarray(data[()]), data.attrs)
                columns.append(Column(name, values.T if of_matlab else values, unit))
            elif data.dtype.names and not of_matlab:
                rows = data[()]
                for field in data.dtype.names:
                    kind = rows.dtype[field]
                    if kind.kind in NUMBER_KINDS and not kind.shape:
                        columns.append(Column(f"{name}.{field}", rows[field], ""))
    return columns


def _words(attribute: Any) -> str:
    """Return an attribute of HDF5 as text; bytes that are no UTF-8 are replaced, anything else taken by its
    `str`."""
    return attribute.decode("utf-8", "replace") if isinstance(attribute, bytes) else str(attribute)


def _unpacked(path: str, values: Any, attributes: Any) -> Any:
    """Return the quantity behind packed numbers, after netCDF's conventions (CF 1.11, 2.5.1 and 8.1).

    path: of the dataset, for complaints. values: its array. attributes: by name; scale_factor times the
    number plus add_offset is the quantity, and NaN stands where the number is _FillValue or missing_value.
    The array as it is where none of these applies. Raises RefusedError where a scale or an offset is no
    number.
    """
    import numpy as np

    def number(key: str, usual: float) -> Any:
        """Return an attribute as a number without dimensions, or the usual one where it is not there.

        Raises RefusedError where it is no number.
        """
        try:
            return np.asarray(attributes.get(key, usual), dtype=np.float64).reshape(())
        except (ValueError, TypeError):
            raise RefusedError(f"'{path}': its {key} is no number") from None

    fills = []
    for key in ("_FillValue", "missing_value"):
        for fill in np.ravel(attributes.get(key, [])):
            # A fill that is NaN (unequal to itself) needs no replacement.
            if np.asarray(fill).dtype.kind in NUMBER_KINDS and fill == fill:
                fills.append(fill)
    is_empty = np.isin(values, fills) if fills else np.zeros(values.shape, dtype=bool)
    is_packed = "scale_factor" in attributes or "add_offset" in attributes
    if not is_empty.any() and not is_packed:
        return values
    scale = number("scale_factor", 1.0)
    offset = number("add_offset", 0.0)
    return np.where(is_empty, np.nan, scale * values + offset)


def parquet_columns(content: bytes) -> list[Column]:
    """Return the columns of a parquet file: numbers (missing ones as NaN), instants, durations and text.

    Parameters
    ----------
    content : bytes
        The file. Columns in a struct are called name.field, those in lists of one length name[0], name[1],
        ... Units come from the metadata of a column.

    Returns
    -------
    list of Column
        In the order of the file; of other kinds, and of lists of several lengths, words that say so.

    Raises
    ------
    RefusedError
        More than `LARGEST_BYTES`.
    """
    import numpy as np
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    pa.set_cpu_count(1)
    file = pq.ParquetFile(pa.BufferReader(content))
    about = file.metadata
    packed_bytes = sum(about.row_group(k).total_byte_size for k in range(about.num_row_groups))
    # Columns of one repeated value take no room in the file, but they do as doubles. The largest size is
    # allowed four times here, half of the memory: most columns are of types of fewer bytes. A double has 8.
    bytes_as_doubles = 8 * about.num_rows * about.num_columns
    if packed_bytes > LARGEST_BYTES or bytes_as_doubles > 4 * LARGEST_BYTES:
        raise RefusedError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")
    table = file.read(use_threads=False)

    # A stack of columns, the next one last: nested ones are put back in their parts.
    units = [(field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace") for field in table.schema]
    waiting = list(zip(table.schema.names, table.columns, units, strict=True))
    waiting.reverse()
    columns: list[Column] = []
    while waiting:
        name, column, unit = waiting.pop()
        kind = column.type
        if pa.types.is_struct(kind):
            for k in reversed(range(kind.num_fields)):
                waiting.append((f"{name}.{kind.field(k).name}", pc.struct_field(column, k), unit))
            continue
        if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            lengths = pc.min_max(pc.list_value_length(column))
            shortest = lengths["min"].as_py()
            longest = lengths["max"].as_py()
            if shortest == longest and 0 < (longest or 0) <= LONGEST_FIELD:
                for k in reversed(range(longest)):
                    waiting.append((f"{name}[{k}]", pc.list_element(column, k), unit))
            else:
                why = (
                    f"lists of {shortest} to {longest} entries; expected one length, at most {LONGEST_FIELD}"
                )
                columns.append(Column(name, why, unit))
            continue

        if pa.types.is_dictionary(kind):
            kind = kind.value_type
            column = column.cast(kind)
        if pa.types.is_time(kind):
            # A time of day is the duration since midnight; pyarrow casts by way of its integers only.
            is_short = kind.unit in ("s", "ms")
            kind = pa.duration(kind.unit)
            column = column.cast(pa.int32() if is_short else pa.int64()).cast(pa.int64()).cast(kind)
        if pa.types.is_integer(kind) and not column.null_count:
            # Whole, as they are: doubles hold integers up to 2^53, stamps in ns are larger.
            values = column.to_numpy()
        elif (pa.types.is_primitive(kind) and not pa.types.is_temporal(kind)) or pa.types.is_decimal(kind):
            values = column.cast(pa.float64(), safe=False).to_numpy()
        elif pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            values = column.to_numpy()
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            values = np.array(column.to_pylist(), dtype=f"U{LONGEST_TEXT}")
        else:
            values = f"{kind}; expected numbers"
        columns.append(Column(name, values, unit))
    return columns


def _messages(content: bytes, kind: str) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time of recording [ns] and message of a bag, in its order.

    kind: 'mcap', 'bag' (ROS 1) or 'db3' (ROS 2). A message is an object with `__dataclass_fields__`, or a
    dict (JSON in MCAP). In MCAP those in other encodings than CDR, ROS 1 and JSON are left out. Damaged files
    raise what their library raises, of many kinds: `main` takes all for a refusal.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    if kind != "mcap":
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"bag.{kind}"
            file.write_bytes(content)
            usual_types = get_typestore(Stores.ROS2_HUMBLE)  # bags before Iron say nothing of their types
            with AnyReader([file], default_typestore=usual_types) as bag:
                for connection, at_ns, data in bag.messages():
                    yield connection.topic, at_ns, bag.deserialize(data, connection.msgtype)
        return

    from mcap.reader import make_reader

    types = get_typestore(Stores.EMPTY)
    registered_schemas = set()
    for schema, channel, message in make_reader(io.BytesIO(content)).iter_messages():
        encoding = channel.message_encoding
        if encoding == "json":
            yield channel.topic, message.log_time, json.loads(message.data)
        elif schema is not None and encoding in ("cdr", "ros1"):
            # Schemas are called package/Name in ROS 1 and package/msg/Name in ROS 2.
            package, _, name = schema.name.rpartition("/")
            type_name = f"{package.removesuffix('/msg')}/msg/{name}"
            if schema.id not in registered_schemas:
                registered_schemas.add(schema.id)
                definition = schema.data.decode()
                if schema.encoding == "ros2idl":
                    types.register(get_types_from_idl(definition))
                else:
                    types.register(get_types_from_msg(definition, type_name))
            deserialize = types.deserialize_cdr if encoding == "cdr" else types.deserialize_ros1
            yield channel.topic, message.log_time, deserialize(message.data, type_name)


def _fields(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the numbers and short vectors in a message by their names; a time as whole nanoseconds, name_ns.

    value: a message (an object with `__dataclass_fields__`, or a dict) or a part of one. Text, matrices and
    vectors of more than `LONGEST_FIELD` entries are left out. Nothing is raised for kinds that are not known:
    they are left out.
    """
    import numpy as np

    fields: dict[str, Any] | None = None
    if hasattr(value, "__dataclass_fields__"):
        fields = {key: getattr(value, key) for key in value.__dataclass_fields__}
    elif isinstance(value, dict):
        fields = value
    if fields is not None:
        fields = {key: item for key, item in fields.items() if not key.startswith("__")}
        if {"sec", "nanosec"} <= fields.keys():
            yield f"{name}_ns", int(fields["sec"]) * 10**9 + int(fields["nanosec"])
            return
        for key, item in fields.items():
            yield from _fields(f"{name}.{key}", item)
    elif not isinstance(value, str):
        numbers = np.asarray(value)
        if numbers.dtype.kind in NUMBER_KINDS and numbers.ndim < 2 and 0 < numbers.size <= LONGEST_FIELD:
            yield name, numbers
        elif isinstance(value, list) and numbers.ndim == 1 and numbers.size <= LONGEST_FIELD:
            # A list of messages.
            for k, item in enumerate(value):
                yield from _fields(f"{name}[{k}]", item)


def bag_columns(content: bytes, kind: str) -> list[Column]:
    """Return the fields of the messages of a bag as topic.field, one row per message of the topic.

    Parameters
    ----------
    content : bytes
    kind : str
        'mcap', 'bag' (ROS 1) or 'db3' (ROS 2).

    Returns
    -------
    list of Column
        Of each topic its time of recording [s], since the first message of all, under the topic and a tab;
        then topic.time [s]: the header's stamps since the first where they increase, else the time of
        recording; then the fields that every message has in the same shape.

    Raises
    ------
    RefusedError
        No message that can be read.
    """
    import numpy as np

    messages: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for topic, at_ns, message in _messages(content, kind):
        name = topic.lstrip("/")
        messages.setdefault(name, []).append((at_ns, dict(_fields(name, message))))
    if not messages:
        raise RefusedError("no messages that can be read; expected CDR, ROS 1 or JSON, and numbers in them")

    # Times are in whole nanoseconds until the first one is taken off: 1e-9 s each.
    begin_ns = min(of_topic[0][0] for of_topic in messages.values())
    columns: list[Column] = []
    for topic, of_topic in messages.items():
        recorded_s = np.array([1e-9 * (at_ns - begin_ns) for at_ns, _ in of_topic])
        columns.append(Column(f"{topic}\t", recorded_s, ""))
        rows = [fields for _, fields in of_topic]
        table = {}
        for name, first in rows[0].items():
            shape = np.shape(first)
            if all(name in fields and np.shape(fields[name]) == shape for fields in rows):
                table[name] = np.asarray([fields[name] for fields in rows])

        stamp_ns = table.pop(f"{topic}.header.stamp_ns", np.zeros(1))
        stamps_increase = stamp_ns.size > 1 and bool(np.all(np.diff(stamp_ns) > 0))
        time_s = 1e-9 * (stamp_ns - stamp_ns[0]) if stamps_increase else recorded_s
        columns.append(Column(f"{topic}.time", time_s, "s"))
        for name, values in table.items():
            if ".header." not in name:
                columns.append(Column(name, values, ""))
    return columns


def sheet_texts(
    content: bytes, *, most_cells: int = MOST_CELLS, most_empty_cells: int = MOST_EMPTY_CELLS
) -> dict[str, str]:
    """Return the visible sheets of a spreadsheet that have two rows and more, as text with tabs, by name.

    Parameters
    ----------
    content : bytes
        An xlsx file.
    most_cells : int
        Cells of all sheets together above which the file is refused.
    most_empty_cells : int
        Empty cells in one piece above which it is refused.

    Returns
    -------
    dict of str to str
        Numbers are written in full, at the size that the spreadsheet shows (`_shown_cell`). A formula without
        its value, as programs that are no spreadsheet write it, stands as its text '=...'.

    Raises
    ------
    RefusedError
        Too much text or too many cells, or no visible sheet with two rows.
    """
    from openpyxl.reader.excel import ExcelReader

    class Reader(ExcelReader):  # type: ignore[misc]
        """A reader of openpyxl that passes over charts."""

        def read_chartsheet(self, sheet: Any, rel: Any) -> None:
            """Do nothing: a sheet that is a chart has no cells, and openpyxl stumbles where it only reads."""

    # The sizes that the archive states are checked before anything is unpacked.
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST_TEXT_BYTES:
            raise RefusedError(f"unpacks to more than {LARGEST_TEXT_BYTES >> 20} MiB: save it as CSV")
        sheet_files = [entry for entry in archive.namelist() if entry.startswith("xl/worksheets/")]
        has_formulas = any(re.search(rb"<f[\s>/]", archive.read(entry)) for entry in sheet_files)
    reader = Reader(io.BytesIO(content), read_only=True, data_only=True)
    reader.read()
    # openpyxl reads the values of formulas or their text, so that a second reader is needed for these.
    formula_reader = None
    if has_formulas:
        formula_reader = Reader(io.BytesIO(content), read_only=True, data_only=False)
        formula_reader.read()

    tables: dict[str, str] = {}
    n_cells = 0
    for number, sheet in enumerate(reader.wb.worksheets):
        if sheet.sheet_state != "visible":  # its author does not show it either
            continue
        sheet.reset_dimensions()  # which the file states, and need not be true
        formula_rows: Iterator[Any] = iter(())
        if formula_reader is not None:
            formula_sheet = formula_reader.wb.worksheets[number]
            formula_sheet.reset_dimensions()
            formula_rows = formula_sheet.iter_rows(values_only=True)

        lines: list[str] = []
        last_filled = 0
        n_empty = 0
        scales: dict[int, tuple[int, int]] = {}
        for row in sheet.iter_rows():
            texts = [_shown_cell(cell, scales) for cell in row]
            for column, formula in enumerate(next(formula_rows, ())):
                # Text that begins like that is one, and so is an array formula, an object.
                if formula is not None and column < len(texts) and not texts[column]:
                    texts[column] = _cell(formula) if isinstance(formula, str) else "=..."
            line = "\t".join(texts)
            lines.append(line)

            # A row without cells counts as one, so that rows without end are refused as well.
            if line.strip():
                last_filled = len(lines)
                n_empty = 0
            else:
                n_empty += max(len(row), 1)
            if n_empty > most_empty_cells:
                raise RefusedError(
                    f"more than {most_empty_cells} empty cells below row {last_filled} of '{sheet.title}': "
                    "save it as CSV"
                )
            n_cells += len(row)
            if n_cells > most_cells:
                raise RefusedError(f"more than {most_cells // 10**6} million cells: save it as CSV")
        n_filled = sum(bool(line.strip()) for line in lines)
        if n_filled > 1:
            tables[sheet.title] = "\n".join(lines) + "\n"
    if not tables:
        raise RefusedError("no visible sheet has a table; expected a row of names and rows of numbers")
    return tables


def _shown_cell(cell: Any, scales: dict[int, tuple[int, int]]) -> str:
    """Return the text of a cell at the size that the spreadsheet shows.

    cell: of openpyxl. 0.3 in the format 0.0 % is '30%', 12500 in the format 0.0, (by thousands) is '12.5'.
    scales: percent signs and thousands by the number of the cell's style, which get filled in here: a sheet
    has few styles and many cells. A cell without a format is written as it is.
    """
    value = cell.value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return _cell(value)
    style = getattr(cell, "_style_id", -1)
    if style not in scales:
        scales[style] = _scale_of_format(cell.number_format or "")
    percents, thousands = scales[style]
    if not (percents or thousands):
        return _cell(value)
    # In decimals, so that 0.07 is 7 % and no 7.000000000000001 %.
    scaled = Decimal(repr(value)).scaleb(2 * percents - 3 * thousands)
    return f"{scaled.normalize():f}{'%' if percents == 1 else ''}"


def _scale_of_format(code: str) -> tuple[int, int]:
    """Return the percent signs in a number format, and the commas behind its last digit.

    Each percent sign shows a hundred times the number, each such comma a thousandth of it (ECMA-376,
    18.8.31). Quoted and escaped characters, colours, and the forms of negative numbers and zero do not count.
    (0, 0) for an empty format; one that is none is not refused.
    """
    positive_form = re.sub(r'"[^"]*"|\\.|_.|\*.|\[[^]]*\]', "", code).partition(";")[0]
    trailing_commas = re.search(r"[0#?](,+)(?=[^0#?,]*$|\.)", positive_form)
    thousands = len(trailing_commas[1]) if trailing_commas else 0
    return positive_form.count("%"), thousands


def _cell(value: Any) -> str:
    """Return the value of a cell as text on one line: nothing as '', yes and no as 1 and 0, floats with all
    their digits, durations in seconds, dates in ISO 8601.

    Anything else by its `str`, runs of blanks and line ends as one blank.
    """
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return repr(value)
    if hasattr(value, "total_seconds"):
        return repr(value.total_seconds())
    text = value.isoformat() if hasattr(value, "isoformat") else str(value)
    return " ".join(text.split())


def mat_variables(content: bytes) -> bytes:
    """Return an archive of the arrays of a MATLAB file (to version 7.2), with the tree of its variables.

    Parameters
    ----------
    content : bytes

    Returns
    -------
    bytes
        An npz archive whose `about` is {"struct": {name: tree}}, where each tree is {"array": number},
        {"text": str or list of str}, {"list": [tree]}, {"struct": {name: tree}} or {"unread": why}. Arrays
        are of doubles or complex numbers.

    Raises
    ------
    RefusedError
        A variable has no possible name. scipy raises errors of many kinds for damaged files.
    """
    import numpy as np
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabFunction, MatlabOpaque, mat_struct

    warnings.simplefilter("error")  # a variable that is there twice
    # scipy calls every object of MATLAB's own "None".
    warnings.filterwarnings("ignore", 'Duplicate variable name "None"')
    arrays: list[Any] = []

    def tree(value: Any) -> dict[str, Any]:
        """Return the tree of a value as scipy gives it; its arrays are appended to `arrays`.

        What is no numbers, text, struct or cell array becomes 'unread'; nothing is refused here.
        """
        if isinstance(value, mat_struct):
            names = vars(value)["_fieldnames"]
            return {"struct": {name: tree(getattr(value, name)) for name in names}}
        if isinstance(value, MatlabFunction | MatlabOpaque) or not isinstance(value, np.ndarray):
            what = "a sparse matrix" if hasattr(value, "tocsc") else "a MATLAB object or function"
            return {
                "unread": f"{what}; expected numbers: save plain vectors, e.g. t = x.Time; y = full(x.Data)"
            }
        if value.dtype.kind == "U":
            lines = [str(line) for line in value.ravel()]
            if len(lines) < 2:
                return {"text": "".join(lines)}
            return {"text": [line.rstrip() for line in lines]}
        if value.dtype.kind == "O":
            items = [tree(item) for item in value.ravel(order="F")]
            is_one_struct = len(items) == 1 and isinstance(value.item(), mat_struct)
            return items[0] if is_one_struct else {"list": items}
        # Whole numbers are stored in fewer bytes than their class has.
        number_type = np.complex128 if value.dtype.kind == "c" else np.float64
        arrays.append(value.astype(number_type))
        return {"array": len(arrays) - 1}

    values = loadmat(io.BytesIO(content), struct_as_record=False)  # type: ignore[arg-type]
    variables = {name: tree(value) for name, value in values.items() if not name.startswith("__")}
    if not all(map(str.isidentifier, variables)):
        raise RefusedError("damaged: a variable has no possible name")
    return _archive({"struct": variables}, arrays)


def _archive(about: Any, arrays: list[Any]) -> bytes:
    """Return an npz archive of arrays, called 0, 1, ..., and of `about`, anything that JSON can say.

    TypeError for what JSON cannot say.
    """
    import numpy as np

    stream = io.BytesIO()
    text = json.dumps(about).encode()
    numbered = {str(number): values for number, values in enumerate(arrays)}
    np.savez(stream, about=np.frombuffer(text, dtype=np.uint8), **numbered)
    return stream.getvalue()


def _columns_archive(columns: list[Column]) -> bytes:
    """Return an npz archive of columns; `about` is a list of [name, unit, why there is no array or ''].

    No columns make an archive of `about` alone.
    """
    about = []
    arrays = []
    for column in columns:
        if isinstance(column.values, str):
            about.append([column.name, column.unit, column.values])
            arrays.append(())
        else:
            about.append([column.name, column.unit, ""])
            arrays.append(column.values)
    return _archive(about, arrays)


def _allow_at_most(limit: int, amount: int) -> None:
    """Lower a limit of this process (`resource.RLIMIT_...`) to an amount, or to what the session allows where
    that is less: a larger one cannot be had.

    Raises ValueError or OSError where the system refuses the limit.
    """
    soft, hard = resource.getrlimit(limit)
    allowed = [amount, *(stated for stated in (soft, hard) if stated != resource.RLIM_INFINITY)]
    resource.setrlimit(limit, (min(allowed), hard))


def main(kind: str) -> int:
    """Read a file of one kind from standard input, write what it holds to standard output.

    Parameters
    ----------
    kind : str
        'hdf5', 'parquet', 'xlsx', 'mat', 'mcap', 'bag' (ROS 1) or 'db3' (ROS 2).

    Returns
    -------
    int
        Exit code: 0, 2 (refused or damaged; standard error may say why) or 3 (no library). A kind that is not
        listed is refused like a damaged bag. Past the limit of processor time the system ends the process.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _allow_at_most(resource.RLIMIT_CPU, CPU_SECONDS)
    _allow_at_most(resource.RLIMIT_AS, MEMORY_BYTES)
    content = sys.stdin.buffer.read()
    try:
        if kind == "xlsx":
            answer = json.dumps(sheet_texts(content)).encode("utf-8", "replace")
        elif kind == "mat":
            answer = mat_variables(content)
        elif kind == "hdf5":
            answer = _columns_archive(hdf5_columns(content))
        elif kind == "parquet":
            answer = _columns_archive(parquet_columns(content))
        else:
            answer = _columns_archive(bag_columns(content, kind))
    except ImportError as error:
        sys.stderr.write(error.name or str(error))
        return NO_LIBRARY
    except RefusedError as error:
        sys.stderr.write(str(error))
        return REFUSED
    except Exception:  # these libraries raise many kinds on damaged files
        return REFUSED
    sys.stdout.buffer.write(answer)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
