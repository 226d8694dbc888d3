"""The documents: every snippet runs, every key has a meaning, the site needs no network."""

import contextlib
import doctest
import glob
import html
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import how_well
from tests.workflow import test_readme
from tests.workflow.command import Answer

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
BLOCK = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# Run by tests of their own.
ELSEWHERE = {
    "from_python.md": "test_front_door.py",
    "own_plant.md": "workflow/test_plant_page.py",
    "simulators.md": "workflow/test_simulators.py",
}
CONSOLE = ["c_code.md", "controllers.md", "margins_in_ci.md", "which_data.md"]
# A compiler runs; and a job of CI, which tests/workflow/test_certify.py runs as well.
MARKS = {"c_code.md": pytest.mark.slow, "margins_in_ci.md": pytest.mark.long}
# Run as notebooks: what their pages must say, in this order.
NOTEBOOKS = {
    "closed_loop": r"reference_rad|first mode *│ 4|without friction|0.18\d*|certified: e|!\[|controller_step",
    "engineer": r"tip_m|mode *│ 7.6|mode *│ 3[23]|no warnings|certified|float hub_step|runs/mine|!\[",
    "student": r"!\[|dry \(Coulomb\) friction|torque_Nm = 0.040|!\[|repaired</th>\s*<td>0.0004|= 0.04$",
    "lecturer": r"!\[|32.2 Hz|order 4|!\[|half axis|!\[|<b>Certified|tracking|is not met",
}


def pages() -> Any:
    """The hook that makes pages of the site from the code."""
    pytest.importorskip("mkdocs")
    found = importlib.util.spec_from_file_location("build_pages", DOCS / "build_pages.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def run_page(path: Path, flexlink: Callable[..., Answer]) -> None:
    """Blocks in order: one with a title is a file, one called console holds commands and what they print."""
    done = 0
    for kind, title, text in BLOCK.findall(path.read_text(encoding="utf-8")):
        if title:
            Path(title).write_text(text, encoding="utf-8")
        elif kind == "console":
            for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
                command, _, expected = part.partition("\n")
                printed = run_command(command, flexlink)
                assert doctest.OutputChecker().check_output(expected, printed, FLAGS), f"{command}\n{printed}"
                done += 1
    assert done


def run_command(command: str, flexlink: Callable[..., Answer]) -> str:
    """As in a shell, but `flexlink` in this process, which saves seconds each."""
    name, *arguments = shlex.split(command)
    if name == "flexlink":
        told = flexlink(*(found for word in arguments for found in (sorted(glob.glob(word)) or [word])))
        assert told.code == 0, f"{command}\n{told.err}"
        return told.out
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("PYTEST_ADDOPTS", None)  # they are for these tests, not for the page's
    command = command.replace("python ", f"{sys.executable} ", 1) if name == "python" else command
    done = subprocess.run(command, shell=True, check=False, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, f"{command}\n{done.stderr}"
    return done.stdout


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in CONSOLE])
@pytest.mark.usefixtures("examples_alone")
def test_commands_of_a_page_print_what_it_says(name, flexlink):
    if name == "c_code.md" and shutil.which("gcc") is None:
        pytest.skip("no gcc on this machine")
    run_page(DOCS / name, flexlink)


def test_no_snippet_is_left_out():
    for page in DOCS.rglob("*.md"):
        name, text = str(page.relative_to(DOCS)), page.read_text(encoding="utf-8")
        assert ("```console" in text) == (name in CONSOLE), name
        assert (">>> " in text) == (name in ELSEWHERE), name
    assert {page.stem for page in (DOCS / "tutorials").iterdir()} == set(NOTEBOOKS)


def test_pages_speak_of_what_is_here_and_not_of_commits():
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        commits = [word for word in re.findall(r"\b[0-9a-f]{7,8}\b", text) if re.search("[a-f]", word)]
        assert [word for word in commits if re.search("[0-9]", word)] == [], page.name
        assert "git show" not in text, page.name


