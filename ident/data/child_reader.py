"""Run as a script, alone: the columns of an HDF5, parquet, xlsx, MATLAB or MCAP file or of a ROS bag, from
standard input to output.

The libraries that read these formats are compiled, and a file can be made to end their process or to fill
the memory. Here that process is not ours, and has limits of memory and time. Out come an npz archive (arrays
0, 1, ..., and `about`: names and units, or the tree of variables, as JSON) or, of a spreadsheet, JSON: the
text of each table, with tabs, by the name of its sheet. Exit code 2: one line on standard error says what is
wrong; 3: the library it names is not there.
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
from typing import Any

# Of a file, and of what it unpacks to: some hundred channels at 1 kHz for twenty minutes as doubles.
LARGEST_BYTES = 2**30
CPU_SECONDS = 120  # less than `foreign_files` waits, so that the limit here ends it
# The file, its columns, the archive of them, and copies that the libraries make.
_MEMORY_BYTES = 8 * LARGEST_BYTES
_NUMBERS = "fiub"
_LONGEST_FIELD = 256  # longer ones are pictures and point clouds
LARGEST_TEXT_BYTES = 2**28  # cells take several times as much memory; of XML a million rows of four
_MOST_CELLS = 20_000_000  # of twenty characters each: 400 MB of text
_EMPTY_CELLS = 500_000  # in one piece: a sheet that somebody formatted to its end, or a trap


class RefusedError(ValueError):
    """Something in the file that is not read; the message is for the user."""


# Name, array (or words: why there is none) and unit; a name may be there twice.
Columns = list[tuple[str, Any, str]]


def hdf5_columns(content: bytes) -> Columns:
    """Datasets by their path; in a file of MATLAB (version 7.3) by the name that they have there."""
    import h5py
    import numpy as np

    found: Columns = []
    with h5py.File(io.BytesIO(content), "r") as file:
        parts: list[tuple[str, Any]] = []
        file.visititems(
            lambda name, item: parts.append((name, item)) if isinstance(item, h5py.Dataset) else None
        )
        matlab = any("MATLAB_class" in item.attrs for _, item in parts)
        total = 0
        for path, data in parts:
            if path.startswith("#") or data.external or data.is_virtual or "MATLAB_empty" in data.attrs:
                continue  # what other files hold is none of this log's business
            # netCDF writes a dimension without a variable as zeros.
            length = _words(data.attrs.get("NAME", "")).startswith(
                "This is a netCDF dimension but not a netCDF variable"
            )
            if data.shape is None or not 0 < data.ndim <= 2 or length:
                continue
            total += data.size * data.dtype.itemsize
            if total > LARGEST_BYTES:
                raise RefusedError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")
            name = path.replace("/", ".") if matlab else path
            kind = data.attrs.get("MATLAB_class", b"")
            unit = _words(data.attrs.get("unit", data.attrs.get("units", "")))
            if data.dtype.kind in _NUMBERS and kind != b"char":
                values = _unpacked(path, np.asarray(data[()]), data.attrs)
                # MATLAB stores column by column.
                found.append((name, values.T if matlab else values, unit))
            elif data.dtype.names and not matlab:
                rows = data[()]
                found += [
                    (f"{name}.{field}", rows[field], "")
                    for field in data.dtype.names
                    if rows.dtype[field].kind in _NUMBERS and not rows.dtype[field].shape
                ]
    return found


def _words(attribute: Any) -> str:
    return attribute.decode("utf-8", "replace") if isinstance(attribute, bytes) else str(attribute)


def _unpacked(path: str, values: Any, attributes: Any) -> Any:
    """The quantity behind packed numbers, after netCDF's conventions (CF 1.11, 2.5.1 and 8.1): scale_factor
    times the number plus add_offset; NaN where the number says that there is none."""
    import numpy as np

    def number(key: str, usual: float) -> Any:
        try:
            return np.asarray(attributes.get(key, usual), dtype=np.float64).reshape(())
        except (ValueError, TypeError):
            raise RefusedError(f"'{path}': its {key} is no number") from None

    fills = [
        fill
        for key in ("_FillValue", "missing_value")
        if key in attributes
        for fill in np.ravel(attributes[key])
        if np.asarray(fill).dtype.kind in _NUMBERS and fill == fill  # NaN is NaN already
    ]
    empty = np.isin(values, fills) if fills else np.zeros(values.shape, dtype=bool)
    if not empty.any() and not {"scale_factor", "add_offset"} & set(attributes):
        return values
    return np.where(empty, np.nan, number("scale_factor", 1.0) * values + number("add_offset", 0.0))


def parquet_columns(content: bytes) -> Columns:
    """Columns of numbers and of instants; missing numbers as NaN. What lies in structs is called name.field,
    in lists of one length name[0], name[1], ..."""
    import numpy as np
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    pa.set_cpu_count(1)
    file = pq.ParquetFile(pa.BufferReader(content))
    about = file.metadata
    sizes = (about.row_group(k).total_byte_size for k in range(about.num_row_groups))
    if sum(sizes) > LARGEST_BYTES or 8 * about.num_rows * about.num_columns > 4 * LARGEST_BYTES:
        raise RefusedError(f"unpacks to more than {LARGEST_BYTES >> 20} MiB: split the file")
    table = file.read(use_threads=False)
    found: Columns = []
    units = [(field.metadata or {}).get(b"unit", b"").decode("utf-8", "replace") for field in table.schema]
    waiting = list(zip(table.schema.names, table.columns, units, strict=True))[::-1]
    while waiting:
        name, column, unit = waiting.pop()
        kind, values = column.type, None
        if pa.types.is_struct(kind):
            parts = [
                (f"{name}.{kind.field(k).name}", pc.struct_field(column, k), unit)
                for k in range(kind.num_fields)
            ]
            waiting += parts[::-1]
            continue
        if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            least, most = (end.as_py() for end in pc.min_max(pc.list_value_length(column)).values())
            if least == most and 0 < (most or 0) <= _LONGEST_FIELD:
                parts = [(f"{name}[{k}]", pc.list_element(column, k), unit) for k in range(most)]
                waiting += parts[::-1]
            else:
                what = f"lists of {least} to {most} entries; expected one length, at most {_LONGEST_FIELD}"
                found.append((name, what, unit))
            continue
        if pa.types.is_dictionary(kind):
            kind, column = kind.value_type, column.cast(kind.value_type)
        if pa.types.is_time(kind):  # of day
            kind = pa.duration(kind.unit)
            column = column.cast(pa.int32() if kind.unit in ("s", "ms") else pa.int64()).cast(pa.int64())
            column = column.cast(kind)
        if pa.types.is_integer(kind) and not column.null_count:
            values = column.to_numpy()  # whole: doubles hold integers up to 2^53, stamps in ns are larger
        elif (pa.types.is_primitive(kind) and not pa.types.is_temporal(kind)) or pa.types.is_decimal(kind):
            values = column.cast(pa.float64(), safe=False).to_numpy()
        elif pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            values = column.to_numpy()
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            values = np.array(column.to_pylist(), dtype="U32")  # as much as tells one run from another
        else:
            values = f"{kind}; expected numbers"
        found.append((name, values, unit))
    return found


def _messages(content: bytes, kind: str) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of recording [ns] and message, in its order; those nobody can read left out."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    if kind != "mcap":
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / f"bag.{kind}"
            file.write_bytes(content)
            usual = get_typestore(Stores.ROS2_HUMBLE)  # bags before Iron say nothing of their types
            with AnyReader([file], default_typestore=usual) as bag:
                for connection, at_ns, data in bag.messages():
                    yield connection.topic, at_ns, bag.deserialize(data, connection.msgtype)
        return
    from mcap.reader import make_reader

    types, known = get_typestore(Stores.EMPTY), set()
    for schema, channel, message in make_reader(io.BytesIO(content)).iter_messages():
        encoding = channel.message_encoding
        if encoding == "json":
            yield channel.topic, message.log_time, json.loads(message.data)
        elif schema is not None and encoding in ("cdr", "ros1"):
            package, _, name = schema.name.rpartition("/")
            whole = f"{package.removesuffix('/msg')}/msg/{name}"
            if schema.id not in known:
                known.add(schema.id)
                text, idl = schema.data.decode(), schema.encoding == "ros2idl"
                types.register(get_types_from_idl(text) if idl else get_types_from_msg(text, whole))
            deserialize = types.deserialize_cdr if encoding == "cdr" else types.deserialize_ros1
            yield channel.topic, message.log_time, deserialize(message.data, whole)


def _fields(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Numbers and short vectors in a message by their names; times in nanoseconds."""
    import numpy as np

    parts = getattr(value, "__dataclass_fields__", value if isinstance(value, dict) else None)
    if parts is not None:
        inner = {key: value[key] if isinstance(value, dict) else getattr(value, key) for key in parts}
        inner = {key: item for key, item in inner.items() if not key.startswith("__")}
        if {"sec", "nanosec"} <= inner.keys():
            yield f"{name}_ns", int(inner["sec"]) * 10**9 + int(inner["nanosec"])
            return
        for key, item in inner.items():
            yield from _fields(f"{name}.{key}", item)
    elif not isinstance(value, str):
        numbers = np.asarray(value)
        if numbers.dtype.kind in _NUMBERS and numbers.ndim < 2 and 0 < numbers.size <= _LONGEST_FIELD:
            yield name, numbers
        elif isinstance(value, list) and numbers.ndim == 1 and numbers.size <= _LONGEST_FIELD:
            for k, item in enumerate(value):
                yield from _fields(f"{name}[{k}]", item)


