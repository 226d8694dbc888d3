"""Settings checked by pydantic: every complaint in one line, the fields in the docstring.

`Settings` is the base of every class of options (of `identify`, of a specification, ...). It is frozen,
refuses what it does not know, and says so in one line of plain words (`first_complaint`), where pydantic
prints a paragraph with links. The same lines are made of what stands in a configuration file, whose keys are
named as the user wrote them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)

# Likeness (difflib's ratio: twice the share of letters in common) from which on a known word is proposed for
# an unknown one: half, so that a letter too few or exchanged is seen in words of three letters.
_LEAST_LIKENESS = 0.5

# What other tools call things, with the keys that say them here. The first keys that are all known count.
_USUAL_NAMES = {
    "order": (("n_real", "n_pairs"), ("controller_order",)),
    "nx": (("n_real", "n_pairs"), ("controller_order",)),
    "delay": (("input_delay_samples",), ("computational_delay_samples",)),
    "nk": (("input_delay_samples",),),
    "Ts": (("dt_s",), ("controller_dt_s",)),
    "fs": (("dt_s",), ("controller_dt_s",)),
}


class _EarlierName(NamedTuple):
    """A key or a value that an earlier version read."""

    known_beside: str  # a key or a value that is known where the earlier one stood, so that no other is meant
    today: str  # what to write today, as the end of a sentence


# Keys and values that were renamed or taken away: files of earlier versions still state them. They are not
# read any more, because a file with two names for one thing would have two answers; what is refused says what
# to write today.
_EARLIER_NAMES = {
    "yardstick": _EarlierName("achievable_performance", "it is called achievable_performance today"),
    "prefilter": _EarlierName("reference_filter", "it is called reference_filter today"),
    "promise": _EarlierName("response", "it is called response today"),
    "search": _EarlierName("axes", "a study computes its whole grid: state from, to and points in [[axes]]"),
    "kp": _EarlierName("fixed", "it is called fixed.kp today"),
    "ti_s": _EarlierName("fixed", "it is called fixed.ti_s today"),
    "td_s": _EarlierName("fixed", "it is called fixed.td_s today"),
    "tf_s": _EarlierName("fixed", "it is called fixed.tf_s today"),
    "pi_d_notch": _EarlierName(
        "pid", "write 'pid' with integrator = true or 'pd', and notches = [{}] with {} for each notch"
    ),
    "iterations": _EarlierName("agreeing_starts", "leave it out: a descent ends by itself"),
    "exchange_tolerance": _EarlierName("agreeing_starts", "leave it out: it is fixed today"),
    "scale_rad_s": _EarlierName("agreeing_starts", "leave it out: it is fixed today"),
    "jobs": _EarlierName("agreeing_starts", "leave it out: study --jobs computes several designs"),
    "growth_rounds": _EarlierName("rounds", "leave it out: set rounds and steps"),
    "growth_steps": _EarlierName("rounds", "leave it out: set rounds and steps"),
    "candidates": _EarlierName("rounds", "leave it out: set starts, rounds and steps"),
    "renewals": _EarlierName("rounds", "leave it out: set starts, rounds and steps"),
    "hull": _EarlierName("pairs_per_mode", "leave it out: the bound has no hulls today"),
    "ellipse_rounds": _EarlierName("pairs_per_mode", "leave it out: it is fixed today"),
    "boundary_samples": _EarlierName("corner_rad_s", "leave it out: it is fixed today"),
    "prior_no_remainder": _EarlierName("prior_missed_mode", "leave it out: set prior_missed_mode"),
}


class _Fields(ModelMetaclass):
    """Metaclass of settings: fields are keywords, and `help` lists them and nothing of pydantic's."""

    def __call__(self, *arguments: Any, **values: Any) -> Any:
        """A new object. Raises ValueError, one line, for a value without its keyword."""
        if arguments:
            name = self.__name__
            first_field = next(iter(self.__dict__["__pydantic_fields__"]))
            raise ValueError(f"{name}: fields are given by name, as {name}({first_field}=...)")
        return super().__call__(**values)

    def __dir__(self) -> list[str]:
        """Names of the fields that this class declares."""
        return [name for name in self.__annotations__ if not name.startswith("_")]


class Settings(BaseModel, metaclass=_Fields):
    """Base of options: frozen; an unknown key is refused by name."""

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
        """Write the fields with their defaults into the docstring, and plain types into the signature.

        NameError where an annotation names what its module does not have.
        """
        lines = [(cls.__doc__ or "").rstrip(), "", "Fields:"]
        for name, field in cls.model_fields.items():
            default = ""
            if not field.is_required():
                default = f" = {field.get_default(call_default_factory=True)!r}"
            lines.append(f"{name}{default}: {field.description or ''}")
        cls.__doc__ = "\n    ".join(lines)

        # Types without what only pydantic reads, as limits.
        plain_types = get_type_hints(cls)
        signature = cls.__signature__
        parameters = [
            parameter.replace(annotation=plain_types[parameter.name])
            for parameter in signature.parameters.values()
        ]
        cls.__signature__ = signature.replace(parameters=parameters)


