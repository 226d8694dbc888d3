"""`flexlink look` against logs whose sampling, steps, limits and gaps are known."""

import re
import shlex

import numpy as np
import pytest

from ident.data.record import Record
from tests.ident.test_forty_logs import LOGS
from tests.workflow.command import Answer
from workflow.commands.logs import read_logs
from workflow.config.run_config import load_config
from workflow.engine.errors import cut_inside
from workflow.look.log_look import look_at
from workflow.tasks.records import read_record
from workflow.text.formats import sparkline

RNG = np.random.default_rng(8)
K = np.delete(np.arange(4000), [1000, 1001, 3000])
T_S = 0.004 * (K + np.clip(0.01 * RNG.standard_normal(K.size), -0.05, 0.05))
SWING = np.sin(0.01 * K) + 0.01 * RNG.standard_normal(K.size)
COLUMNS = {
    "t_ms": 1e3 * T_S,
    "u_V": np.clip(12 * SWING, -9, 9),
    "hub_rad": 0.002 * np.round(SWING / 0.002),
    "still": np.ones(K.size),
}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("look") / "a.npz"
    np.savez(path, **COLUMNS)
    return path


def test_numbers(log):
    found = look_at(log)
    time = found.time
    assert (time.name, time.unit, time.missing, time.gap_place) == ("t_ms", "ms", 3, "index 1000")
    # The median of 4000 steps with a deviation of sqrt(2) % each; the largest of them is below 10 %.
    assert time.period_s == pytest.approx(0.004, rel=4 * 1.25 * 0.0142 / np.sqrt(K.size))
    assert 0.03 < time.jitter <= 0.11
    assert time.gap_s == pytest.approx(0.012, rel=0.05)
    u, hub, still = found.columns
    assert (u.unit, hub.unit, still.unit) == ("V", "rad", "")
    assert u.clipped == pytest.approx(np.mean(np.abs(COLUMNS["u_V"]) == 9), rel=0.01)
    assert hub.step == pytest.approx(0.002, rel=1e-9)
    assert (u.step, hub.clipped, still.step) == (0.0, 0.0, 0.0)
    assert (found.roles.input, found.roles.output, found.roles.time) == ("u_V", "hub_rad", "t_ms")


def test_table_and_page(log, flexlink, tmp_path, faults_seen):
    answer: Answer = flexlink("look", log, "--out", tmp_path / "page.html")
    assert answer.code == 0, answer.err
    for words in ("3 rows missing", "milliseconds", "steps of 0.002 rad", "stands still", "clipped?", "▁"):
        assert words in answer.out
    assert f"flexlink identify {log} --input u_V --output hub_rad --time t_ms" in answer.out
    taken = answer.out.partition("taken as")[2].partition("signals")[0]
    for role, name in (("command", "u_V"), ("output", "hub_rad"), ("time", "t_ms")):
        assert re.search(rf"{role} +│ {name} ", taken)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<figure>") == 1
    assert "steps of 0.002 rad" in page
    assert faults_seen(tmp_path / "page.html") == []
    document = flexlink("look", log, "--json").document()
    assert document["numbers"]["columns"]["hub_rad"]["step"] == pytest.approx(0.002, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("preamble", "semicolons, decimal comma, names in line 5, numbers from line 6"),
        ("128 Hz rounded to milliseconds", "rounded to their last digit"),
        ("commas", "read in seconds; no jitter; no row missing"),
        ("no names", "which is the input and which is the output? It has column 1"),
        ("words in another column", "note"),
    ],
)
def test_what_is_said_of_text(name, words, flexlink, tmp_path):
    path = tmp_path / LOGS[name].file
    path.write_bytes(LOGS[name].content)
    answer = flexlink("look", path)
    assert answer.code == 0
    assert words in " ".join(answer.out.split())


