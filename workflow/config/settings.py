"""TOML files checked by pydantic, with every complaint on one line: file, dotted key, what was expected."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, ValidationInfo
from pydantic_core import to_json

from ident.data.settings import first_complaint
from workflow.engine.errors import InputError

ModelT = TypeVar("ModelT", bound=BaseModel)
T = TypeVar("T")

_VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")


class Section(BaseModel):
    """Unknown keys are refused by name; nothing changes after loading; nan and inf are no settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def repeated(values: Sequence[T]) -> T | None:
    """The first that is there more than once, if any."""
    return next((value for value in values if values.count(value) > 1), None)


def check(
    model: type[ModelT], document: Any, *, source: str, context: Mapping[str, Any] | None = None
) -> ModelT:
    """`document` as a `model`. Raises InputError: `source`, dotted key and what was expected in one line."""
    try:
        # As JSON, whose strict reading takes `true` for no 1.0 and "2" for no 2, but a list for a tuple.
        return model.model_validate_json(
            to_json(document, inf_nan_mode="constants"), strict=True, context=dict(context or {})
        )
    except ValidationError as error:
        raise InputError(f"{source}: {first_complaint(model, error)}") from error


def expand(text: str) -> str:
    """`${NAME}` replaced from the environment. Raises ValueError naming a variable that is not set."""

    def value(match: re.Match[str]) -> str:
        name = match.group(1)
        found = os.environ.get(name)
        if not found:
            raise ValueError(
                f"environment variable {name} is not set; set it to the folder meant by {text!r}"
            )
        return found

    return _VARIABLE.sub(value, text)


def resolve(path: Path, info: ValidationInfo, *, kind: str = "file") -> Path:
    """With variables of the environment expanded, relative to the `base` of the validation context; must be a
    file unless `may_be_gone` is set there.

    Raises ValueError saying what was found instead.
    """
    context = info.context or {}
    base, path = context.get("base"), Path(expand(str(path)))
    resolved = Path(os.path.normpath(Path(base) / path)) if base else path
    # os.path answers for names that no file can have, too.
    if not context.get("may_be_gone") and not os.path.isfile(resolved):
        if os.path.isdir(resolved):
            raise ValueError(f"expected a {kind}, found a directory: {resolved}")
        raise ValueError(f"no such {kind}: {resolved}")
    return resolved


InputPath = Annotated[Path, AfterValidator(resolve)]
