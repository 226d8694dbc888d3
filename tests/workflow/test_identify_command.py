"""`flexlink identify`: one line on a CSV file, one page in words and pictures, models for other programs."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from tests.ident.benchmark_plants import P2_HZ, p2
from tests.workflow.page_shape import shape_faults
from tests.workflow.test_report import ATTACK, Page, is_one_file
from workflow.commands.identify import identify_logs
from workflow.commands.logs import Reading, read_logs
from workflow.tasks.exports import read_model
from workflow.text.formats import interval

DT_S = 0.005
COLUMNS = ("--input", "u_V", "--output", "tip_m", "--time", "t_s")


def write_log(path: Path, u, y, names=("t_s", "u_V", "tip_m"), **more) -> Path:
    columns = [np.arange(u.size) * DT_S, u, y, *more.values()]
    header = ",".join([*names, *more])
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="", fmt="%.12g")
    return path


def p2_log(path: Path, seed: int) -> Path:
    record = p2(seed).record
    return write_log(path, record.input[:, 0], record.output[:, 0])


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    p2_log(folder / "first.csv", 1)
    p2_log(folder / "fresh.csv", 2)
    return folder


def test_more_samples_than_memory_are_refused(logs, refused, monkeypatch):
    monkeypatch.setattr("workflow.tasks.records.MOST_SAMPLES", 100)
    line = refused("identify", logs / "first.csv", *COLUMNS)
    assert line.startswith("flexlink: first: ")
    assert "at most 100 are identified together" in line


def test_unclear_columns_offer_a_command_with_every_log(tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    u, y = np.random.default_rng(0).standard_normal((2, 40))
    paths = [write_log(Path(f"{k} a.csv"), u, y, tip_2_m=-y) for k in range(2)]
    line = refused("identify", *paths)
    words = shlex.split(line.split("type: flexlink ")[1])
    assert words[:3] == ["identify", *map(str, paths)]


def identify_first(logs, **written):
    fresh = [logs / "fresh.csv"]
    read = read_logs([logs / "first.csv"], Reading(input_name="u_V", output_name="tip_m", time="t_s"), fresh)
    return identify_logs(read, **written)


@pytest.fixture(scope="module")
def identified(logs):
    """The one-liner with everything it can write; document on standard output read back from the call."""
    written = {"report": logs / "page.html", "export": logs / "model.json", "out": logs / "model.npz"}
    return logs, identify_first(logs, **written).to_document()


def test_the_first_screen_of_an_identification(identified, browser):
    logs, _ = identified
    assert shape_faults(browser, logs / "page.html", screens=5) == []


def test_page_says_in_words_what_the_numbers_say(identified, faults_seen):
    logs, document = identified
    page = Page((logs / "page.html").read_text(encoding="utf-8"))
    numbers = document["numbers"]
    words = page.text.split("Modes and poles")[0]  # the first screen
    assert "Model of order 8 with 3 lightly damped modes" in words
    assert "chosen by an information criterion" in words
    assert "The data need 3 modes" in page.text
    for mode in numbers["modes"]:
        assert f"{mode['frequency_Hz']:.3g} Hz, {mode['damping']:.3g}" in words
    assert f"Fit, validation {numbers['fit_validation_percent']['fresh']:.3g} % fresh" in words
    assert "The residuals pass both tests" in words
    for known in numbers["uncertainty"]["intervals"]["modes"]:
        assert interval(known["frequency_Hz"]) in page.text
        assert interval(known["damping"]) in page.text
    for test in numbers["uncertainty"]["tests"]:
        assert test["verdict"] in page.text
    assert len(re.findall("<figure>", (logs / "page.html").read_text())) == 7
    assert faults_seen(logs / "page.html") == []


def test_intervals_hold_the_truth(identified):
    known = identified[1]["numbers"]["uncertainty"]["intervals"]["modes"]
    ends = [each["frequency_Hz"] for each in known]
    assert all(
        low <= hertz <= high for hertz, (low, high) in zip(P2_HZ, ends, strict=True)
    )  # of this seed; coverage over seeds is in tests/ident/test_pole_intervals.py
    # The exported model is the one on the page, its ellipses the posterior's.
    logs, document = identified
    assert document["report"] == str(logs / "page.html")
    assert document["numbers"]["model_file"] == str(logs / "model.json")
    assert (document["numbers"]["warnings"], document["verdict"]) == ([], "no warnings")
    file = read_model(logs / "model.json")
    hertz = np.sort(file.model.poles.omega_rad_s(DT_S)) / (2 * np.pi)
    assert hertz.tolist() == pytest.approx([mode["frequency_Hz"] for mode in document["numbers"]["modes"]])
    omega = file.ellipses.omega_rad_s
    assert file.ellipses.contains(file.model.frequency_response(omega)).mean() > 0.95
    assert file.ellipses.contains(p2(1).response(omega)).mean() > 0.8


def test_page_is_one_file_that_fetches_nothing(identified):
    is_one_file((identified[0] / "page.html").read_text(encoding="utf-8"))


def test_command_prints_table_and_places(flexlink, undrawn, logs, tmp_path):
    page, model = tmp_path / "page.html", tmp_path / "model.mat"
    answer = flexlink(
        *("identify", logs / "first.csv", *COLUMNS, "--real", 2, "--pairs", 3),
        *("--report", page, "--export", model),
    )
    assert answer.code == 0, answer.err
    assert answer.err == ""
    assert f"report: {page}" in answer.out
    assert f"model: {model}" in answer.out
    assert "2.5 Hz, damping 0.0147 (95 %:" in answer.out
    text = Page(page.read_text(encoding="utf-8")).text
    assert "as specified" in text
    assert "no record was kept for validation" in text.lower()
    assert read_model(model).model.order == 8


def test_same_files_same_page(identified, tmp_path):
    logs, _ = identified
    identify_first(logs, report=tmp_path / "b.html")
    assert (tmp_path / "b.html").read_bytes() == (logs / "page.html").read_bytes()


def test_what_to_do_stands_in_the_table_and_on_the_page(flexlink, undrawn, tmp_path):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=400), 4)
    y = scipy.signal.lfilter([0, 0.1], np.polymul([1, -0.9], [1, -1.9, 0.95]), u)
    # An echo 20 samples later, for which a few poles have no place: no noise model makes that white.
    y[20:] += y[:-20].copy()
    limit = np.quantile(np.abs(y), 0.9)
    log = write_log(tmp_path / "log.csv", u, np.clip(y, -limit, limit))
    answer = flexlink(
        "identify", log, *COLUMNS, "--real", 1, "--pairs", 1, "--report", tmp_path / "p.html", "--json"
    )
    document = answer.document()
    sentences = document["numbers"]["warnings"]
    assert any("saturated or clipped: lower the amplitude" in sentence for sentence in sentences)
    assert any("residuals" in sentence for sentence in sentences)
    assert "warning" in document["verdict"]
    rows = [row["value"] for row in document["table"] if row["section"] == "warnings"]
    assert rows == sentences
    text = Page((tmp_path / "p.html").read_text(encoding="utf-8")).text
    for sentence in sentences:
        assert sentence[1:] in text


def test_commands_beyond_what_the_amplifier_gives_are_taken_as_that(flexlink, undrawn, tmp_path):
    """A log of commands, its limit stated, gives the numbers of a log of what the amplifier gave."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.normal(size=400), 4)
    given = np.clip(u, -1.5, 1.5)
    y = scipy.signal.lfilter([0, 0.1], np.polymul([1, -0.9], [1, -1.9, 0.95]), given)
    y += 0.01 * rng.normal(size=y.size)
    found, page = {}, tmp_path / "page.html"
    for name, column, more in (("given", given, ()), ("commanded", u, ("--input-limit", 1.5))):
        log = write_log(tmp_path / f"{name}.csv", column, y)
        call = ("identify", log, *COLUMNS, "--real", 1, "--pairs", 1, "--report", page, "--json", *more)
        found[name] = flexlink(*call).document()
    numbers = {name: document["numbers"] for name, document in found.items()}
    for key in ("modes", "real_poles_z", "fit_estimation_percent"):
        assert str(numbers["commanded"][key]).replace("commanded", "given") == str(numbers["given"][key])
    cut = int(np.sum(np.abs(u) > 1.5))
    told = f"{cut} samples of the command exceeded the amplifier's 1.5 V"
    assert told in Page(page.read_text(encoding="utf-8")).text
    assert any(told in row["value"] for row in found["commanded"]["table"])
    # That the input stands at a limit is no doubt where it was stated.
    assert [sum("clipped" in warning for warning in one["warnings"]) for one in numbers.values()] == [1, 0]


