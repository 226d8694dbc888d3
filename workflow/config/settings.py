"""TOML files checked by pydantic, with every complaint on one line: file, dotted key, what was expected."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, ValidationInfo
from pydantic_core import ErrorDetails, to_json

from workflow.engine.errors import InputError, shortened

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
        text = to_json(document, inf_nan_mode="constants")
        return model.model_validate_json(text, strict=True, context=dict(context or {}))
    except ValidationError as error:
        raise InputError(f"{source}: {_first_complaint(model, error)}") from error


def _first_complaint(model: type[BaseModel], error: ValidationError) -> str:
    # A misspelt key is also a missing one: the unknown key is what the reader can act on, so it goes first.
    details = sorted(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")
    if len(details) > 1 and all(item["type"] == "missing" for item in details):
        return "missing keys " + ", ".join(_walk(model, item["loc"])[0] for item in details)
    rest = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    return _complaint(model, details[0]) + rest


def meant(word: str, known: Sequence[str], what: str) -> str:
    """What to write in place of a word that nobody knows: the known one that looks like it, else all."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"known {what}: {', '.join(known)}"


def _complaint(model: type[BaseModel], detail: ErrorDetails) -> str:
    kind, message = detail["type"], detail["msg"]
    key, known = _walk(model, detail["loc"])
    if kind == "extra_forbidden":
        return f"unknown key {key} ({meant(str(detail['loc'][-1]), sorted(known), 'keys')})"
    if kind == "missing":
        return f"missing key {key}"
    if kind == "union_tag_not_found":
        return f"missing key {key}.{_bare(detail['ctx']['discriminator'])}"
    if kind == "union_tag_invalid":
        context = detail["ctx"]
        discriminator = _bare(context["discriminator"])
        return f"{key}.{discriminator}: expected one of {context['expected_tags']}, got {context['tag']!r}"
    message = message.removeprefix("Value error, ")
    where = f"{key}: " if key else ""
    if kind == "value_error":
        return where + message
    message = message[:1].lower() + message[1:]
    return f"{where}{message}, got {shortened(detail['input'])}"


def _bare(text: object) -> str:
    return str(text).strip("'")


def _walk(model: type[BaseModel], location: Iterable[int | str]) -> tuple[str, list[str]]:
    """Dotted key as the user wrote it, and the keys known where it stands.

    pydantic puts the tag of a discriminated union into the location; the user never wrote it, so it is left
    out.
    """
    parts: list[str] = []
    here: list[type[BaseModel]] = [model]
    known = _keys(here)
    for step in location:
        if isinstance(step, int):
            parts.append(f"[{step}]")
            continue
        tagged = [candidate for candidate in here if step in _tags(candidate)]
        if tagged and not any(step in candidate.model_fields for candidate in here):
            here = tagged
            known = _keys(here)
            continue
        known = _keys(here)
        parts.append(f".{step}" if parts else step)
        annotations = [c.model_fields[step].annotation for c in here if step in c.model_fields]
        here = [found for annotation in annotations for found in _models_in(annotation)]
    return "".join(parts), known


def _keys(models: Iterable[type[BaseModel]]) -> list[str]:
    return sorted({field.alias or name for model in models for name, field in model.model_fields.items()})


def _tags(model: type[BaseModel]) -> set[str]:
    field = model.model_fields.get("kind")
    return {str(value) for value in get_args(field.annotation)} if field else set()


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models_in(part)]


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
