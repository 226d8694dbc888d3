"""`flexlink tune`: designs of the page are those of `flexlink design`; nobody but the page is served."""

import http.client
import json
import re
import shutil
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from control_design.plants.plant_set import UncertainPlant
from tests.browser import PROGRAM, Browser, barriers
from tests.workflow import report_examples as example
from tests.workflow.command import start_flexlink
from tests.workflow.test_design_sources import DT_S, QUICK, WISH, arm, document, write_json
from workflow.config.design_file import DesignFile, read_design_file
from workflow.engine import codec
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.design_source import load_sources
from workflow.tasks.results import IdentifiedPlant, RunResults
from workflow.text.formats import percent, si
from workflow.tune import session as tuning
from workflow.tune.server import TuneServer
from workflow.tune.session import SupersededError, TuningSession, toml_of

UNCERTAIN = "\n[uncertainty]\nmultiplicative = 0.05\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("tune")
    write_json(path / "arm.json", document(arm()))
    write_json(path / "stiff.json", document(arm(mode_rad_s=18.0)))
    (path / "spec.toml").write_text(WISH + QUICK + UNCERTAIN)
    return path


@pytest.fixture(scope="module")
def session(folder) -> TuningSession:
    """With a first design."""
    file = read_design_file(folder / "spec.toml")
    found = TuningSession([folder / "arm.json"], file, folder / "saved", 2006)
    assert found.design({})["certified"]
    return found


@pytest.fixture
def posterior_session(tmp_path) -> TuningSession:
    model = example.model()
    found = IdentifiedPlant(model, example.posterior(model), 0.9)
    np.savez(tmp_path / "plant.npz", **codec.to_arrays(found))
    spec = "bandwidth_rad_s = 1.0\nmodulus_margin = 0.4\ncontroller_order = 2\n"
    (tmp_path / "spec.toml").write_text(spec + QUICK)
    file = read_design_file(tmp_path / "spec.toml")
    return TuningSession([tmp_path / "plant.npz"], file, tmp_path / "saved", 1)


@pytest.fixture
def server(session) -> Iterator[TuneServer]:
    made = TuneServer(session)
    thread = threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield made
    made.shutdown()
    made.server_close()
    thread.join()


def ask(server: TuneServer, path: str, content: Any = None, **headers: str) -> tuple[int, Any, Any]:
    """Status, content and headers; a POST where there is content."""
    link = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
    body = content if content is None or isinstance(content, bytes) else json.dumps(content).encode()
    link.request("GET" if content is None else "POST", path, body, headers)
    answer = link.getresponse()
    text = answer.read().decode()
    link.close()
    kind = answer.headers["Content-Type"]
    return answer.status, json.loads(text) if kind.startswith("application/json") else text, answer.headers


# -- designs -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_saved_is_what_flexlink_design_writes(session, folder, flexlink):
    values = {"bandwidth_rad_s": 0.6, "effort_limit": 15.0}
    shown = session.design(values)
    saved = session.save(values, "first")
    directory = Path(saved["directory"])
    assert {path.name for path in directory.iterdir()} >= {"design.toml", "controller.json", "controller.c"}
    again = folder / "again"
    again.mkdir()
    call = ["design", folder / "arm.json", "--spec", directory / "design.toml", "--out", again, "--json"]
    gamma = flexlink(*call, "--quiet").document()["numbers"]["design"]["synthesis"]["gamma"]
    for name in ("controller.json", "controller.c", "controller.h"):
        assert (again / name).read_bytes() == (directory / name).read_bytes()
    assert shown["gamma"] == pytest.approx(gamma, rel=1e-3)  # on the certificate's grid and on the design's
    law = json.loads((directory / "controller.json").read_text())
    assert np.array_equal(law["A"], session._last.A)
    assert np.array_equal(law["C"], session._last.C)


@pytest.mark.long
def test_settings_change_the_design(session):
    tight, wide = (session.design({"effort_limit": limit}) for limit in (2.0, 40.0))
    session.design({})
    assert tight["gamma"] > 1.05 * wide["gamma"]
    assert tight["items"] != wide["items"]


def test_a_newer_design_ends_the_one_that_runs(session, monkeypatch):
    begun = threading.Event()
    real = tuning.find_design

    def slow(*given, **more):
        still = given[5]
        begun.set()
        while True:  # ends by what `still` raises
            still(0.0, "")
            time.sleep(0.005)

    monkeypatch.setattr(tuning, "find_design", slow)
    raised: list[BaseException] = []

    def first() -> None:
        try:
            session.design({"effort_limit": 30.0})
        except SupersededError as error:
            raised.append(error)

    thread = threading.Thread(target=first)
    thread.start()
    assert begun.wait(10)
    monkeypatch.setattr(tuning, "find_design", real)
    assert session.design({})["certified"]
    thread.join(10)
    assert len(raised) == 1