def closed_loop_log(path: Path, seed: int) -> Path:
    """u = r - 2 y at the same sample; a mode at 30 rad/s with damping 0.1 and coloured noise in the loop."""
    rng = np.random.default_rng(seed)
    n, w, zeta = 4000, 30.0, 0.1
    a1 = 2 * np.exp(-zeta * w * DT_S) * np.cos(w * np.sqrt(1 - zeta**2) * DT_S)
    a2 = -np.exp(-2 * zeta * w * DT_S)
    noise = scipy.signal.lfilter([1], [1, -0.9], 0.005 * rng.normal(size=n))
    r = np.repeat(rng.choice([-1.0, 1.0], n // 4), 4)
    u, y, clean = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        clean[k] = (a1 * clean[k - 1] + a2 * clean[k - 2] + 0.02 * u[k - 1]) if k > 1 else 0.0
        y[k] = clean[k] + noise[k]
        u[k] = r[k] - 2 * y[k]
    return write_log(path, u, y, r_V=r)


@pytest.mark.slow
def test_logs_of_a_closed_loop_in_two_stages(flexlink, undrawn, tmp_path):
    log = closed_loop_log(tmp_path / "loop.csv", 1)
    answer = flexlink(
        *("identify", log, *COLUMNS, "--reference", "r_V", "--real", 0, "--pairs", 1),
        *("--report", tmp_path / "page.html", "--json"),
    )
    numbers = answer.document()["numbers"]
    (mode,) = numbers["modes"]
    assert mode["omega_rad_s"] == pytest.approx(30.0, rel=0.02)
    assert mode["damping"] == pytest.approx(0.1, rel=0.1)
    assert numbers["closed_loop"]["method"] == "two_stage"
    assert "The reference explains" in numbers["closed_loop"]["reason"]
    assert "The reference explains" in Page((tmp_path / "page.html").read_text(encoding="utf-8")).text


@pytest.mark.slow
def test_repeats_that_differ_between_amplitudes_are_warned_of(flexlink, undrawn, tmp_path):
    """Gain 5 % higher at twice the input, and the same records of an arm that keeps its gain."""
    rng = np.random.default_rng(7)
    swept = np.sin(np.pi * 0.3 / 1500 * np.arange(1500) ** 2 / 2)
    for gain, warned in ((1.05, True), (1.0, False)):
        logs = []
        for size, factor in ((1.0, 1.0), (2.0, gain)):
            for k in range(3):
                y = scipy.signal.lfilter([0.0, 0.1 * factor], [1.0, -0.9], size * swept)
                y += 0.003 * rng.standard_normal(y.size)
                logs.append(write_log(tmp_path / f"{gain}_{size}_{k}.csv", size * swept, y))
        answer = flexlink("identify", *logs, *COLUMNS, "--real", 1, "--pairs", 0, "--json")
        said = [w for w in answer.document()["numbers"]["warnings"] if "depends on amplitude" in w]
        assert len(said) == warned
        assert not warned or "% higher at the larger amplitude, as under dry friction" in said[0]


@pytest.mark.slow
def test_a_band_leaves_out_drift_and_friction(flexlink, undrawn, tmp_path):
    """A random walk on the output: its power is at low frequency, below the band."""
    truth = p2(4)
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=2000))
    y = truth.record.output[:, 0] + 0.02 * walk * truth.clean.std() / walk.std()
    log = write_log(tmp_path / "log.csv", truth.record.input[:, 0], y)
    answer = flexlink(
        *("identify", log, *COLUMNS, "--real", 2, "--pairs", 2, "--band", 8, 300, "--json"),
        *("--report", tmp_path / "page.html"),
    )
    numbers = answer.document()["numbers"]
    hertz = [mode["frequency_Hz"] for mode in numbers["modes"]]
    assert hertz == pytest.approx(P2_HZ[:2], rel=0.01)
    assert numbers["uncertainty"]["bands"][0]["from_rad_s"] >= 8
    text = Page((tmp_path / "page.html").read_text(encoding="utf-8")).text
    assert "Fitted inside the band from 8 to 300 rad/s" in text
    assert not [sentence for sentence in numbers["warnings"] if "outside the band" in sentence]

    upper = 2 * np.pi * P2_HZ[1] / 1.1
    cut = flexlink("identify", log, *COLUMNS, "--real", 2, "--pairs", 2, "--band", 8, upper, "--json")
    warnings = cut.document()["numbers"]["warnings"]
    assert [sentence for sentence in warnings if "outside the band of the data" in sentence]


