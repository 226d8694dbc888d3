"""Damaged log files: columns or a ValueError of one line, whatever the bytes; no crash, no hang."""

import gzip
import io
import json
import os
import re
import time
import zipfile

import numpy as np
import pytest

from ident.data.child_reader import MOST_CELLS, MOST_EMPTY_CELLS, RefusedError, sheet_texts
from ident.data.foreign_files import read_in_child
from ident.data.record_files import read_table
from tests.ident.mutations import Tally, mutated, tally
from tests.ident.test_forty_logs import LOGS

# Those that a process of its own reads take a second each.
IN_PROCESS = ("semicolons, decimal commas", "serial plotter behind a monitor", "packed by gzip",
              "npz, a matrix", "scope of a PLC")  # fmt: skip
IN_A_CHILD = (
    "a spreadsheet with preamble, units and dates", "parquet with structs of lists",
    "HDF5 with groups and attributes", "MATLAB 5", "MATLAB 7.3", "MCAP of JSON", "MCAP of ROS 2, two topics",
    "ROS 1 bag", "ROS 2 bag",
)  # fmt: skip


def refusal(path) -> str | None:
    """What is said of a log, or of the first of its columns that is refused; the others hold numbers."""
    said = None
    try:
        table = read_table(path)
        for name in table.names:
            try:
                assert np.all(np.isfinite(table.columns([name])[name]))
            except ValueError as error:
                said = said or error
    except ValueError as error:
        said = error
    if said is None:
        return None
    assert str(said).startswith(str(path))
    return str(said).replace(str(path), path.name)


def damaged(name, folder, count) -> Tally:
    content, path = LOGS[name].content, folder / LOGS[name].file
    whole = content if isinstance(content, bytes) else content()

    def attempt(rng):
        path.write_bytes(mutated(whole, rng))
        return refusal(path)

    return tally(attempt, count, 40)


# That whole ones are read says test_forty_logs.py. Those that a child reads are fewer, a third of a second
# each. With 93 % 15 of a kind show what one in six does, and the 135 of all kinds what one in fifty does.
@pytest.mark.parametrize(
    ("name", "count"),
    [
        *(pytest.param(name, 100, marks=pytest.mark.slow) for name in IN_PROCESS),
        *(pytest.param(name, 1, marks=pytest.mark.slow) for name in ("MATLAB 5", "ROS 2 bag")),
        *(pytest.param(name, 2000, marks=pytest.mark.long) for name in IN_PROCESS),
        *(pytest.param(name, 15, marks=pytest.mark.long) for name in IN_A_CHILD),
    ],
)
def test_damaged_bytes(name, count, tmp_path):
    assert damaged(name, tmp_path, count).wrong == []


def child_answer(folder, code, **limits) -> bytes:
    """What is made of the answer of a child that runs this code."""
    script = folder / "child.py"
    script.write_text(code)
    return read_in_child("HDF5", "h5py", b"", script=script, **limits)


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "HDF5 file, or a damaged one"),
        ("import time; time.sleep(60)", "in 2 s"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGXCPU)", "120 s of processor time"),
        ("import sys; sys.stderr.write('h5py'); sys.exit(3)", r"h5py: .*python.* -m pip install h5py$"),
        ("import sys; sys.stderr.write('two\\nlines'); sys.exit(2)", "^: two lines$"),
    ],
    ids=["dies", "hangs", "runs out of time", "lacks its library", "refuses"],
)
def test_a_child_that_does_not_answer_is_a_refusal(tmp_path, code, words):
    with pytest.raises(ValueError, match=words):
        child_answer(tmp_path, code, longest_wait_s=2)


def test_sizes_are_limited(tmp_path):
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(bytes(2**21)))
    with pytest.raises(ValueError, match=r"a\.csv\.gz: unpacks .* 1 MiB"):
        read_table(tmp_path / "a.csv.gz", largest_bytes=2**20)
    (tmp_path / "a.csv").write_bytes(bytes(2**21))
    with pytest.raises(ValueError, match=r"a\.csv: 2 MiB; .* 1:"):
        read_table(tmp_path / "a.csv", largest_bytes=2**20)