def bag_columns(content: bytes, kind: str) -> Columns:
    """topic.field, one row per message; topic.time is the header's stamp, or where there is none the time of
    recording, which stands under the topic and a tab."""
    import numpy as np

    rows: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for topic, at_ns, message in _messages(content, kind):
        name = topic.lstrip("/")
        rows.setdefault(name, []).append((at_ns, dict(_fields(name, message))))
    if not rows:
        raise RefusedError("no messages that can be read; expected CDR, ROS 1 or JSON, and numbers in them")
    begin_ns = min(found[0][0] for found in rows.values())
    columns: Columns = []
    for topic, found in rows.items():
        recorded_s = np.array([1e-9 * (at_ns - begin_ns) for at_ns, _ in found])
        columns.append((f"{topic}\t", recorded_s, ""))
        table = {
            name: np.asarray([fields[name] for _, fields in found])
            for name, first in found[0][1].items()
            if all(name in fields and np.shape(fields[name]) == np.shape(first) for _, fields in found)
        }
        stamp_ns = table.pop(f"{topic}.header.stamp_ns", np.zeros(1))
        stamped = stamp_ns.size > 1 and bool(np.all(np.diff(stamp_ns) > 0))
        columns.append((f"{topic}.time", 1e-9 * (stamp_ns - stamp_ns[0]) if stamped else recorded_s, "s"))
        columns += [(name, values, "") for name, values in table.items() if ".header." not in name]
    return columns


