"""The nominal rig: every physical parameter of a flexible-link arm, as read from a TOML file.

A straight uniform link is clamped radially to a rigid hub, which a voltage-driven gear motor turns in a
horizontal plane; hub angle and tip position are measured with noise. `Rig` holds one section per part of the
arm, each a class with checked fields; it is read from a file, written to one, and changed into another rig by
dotted keys such as "link.length_m". Errors are one line that names the key.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Collection, Mapping
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

# Largest value of a parameter, SI units. Nothing in an arm is larger (Young's modulus of diamond: 1.2e12);
# beyond, powers of it overflow.
_LARGEST = 1e15
# Smallest factor of a drawn parameter: a wide tolerance cannot turn one to zero or below.
_SMALLEST_FACTOR = 0.05
# Likeness (`difflib`, 0 to 1) from which an unknown key is taken for a misspelt one.
_ALIKE = 0.7
Positive = Annotated[float, Field(gt=0, le=_LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=_LARGEST)]

# What is measured, in the order of a record's columns.
Output = Literal["hub_angle_rad", "tip_m", "tip_acceleration_m_s2", "hub_speed_rad_s", "tip_deflection_m"]


class _Checked(BaseModel):
    """A frozen section of a rig file: every key known, every number finite and of its stated type."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        """Raises ValueError, one line, for a key or a value that cannot be used."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            known = tuple(type(self).model_fields)
            raise ValueError(f"{type(self).__name__}: {one_line(error, known)}") from None

    # As on BaseModel: validation of files does not pass through __init__.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]


class Link(_Checked):
    """A uniform Euler-Bernoulli link of rectangular cross section; it bends about I = b h^3 / 12."""

    length_m: Positive = Field(description="free length, from the clamp to the tip")
    width_m: Positive = Field(description="side b of the cross section, along the bending axis")
    thickness_m: Positive = Field(description="side h of the cross section, in the plane of motion")
    density_kg_m3: Positive = Field(description="mass density")
    youngs_modulus_Pa: Positive = Field(description="Young's modulus")
    kelvin_voigt_s: NotNegative = Field(description="kappa in M = E I (w'' + kappa dw''/dt)")

    @property
    def mass_per_length_kg_m(self) -> float:
        """Density times the area of the cross section, kg/m."""
        return self.density_kg_m3 * self.width_m * self.thickness_m

    @property
    def bending_stiffness_Nm2(self) -> float:
        """E I with I = b h^3 / 12, N m^2."""
        return self.youngs_modulus_Pa * self.width_m * self.thickness_m**3 / 12.0


class Hub(_Checked):
    """The rigid body between motor and link."""

    inertia_kg_m2: Positive = Field(description="about the hub axis, reflected motor inertia included")
    radius_m: NotNegative = Field(description="distance from the hub axis to the clamp")
    viscous_friction_Nms: NotNegative = Field(description="linear friction of motor and gear, at the hub")


class Motor(_Checked):
    """A voltage-driven direct-current motor without inductance, behind a rigid gear."""

    torque_constant_Nm_A: Positive = Field(description="torque constant, motor side")
    back_emf_Vs_rad: NotNegative = Field(description="back-EMF constant, motor side")
    resistance_ohm: Positive = Field(description="winding resistance")
    gear_ratio: Positive = Field(description="motor turns per hub turn")

    @property
    def torque_per_volt_Nm_V(self) -> float:
        """Stall torque at the hub for one volt."""
        return self.gear_ratio * self.torque_constant_Nm_A / self.resistance_ohm

    @property
    def back_emf_damping_Nms(self) -> float:
        """Braking torque at the hub per unit hub speed at zero volts."""
        return self.torque_per_volt_Nm_V * self.gear_ratio * self.back_emf_Vs_rad


class Payload(_Checked):
    """A point mass at the tip, without rotary inertia."""

    mass_kg: NotNegative = Field(description="point mass at the tip")


class Sensors(_Checked):
    """Measurement noise of the outputs: white Gaussian, or a maker's figure for noise of any colour."""

    hub_angle_noise_rad: NotNegative = Field(description="standard deviation of the hub angle noise")
    tip_noise_m: NotNegative = Field(0.0, description="standard deviation of the tip position noise")
    tip_acceleration_noise_m_s2: NotNegative = Field(
        0.0, description="standard deviation of the noise of an accelerometer at the tip"
    )
    hub_speed_noise_rad_s: NotNegative = Field(
        0.0, description="standard deviation of the noise of a tachometer at the hub"
    )
    tip_deflection_noise_m: NotNegative = Field(
        0.0, description="standard deviation of the noise of a strain gauge or camera that shows the bending"
    )
    noise_is: Literal["measured", "data sheet"] = Field("measured", description="where the levels come from")


class Sampling(_Checked):
    """Sampling of inputs (held) and outputs."""

    dt_s: float = Field(gt=0, le=10, description="sampling period; the voltage is held over it")
    transport_delay_s: float = Field(
        0.0, ge=0, le=60, description="from the logged voltage to the motor's; every sample of it is stored"
    )