@pytest.mark.slow
def test_near_designs_are_soon_there_and_hardly_worse(session):
    session.design({})
    wanted = {"effort_limit": 12.0, "bandwidth_rad_s": 0.8}
    near = session.near(wanted)
    started = session.design(wanted)
    assert near["gamma"] == pytest.approx(started["gamma"], rel=0.02)
    assert near["items"][0]["requirement"] == started["items"][0]["requirement"]
    assert session.near({"bandwidth_rad_s": 60.0, "effort_limit": None}) == {}
    session.design({})


def test_the_scaled_design_is_the_last_one_times_a_gain(session):
    session.design({})
    found = session.scaled({"effort_limit": 5.0})
    assert found["certified"] is None
    curves = found["plants"][0]["gains"]
    omega = np.array(curves[0]["x"])
    loop = found["gain"] * session._last.response(omega) * arm()(np.exp(1j * omega * DT_S))
    assert np.allclose(curves[0]["nominal"], np.abs(1 / (1 + loop)), rtol=1e-3)
    assert np.allclose(curves[2]["nominal"], np.abs(loop / (1 + loop)), rtol=1e-3)
    limit = np.array(curves[1]["limit"], dtype=float)
    assert np.allclose(limit[np.isfinite(limit)], 5.0, rtol=1e-3)
    # A smaller gain suits a smaller effort.
    assert found["gain"] < session.scaled({"effort_limit": 50.0})["gain"]


@pytest.mark.slow
def test_confidence_is_kept_with_the_design(posterior_session, tmp_path):
    session = posterior_session
    names = {one["name"] for one in session.settings()}
    assert "confidence" in names
    assert session.settings()[-1]["value"] == 0.9
    narrow, wide = (session.design({"confidence": level}) for level in (0.6, 0.999))
    assert wide["gamma"] > narrow["gamma"]
    assert len(narrow["plants"][0]["step"]["samples"]) == 15
    usual = tmp_path / "usual.toml"
    usual.write_text(toml_of(session.completed({"confidence": 0.95})))
    # Stated at the default of [plant]: not the 0.9 of the plant's file.
    assert load_sources(session.paths, read_design_file(usual))[0].plant.level == 0.95
    saved = session.save({"confidence": 0.999}, "sure")
    file = read_design_file(Path(saved["directory"]) / "design.toml")
    assert file.plant.level == 0.999
    law = json.loads((Path(saved["directory"]) / Path(saved["files"][1]).name).read_text())
    assert np.array_equal(law["A"], session._last.A)


@pytest.mark.long
def test_several_plants_share_a_design(folder):
    paths = [folder / "arm.json", folder / "stiff.json"]
    session = TuningSession(paths, read_design_file(folder / "spec.toml"), folder / "two", 3)
    found = session.design({"bandwidth_rad_s": 0.5})
    assert [plant["name"] for plant in found["plants"]] == ["arm", "stiff"]
    assert found["plants"][0]["nyquist"] != found["plants"][1]["nyquist"]


@pytest.mark.slow
def test_a_design_says_what_is_said_of_its_limits(session):
    free = dict(session.design({})["numbers"])
    assert "no input_limit" in free["at the limits"]
    limited = session.design({"input_limit": 2.0})
    assert "end where they must" in dict(limited["numbers"])["at the limits"]
    assert sum("limited" in item["requirement"] for item in limited["items"]) == 2, dict(limited["numbers"])[
        "at the limits"
    ]
    assert all(item["met"] for item in limited["items"])
    assert "before the design ends" in dict(session.scaled({"input_limit": 2.0})["numbers"])["at the limits"]


def test_a_specification_that_contradicts_itself_is_a_result(session):
    found = session.design({"bandwidth_rad_s": 60.0, "effort_limit": None})
    assert found["certified"] is False
    assert found["reason"]
    assert found["plants"] == []


def test_a_design_file_survives_its_writing(session, tmp_path):
    asked = session.completed({"effort_limit": 11.5, "effort_rolloff_rad_s": None, "integrator": True})
    (tmp_path / "design.toml").write_text(toml_of(asked))
    read = read_design_file(tmp_path / "design.toml")
    assert read.model_dump() == asked.model_dump()
    assert read.specification.effort_limit == 11.5
    assert read.specification.integrator


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "x" * 90, "a\nb"])
def test_a_name_leads_nowhere_else(session, name):
    with pytest.raises(ValueError, match="expected letters"):
        session.save({}, name)


