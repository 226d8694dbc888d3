"""Results that say what was found: in text, in a notebook, and models in files."""

from __future__ import annotations

import html
from pathlib import Path

from flexlink.summaries import SUMMARIES
from ident.basis.model import GobfModel
from ident.basis.model_files import ModelFile
from ident.data.shown import Shown


def describe(result: object) -> str:
    """Return the sentences of a result, a line each.

    A class without any, as that of somebody who derives from `Shown`, has those of its base, or prints as any
    object does.
    """
    # By the name of its class or of the nearest base: whoever extends a result keeps its sentences.
    for kind in type(result).__mro__:
        if kind.__name__ in SUMMARIES:
            lines = SUMMARIES[kind.__name__](result)
            return "\n".join(line.rstrip() for line in lines)
    return object.__repr__(result)


def html_text(result: Shown) -> str:
    """Return the sentences as HTML for a notebook, with a table where the class has a short one."""
    # Names of records and signals are a user's: they must not become tags.
    headline, *lines = (html.escape(line.strip()) for line in describe(result).splitlines())
    sentences = "<br>".join([f"<b>{headline}</b>", *lines])
    sentences = f"<p>{sentences}</p>"
    if not result.table_in_notebook:
        return sentences
    table = result.table().to_html(index=False, na_rep="", float_format="{:.4g}".format, border=0)
    return f"{sentences}{table}"


def save(model: GobfModel, path: Path) -> None:
    """Write a model to a .json or .mat file; ValueError for another ending."""
    from workflow.config.command_files import MODEL_SUFFIXES
    from workflow.engine.storage import write_bytes
    from workflow.tasks.exports import model_bytes

    if path.suffix.lower() not in MODEL_SUFFIXES:
        raise ValueError(f"{path}: expected a file name that ends in {' or '.join(MODEL_SUFFIXES)}")
    write_bytes(path, model_bytes(path, ModelFile(model)))