class Rig(_Checked):
    """Nominal parameters of the arm; immutable and checked when built.

    `tolerances` holds relative standard deviations of nominal values under dotted keys such as
    "hub.inertia_kg_m2"; a parameter that is not listed is exact.

    Examples
    --------
    >>> rig = flexlink.Rig.from_toml("examples/gap_case/rig.toml")
    >>> rig.link.length_m, rig.tolerances["hub.inertia_kg_m2"]
    (1.0, 0.05)
    """

    link: Link
    hub: Hub
    motor: Motor
    payload: Payload
    sensors: Sensors
    sampling: Sampling
    tolerances: dict[str, Positive] = Field(default_factory=dict, description="relative standard deviations")

    @model_validator(mode="after")
    def _tolerances_name_parameters(self) -> Self:
        """The rig itself. Raises ValueError for a tolerance of something that is no parameter."""
        known = parameter_keys()
        for key in self.tolerances:
            if key not in known:
                raise ValueError(f"tolerances.{key}: unknown parameter, expected one of {', '.join(known)}")
        return self

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Self:
        """The rig that a file states.

        Raises
        ------
        ValueError
            One line with the file and the dotted key (or the line of a syntax error) and what was expected.
        FileNotFoundError
            There is no such file.
        """
        if Path(path).exists() and not Path(path).is_file():  # a pipe would be waited for
            raise ValueError(f"{path}: not a file")
        try:
            text = Path(path).read_bytes().decode("utf-8-sig")  # some editors put a mark in front
            content = tomllib.loads(text)
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: not UTF-8 text (byte {error.start})") from error
        except (ValueError, RecursionError) as error:  # syntax; integers or nesting without end
            raise ValueError(f"{path}: not valid TOML: {error}") from error
        return cls.from_document(content, str(path))

    @classmethod
    def from_document(cls, content: Mapping[str, Any], source: str) -> Self:
        """The rig of the content of a rig file, a table of tables. Raises ValueError that names `source`."""
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise ValueError(f"{source}: {one_line(error)}") from error

    def to_toml(self) -> str:
        """The rig as the text of a rig file; reading it back gives an equal Rig."""
        lines: list[str] = ["# rig; SI units, given in the key names"]
        for section, values in self.model_dump(exclude_defaults=True).items():
            lines.append("")
            if section == "tolerances":
                lines.append("# relative standard deviations of the values above; not listed = exact")
            lines.append(f"[{section}]")
            for name, value in values.items():
                # Names of tolerances have a dot in them, which is a table without quotation marks.
                key = f'"{name}"' if section == "tolerances" else name
                text = f'"{value}"' if isinstance(value, str) else f"{float(value)!r}"
                lines.append(f"{key} = {text}")
        return "\n".join(lines) + "\n"

    def value(self, key: str) -> float:
        """The parameter under a dotted key such as "link.length_m"; ValueError if there is none."""
        if key not in parameter_keys():
            raise ValueError(f"{key}: unknown parameter, expected one of {', '.join(parameter_keys())}")
        section, name = key.split(".")
        return float(getattr(getattr(self, section), name))

    def perturbed(self, values: Mapping[str, float]) -> Self:
        """This rig with the parameters under the given dotted keys set to new values.

        The result is checked like any other rig; an unknown key or a bad value raises a one-line ValueError.
        """
        content: dict[str, Any] = self.model_dump()
        for key, value in values.items():
            self.value(key)
            section, name = key.split(".")
            content[section][name] = float(value)
        try:
            return type(self).model_validate(content)
        except ValidationError as error:
            raise ValueError(one_line(error)) from error

    def scaled(self, factors: Mapping[str, float]) -> Self:
        """This rig with the parameters under the given dotted keys multiplied by factors.

        An unknown key or a bad value raises a one-line ValueError.
        """
        return self.perturbed({key: self.value(key) * factor for key, factor in factors.items()})

    def drawn(self, rng: np.random.Generator) -> Self:
        """A rig as the tolerances allow: every listed parameter times (1 + tolerance * normal deviate).

        A factor is kept above 0.05 so that a wide tolerance cannot turn a parameter negative.
        """
        factors = {}
        for key, tolerance in self.tolerances.items():
            factor = 1.0 + tolerance * rng.standard_normal()
            factors[key] = max(factor, _SMALLEST_FACTOR)
        return self.scaled(factors)


@cache
def parameter_keys() -> tuple[str, ...]:
    """Dotted keys of all parameters of a Rig, in file order."""
    keys = []
    for section, field in Rig.model_fields.items():
        # Tolerances are a dictionary, which has no fields.
        entries = getattr(field.annotation, "model_fields", {})
        for name, entry in entries.items():
            if entry.annotation is float:
                keys.append(f"{section}.{name}")
    return tuple(keys)


def one_line(error: ValidationError, known: Collection[str] = ()) -> str:
    """The gravest complaint of pydantic in one line: dotted key, what was expected, what came.

    known : collection of str
        The keys that may be meant, where they are not those of a rig.
    """
    # An unknown key first: a misspelt key is also a missing one, and its spelling is what has to be seen.
    complaints = error.errors()
    first = min(complaints, key=lambda complaint: complaint["type"] != "extra_forbidden")
    key = ".".join(str(part) for part in first["loc"])
    kind = first["type"]
    message = first["msg"].removeprefix("Value error, ")
    if kind == "missing":
        return f"{key}: missing, expected a value"
    if kind == "extra_forbidden":
        possible = known or (*parameter_keys(), *Rig.model_fields)
        close = get_close_matches(key, possible, n=1, cutoff=_ALIKE)
        # A parameter without its section: "dt_s" of "sampling.dt_s".
        close = close or [full for full in parameter_keys() if full.rpartition(".")[2] == key]
        if close:
            return f"{key}: unknown key (did you mean {close[0]}?)"
        # Those of a rig would fill a page.
        if known:
            return f"{key}: unknown key (known: {', '.join(known)})"
        return f"{key}: unknown key"
    if kind == "value_error":
        return f"{key}: {message}" if key else message
    expected = message.removeprefix("Input should be ")
    try:
        # The first 80 characters: somebody may have put a whole table there.
        input_text = f"{first['input']!r:.80}"
    except ValueError:  # hexadecimal digits give integers that Python does not write in decimal ones
        input_text = "a number of too many digits"
    return f"{key}: expected {expected}, got {input_text}"