# -- server --------------------------------------------------------------------------------------------------


def test_others_are_refused(server):
    assert server.server_address[0] == "127.0.0.1"
    assert server.url.startswith(f"http://127.0.0.1:{server.server_port}/?token=")
    assert len(server.token) >= 32
    content = {"settings": {}}
    key = {"X-Flexlink-Token": server.token}
    path = f"/?token={server.token}"
    for asked in (
        ask(server, "/"),
        ask(server, "/?token=guess"),
        ask(server, path, Host=f"evil.example:{server.server_port}"),
        ask(server, path, Origin="http://evil.example"),
        ask(server, "/scaled", content),
        ask(server, f"/scaled?token={server.token}", content),
        ask(server, "/scaled", content, **{"X-Flexlink-Token": "é"}),
        ask(server, "/scaled", content, Origin="http://evil.example", **key),
        ask(server, "/scaled", content, Origin="null", **key),
        ask(server, "/scaled", content, Host="evil.example", **key),
    ):
        assert asked[0] == 403
        assert "token" in asked[1]["error"]
    status, page, headers = ask(server, path)
    assert status == 200
    assert "X-Flexlink-Token" in page
    assert server.token not in page
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Access-Control-Allow-Origin" not in headers


@pytest.mark.parametrize(
    ("path", "content", "status", "words"),
    [
        ("/scaled", b"{", 400, "Expecting"),
        ("/scaled", b"\xff", 400, "codec"),
        ("/scaled", [1], 400, "object"),
        ("/scaled", {"settings": {"bandwith_rad_s": 1}}, 400, "bandwith_rad_s"),
        ("/design", {"settings": {"bandwidth_rad_s": -1}}, 400, "greater than 0"),
        ("/design", {"settings": {"controller_order": "many"}}, 400, "controller_order"),
        ("/save", {"settings": {}, "name": "../up"}, 400, "expected letters"),
        ("/save", {"settings": {}, "name": 7}, 400, "expected letters"),
        ("/nothing", {"settings": {}}, 404, "no such"),
        ("/scaled", b" " * (1 << 17), 413, "bytes"),
        ("/scaled", b"[" * 60_000, 400, "nested deeper"),
        ("/scaled", b'{"settings": {"a": ' + b'{"a": ' * 9_000 + b"1" + b"}" * 9_002, 400, "nested deeper"),
        ("/scaled", b'{"settings": {"a": ' + b"[" * 50 + b"]" * 50 + b"}}", 400, "nested deeper"),
        ("/scaled", b'{"settings": {"effort_limit": ' + b"1" * 5_000 + b"}}", 400, "4300 digits"),
        ("/scaled", b'{"settings": {"effort_limit": ' + b"1" * 4_000 + b"}}", 400, "beyond 64 bits"),
        ("/scaled", b'{"settings": {"effort_limit": 1e999}}', 400, "finite"),
        ("/scaled", b'{"settings": {"effort_limit": -Infinity}}', 400, "finite"),
        ("/scaled", b'{"settings": {"effort_limit": NaN}}', 400, "finite"),
        ("/scaled", b'{"settings": {"effort_limit": 1, "effort_limit": 2}}', 400, "twice"),
        ("/scaled", b'{"settings": {"\\ud800": 1}}', 400, "UTF-16"),
        ("/save", b'{"settings": {}, "name": "\\udfff"}', 400, "UTF-16"),
        ("/save", b'{"settings": {}, "name": "a\\u0000b"}', 400, "NUL"),
        ("/scaled", {"settings": {"effort_limit": {"a": [1]}}}, 400, "effort_limit"),
        ("/scaled", {"settings": {"effort_limit": True}}, 400, "effort_limit"),
        ("/scaled", {"settings": {"confidence": "0.9"}}, 400, "confidence"),
        ("/scaled", {"settings": None}, 400, "settings"),
        ("/scaled", b"", 400, "Expecting"),
    ],
)
def test_what_is_wrong_is_one_line(server, path, content, status, words, capfd):
    found, said, _ = ask(server, path, content, **{"X-Flexlink-Token": server.token})
    assert found == status
    assert words in said["error"]
    assert "\n" not in said["error"]
    assert capfd.readouterr() == ("", "")


