"""The pictures of README and of the first page of the site: `python docs/pictures.py` draws them again."""

from __future__ import annotations

import tempfile
import threading
import time
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

import flexlink
from diagnosis.diagnosis import diagnose
from flexlink.pictures import as_response
from tests.browser import Browser
from workflow.commands.run import run_from_files
from workflow.diagnose.case_files import load_case
from workflow.figures.bode import draw_bode
from workflow.figures.gap_records import draw_measured_beside_simulated
from workflow.figures.svg import alone
from workflow.tune import tuning

DOCS = Path(__file__).parent


def overview() -> bytes:
    """The built-in arm: response, loop and step of `make run`."""
    with tempfile.TemporaryDirectory() as folder:
        run_from_files(None, Path(folder) / "run")
        return (Path(folder) / "run" / "figures" / "overview.svg").read_bytes()


def diagnosis() -> bytes:
    """examples/gap_case: measured beside simulated, before and after the repair."""
    case = load_case(DOCS.parent / "examples" / "gap_case").case
    return alone(draw_measured_beside_simulated(diagnose(case)))


def response() -> bytes:
    """The response that the Python lines of README identify."""
    voltage = flexlink.prbs(register_length=11, hold_samples=2, amplitude_V=12.0, n_samples=4000)
    run = flexlink.simulate(flexlink.paper_link(), voltage, rng=np.random.default_rng(1))
    found = flexlink.identify(run.record("hub_angle_rad"), integrators=1, n_real=1, n_pairs=2)
    name = f"{found.model.input_name} to {found.model.output_name}"
    return alone(draw_bode(as_response(flexlink.uncertainty(found)), name, "as logged"))


def tune() -> bytes:
    """The page of `flexlink tune --demo` with its first design and the bound, in 256 colours."""
    with tempfile.TemporaryDirectory() as name, tuning([], None, out=Path(name), seed=2006) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser, picture, small = Browser(), Path(name) / "page.png", BytesIO()
        browser.go(server.url, 1280, 860)
        # The bound over controllers of any order comes last, seconds after the first design.
        names = "[...document.querySelectorAll('#numbers dt')]"
        bound = f"{names}.find(name => name.textContent.includes('bound'))"
        while browser.ask(f"{bound}?.nextElementSibling.textContent ?? '–'") == "–":
            time.sleep(0.5)
        browser.ask("document.getElementById('state').textContent = ''")  # how long it took here
        browser.picture(picture, whole=False)
        browser.close()
        server.shutdown()
        Image.open(picture).convert("RGB").quantize(256).save(small, "png", optimize=True)
    return small.getvalue()


if __name__ == "__main__":
    for draw in (overview, diagnosis, response, tune):
        (DOCS / f"{draw.__name__}.{'png' if draw is tune else 'svg'}").write_bytes(draw())
