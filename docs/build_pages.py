"""Pages of the site that are made from the code (a hook of mkdocs)."""

from __future__ import annotations

import ast
import html
import inspect
import os
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

import jupytext
import nbformat
from docstring_parser import Docstring, DocstringStyle, parse
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbconvert import MarkdownExporter
from nbconvert.filters import strip_ansi
from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[1]
GALLERY = ROOT / "build" / "gallery"
KERNEL = """---
jupyter:
  kernelspec:
    name: python3
    display_name: Python 3
    language: python
---
"""
UNITS = {
    "V_per_rad": "V/rad", "Vs_per_rad": "V s/rad", "rad_per_V": "rad/V", "Vs_rad": "V s/rad", "Nm_A": "N m/A",
    "per_s": "1/s", "rad_s2": "rad/s²", "rad_s": "rad/s", "m_s2": "m/s²", "m_s": "m/s",
    "Nms": "N m s", "Nm": "N m", "kg_m3": "kg/m³", "kg_m2": "kg m²", "kg_m": "kg/m", "kg": "kg",
    "rad": "rad", "deg": "deg", "Hz": "Hz", "hz": "Hz", "dB": "dB", "db": "dB", "percent": "%",
    "samples": "samples", "Pa": "Pa", "ohm": "ohm", "N": "N", "V": "V", "m": "m", "s": "s",
}  # fmt: skip
SHOWN = {
    "look.html": ("What a log holds", "flexlink look logs/09_prbs.csv --out look.html"),
    "identify.html": (
        "A model from logs",
        "flexlink identify logs/0*_V_rms_*.csv --validation logs/09_prbs.csv --output hub_angle_rad \\\n"
        "  --integrators 1 --delay 1 --real 1 --pairs 2 --response 'without friction' --report identify.html",
    ),
    "run/report.html": ("From records to a certified controller", "flexlink run --out run"),
    "diagnosis/gap_case.html": (
        "Why simulation and machine disagree",
        "flexlink diagnose examples/gap_case --out diagnosis",
    ),
}