@pytest.mark.slow
def test_friction_is_identified_from_logs_where_that_is_asked_for(flexlink, undrawn, tmp_path):
    """On records of the default arm: the model behind its friction simulates unseen ones better."""
    assert flexlink("simulate", "--out", tmp_path / "logs").code == 0
    *logs, fresh = sorted((tmp_path / "logs").glob("*.csv"))
    command = ("identify", *logs[:2], "--validation", fresh, "--input", "voltage_V", "--time", "time_s")
    command = (*command, "--output", "hub_angle_rad", "--integrators", 1, "--delay", 1, "--json")
    command = (*command, "--real", 1, "--pairs", 2, "--omega-min", 30, "--noise", "white")
    told = {}
    for response in ("as recorded", "without friction", "this amplitude"):
        page = tmp_path / "page.html"
        answer = flexlink(*command, "--response", response, "--report", page)
        document = answer.document()
        told[response] = {row["label"]: row["value"] for row in document["table"]}
        text = Page(page.read_text(encoding="utf-8")).text
        assert ("Coulomb" in text) == (response != "as recorded")
        assert ("best linear approximation" in text) == (response == "this amplitude")
    unexplained = {response: 100 - float(row["fit, validation"].split()[0]) for response, row in told.items()}
    assert unexplained["without friction"] < unexplained["as recorded"] / 2
    assert unexplained["this amplitude"] == unexplained["without friction"]  # of the same model


