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

# A variable of the environment in a path: ${NAME}.
_VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")


class Section(BaseModel):
    """Unknown keys are refused by name; nothing changes after loading; nan and inf are no settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def repeated(values: Sequence[T]) -> T | None:
    """The first value that is there more than once, None where each is there once."""
    return next((value for value in values if values.count(value) > 1), None)


def check(
    model: type[ModelT], document: Any, *, source: str, context: Mapping[str, Any] | None = None
) -> ModelT:
    """A document as settings.

    Parameters
    ----------
    model : type
        Class of the settings.
    document : JSON-able value
    source : str
        File or option, with which a complaint begins.
    context : mapping, optional
        Of the validation, see `resolve`.

    Raises
    ------
    InputError
        `source`, dotted key and what was expected, in one line.
    """
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
        content = os.environ.get(name)
        if not content:
            raise ValueError(
                f"environment variable {name} is not set; set it to the folder meant by {text!r}"
            )
        return content

    return _VARIABLE.sub(value, text)


def resolve(path: Path, info: ValidationInfo, *, kind: str = "file") -> Path:
    """A path of a configuration as a path that can be opened.

    Variables of the environment are expanded.

    Parameters
    ----------
    path : Path
    info : ValidationInfo
        Its context may hold `base`, the folder that the path is relative to, and `may_be_gone`: then the file
        need not be there.
    kind : str
        What the file is called in a complaint.

    Raises
    ------
    ValueError
        One line: no such file, or a directory.
    """
    context = info.context or {}
    base = context.get("base")
    path = Path(expand(str(path)))
    resolved = Path(os.path.normpath(Path(base) / path)) if base else path
    # os.path answers for names that no file can have, too.
    if not context.get("may_be_gone") and not os.path.isfile(resolved):
        if os.path.isdir(resolved):
            raise ValueError(f"expected a {kind}, found a directory: {resolved}")
        raise ValueError(f"no such {kind}: {resolved}")
    return resolved


InputPath = Annotated[Path, AfterValidator(resolve)]