def answered(server: TuneServer, request: bytes) -> int:
    """Status of the answer to bytes as they are, after which the server hangs up."""
    with socket.create_connection(server.server_address, timeout=20) as link:
        link.sendall(request)
        answer = b""
        while part := link.recv(1 << 16):
            answer += part
    return int(answer.split()[1])


@pytest.mark.parametrize(
    ("lines", "content", "status"),
    [
        ("Content-Length: many", b"{}", 400),
        ("Content-Length: \u00b2", b"{}", 400),  # a digit to str.isdigit, no number to int
        ("Content-Length: -2", b"{}", 400),
        ("Content-Length: +2", b"{}", 400),
        ("Content-Length: 0x2", b"{}", 400),
        ("Content-Length: 2.0", b"{}", 400),
        ("Content-Length:", b"{}", 400),
        ("Content-Length: " + "9" * 5_000, b"{}", 400),
        ("Content-Length: 99999999999", b"{}", 413),
        ("Content-Length: 2\r\nContent-Length: 30", b"{}", 400),
        ("Content-Length: 2\r\nTransfer-Encoding: chunked", b"2\r\n{}\r\n0\r\n\r\n", 400),
        ("Transfer-Encoding: chunked", b"2\r\n{}\r\n0\r\n\r\n", 411),
        ("Accept: */*", b"", 411),
    ],
)
def test_a_length_that_is_none_is_refused(server, lines, content, status, capfd):
    head = f"POST /scaled HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n{lines}\r\n"
    head += f"X-Flexlink-Token: {server.token}\r\n\r\n"
    assert answered(server, head.encode("latin-1") + content) == status
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("request_line", "status"),
    [("GET http://[ HTTP/1.1", 400), ("GET /?token=%ff%00 HTTP/1.1", 403), ("PUT / HTTP/1.1", 501)],
)
def test_an_address_that_is_none_is_refused(server, request_line, status, capfd):
    host = f"Host: 127.0.0.1:{server.server_port}"
    assert answered(server, f"{request_line}\r\n{host}\r\n\r\n".encode()) == status
    assert answered(server, f"{request_line}\r\n\r\n".encode()) in (400, 403, 501)  # no Host at all
    assert capfd.readouterr() == ("", "")


def test_whoever_leaves_in_the_middle_leaves_no_traceback(server, capfd):
    for _ in range(3):
        with socket.create_connection(server.server_address) as link:
            # Closed with a reset, as by a browser that is killed.
            link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            link.sendall(b"POST /scaled HTTP/1.1\r\nContent-Length: 100\r\n")
    assert ask(server, f"/?token={server.token}")[0] == 200
    assert capfd.readouterr() == ("", "")


def test_actions_of_the_page(server):
    key = {"X-Flexlink-Token": server.token, "Origin": f"http://127.0.0.1:{server.server_port}"}
    content = {"settings": {"effort_limit": 12.0}}
    assert ask(server, "/design", content, **key)[1]["certified"]
    assert ask(server, "/scaled", content, **key)[1]["plants"]
    bound = ask(server, "/bound", content, **key)[1]
    assert 0 < bound["reached"] < 1.5


def test_it_needs_one_source(refused, folder):
    assert "--demo" in refused("tune")
    assert "--demo" in refused("tune", folder / "arm.json", "--demo")
    assert "no such" in refused("tune", folder / "nothing")
    assert "--spec" in refused("tune", folder / "arm.json", "--quiet", "--no-browser")


@pytest.mark.long
def test_ctrl_c_ends_it(folder):
    spec = ["--spec", folder / "spec.toml", "--no-browser", "--quiet"]
    process = start_flexlink("tune", folder / "arm.json", *spec)
    address = process.stdout.readline().decode()
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]+\n", address)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == b"stopped\n"
    assert err == b""


@pytest.mark.long
def test_the_demo_is_the_built_in_arm(tmp_path):
    process = start_flexlink("tune", "--demo", "--no-browser", "--quiet", "--out", tmp_path / "saved")
    assert process.stdout.readline().startswith(b"http://127.0.0.1:")
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 0
    # The plant stays, for `flexlink design` with what was saved; sliders have its units.
    kept = TuningSession([tmp_path / "saved" / "default_arm"], DesignFile(), tmp_path / "saved", 2006)
    units = {one["name"]: one["unit"] for one in kept.settings()}
    wanted = {"effort_limit": "V / rad", "input_limit": "V", "rate_limit": "V / s", "modulus_margin": ""}
    assert units.items() >= {**wanted, "bandwidth_rad_s": "rad/s"}.items()