def test_a_log_in_milliseconds_gives_the_poles_of_the_same_log_in_seconds(flexlink, undrawn, tmp_path):
    """Same bits: the stamps are divided by 1000, which rounds once."""
    record = p2(5, 600).record
    u, y = record.input[:, 0], record.output[:, 0]
    stamps = np.arange(u.size) * DT_S
    found, told = {}, {}
    for name, header, factor, more in (
        ("seconds", "t_s", 1, ()),
        ("milliseconds", "Zeit [ms]", 1000, ()),
        ("stated", "t", 1000, ("--time-unit", "ms")),
    ):
        log = tmp_path / f"{name}.csv"
        lines = [f"{header},u_V,tip_m"]
        lines += [f"{t:.6g},{a:.12g},{b:.12g}" for t, a, b in zip(factor * stamps, u, y, strict=True)]
        log.write_text("\n".join(lines))
        answer = flexlink(
            *("identify", log, "--input", "u_V", "--output", "tip_m", "--time", header, *more),
            *("--real", 2, "--pairs", 3, "--json", "--report", tmp_path / f"{name}.html"),
        )
        document = answer.document()
        found[name] = {key: document["numbers"][key] for key in ("modes", "real_poles_z", "warnings")}
        told[name] = {row["label"]: row["value"] for row in document["table"]}
        assert told[name][name] in Page((tmp_path / f"{name}.html").read_text(encoding="utf-8")).text
    assert found["milliseconds"] == found["seconds"] == found["stated"]
    told_ms = told["milliseconds"]
    assert told_ms["milliseconds"] == "time column 'Zeit [ms]': milliseconds, sampled every 5 ms, 3 s"
    assert (told_ms["input"], told_ms["output"]) == ("'u_V' in V", "'tip_m' in m")
    assert told["stated"]["stated"] == "time column 't': milliseconds as given, sampled every 5 ms, 3 s"