def on_files(files: Files, config: Any) -> Files:
    """Generated pages join those of docs/."""
    made = {
        **configuration(),
        "reference/command_line.md": command_line(),
        **python(),
        "gallery.md": gallery(),
    }
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    for name in SHOWN:
        if (GALLERY / name).is_file():
            files.append(File.generated(config, f"pages/{name}", content=(GALLERY / name).read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Tutorials are run, formulas drawn. Links to files of the repository, which are not on the site, become
    their names."""
    if page.file.src_uri.startswith("tutorials/"):
        markdown = notebook(markdown, Path(page.file.src_uri), config, files)
    markdown = with_formulas(markdown)
    return re.sub(r"\[[^\]]*\]\((?:\.\./)+((?:examples|benchmarks|tests)[^)]*)\)", r"`\1`", markdown)


def notebook(markdown: str, page: Path, config: Any, files: Files) -> str:
    """The page with what its cells show, each picture a file; the notebook itself beside it."""
    cells = jupytext.reads(KERNEL + markdown, fmt="md")
    if config.extra["execute"]:
        run(cells)
    text, found = MarkdownExporter().from_notebook_node(cells)
    for name, content in found["outputs"].items():
        text = text.replace(f"({name})", f"({page.stem}_{name})")
        files.append(File.generated(config, f"{page.parent}/{page.stem}_{name}", content=content))
    files.append(File.generated(config, f"{page.with_suffix('.ipynb')}", content=nbformat.writes(cells)))
    # Tables and pictures as those of the other pages, text without the colours of a terminal.
    text = re.sub(r"<style scoped>.*?</style>", "", strip_ansi(text), flags=re.DOTALL)
    text = re.sub(r"<table[^>]*>", "<table>", text).replace("![svg]", "![What the lines above draw]")
    text = text.replace("%%bash\n", "")
    return text.replace("\n\n", f"\n\n[This page as a notebook]({page.stem}.ipynb){{ .notebook }}\n\n", 1)


def run(cells: nbformat.NotebookNode) -> None:
    """Run a notebook in a directory with the examples and nothing else; progress is not kept."""
    os.environ["COLUMNS"] = "96"  # what a page of the site has room for
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with TemporaryDirectory() as folder:
        shutil.copytree(ROOT / "examples", Path(folder) / "examples")
        shutil.rmtree(Path(folder) / "examples" / "logs", ignore_errors=True)
        NotebookClient(
            cells,
            kernel_name="python3",
            extra_arguments=["--log-level=ERROR"],
            resources={"metadata": {"path": folder}},
            coalesce_streams=True,
        ).execute()
    for cell in cells.cells:
        cell.outputs = [shown for shown in cell.get("outputs", []) if shown.get("name") != "stderr"]


def unit_of(key: str, meaning: str) -> str:
    """From the end of the name, the longer endings first; else from brackets in the meaning."""
    for ending, unit in UNITS.items():
        if key == ending or key.endswith(f"_{ending}"):
            return unit
    found = re.search(r"\[(s|m|V|rad|rad/s|Hz|kg)\]", meaning)
    return found.group(1) if found else ""


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Settings that an annotation has inside."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)


def sections(model: type[BaseModel], where: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Dotted place and model of every table of a configuration, this one first."""
    yield where, model
    for key, field in model.model_fields.items():
        inner = list(models_in(field.annotation))
        for part in inner:
            kind = get_args(part.model_fields["kind"].annotation) if len(inner) > 1 else ()
            place = f"{where}.{key}".lstrip(".")
            yield from sections(part, f'{place}: kind = "{kind[0]}"' if kind else place)


def keys(model: type[BaseModel]) -> Iterator[tuple[str, Any]]:
    """Keys of a table that hold values, not tables."""
    for key, field in model.model_fields.items():
        if not list(models_in(field.annotation)):
            yield field.alias or key, field


def roots() -> dict[str, type[BaseModel]]:
    """The files that are configured."""
    from workflow.config.design_file import DesignFile
    from workflow.config.run_config import RunConfig
    from workflow.study.settings import StudyConfig

    return {"A run": RunConfig, "A design file": DesignFile, "A study": StudyConfig}


CONFIGURATION_OVERVIEW = """# Configuration

For those who edit a TOML file: every key of a run, a design file and a study. The models that check the
files make these pages. An unknown key is refused by name.
Examples: `examples/*.toml`. For rig and case files see [case files](../case_files.md)."""
KEYS_OF_A_PAGE = """Keys of these tables, with unit, default and meaning. Keys in bold are required;
all others may be left out."""
CONFIGURATION_SHARED = """A design file also has these tables of a run: `[specification]`, `[synthesis]`,
`[certificate]`, `[achievable_performance]` and `[reference_filter]`."""
# Pages of the configuration: title, which file, its tables.
CONFIGURATION = {
    "records": ("A run: records", "A run", ("", "run", "source")),
    "channels": ("A run: models and uncertainty", "A run", ("channels", "closed_loop_data")),
    "specification": (
        "A run: controller",
        "A run",
        ("specification", "synthesis", "certificate", "achievable_performance", "reference_filter"),
    ),
    "closed_loop": ("A run: closed loop and notes", "A run", ("closed_loop", "notes")),
    "design": ("A design file", "A design file", ("", "plant", "uncertainty")),
    "study": ("A study", "A study", ("", "study", "axes", "pareto")),
}


def configuration() -> dict[str, str]:
    """Pages with every key of a run, a design file and a study: unit, default, meaning."""
    made, lines = {}, ["| page | tables |", "|---|---|"]
    for name, (title, root, tables) in CONFIGURATION.items():
        parts = [f"# {title}", KEYS_OF_A_PAGE]
        for place, model in sections(roots()[root]):
            rows = [row(key, field) for key, field in keys(model)]
            if rows and re.split(r"[.:]", place)[0] in tables:
                parts.append(f"## {place or 'top level'}\n\n{sentence(model)}")
                parts.append("| key | unit | default | meaning |\n|---|---|---|---|\n" + "\n".join(rows))
        made[f"reference/configuration_{name}.md"] = "\n\n".join(parts) + "\n"
        listed = ", ".join(f"`[{table}]`" for table in tables if table)
        lines.append(f"| [{title}](configuration_{name}.md) | {listed} |")
    overview = [CONFIGURATION_OVERVIEW, "\n".join(lines), CONFIGURATION_SHARED]
    return made | {"reference/configuration.md": "\n\n".join(overview) + "\n"}


def sentence(model: type[BaseModel]) -> str:
    """The first paragraph of a docstring of its own."""
    text = inspect.cleandoc(model.__dict__.get("__doc__") or "")
    return " ".join(text.partition("\n\n")[0].split())


def row(key: str, field: Any, otherwise: str = "") -> str:
    """One line of a table; `otherwise` is said of a key that has no meaning of its own."""
    meaning = field.description or otherwise
    if field.is_required():
        name, default = f"**`{key}`**", ""
    else:
        value = field.get_default(call_default_factory=True)
        name, default = f"`{key}`", "none" if value is None else f"`{value!r}`"
        if isinstance(value, BaseModel):
            default = ""  # the table of its own keys has their defaults
    choices = [f"`{choice}`" for choice in get_args(field.annotation) if isinstance(choice, str)]
    text = f"{meaning} ({', '.join(choices)})" if choices else meaning
    return (
        "| "
        + " | ".join(cell.replace("|", "\\|") for cell in (name, unit_of(key, meaning), default, text))
        + " |"
    )


COMMAND_LINE = """What `flexlink COMMAND -h` prints: every option of every command.
[Every command with an example](../commands.md) is the place to begin."""


def command_line() -> str:
    """What `flexlink COMMAND -h` prints."""
    from typer.main import get_command
    from typer.testing import CliRunner

    from workflow.cli import _plug_in, app

    _plug_in(["-h"])
    runner, parts = CliRunner(), ["# Command line", COMMAND_LINE]
    for name in ("", *get_command(app).commands):
        shown = runner.invoke(app, [*name.split(), "--help"], prog_name="flexlink", terminal_width=94)
        parts.append(f"## {f'flexlink {name}'.strip()}\n\n```text\n{shown.stdout.strip()}\n```")
    return "\n\n".join(parts) + "\n"


# Pages of the Python reference.
MODULES = {
    "models": "Records, models and uncertainty",
    "comparison": "Beside other methods",
    "design": "Controllers and certificates",
    "machines": "Simulated machines",
    "causes": "Diagnosis",
    "pictures": "Pictures",
    "tables": "Tables",
}


MADE_FROM_DOCSTRINGS = """Names of `import flexlink`, in alphabetical order; the
[overview](python.md#what-the-examples-use) has what the examples use."""


def python() -> dict[str, str]:
    """Pages with every name of the front door and its docstring."""
    import flexlink

    made, lines = {}, ["| page | names |", "|---|---|"]
    for module, title in MODULES.items():
        names = sorted(import_module(f"flexlink.{module}").__all__)
        parts = [f"# {title}", MADE_FROM_DOCSTRINGS]
        for name in names:
            thing = getattr(flexlink, name)
            parts.append(f"## {name}\n\n{settings(thing) or docstring(name, thing)}")
        made[f"reference/python_{module}.md"] = "\n\n".join(parts) + "\n"
        listed = ", ".join(f"`{name}`" for name in names)
        lines.append(f"| [{title}](python_{module}.md) | {listed} |")
    overview = [PYTHON_OVERVIEW, "\n".join(lines), EXAMPLES_USE, f"```python\n{what_examples_use()}\n```"]
    return made | {"reference/python.md": "\n\n".join(overview) + "\n"}


PYTHON_OVERVIEW = """# Python

For scripts and notebooks: every name of `import flexlink`, with its arguments, units, errors and an example.
Start with [From Python](../from_python.md)."""
EXAMPLES_USE = """## What the examples use

Every example runs as it stands behind these lines:"""


def what_examples_use() -> str:
    """The functions that examples of docstrings call, as the test that runs them has them."""
    source = (ROOT / "tests" / "test_front_door.py").read_text(encoding="utf-8")
    imports = [
        "import control",
        "import flexlink",
        "import numpy as np",
        "from numpy.random import default_rng",
        "from scipy.signal import lfilter",
    ]
    parsed = ast.parse(source)
    functions = [
        # Decorated functions begin with their decorator.
        "\n".join(
            source.split("\n")[
                min([node.lineno, *(mark.lineno for mark in node.decorator_list)]) - 1 : node.end_lineno
            ]
        )
        for node in parsed.body
        if isinstance(node, ast.FunctionDef) and f'"{node.name}": {node.name},' in source
    ]
    return "\n\n\n".join(["\n".join(imports), *functions])


def settings(thing: Any) -> str:
    """Keys of settings as a table, with the text of their docstring; nothing for other things."""
    if not (isinstance(thing, type) and issubclass(thing, BaseModel)):
        return ""
    # Settings add a list of their fields for `help`; here the table has them.
    text = inspect.cleandoc(thing.__dict__.get("__doc__") or "").partition("\nFields:\n")[0]
    described = parse(text.strip(), DocstringStyle.NUMPYDOC)
    parts = [prose(described.short_description), prose(described.long_description)]
    head = "| key | unit | default | meaning |\n|---|---|---|---|\n"
    for place, model in sections(thing):
        fields = [(field.alias or key, field) for key, field in model.model_fields.items()]
        title = f"Keys of `{place}`" if place else "Keys"
        rows = [row(key, field, "its keys are below") for key, field in fields]
        parts.append("\n\n".join(text for text in (f"**{title}**", sentence(model) if place else "") if text))
        parts.append(head + "\n".join(rows))
    parts.extend(last_sections(described))
    return "\n\n".join(part for part in parts if part)


def docstring(name: str, thing: Any) -> str:
    """Signature and numpydoc docstring of a function or class as Markdown.

    Parameters, what is returned and what is raised become tables; text stays text, with its formulas: those
    behind `.. math::` as MathML, which browsers draw without a script, others as they are written.
    """
    described = parse(inspect.cleandoc(thing.__doc__ or ""), DocstringStyle.NUMPYDOC)
    parts = [f"```python\n{signature(name, thing)}\n```", prose(described.short_description)]
    parts.append(prose(described.long_description))
    # A class of results lists its attributes, anything else its parameters.
    for title, section in (("Parameters", "param"), ("Attributes", "attribute")):
        listed = [
            # Names that share a line of a docstring may stand on lines of their own in a narrow column.
            (
                ", ".join(f"`{part}`" for part in entry.arg_name.split(", ")),
                entry.type_name,
                entry.description,
            )
            for entry in described.params
            if entry.args[0] == section
        ]
        parts.append(cells(title, ("name", "type", "meaning"), listed))
    returned = [(part.return_name or "", part.type_name, part.description) for part in described.many_returns]
    parts.append(cells("Returns", ("name", "type", "meaning"), returned))
    parts.extend(last_sections(described))
    return "\n\n".join(part for part in parts if part)


def last_sections(described: Docstring) -> list[str]:
    """What is raised, notes and examples of a docstring, which functions, classes and settings share."""
    raised = [(part.type_name, part.description) for part in described.raises]
    parts = [cells("Raises", ("error", "when"), raised)]
    for part in described.meta:
        section = part.args[0].capitalize()
        if section in ("Notes", "References", "See also"):
            parts.append(f"**{section}**\n\n{prose(part.description)}")
    if described.examples:
        lines = []
        for example in described.examples:
            lines.extend(text for text in (example.snippet, example.description) if text)
        code = "\n".join(lines)
        parts.append(f"**Examples**\n\n```python\n{code}\n```")
    return parts


# A signature that is longer than this has a line for each parameter: what a page shows without wrapping.
LONGEST_SIGNATURE = 88


def signature(name: str, thing: Any) -> str:
    """How a function or class is called, with types as a reader writes them: no quotes, no modules."""
    try:
        found = inspect.signature(thing)
    except (TypeError, ValueError):
        return name
    listed, starred = [], False
    for parameter in found.parameters.values():
        starred = starred or parameter.kind is parameter.VAR_POSITIONAL
        if parameter.kind is parameter.KEYWORD_ONLY and not starred:
            listed.append("*")
            starred = True
        listed.append(plain_types(str(parameter)))
    returned = ""
    if not isinstance(thing, type) and found.return_annotation is not found.empty:
        annotation = found.return_annotation
        returned = f" -> {plain_types(annotation if isinstance(annotation, str) else annotation.__name__)}"
    line = f"{name}({', '.join(listed)}){returned}"
    if len(line) <= LONGEST_SIGNATURE:
        return line
    return "\n".join([f"{name}(", *(f"    {text}," for text in listed), f"){returned}"])


def plain_types(text: str) -> str:
    """A parameter without the quotes of an annotation that is kept as text, and without modules."""
    text = re.sub(r"^(\**\w+: )(['\"])(.*?)\2(?= = |$)", r"\1\3", text)
    return re.sub(r"(?:\b[A-Za-z_]+\.)+([A-Za-z_]+)", r"\1", text)


def cells(title: str, columns: Sequence[str], rows: Sequence[Sequence[str | None]]) -> str:
    """A titled Markdown table of the rows, without columns that are empty in all of them; nothing for no
    rows."""
    if not rows:
        return ""
    used = [number for number in range(len(columns)) if any(values[number] for values in rows)]
    lines = [" | ".join(columns[number] for number in used), " | ".join("---" for _ in used)]
    for values in rows:
        texts = [" ".join(prose(values[number]).split()).replace("|", "\\|") for number in used]
        lines.append(" | ".join(texts))
    return f"**{title}**\n\n" + "\n".join(f"| {line} |" for line in lines)


# Formulas of a page, in the spelling that GitHub draws as well: a block between lines of `$$`, and $`...`$ in
# a sentence. A fenced block of code is matched first, so that what looks like a formula there stays code.
FORMULA = re.compile(
    r"(?P<code>^```.*?^```$)|^(?P<indent>[ ]*)\$\$\n(?P<block>.*?)^[ ]*\$\$$|\$`(?P<inline>[^`]+)`\$",
    re.MULTILINE | re.DOTALL,
)


def with_formulas(markdown: str) -> str:
    """A page with its formulas as MathML, which browsers draw without a script and without a network."""

    def replaced(found: re.Match[str]) -> str:
        if found["code"]:
            return found["code"]
        if found["inline"]:
            # Without the span a formula that begins a line would be taken for a paragraph of its own.
            return f"<span>{drawn(found['inline'], 'inline')}</span>"
        # Indented as it stands, so that a formula inside a list stays in its item.
        return f"{found['indent']}<div>{drawn(found['block'], 'block')}</div>"

    return FORMULA.sub(replaced, markdown)


def drawn(latex: str, display: str) -> str:
    """A formula as MathML in which Markdown finds no mark of its own."""
    mathml: str = convert(" ".join(latex.split()), display=display)
    return mathml.replace("*", "&#42;").replace("_", "&#95;")


# A formula of its own in a docstring: `.. math::` and the indented lines behind it.
DISPLAYED = re.compile(r"^\.\. math::[ ]*([^\n]*)\n?((?:[ ]+[^\n]*\n?|\n)*)", re.MULTILINE)


def prose(text: str | None) -> str:
    """Text of a docstring as Markdown: what Markdown would take for a mark of its own stays as it is
    written."""
    parts = []
    end = 0
    for formula in DISPLAYED.finditer(text or ""):
        parts.append(escaped((text or "")[end : formula.start()]))
        parts.append(f"\n\n<div>{drawn(f'{formula[1]} {formula[2]}', 'block')}</div>\n\n")
        end = formula.end()
    parts.append(escaped((text or "")[end:]))
    return "".join(parts).strip()


def escaped(text: str) -> str:
    """Text in which `*`, `_`, `<` and brackets are themselves, but for code in backticks and indented
    lines."""
    lines = []
    for line in text.split("\n"):
        if line.startswith("    "):
            lines.append(line)
            continue
        pieces = line.split("`")
        for number in range(0, len(pieces), 2):
            pieces[number] = re.sub(r"([*_\[\]])", r"\\\1", html.escape(pieces[number], quote=False))
        lines.append("`".join(pieces))
    return "\n".join(lines)


def gallery() -> str:
    """Links to the pages that `make docs` has drawn, with the command of each."""
    parts = [
        "# Gallery",
        "For those who want to see results before they install anything: pages as flexlink writes them. "
        "Each is one file that opens without a network, drawn for this site by the command above it. "
        "`flexlink simulate --out logs` makes the logs.",
    ]
    for name, (title, command) in SHOWN.items():
        if (GALLERY / name).is_file():
            frame = f'<iframe src="pages/{name}" title="{title}" loading="lazy" class="page"></iframe>'
            parts.append(
                f"## {title}\n\n```bash\n{command}\n```\n\n[Open the page alone](pages/{name})\n\n{frame}"
            )
    if len(parts) == 2:
        parts.append("No page has been drawn here: `make docs` does it.")
    return "\n\n".join(parts) + "\n"
