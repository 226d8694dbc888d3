"""Options of a command that set fields of settings: name, kind, range and words come from the field.

Settings are slow to load, so these options are made when their command is called (`completed`).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import typer

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

F = TypeVar("F", bound=Callable[..., Any])
# Ends of a field's range as a help text says them, by their names in pydantic's metadata.
_LIMITS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
# Where it is not that of the field, and no hint names it (`workflow.text.options`).
_NAMES = {
    "input_name": "--input",
    "output_name": "--output",
    "units": "--unit",
    "band_Hz": "--band",
    "duration_s": "--duration",
    "peak_V": "--voltage",
    "rms_V": "--rms",
    "angle_deg": "--angle",
    "gain_rad_per_Vs": "--gain",
    "noise_std_rad": "--noise-std",
    "lead_in_s": "--lead-in",
    "bandwidth_rad_s": "--bandwidth",
    "lowest_bandwidth_rad_s": "--lowest-bandwidth",
    "controller_order": "--order",
}
# What is typed for a key of [specification] in place of a number: it is not asked.
NONE = "none"
# Before the help of an option that is stated for each column by itself.
_BY_COLUMN = "COLUMN=VALUE (repeatable): "


def with_fields(**places: Sequence[str]) -> Callable[[F], F]:
    """Give a command options for fields of settings; it takes their values as `**given`.

    The options are made by `completed`: a place that is not in `SETTINGS` is a KeyError only there.

    Parameters
    ----------
    places : sequences of str
        By the name of a place in `SETTINGS`, its fields, with what stands before them in the table of option
        names ("x.field").
    """

    def noted(function: F) -> F:
        # Typer would take `**given` for one option of that name.
        signature = inspect.signature(function)
        named = [each for each in signature.parameters.values() if each.kind is not each.VAR_KEYWORD]
        function.__signature__ = signature.replace(parameters=named)  # type: ignore[attr-defined]
        function.of_fields = places  # type: ignore[attr-defined]
        return function

    return noted


# Where the settings of each place stand: "module:class", loaded when a command with fields of it is called.
SETTINGS = {
    "fit": "workflow.config.uncertainty_options:FitOptions",
    "ellipses": "workflow.config.uncertainty_options:UncertaintyOptions",
    "reading": "workflow.commands.logs:Reading",
    "channel": "workflow.config.run_config:Channel",
    "loop": "workflow.config.run_config:ClosedLoopData",
    "plan": "plant.experiment_plan:ExperimentPlan",
    "limits": "workflow.excite:ExperimentLimits",
    "files": "workflow.config.command_files:CommandFiles",
    "specification": "control_design.specification:Specification",
    "simulator": "workflow.diagnose.simulator_settings:SimulatorSettings",
}


def completed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The command with the options that `with_fields` promised."""
    hints = get_type_hints(function, include_extras=True)
    named = inspect.signature(function).parameters.values()
    parameters = [each.replace(annotation=hints[each.name]) for each in named]
    for place, names in function.of_fields.items():  # type: ignore[attr-defined]
        fields = resolve_name(SETTINGS[place]).model_fields
        # Only a specification has keys whose absence differs from their default.
        may_be_none = place == "specification"
        parameters += [
            _parameter(name, fields[name.rpartition(".")[2]], may_be_none=may_be_none) for name in names
        ]

    @wraps(function)
    def called(**given: Any) -> Any:
        return function(**given)

    # Typer reads signature and annotations of what it is given, and `function` knows nothing of the fields.
    called.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [each.replace(kind=each.KEYWORD_ONLY) for each in parameters]
    )
    called.__annotations__ = {each.name: each.annotation for each in parameters}
    return called


def option_name(key: str) -> str:
    """What the option for a field is called."""
    from workflow.text.options import OPTIONS

    return {**_NAMES, **OPTIONS["identify"]}.get(key, f"--{key.replace('_', '-')}")


def _number_or_none(text: str) -> float | str:
    """A number, or `NONE` as it is. Raises BadParameter for any other word."""
    if text == NONE:
        return NONE
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a valid float, nor none") from None


def _parameter(key: str, field: FieldInfo, *, may_be_none: bool = False) -> inspect.Parameter:
    """Option for a field; may_be_none: an optional number takes the word none as well."""
    kind = _kind(field.annotation)
    words = described(field)
    if _is_mapping(field.annotation):
        words = _BY_COLUMN + words
    form = "<float> <float>" if get_origin(kind) is tuple else None
    parser = None
    if may_be_none and kind is float and type(None) in get_args(field.annotation):
        form = "<float>|none"
        parser = _number_or_none
    option = typer.Option(option_name(key), help=words[0].upper() + words[1:], metavar=form, parser=parser)
    return inspect.Parameter(
        key.replace(".", "_"),
        inspect.Parameter.KEYWORD_ONLY,
        default=False if kind is bool else None,
        annotation=Annotated[kind if kind is bool else kind | None, option],
    )


def _is_mapping(annotation: Any) -> bool:
    origin = get_origin(annotation)
    return isinstance(origin, type) and issubclass(origin, Mapping)


def _kind(annotation: Any) -> Any:
    """What the command line takes for a field; settings check the rest."""
    if _is_mapping(annotation):
        return list[str]
    # Numbers with a range are Annotated, each in its own way: the type beneath counts.
    kinds = [
        getattr(kind, "__origin__", kind) if hasattr(kind, "__metadata__") else kind
        for kind in (annotation, *get_args(annotation))
    ]
    pairs = [kind for kind in kinds if get_origin(kind) is tuple]
    if pairs:
        # (float, ...) is an option that may be repeated, (float, float) one that takes two numbers.
        return list[get_args(pairs[0])[0]] if Ellipsis in get_args(pairs[0]) else pairs[0]  # type: ignore[misc]
    # A field that takes a number or a word is typed as text, and its settings tell which it is.
    plain = [kind for kind in kinds if kind in (bool, int, float, Path)]
    choices = [choice for kind in kinds for choice in get_args(kind) if isinstance(choice, str)]
    return plain[0] if len(plain) == 1 and not choices else str


def described(field: FieldInfo) -> str:
    """Description, choices, range and, where it is not said, default of a field."""
    from pydantic_core import PydanticUndefined

    remarks = []
    # Words of a Literal, which may stand beside None.
    for kind in (field.annotation, *get_args(field.annotation)):
        choices = get_args(kind)
        if len(choices) > 1 and isinstance(choices[0], str):
            remarks.append(", ".join(choices))
    for metadata in field.metadata:
        for limit, words in _LIMITS.items():
            if hasattr(metadata, limit):
                remarks.append(f"{words} {getattr(metadata, limit):g}")
    description = str(field.description)
    has_default = not any(field.default is none for none in (None, False, PydanticUndefined, ()))
    if has_default and "default:" not in description:
        remarks.append(f"default: {field.default}")
    return f"{description} [{'; '.join(remarks)}]" if remarks else f"{description}."
