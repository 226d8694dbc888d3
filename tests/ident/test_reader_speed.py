"""Tables of text are read in a time that grows as their length, on any machine: beside a plain reader."""

import csv
import io
import time

import pytest

from ident.data.json_columns import json_columns
from ident.data.record_files import read_table
from ident.data.roles import roles_of

# Characters of the shorter of two texts: enough that a square of the length would show.
SIZE = 50_000
# Twice the text takes twice the time; a square takes four times it.
MOST_TIMES = 2.6
# Whatever a table looks like, reading it takes at most this many times as long as splitting a plain one and
# converting its numbers: a megabyte a second where Python's reader of CSV does sixteen. A number of seconds
# would tell the machine, whose own speed changes by a factor of two.
MOST_TIMES_PLAIN = 16.0
# A longer text read within this time is not compared with the shorter one.
QUICK_S = 0.05
ROWS = 30


def rows(cell, head="t_s,u_V,y_rad,note", count=ROWS):
    return head + "\n" + "".join(f"{k / 1000},{k % 5},{k * k % 97 / 10},{cell}\n" for k in range(count))


def named(name):
    return rows("", f"t_s,u_V,{name},note", 300)


def wide(names, size, count=200):
    columns = size // (2 * count)
    lines = [",".join(names(j) for j in range(columns))]
    lines += [",".join(str(j * k % 7) for j in range(columns)) for k in range(count)]
    return "\n".join(lines) + "\n"


# By length: cells, lines, names, columns, rows, header lines, quotes, comments, units.
TEXTS = {
    "a cell of hex digits": lambda n: rows("9f3a1e07" * (n // (8 * ROWS))),
    "a cell of letters": lambda n: rows("ab" * (n // (2 * ROWS))),
    "a cell of digits and a letter": lambda n: rows("1" * (n // ROWS) + "x"),
    "a cell of blanks": lambda n: rows("a" + " " * (n // ROWS) + "b"),
    "a cell of names and signs": lambda n: rows("ab = " * (n // (5 * ROWS))),
    "a cell of grouped digits": lambda n: rows("1" + "'000" * (n // (4 * ROWS)) + "x"),
    "quotes": lambda n: rows('"' + '""' * (n // (2 * ROWS)) + '"'),
    "a line of 1e1e1": lambda n: "1e1" * (n // 3) + "\n",
    "a line of words": lambda n: "ab " * (n // 3) + "\n1 2\n3 4\n",
    "labelled numbers": lambda n: "\n".join(f"volt:{k % 7} angle:{k % 97 / 10}" for k in range(n // 16)),
    "a monitor's arrows": lambda n: "\n".join(["a" + " " * (n // ROWS) + "-> 1,2"] * ROWS),
    "comments": lambda n: "# some words of it\n" * (n // 19) + rows(""),
    "comment signs": lambda n: "!  " * (n // 3) + "\n" + rows(""),
    "lines above the names": lambda n: "key: value\n" * (n // 11) + rows(""),
    "blank lines": lambda n: rows("", count=300) + "\n" * n + "9.9,1,1,\n",
    "a name of letters": lambda n: named("ab" * (n // 2)),
    "a name of underscores": lambda n: named("a_" * (n // 2)),
    "a name of capitals": lambda n: named("aB" * (n // 2)),
    "a name of brackets": lambda n: named("(" * n),
    "a name of blanks": lambda n: named("y" + " " * n + "x"),
    "a name of rates": lambda n: named("per/" * (n // 4)),
    "a name of times": lambda n: named("time in " * (n // 8)),
    "a unit": lambda n: "time,u,y,z\ns,V," + "m" * n + ",\n" + rows("", count=300).partition("\n")[2],
    "columns": lambda n: wide(lambda j: f"c{j}", n),
    "columns of one name": lambda n: wide(lambda j: "c", n),
    "columns of inputs": lambda n: wide(lambda j: f"u{j}", n),
    "rows": lambda n: rows("", count=n // 15),
    "rows with decimal commas": lambda n: rows("", count=n // 15).replace(",", ";").replace(".", ","),
    "rows with dates": lambda n: (
        "t,u_V,y_rad\n"
        + "".join(
            f"2024-03-01 12:00:{k // 1000:02d}.{k % 1000:03d},{k % 5},{k % 97}\n" for k in range(n // 30)
        )
    ),
    "rows with units": lambda n: rows("", count=n // 20).replace(",\n", " V,\n"),
    "rows with lists": lambda n: (
        "t_s;u_V;y\n" + "".join(f"{k};{k % 5};[0.1, {k % 10}.5]\n" for k in range(n // 20))
    ),
    "long lists": lambda n: (
        "t_s;u_V;y\n" + "".join(f"{k};{k % 5};[{', '.join(['0.1'] * (n // 1500))}]\n" for k in range(300))
    ),
}


def cpu_s(path):
    """CPU time of all that reading a table does, whether it is one or not."""
    begin = time.process_time()
    try:
        table = read_table(path)
        for name in table.names:
            table.unit(name)
        roles_of(table, "a.csv")
    except ValueError:
        pass
    return time.process_time() - begin


def plain_cpu_s(text):
    """CPU time of splitting a plain table and converting its numbers, with Python's own reader alone."""
    begin = time.process_time()
    for row in csv.reader(io.StringIO(text)):
        list(map(float, row))
    return time.process_time() - begin


# What another kind of text goes through as well, and a little more beside it.
FURTHER = (
    "a cell of letters",
    "a cell of names and signs",
    "columns",
    "columns of inputs",
    "long lists",
    "rows",
    "rows with decimal commas",
)


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.long) if kind in FURTHER else kind for kind in TEXTS]
)
def test_time_is_linear_in_the_length(kind, tmp_path):
    """What takes less than a twentieth of a second has no square in it that matters.

    Both lengths and the plain table take turns, so that a busy machine slows all three; the fastest of each
    counts, since other programs make a run slower, never faster.
    """
    shorter, longer = TEXTS[kind](SIZE), TEXTS[kind](2 * SIZE)
    assert len(longer) > 1.8 * len(shorter)
    plain = "1,2.5,30\n" * (len(longer) // 9)
    shorter_file, longer_file = tmp_path / "shorter.csv", tmp_path / "longer.csv"
    shorter_file.write_text(shorter, encoding="utf-8")
    longer_file.write_text(longer, encoding="utf-8")
    turns = [(cpu_s(shorter_file), cpu_s(longer_file), plain_cpu_s(plain)) for _ in range(3)]
    shorter_s, longer_s, plain_s = (min(times) for times in zip(*turns, strict=True))
    assert longer_s < MOST_TIMES_PLAIN * plain_s
    if longer_s > QUICK_S:
        assert longer_s < MOST_TIMES * shorter_s


@pytest.mark.parametrize("count", [4000, pytest.param(20_000, marks=pytest.mark.long)])
def test_rows_of_json_with_a_name_each_are_refused_before_they_are_cells(count):
    rows_of_names = "\n".join(f'{{"k{number}": {number}}}' for number in range(count))
    begin = time.process_time()
    with pytest.raises(ValueError, match="the same names in each row"):
        json_columns(rows_of_names, in_lines=True)
    assert time.process_time() - begin < 1.0