@pytest.mark.usefixtures("unidentified")
@pytest.mark.parametrize("cell", ["nan", "", "overflow"])
def test_a_cell_without_a_number_is_taken_out_and_filled_in(cell, flexlink, refused, tmp_path):
    rng, path = np.random.default_rng(1), tmp_path / "log.csv"
    u = np.repeat(rng.choice([-1.0, 1.0], 400), 10)
    y = np.cumsum(np.cumsum(u - u.mean())) * 1e-4
    rows = [f"{0.01 * k:.2f},{u[k]},{y[k] if k != 2000 else cell}" for k in range(u.size)]
    path.write_text("\n".join(["t_s,u_V,y_rad", *rows]) + "\n")
    last = flexlink("look", path).out.splitlines()[-1]
    assert last.startswith(f"{path}, line 2002: column 'y_rad' is")
    assert "delete such rows (1 here)" in last
    assert "init fills the gap that this leaves" in refused("init", path, "--out", tmp_path / "a.toml")
    path.write_text("\n".join(["t_s,u_V,y_rad", *(row for row in rows if cell not in row.split(","))]) + "\n")
    seen = " ".join(flexlink("look", path).out.replace("│", " ").split())
    assert "1 row missing" in seen
    assert "flexlink run takes that by itself, identify with --repair" in seen
    answer = flexlink("init", path, "--out", tmp_path / "a.toml")
    assert answer.code == 0
    assert "none shows: give further logs" in answer.out
    assert "repair = true" in (tmp_path / "a.toml").read_text()
    # A gap that no command fills: the next step is to split.
    path.write_text("\n".join(["t_s,u_V,y_rad", *rows[:1000], *rows[1100:1900]]) + "\n")
    assert flexlink("look", path).out.splitlines()[-1].endswith("100 rows are missing, split the file there")


@pytest.mark.usefixtures("unidentified")
@pytest.mark.parametrize("marks", [(0, 1), ("up", "down"), (0.5, 2.5)])
def test_runs_in_one_table_are_records_and_a_counter_does_not_wrap(marks, flexlink, refused, tmp_path):
    t, count, path = 0.01 * (np.arange(6000) % 3000), np.arange(6000) % 3000, tmp_path / "a.csv"
    u = np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 1500), 4)
    y = 0.01 * np.cumsum(u.reshape(2, -1), axis=1).ravel()
    rows = [f"{t[k]:.2f},{count[k]},{marks[k // 3000]},{u[k]},{y[k]:.6f}" for k in range(6000)]
    path.write_text("\n".join(["t_s,frame,trial,u_V,y_rad_s", *rows]) + "\n")
    seen = " ".join(flexlink("look", path).out.replace("│", " ").split())
    assert f"2 runs (trial {marks[0]} to trial {marks[1]}), each a record of its own; every 10 ms" in seen
    assert "--unwrap" not in seen
    assert flexlink("init", path, "--out", tmp_path / "a.toml").code == 0
    config, _ = load_config(tmp_path / "a.toml")
    read = [read_record(config.source, entry, config.channels) for entry in config.source.records]
    read += [*read_logs([path]).measured, Record.from_file(path, ["u_V"], ["y_rad_s"], time="t_s", run=1)]
    for record, part in zip(read, (0, 1, 0, 1, 1), strict=True):
        assert record.name == f"a, trial {marks[part]}"
        np.testing.assert_array_equal(record.input[:, 0], np.split(u, 2)[part])
    with pytest.raises(ValueError, match=r"holds 2 runs, .*; expected one of them: run = 0 to 1"):
        Record.from_file(path, ["u_V"], ["y_rad_s"], time="t_s")
    kept = [",".join(cell for k, cell in enumerate(row.split(",")) if k not in (1, 2)) for row in rows]
    path.write_text("\n".join(["t_s,u_V,y_rad_s", *kept]) + "\n")
    words = r"line 3002: time 't_s' goes from 29.99 to 0 s; .*split the file there, or number its runs in a"
    assert re.search(words, refused("identify", path))