# -- page ----------------------------------------------------------------------------------------------------


def text(browser: Browser, name: str) -> str:
    return str(browser.ask(f"document.getElementById('{name}').textContent"))


def wait_until(browser: Browser, condition: Callable[[], bool]) -> None:
    for _ in range(1200):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError(text(browser, "state"))


def designed(browser: Browser, number: int) -> None:
    wait_until(browser, lambda: browser.ask("document.body?.dataset.designed") == str(number))


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="chromium is not installed")
def test_the_page_by_keyboard(server, browser):
    browser.go(server.url)
    designed(browser, 1)
    assert text(browser, "headline") == "Certified"
    assert browser.ask("document.querySelectorAll('.panels svg[role=img]').length") == 11
    first = browser.ask("document.querySelector('.panels .nominal').getAttribute('d')")
    stated = browser.ask("document.getElementById('c-effort_limit').getAttribute('aria-valuetext')")
    browser.ask("document.getElementById('c-effort_limit').focus()")
    browser.press("p")
    assert text(browser, "pin") == "Unpin"
    browser.press("PageDown")  # a tenth of the range
    designed(browser, 2)
    moved = browser.ask("document.getElementById('c-effort_limit').getAttribute('aria-valuetext')")
    assert float(moved) < 0.6 * float(stated)
    assert browser.ask("document.querySelector('.panels .nominal').getAttribute('d')") != first
    assert browser.ask("document.querySelectorAll('.panels .curve.pinned').length") >= 6
    assert browser.ask("Number(document.body.dataset.scaled)") > 0
    browser.press("u")
    assert browser.ask("document.getElementById('c-effort_limit').getAttribute('aria-valuetext')") == stated
    assert browser.ask("document.querySelector('.panels .nominal').getAttribute('d')") == first
    assert browser.ask("document.getElementById('undo').disabled")
    for width, dark in ((400, False), (1280, True)):
        browser.resize(width, dark=dark)
        assert browser.ask("document.documentElement.scrollWidth") <= width
    own = f"request: http://127.0.0.1:{server.server_port}/"
    assert [said for said in browser.complaints() if not said.startswith(own)] == []
    assert barriers(browser) == []


@pytest.mark.skipif(PROGRAM is None, reason="chromium is not installed")
def test_every_gain_of_the_page_has_its_unit_and_none_is_cut_off(server, browser):
    browser.go(server.url)
    designed(browser, 1)
    titles = browser.ask("[...document.querySelectorAll('.panels h2')].map(title => title.textContent)")
    gains = [title for title in titles if "gain of" in title or title.startswith("|")]
    assert len(gains) == 7
    # Nobody stated a unit of this arm's signals; the loop has none.
    assert all(title.endswith("[1]") or "[as logged]" in title or "[1]:" in title for title in gains)
    for symbol in ("K G", "G", "K"):
        (place,) = [k for k, title in enumerate(titles) if title.startswith(f"Bode: gain of {symbol} [")]
        panel = f"document.querySelectorAll('.panels > div')[{place}]"
        extent = "(box => [box.y, box.y + box.height])({}.querySelector('{}').getBBox())"
        low, high = browser.ask(extent.format(panel, ".curve.nominal"))
        frame = browser.ask(extent.format(panel, ".frame"))
        assert frame[0] < low < high < frame[1]
        assert high - low > 0.5 * (frame[1] - frame[0])


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="chromium is not installed")
def test_the_page_saves_and_says_what_is_wrong(server, browser, session):
    browser.go(server.url)
    designed(browser, 1)
    browser.ask(
        "document.getElementById('name').value = 'by-hand-3'; document.getElementById('save').click()"
    )
    wait_until(browser, lambda: text(browser, "state").startswith("saved"))
    assert (session.out / "by-hand-3" / "controller.json").is_file()
    assert browser.ask("document.getElementById('name').value") == "by-hand-4"
    box = "document.querySelector('#c-modulus_margin + input')"
    browser.ask(f"{box}.value = 3; {box}.dispatchEvent(new Event('change'))")
    wait_until(browser, lambda: "less than 1" in text(browser, "state"))