def sheet_texts(content: bytes) -> dict[str, str]:
    """The visible sheets that have two rows and more, as text with tabs, by name."""
    from openpyxl.reader.excel import ExcelReader

    class Reader(ExcelReader):  # type: ignore[misc]
        def read_chartsheet(self, sheet: Any, rel: Any) -> None:
            """A sheet that is a chart has no cells; openpyxl stumbles over it where it only reads."""

    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST_TEXT_BYTES:
            raise RefusedError(f"unpacks to more than {LARGEST_TEXT_BYTES >> 20} MiB: save it as CSV")
        sheets = [entry for entry in archive.namelist() if entry.startswith("xl/worksheets/")]
        formulas = any(re.search(rb"<f[\s>/]", archive.read(entry)) for entry in sheets)
    reader = Reader(io.BytesIO(content), read_only=True, data_only=True)
    reader.read()
    # A program that is no spreadsheet writes formulas without their values: these are told by their text.
    with_formulas = Reader(io.BytesIO(content), read_only=True, data_only=False) if formulas else None
    if with_formulas is not None:
        with_formulas.read()
    found: dict[str, str] = {}
    cells = 0
    for number, sheet in enumerate(reader.wb.worksheets):
        if sheet.sheet_state != "visible":  # its author does not show it either
            continue
        sheet.reset_dimensions()  # which the file states, and need not be true
        lines, last, empty = [], 0, 0
        factors: dict[int, tuple[int, int]] = {}
        formula_rows: Iterator[Any] = iter(())
        if with_formulas is not None:
            twin = with_formulas.wb.worksheets[number]
            twin.reset_dimensions()
            formula_rows = twin.iter_rows(values_only=True)
        for row in sheet.iter_rows():
            texts = [_shown_cell(cell, factors) for cell in row]
            for column, formula in enumerate(next(formula_rows, ())):
                # Text that begins like that is one, and so is an array formula, an object.
                if formula is not None and column < len(texts) and not texts[column]:
                    texts[column] = _cell(formula) if isinstance(formula, str) else "=..."
            line = "\t".join(texts)
            lines.append(line)
            last, empty = (len(lines), 0) if line.strip() else (last, empty + max(len(row), 1))
            if empty > _EMPTY_CELLS:
                raise RefusedError(
                    f"more than {_EMPTY_CELLS} empty cells below row {last} of '{sheet.title}': "
                    "save it as CSV"
                )
            cells += len(row)
            if cells > _MOST_CELLS:
                raise RefusedError(f"more than {_MOST_CELLS // 10**6} million cells: save it as CSV")
        if sum(bool(line.strip()) for line in lines) > 1:
            found[sheet.title] = "\n".join(lines) + "\n"
    if not found:
        raise RefusedError("no visible sheet has a table; expected a row of names and rows of numbers")
    return found


def _shown_cell(cell: Any, factors: dict[int, tuple[int, int]]) -> str:
    """The text of a cell as the spreadsheet shows its size: 30% of 0.3 in the format 0.0 %, 12.5 of 12500 in
    the format 0.0, (by thousands). factors: percent signs and thousands by style, as they get known."""
    value = cell.value
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return _cell(value)
    style = getattr(cell, "_style_id", -1)
    if style not in factors:
        factors[style] = _scale_of_format(cell.number_format or "")
    percents, thousands = factors[style]
    if not (percents or thousands):
        return _cell(value)
    # In decimals, so that 0.07 is 7 % and no 7.000000000000001 %.
    scaled = Decimal(repr(value)).scaleb(2 * percents - 3 * thousands)
    return f"{scaled.normalize():f}{'%' if percents == 1 else ''}"


