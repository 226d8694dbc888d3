"""Models in files for other programs."""

from __future__ import annotations

from pathlib import Path

from ident.basis.model_files import ModelFile
from ident.data.foreign_files import content_of
from workflow.engine import documents
from workflow.engine.errors import naming

MODEL_SUFFIXES = (".json", ".mat")


def model_bytes(path: Path, file: ModelFile) -> bytes:
    """JSON or MAT by the ending (`MODEL_SUFFIXES`)."""
    return file.to_mat() if path.suffix.lower() == ".mat" else file.to_json().encode("utf-8")


def read_model(path: Path) -> ModelFile:
    """The model in a file of `model_bytes`. Raises InputError: one line that names the file."""
    with naming(str(path)):
        if path.suffix.lower() == ".mat":
            return ModelFile.from_mat(content_of(path), str(path))
        return ModelFile.from_json(documents.read_text(path), str(path))