def test_a_page_begins_with_a_sentence_and_not_with_a_heading():
    for page in DOCS.rglob("*.md"):
        title, _, rest = page.read_text(encoding="utf-8").partition("\n\n")
        assert title.startswith("# "), page.name
        assert re.match(r"[A-Z`a-z\"]", rest), page.name


def test_how_well_it_works_is_what_the_results_say():
    assert how_well.PAGE.read_text(encoding="utf-8") == how_well.page()


def test_numbers_beside_other_tools_are_those_of_how_well_it_works():
    text = (DOCS / "beside_others.md").read_text(encoding="utf-8")
    measured = how_well.PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|]+ \| ([^|]*\d[^|]*) \| `python -m (benchmarks\.\w+)` \|$", text, re.MULTILINE)
    assert len(rows) == 3
    rows += [("52 of 64", "benchmarks.mujoco_cases"), ("0 of 16", "benchmarks.mujoco_cases")]
    rows += [("100.0 of 100 with 6 parameters in 6.3 s", "benchmarks.landau_transmission")]
    for numbers, command in rows:
        assert numbers in text
        assert numbers in measured
        assert importlib.util.find_spec(command), command


def test_files_and_tests_that_pages_name_are_there():
    defined = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    named = 0
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        for path in re.findall(r"`([a-z_]+/[a-z0-9_/]+\.(?:py|txt|toml|md))`", text):
            if path.startswith(("runs/", "answer/", "stages/")):
                continue  # a command writes it
            places = (ROOT, *(ROOT / name for name in ("workflow", "ident", "control_design")))
            assert any((place / path).exists() for place in places), f"{page.name}: {path}"
            named += 1
        for name in re.findall(r"`(test_\w+)`", text):
            assert name in defined, f"{page.name}: {name}"
            named += 1
        for link in re.findall(r"\]\((?!https?:|#)([^)#]+)", text):
            made = link.startswith(("reference/", "gallery", "../reference/", "../gallery"))
            assert made or (page.parent / link).exists(), f"{page.name}: {link}"
    assert named > 50


def test_every_key_of_a_configuration_has_a_meaning():
    hook = pages()
    found = [
        (title, place, key, field.description)
        for title, root in hook.roots().items()
        for place, model in hook.sections(root)
        for key, field in hook.keys(model)
    ]
    assert len(found) > 150
    assert [entry for entry in found if not entry[3]] == []
    text = "\n".join(hook.configuration().values())
    assert [key for _, _, key, _ in found if f"`{key}`" not in text] == []
    assert "| `bandwidth_rad_s` | rad/s | none |" in text
    # Of endings that end alike the longer one is the unit.
    assert "| `decay_min_per_s` | 1/s | none |" in text
    assert hook.unit_of("back_emf_Vs_rad", "") == "V s/rad"
    assert "| **`amplitude_V`** | V |  | largest voltage |" in text