def spreadsheet(path, change) -> None:
    """A good one but for the text of its sheet."""
    with (
        zipfile.ZipFile(io.BytesIO(LOGS["a spreadsheet"].content)) as old,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for entry in old.infolist():
            text = old.read(entry)
            new.writestr(entry, change(text) if entry.filename == "xl/worksheets/sheet2.xml" else text)


def test_entities_that_grow_do_not_fill_the_memory(tmp_path):
    """A spreadsheet is XML: each of ten entities is ten of the one before."""
    entities = "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(10))
    head = f'<!DOCTYPE worksheet [<!ENTITY a0 "aaaaaaaaaa">{entities}]>'.encode()
    spreadsheet(tmp_path / "a.xlsx", lambda text: head + text.replace(b">t_s<", b">&a10;<"))
    with pytest.raises(ValueError, match=r"a\.xlsx: "):
        read_table(tmp_path / "a.xlsx").columns(["t_s"])


ENDLESS = {
    "rows without cells": (600_000, lambda k: b""),
    "formatted rows": (600_000, lambda k: b'<c r="A%d" s="0"/>' % k),
    "a cell far out in every row": (5_000, lambda k: b'<c r="XFD%d"><v>1</v></c>' % k),
}


@pytest.mark.parametrize("smaller", [50, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize(("last", "row"), ENDLESS.values(), ids=ENDLESS)
def test_a_sheet_without_end_is_refused_within_seconds(tmp_path, last, row, smaller):
    """smaller: by how much the limits and the sheets are."""
    rows = b"".join(b'<row r="%d">%b</row>' % (k, row(k)) for k in range(100, 100 + last // smaller))
    end = b"</sheetData>"
    spreadsheet(tmp_path / "a.xlsx", lambda text: text.replace(end, rows + end))
    content = (tmp_path / "a.xlsx").read_bytes()
    began_s = time.process_time()
    with pytest.raises(RefusedError, match="cells"):
        sheet_texts(content, most_cells=MOST_CELLS // smaller, most_empty_cells=MOST_EMPTY_CELLS // smaller)
    assert time.process_time() - began_s < 20


def test_what_the_child_refuses_is_said_with_the_name_of_the_file(tmp_path):
    spreadsheet(
        tmp_path / "a.xlsx", lambda text: re.sub(rb"<sheetData>.*</sheetData>", b"<sheetData/>", text)
    )
    with pytest.raises(ValueError, match=r"a\.xlsx: no visible sheet"):
        read_table(tmp_path / "a.xlsx")


def test_a_log_that_is_no_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    (tmp_path / "b.csv").mkdir()
    (tmp_path / "c.npz").symlink_to("/dev/zero")
    for name in ("a.csv", "b.csv", "c.npz"):
        with pytest.raises(ValueError, match=f"{name}: not a file$"):
            read_table(tmp_path / name)


def test_the_child_reads_no_other_file(tmp_path):
    import h5py

    secret = tmp_path / "secret.bin"
    np.arange(8.0).tofile(secret)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("there", data=np.arange(8.0))
        file.create_dataset("elsewhere", (8,), "f8", external=[(str(secret), 0, 64)])
        file["link"] = h5py.ExternalLink(str(tmp_path / "b.h5"), "x")
    assert read_table(tmp_path / "a.h5").names == ("there",)


def test_no_surroundings_reach_the_child(tmp_path, monkeypatch):
    monkeypatch.setenv("HDF5_PLUGIN_PATH", "/elsewhere")
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    code = "import json, os, sys; print(json.dumps([dict(os.environ), sys.flags.isolated]))"
    surroundings, isolated = json.loads(child_answer(tmp_path, code))
    assert "/elsewhere" not in surroundings.values()
    assert isolated