@pytest.mark.slow
def test_controls_are_made_of_the_specification(session):
    known = {one["name"]: one for one in session.settings()}
    assert known["modulus_margin"]["lt"] == 1
    assert known["controller_order"]["kind"] == "count"
    assert known["controller_order"]["le"] == 16
    assert known["effort_limit"]["optional"]
    assert known["structure"]["choices"] == ["biquads", "p", "pi", "pd", "pid"]
    assert known["integrator"]["kind"] == "switch"
    assert known["controller_order"]["unasked"] == "auto"
    assert not {"mode_band_rad_s", "confidence"} & known.keys()  # of pairs, and of stated discs
    assert 1 <= int(dict(session.design({"controller_order": "auto"})["numbers"])["controller order"]) <= 12


def test_what_follows_from_a_structure_is_said_and_not_set(folder, tmp_path):
    asked = tmp_path / "pid.toml"
    asked.write_text('structure = "pid"\nbandwidth_rad_s = 2.0\nlow_pass = { frequency_hz = 4.0 }\n')
    session = TuningSession([folder / "arm.json"], read_design_file(asked), tmp_path / "out", 1)
    of = {one["name"]: one.get("set_by_structure", {}) for one in session.settings()}
    assert of["controller_order"]["pid"] == "structure pid has order 4"
    assert of["controller_order"]["pi"] == "structure pi has order 3"
    assert of["integrator"]["pd"] == "structure pd has no integrator"
    assert "biquads" not in of["integrator"]
    assert not of["bandwidth_rad_s"]


def test_a_plant_of_its_own_grid_has_curves_on_it(session):
    omega = np.geomspace(0.2, 50.0, 40)
    nominal = arm()

    class Known:
        omega_rad_s, level = omega, 0.95
        centre = nominal(np.exp(1j * omega * DT_S))
        covariance = 1e-6 * np.broadcast_to(np.eye(2), (40, 2, 2))

    plant = UncertainPlant(control.ss(nominal), name="known", uncertainty=Known())
    gains = tuning._gains(session._last, plant, session.specification)
    assert len(gains[0]["x"]) == 40


def test_numbers_beside_the_sliders_are_those_of_the_run(fast_run, monkeypatch, tmp_path):
    """Its own controller: predicted step and certified margins, as its page and terminal have them."""
    results = RunResults(RunDirectory(fast_run[0]))
    session = TuningSession([fast_run[0]], DesignFile(), tmp_path / "saved", 2006)
    monkeypatch.setattr(tuning, "_GAINS", np.ones(1))
    found = session.scaled({})
    shown, check = dict(found["numbers"]), results.closed_loop.check
    worst, step = results.certify.certificate.plants[0].worst_margins, check.predicted
    assert shown["overshoot"] == percent(step.overshoot_percent)
    assert shown["settling time to 2 %"] == si(step.settling_time_s, "s")
    assert shown["peak command"] == si(step.peak_command, "V")
    assert session.step_words == si(check.reference_step, "rad", 4)
    phase, delay = np.degrees(worst.phase_rad), 1000 * worst.delay_s
    margins = {"modulus": worst.modulus, "gain": worst.gain_up, "phase": phase, "delay": delay}
    for name, value in margins.items():  # the certificate's grid is denser
        assert float(shown[f"{name} margin"].split()[0]) == pytest.approx(value, rel=0.01)
    drawn = found["plants"][0]["step"]
    assert len(drawn["samples"]) == 15
    # The thinned step is drawn where the whole one is, and until it has settled.
    run = session._steps(session._last, session._plants[0])[0]
    seen = run.time_s <= drawn["end"]
    line = np.interp(run.time_s[seen], drawn["nominal"]["x"], drawn["nominal"]["y"])
    assert np.max(np.abs(line - run.measured[seen])) < 2e-3 * np.ptp(run.measured)
    assert drawn["end"] > step.settling_time_s


def test_a_run_is_tuned_from_its_own_design_at_the_bandwidth_it_found(fast_run, tmp_path):
    run = shutil.copytree(fast_run[0], tmp_path / "run")
    session = TuningSession([run], DesignFile(), tmp_path / "saved", 2006)
    found = session.near({})
    assert found["gamma"] == pytest.approx(RunResults(RunDirectory(run)).design.gamma, rel=0.02)
    stated = session.specification.bandwidth_rad_s
    open_ended = session.specification.model_dump() | {
        "bandwidth_rad_s": 3 * stated,
        "lowest_bandwidth_rad_s": 0.1 * stated,
    }
    file = DesignFile.model_validate({"specification": open_ended})
    session = TuningSession([run], file, tmp_path / "saved", 2006)
    assert session.specification.lowest_bandwidth_rad_s is None
    assert "lowest_bandwidth_rad_s" not in [one["name"] for one in session.settings()]
    assert session.specification.bandwidth_rad_s == stated