# In CI one of four readers, who needs no program of his own: the others run commands of the README.
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "student" else pytest.mark.long)
        for name in NOTEBOOKS
    ],
)
def test_tutorial_runs_and_shows_what_it_finds(name, tmp_path, monkeypatch):
    pytest.importorskip("mkdocs")
    from mkdocs.structure.files import Files

    hook, files = pages(), Files([])
    monkeypatch.setattr(hook, "TemporaryDirectory", lambda: contextlib.nullcontext(tmp_path))
    here = SimpleNamespace(_current_plugin=None)
    config = SimpleNamespace(extra={"execute": True}, site_dir="", use_directory_urls=False, plugins=here)
    text = (DOCS / "tutorials" / f"{name}.md").read_text(encoding="utf-8")
    page = html.unescape(hook.notebook(text, Path("tutorials", f"{name}.md"), config, files))
    assert re.search(NOTEBOOKS[name].replace("|", ".*?"), page, re.DOTALL | re.MULTILINE)
    made = {file.src_uri: file.content_bytes for file in files}
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", page)
    assert pictures
    assert all(len(made[f"tutorials/{picture}"]) > 10_000 for picture in pictures)
    cells = json.loads(made[f"tutorials/{name}.ipynb"])["cells"]
    assert all(cell["execution_count"] for cell in cells if cell["cell_type"] == "code")
    if name == "engineer":
        test_readme.assert_verdict_of_the_run(page)
    if name == "student":
        test_readme.assert_hidden_cause_is_found(tmp_path / "answer" / "gap_case.json")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`make docs` without gallery and notebooks."""
    pytest.importorskip("material")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(folder)]
    settings = os.environ | {"NO_MKDOCS_2_WARNING": "1", "FLEXLINK_EXECUTE": "false"}
    done = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True, env=settings)
    assert done.returncode == 0, done.stderr
    return folder


def test_a_docstring_becomes_tables_text_and_drawn_formulas():
    def gain(k, limit=None):
        """Largest gain of a *loop* <1 rad/s>.

        Parameters
        ----------
        k : (F,) array
            Controller, |k| at most `limit`.

        Raises
        ------
        ValueError
            For nan.

        Notes
        -----
        It is

        .. math::

            S = (1 + G K)^{-1}
        """

    page = pages().docstring("gain", gain)
    assert "gain(k, limit=None)" in page
    assert r"| `k` | (F,) array | Controller, \|k\| at most `limit`. |" in page
    assert "| ValueError | For nan. |" in page
    # Markdown would take a star for emphasis and an angle for a tag.
    assert r"\*loop\* &lt;1 rad/s&gt;" in page
    assert "<math" in page
    assert "^{-1}" not in page


def test_formulas_of_a_page_are_drawn_and_code_stays_code():
    """Without a mark that Markdown reads; a formula that begins a line stays in its sentence."""
    markdown = pytest.importorskip("markdown")
    hook = pages()
    page = "Of\n$`V V^*`$ and $`a_1 b_1`$ x_1:\n\n$$\n\\frac{a}{b}\n$$\n\n```text\n$`left`$\n```\n"
    drawn = markdown.markdown(hook.with_formulas(page), extensions=["fenced_code"])
    assert drawn.count("<math") == 3
    assert drawn.count("<p>") == 1
    assert "<em>" not in drawn
    assert "<mfrac>" in drawn
    assert "$`left`$" in drawn
    for path in DOCS.rglob("*.md"):
        made = hook.with_formulas(path.read_text(encoding="utf-8"))
        assert "$$" not in made, path.name
        assert "$`" not in made, path.name


@pytest.mark.slow
def test_the_site_is_built_whole_and_asks_no_network(site):
    made = {str(page.relative_to(site)) for page in site.rglob("*.html")}
    assert {"index.html", "reference/python.html", "reference/configuration.html"} <= made
    assert "tutorials/engineer.html" in made
    for page in site.rglob("*.html"):
        if "pages" in page.parts:
            continue  # drawn by flexlink, tested with it
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(
            r"<(?:script|img|link|iframe|source)\b[^>]*(?:src|href)=\"?(https?:[^\" >]+)", text
        )
        assert fetched == [], page.name


@pytest.mark.slow
def test_the_search_works_in_pages_that_are_opened_as_files(site, browser):
    browser.open(site / "theory" / "arm.html")
    browser.ask("document.querySelector('#__search').click()")
    browser.ask("document.querySelector('[data-md-component=search-query]').focus()")
    for letter in "quantisation":
        browser.press(letter)
    found = "[...document.querySelectorAll('.md-search-result__link')].map(link => link.href).join()"
    look = f"const look = () => {found} ? done({found}) : setTimeout(look, 50)"
    until = f"new Promise(done => {{ {look}; look() }})"
    assert (site / "glossary.html").as_uri() in browser.ask(until)
    assert browser.complaints() == []