def test_sparkline():
    assert sparkline(np.arange(8.0)) == "▁▂▃▄▅▆▇█"
    assert sparkline(np.ones(5)) == ""
    # Two levels, each in every part: what is drawn is how much of which.
    levels = np.where(np.arange(6000) % 100 < np.arange(6000) // 100, 5.0, -5.0)
    assert set(sparkline(levels)) >= {"▁", "▄", "█"}
    # A short pulse among many samples is seen.
    assert sparkline(np.eye(1, 6000, 3030)[0]).index("█") == 30


def test_sentences_of_the_page_end_with_their_words(flexlink, tmp_path):
    rows = "".join(f"{0.01 * k:.2f},{k % 5},{k % 7}\n" for k in range(50))
    (tmp_path / "log.csv").write_text("t_s,u_V,hub_rad\n" + rows)
    assert flexlink("look", tmp_path / "log.csv", "--out", tmp_path / "page.html").code == 0
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "numbers from line 2.</li>" in page


@pytest.mark.parametrize("sweeps", [1, pytest.param(4, marks=pytest.mark.long)])
def test_a_bode_table_is_said_to_be_one_and_goes_on(sweeps, flexlink, refused, tmp_path):
    rng, hz = np.random.default_rng(3), np.geomspace(0.5, 40.0, 40)
    # 30 / (s + 10), sampled at 100 Hz and held; 0.5 % of noise.
    z = np.exp(2j * np.pi * hz * 0.01)
    true = 3 * (1 - np.exp(-0.1)) / (z - np.exp(-0.1))
    lines = ["Frequency (Hz);Trace 1: Gain: Magnitude (dB);Trace 1: Gain: Phase (°)"]
    for _ in range(sweeps):
        noise = rng.standard_normal((2, hz.size)) * 0.005
        for f, g in zip(hz, true * (1 + noise[0] + 1j * noise[1]), strict=True):
            lines.append(f"{f:.6f};{20 * np.log10(abs(g)):.6f};{np.rad2deg(np.angle(g)):.6f}")
    path = tmp_path / "bode.txt"
    path.write_text("\n".join(lines) + "\n")
    answer = flexlink("look", path, "--out", tmp_path / "page.html")
    assert answer.code == 0, answer.err
    assert "frequency response" in answer.out
    assert "Frequency response:" in (tmp_path / "page.html").read_text()
    spec = tmp_path / "SPEC.toml"
    wish = (
        "bandwidth_rad_s = 2.0\ncontroller_order = 1\n[plant]\ndt_s = 0.01\nfit = {n_real = 1, n_pairs = 0}\n"
    )
    quick = "[synthesis]\nstarts = 1\ndense_points = 500\n"
    if sweeps == 1:
        assert f"flexlink design {path} --spec SPEC.toml, with [plant] dt_s and [uncertainty]" in answer.out
        spec.write_text(wish)
        line = refused("design", path, "--spec", spec)
        assert "give variance_real, variance_imag or a stated uncertainty" in line
        assert "pool" not in line
        assert "one sweep" in refused("identify", path, "--dt-s", "0.01")
        spec.write_text(f"{wish}[uncertainty]\nmultiplicative = 0.05\n{quick}")
        assert flexlink("design", path, "--spec", spec).code == 0
        return
    assert f"flexlink identify {path} --dt-s SECONDS" in answer.out
    assert "--dt-s SECONDS" in refused("identify", path)
    assert "leave out --repair" in refused("identify", path, "--dt-s", "0.01", "--repair")
    found = flexlink("identify", path, "--dt-s", "0.01", "--real", "1", "--pairs", "0", "--export",
                     tmp_path / "m.json", "--out", tmp_path / "m.npz", "--json").document()  # fmt: skip
    assert found["numbers"]["real_poles_per_s"] == pytest.approx([10.0], rel=0.02)
    spec.write_text(wish.partition("[plant]")[0] + quick)
    for model in ("m.json", "m.npz"):
        assert flexlink("design", tmp_path / model, "--spec", spec).code == 0


def test_the_next_command_reads_the_log_as_it_was_looked_at(flexlink, tmp_path):
    """With the options that were given, and names in full, however long they are."""
    name = "Plant Model/Sensor Subsystem/Encoder of the left hub (filtered, at the load side) [rad]"
    rows = [f"{5 * k}|{1 + k % 3},250|{k % 7},125" for k in range(80)]
    path = tmp_path / "my log.csv"
    path.write_text("\n".join([f"tick|u_V|{name}", *rows]) + "\n")
    stated = ["--time", "tick", "--time-unit", "ms", "--decimal", "comma"]
    answer: Answer = flexlink("look", path, *stated)
    assert answer.code == 0, answer.err
    words = shlex.split(answer.out.strip().splitlines()[-1])
    assert words[:3] == ["flexlink", "identify", str(path)]
    assert words[words.index("--output") + 1] == name
    for option in (["--time", "tick"], ["--time-unit", "ms"], ["--decimal", "comma"]):
        assert words[words.index(option[0]) + 1] == option[1]
    # The table folds a long name: every part of it is there.
    shown = "".join(
        re.findall(r"[^\W_]+", "".join(line.split("│")[2] for line in answer.out.splitlines() if "│" in line))
    )
    assert "".join(re.findall(r"[^\W_]+", name)) in shown


@pytest.mark.parametrize(
    "text", ["x" * 400, "a: " + "x" * 400 + "; type: flexlink identify 'a b.csv' --input u"]
)
def test_a_line_is_cut_but_never_its_command(text):
    line = cut_inside(text)
    assert len(line) <= 300
    assert (
        line.endswith("...")
        if "flexlink" not in text
        else line.endswith("type: flexlink identify 'a b.csv' --input u")
    )
    command = "type: flexlink identify " + "y" * 500
    assert cut_inside(f"{'x' * 200}; {command}").endswith(f"... {command}")