def first_complaint(model: type[BaseModel], error: ValidationError) -> str:
    """The gravest complaint of a validation in one line: dotted key, what was expected, what came.

    The error holds one complaint at least, as pydantic makes it.

    Parameters
    ----------
    model : type of BaseModel
        What was validated.
    error : ValidationError
        What pydantic says of it.

    Returns
    -------
    str
        An unknown key before all others; where only keys are missing, all of these.
    """
    # A misspelt key is also a missing one: the unknown key is what the reader can act on, so it goes first.
    details = sorted(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")
    # A list whose entries are refused is also too short: what encloses another complaint follows from it.
    details = [detail for detail in details if not _encloses_another(detail, details)]
    if len(details) > 1 and all(detail["type"] == "missing" for detail in details):
        keys = [_walk(model, detail["loc"]).key for detail in details]
        return "missing keys " + ", ".join(keys)
    complaint = _complaint(model, details[0])
    if len(details) > 1:
        complaint += f" (and {len(details) - 1} more)"
    return complaint


def _encloses_another(detail: ErrorDetails, details: Sequence[ErrorDetails]) -> bool:
    """Whether a complaint is about a place within which another of the complaints lies."""
    place = detail["loc"]
    return any(len(other["loc"]) > len(place) and other["loc"][: len(place)] == place for other in details)


def meant(word: str, known: Sequence[str], what: str) -> str:
    """What to write in place of a word that nobody knows: what it is called today, what other tools mean by
    it, or a word like it.

    Where there is none of these, all that is known.

    Without known words: the list in the answer is empty.

    Parameters
    ----------
    word : str
        What was written.
    known : sequence of str
        What may be written.
    what : str
        What these are, in the plural: 'keys'.
    """
    earlier = _EARLIER_NAMES.get(word)
    if earlier is not None and earlier.known_beside in known:
        return earlier.today
    for keys in _USUAL_NAMES.get(word, ()):
        if set(keys) <= set(known):
            return f"did you mean {' and '.join(keys)}?"
    close = difflib.get_close_matches(word, known, n=1, cutoff=_LEAST_LIKENESS)
    return f"did you mean {close[0]}?" if close else f"known {what}: {', '.join(known)}"


# What pydantic calls after JSON, by its kind of complaint, in the words of TOML and of this documentation.
_IN_OUR_WORDS = {
    "dict_type": "expected a table",
    "model_type": "expected a table",
    "list_type": "expected a list",
    "tuple_type": "expected a list",
}


def _complaint(model: type[BaseModel], detail: ErrorDetails) -> str:
    """One complaint of pydantic about a model in one line; detail: its kind, place, message and input.

    A kind that is not listed here gets pydantic's own message. Of what came 80 characters are shown, a line's
    worth.
    """
    kind = detail["type"]
    key, known_keys = _walk(model, detail["loc"])

    # Keys that are unknown or missing; of a union the key that says which member it is.
    if kind == "extra_forbidden":
        return f"unknown key {key} ({meant(str(detail['loc'][-1]), sorted(known_keys), 'keys')})"
    if kind == "missing":
        return f"missing key {key}"
    if kind == "union_tag_not_found":
        return f"missing key {key}.{_without_quotes(detail['ctx']['discriminator'])}"
    if kind == "union_tag_invalid":
        context = detail["ctx"]
        discriminator = _without_quotes(context["discriminator"])
        return f"{key}.{discriminator}: expected one of {context['expected_tags']}, got {context['tag']!r}"

    # Values: messages of our own as they are, those of pydantic as the end of a sentence, with what came.
    message = detail["msg"].removeprefix("Value error, ")
    where = f"{key}: " if key else ""
    if kind == "value_error":
        return where + message
    message = message[:1].lower() + message[1:]
    message = _IN_OUR_WORDS.get(kind, message)
    if kind == "literal_error" and str(detail["input"]) in _EARLIER_NAMES:
        earlier = _EARLIER_NAMES[str(detail["input"])]
        if repr(earlier.known_beside) in detail["ctx"]["expected"]:
            return f"{where}there is no {detail['input']!r} any more ({earlier.today})"
    try:
        value = f"{detail['input']!r:.80}"
    except ValueError:  # Python writes no integer of more than 4300 digits
        value = "a number of too many digits"
    return f"{where}{message}, got {value}"


def _without_quotes(text: object) -> str:
    """A word without the quotes that pydantic puts around it. Text without quotes stays."""
    return str(text).strip("'")


class _Place(NamedTuple):
    """A place in settings: its dotted key as the user wrote it, and the keys that are known there."""

    key: str
    known_keys: list[str]


def _walk(model: type[BaseModel], location: Iterable[int | str]) -> _Place:
    """The place in a model that pydantic calls by keys and indices.

    pydantic puts the tag of a discriminated union into the location; the user never wrote it, so it is left
    out. A key that no model has ends the walk of models, and is part of the dotted key all the same.
    """
    key_parts: list[str] = []
    # Models that may stand at the place so far: of a union there are several.
    models: list[type[BaseModel]] = [model]
    known_keys = _keys(models)
    for step in location:
        if isinstance(step, int):
            key_parts.append(f"[{step}]")
            continue

        # A tag picks models, where no field is called so.
        tagged = list[type[BaseModel]]()
        for candidate in models:
            kind = candidate.model_fields.get("kind")
            if kind and step in get_args(kind.annotation):
                tagged.append(candidate)
        is_field = any(step in candidate.model_fields for candidate in models)
        if tagged and not is_field:
            models = tagged
            known_keys = _keys(models)
            continue

        # A key leads to the models in the type of its field.
        known_keys = _keys(models)
        key_parts.append(f".{step}" if key_parts else step)
        inner_models = list[type[BaseModel]]()
        for candidate in models:
            if step in candidate.model_fields:
                inner_models += _models_in(candidate.model_fields[step].annotation)
        models = inner_models
    return _Place("".join(key_parts), known_keys)


def _keys(models: Iterable[type[BaseModel]]) -> list[str]:
    """Keys of the fields of some models as a user writes them, sorted. Empty for no models."""
    return sorted({field.alias or name for model in models for name, field in model.model_fields.items()})


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Models in the type of a field: itself, or those in its union, tuple or list.

    Empty where none is in it, as in the type of a number.
    """
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    models = list[type[BaseModel]]()
    for part in get_args(annotation):
        models += _models_in(part)
    return models
