"""Results that say what was found: in text, in a notebook, in a picture."""

from __future__ import annotations

import html
from functools import cache
from pathlib import Path
from typing import Any

from ident.basis.model import GobfModel
from ident.basis.model_files import ModelFile
from ident.data.shown import Shown


def text(result: object) -> str:
    """The sentences of a result: the macro in results.j2 that has the name of its class, or of a base of it.

    A class without one, as that of somebody who derives from `Shown`, prints as any object does.
    """
    macros = _macros()
    name = next((kind.__name__ for kind in type(result).__mro__ if hasattr(macros, kind.__name__)), None)
    if name is None:
        return object.__repr__(result)
    said = str(getattr(macros, name)(result))
    return "\n".join(line.rstrip() for line in said.splitlines() if line.strip())


def html_text(result: Shown) -> str:
    """The same for a notebook, with a table where the class has a short one."""
    first, *others = (html.escape(line.strip()) for line in text(result).splitlines())
    said = f"<p>{'<br>'.join([f'<b>{first}</b>', *others])}</p>"
    if not result.table_in_notebook:
        return said
    table = result.table().to_html(index=False, na_rep="", float_format="{:.4g}".format, border=0)
    return f"{said}{table}"


def save(model: GobfModel, path: Path) -> None:
    from workflow.config.command_files import MODEL_SUFFIXES
    from workflow.engine.storage import write_bytes
    from workflow.tasks.exports import model_bytes

    if path.suffix.lower() not in MODEL_SUFFIXES:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(MODEL_SUFFIXES)}")
    write_bytes(path, model_bytes(path, ModelFile(model)))


@cache
def _macros() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from workflow.describe.diagnosis_words import times_noise
    from workflow.text.findings.sentences import words
    from workflow.text.formats import at_least, at_most, bound, listing

    # Text; the HTML is escaped line by line.
    loader = PackageLoader("flexlink")
    environment = Environment(loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"words": words, "at_least": at_least, "at_most": at_most, "bound": bound}
    environment.filters |= {"listing": listing, "times_noise": times_noise}
    environment.globals |= {"zip": zip, "abs": abs}
    return environment.get_template("results.j2").module