def test_integers_called_seconds_are_doubted(refused, tmp_path):
    record = p2(5, 600).record
    rows = enumerate(zip(record.input[:, 0], record.output[:, 0], strict=True))
    lines = ["t,u,y", *(f"{5 * k},{a:.12g},{b:.12g}" for k, (a, b) in rows)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    command = ("identify", tmp_path / "log.csv", "--input", "u", "--output", "y", "--time", "t")
    said = refused(*command, "--real", 2, "--pairs", 3, "--json")
    assert "time column 't' has steps of 5 s, no unit is stated" in said
    assert "state --time-unit ms, or --time-unit s if it is right" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--time-unit", "foo"), "unknown unit of time 'foo'; expected s, ms, us"),
        (("--export", "{out}/model.txt"), "the ending must be .json or .mat"),
        (("--export", "{out}/gone/model.mat"), "is not a directory"),
        (("--report", "{out}"), "it is a directory"),
        (("--report", "{log}"), "that is a source already"),
        (("--report", "{out}/a", "--out", "{out}/a"), "that is --out already"),
        (("--reference", "r"), "no column 'r'"),
        (("--input-limit", "0"), "--input-limit: input should be greater than 0"),
        (("--level", "0.2"), "flexlink: --level: input should be greater than 0.5"),
        (("--pairs", "13"), "flexlink: --pairs: input should be less than or equal to 12, got 13"),
        (
            ("--response", "amplitude 2"),
            "should be 'as recorded', 'without friction', 'without remote friction' or 'this amplitude'",
        ),
        (("--response", "this amplitude", "--band", "10", "20"), "takes records as measured: no increments"),
        (("--band", "50", "20"), "a band needs 0 < low < high in rad/s; got 50, 20"),
        (("--band", "50", "2000"), "the band must lie in (0, 628"),
        (("--pairs", "12", "--report", "{out}/page.html"), "too few"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_leaves_nothing(refused, tmp_path, arguments, words):
    out = tmp_path / "out"
    out.mkdir()
    rng = np.random.default_rng(0)
    log = write_log(tmp_path / "log.csv", rng.normal(size=40), rng.normal(size=40))
    filled = [argument.format(out=out, log=log) for argument in arguments]
    assert words in refused("identify", log, *COLUMNS, *filled)
    assert list(out.iterdir()) == []
    assert log.read_text().startswith("t_s,")


def test_hostile_names_are_escaped(undrawn, tmp_path):
    record = p2(3, 600).record
    hostile = f"{ATTACK}&$x_1$"
    log = write_log(tmp_path / "log.csv", record.input[:, 0], record.output[:, 0], ("t_s", "u_V", hostile))
    logs = read_logs([log], Reading(input_name="u_V", output_name=hostile, time="t_s"))
    summary = identify_logs(logs, report=tmp_path / "page.html", export=tmp_path / "m.json")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert ATTACK not in text
    assert hostile in Page(text).text
    assert summary.numbers["output"] == hostile
    assert read_model(tmp_path / "m.json").model.output_name == hostile