def _scale_of_format(code: str) -> tuple[int, int]:
    """Percent signs in a number format, each of which shows a hundred times the number, and commas behind its
    last digit, each of which shows a thousandth (ECMA-376, 18.8.31)."""
    positive = re.sub(r'"[^"]*"|\\.|_.|\*.|\[[^]]*\]', "", code).partition(";")[0]
    trailing = re.search(r"[0#?](,+)(?=[^0#?,]*$|\.)", positive)
    return positive.count("%"), len(trailing[1]) if trailing else 0


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return repr(value)
    if hasattr(value, "total_seconds"):
        return repr(value.total_seconds())
    return " ".join((value.isoformat() if hasattr(value, "isoformat") else str(value)).split())


def mat_variables(content: bytes) -> bytes:
    """Archive of the arrays of a MATLAB file (to version 7.2), `about` the tree of its variables: each is
    {"array": number}, {"text": .}, {"list": [.]}, {"struct": {name: .}} or {"unread": why}."""
    import numpy as np
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabFunction, MatlabOpaque, mat_struct

    warnings.simplefilter("error")  # a variable that is there twice
    # scipy calls every object of MATLAB's own "None".
    warnings.filterwarnings("ignore", 'Duplicate variable name "None"')
    arrays: list[Any] = []

    def tree(value: Any) -> dict[str, Any]:
        if isinstance(value, mat_struct):
            return {"struct": {name: tree(getattr(value, name)) for name in vars(value)["_fieldnames"]}}
        if isinstance(value, MatlabFunction | MatlabOpaque) or not isinstance(value, np.ndarray):
            what = "a sparse matrix" if hasattr(value, "tocsc") else "a MATLAB object or function"
            return {
                "unread": f"{what}; expected numbers: save plain vectors, e.g. t = x.Time; y = full(x.Data)"
            }
        if value.dtype.kind == "U":
            rows = [str(row).rstrip() for row in value.ravel()]
            return {"text": "".join(map(str, value.ravel()))} if len(rows) < 2 else {"text": rows}
        if value.dtype.kind == "O":
            items = [tree(item) for item in value.ravel(order="F")]
            one = len(items) == 1 and isinstance(value.item(), mat_struct)
            return items[0] if one else {"list": items}
        # Whole numbers are stored in fewer bytes than their class has.
        arrays.append(value.astype(np.complex128 if value.dtype.kind == "c" else np.float64))
        return {"array": len(arrays) - 1}

    found = loadmat(io.BytesIO(content), struct_as_record=False)  # type: ignore[arg-type]
    variables = {name: tree(value) for name, value in found.items() if not name.startswith("__")}
    if not all(map(str.isidentifier, variables)):
        raise RefusedError("damaged: a variable has no possible name")
    return _archive({"struct": variables}, arrays)


def _archive(about: Any, arrays: list[Any]) -> bytes:
    import numpy as np

    stream, text = io.BytesIO(), json.dumps(about).encode()
    named = {str(k): values for k, values in enumerate(arrays)}
    np.savez(stream, about=np.frombuffer(text, dtype=np.uint8), **named)
    return stream.getvalue()


def main(kind: str) -> int:
    """kind: hdf5, parquet, xlsx, mat, mcap, bag (ROS 1) or db3 (ROS 2)."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for kind_of_limit, most in ((resource.RLIMIT_CPU, CPU_SECONDS), (resource.RLIMIT_AS, _MEMORY_BYTES)):
        soft, hard = resource.getrlimit(kind_of_limit)
        allowed = min([most, *(limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY)])
        resource.setrlimit(kind_of_limit, (allowed, hard))
    content = sys.stdin.buffer.read()
    try:
        if kind == "xlsx":
            found = json.dumps(sheet_texts(content)).encode("utf-8", "replace")
        elif kind == "mat":
            found = mat_variables(content)
        else:
            read = {"hdf5": hdf5_columns, "parquet": parquet_columns}.get(kind)
            columns = read(content) if read else bag_columns(content, kind)
            about = [
                [name, unit, values if isinstance(values, str) else ""] for name, values, unit in columns
            ]
            found = _archive(about, [() if isinstance(values, str) else values for _, values, _ in columns])
    except ImportError as error:
        sys.stderr.write(error.name or str(error))
        return 3
    except RefusedError as error:
        sys.stderr.write(str(error))
        return 2
    except Exception:  # these libraries raise many kinds on damaged files
        return 2
    sys.stdout.buffer.write(found)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
