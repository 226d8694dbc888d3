"""Models in files for other programs, written and read as a whole."""

from __future__ import annotations

from pathlib import Path

from ident.basis.model_files import ModelFile
from ident.data.foreign_files import content_of
from workflow.engine import documents, storage
from workflow.engine.errors import naming

MODEL_SUFFIXES = (".json", ".mat")


def write_model(path: Path, file: ModelFile) -> None:
    """JSON or MAT by the ending (`MODEL_SUFFIXES`), atomically."""
    content = file.to_mat() if path.suffix.lower() == ".mat" else file.to_json().encode("utf-8")
    storage.write_bytes(path, content)


def read_model(path: Path) -> ModelFile:
    """The model in a file of `write_model`. Raises InputError: one line that names the file."""
    with naming(str(path)):
        if path.suffix.lower() == ".mat":
            return ModelFile.from_mat(content_of(path), str(path))
        return ModelFile.from_json(documents.read_text(path), str(path))
