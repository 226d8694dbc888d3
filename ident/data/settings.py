"""Settings checked by pydantic: every complaint in one line, the fields in the docstring."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


class _Fields(ModelMetaclass):
    """`help` lists what a reader sets, which stands in the docstring, and nothing of pydantic's."""

    def __dir__(self) -> list[str]:
        return [name for name in self.__annotations__ if not name.startswith("_")]


class Settings(BaseModel, metaclass=_Fields):
    """Frozen; an unknown key is refused by name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def __init__(self, **values: Any) -> None:
        """Raises ValueError, one line, for a key or a value that cannot be used."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ValueError(f"{type(self).__name__}: {first_complaint(type(self), error)}") from None

    # As on BaseModel: validation of files does not pass through __init__.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        fields = (
            f"{name}{'' if field.is_required() else f' = {field.get_default(call_default_factory=True)!r}'}: "
            f"{field.description or ''}"
            for name, field in cls.model_fields.items()
        )
        cls.__doc__ = "\n    ".join([(cls.__doc__ or "").rstrip(), "", "Fields", "------", *fields])
        plain = get_type_hints(cls)  # without what only pydantic reads
        own = cls.__signature__
        cls.__signature__ = own.replace(
            parameters=[each.replace(annotation=plain[each.name]) for each in own.parameters.values()]
        )


def first_complaint(model: type[BaseModel], error: ValidationError) -> str:
    """The gravest complaint in one line: dotted key, what was expected, what came."""
    # A misspelt key is also a missing one: the unknown key is what the reader can act on, so it goes first.
    details = sorted(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")
    if len(details) > 1 and all(item["type"] == "missing" for item in details):
        return "missing keys " + ", ".join(_walk(model, item["loc"])[0] for item in details)
    return _complaint(model, details[0]) + (f" (and {len(details) - 1} more)" if len(details) > 1 else "")


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
    try:
        given = f"{detail['input']!r:.80}"
    except ValueError:  # Python writes no integer of more than 4300 digits
        given = "a number of too many digits"
    return f"{where}{message}, got {given}"


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
        kinds = [(candidate, candidate.model_fields.get("kind")) for candidate in here]
        tagged = [candidate for candidate, kind in kinds if kind and step in get_args(kind.annotation)]
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


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models_in(part)]
