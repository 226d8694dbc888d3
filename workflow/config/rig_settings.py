"""How a configuration names the simulated machine: a preset or a rig file, effects by their id, excitations
(the signals themselves are `plant.excitation`'s)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BeforeValidator, Field, PlainSerializer, PlainValidator, ValidationInfo

from plant import excitation
from plant.effects import parse_effect
from plant.presets import paper_link
from plant.rig import Rig
from workflow.config.settings import Section, resolve
from workflow.engine import documents
from workflow.engine.errors import naming, shortened

# Rigs by the names that a configuration may use in place of a file.
PRESETS: dict[str, Callable[[], Rig]] = {"paper_link": paper_link}


def read_rig(path: Path) -> Rig:
    """A rig file. Raises InputError naming it and the dotted key."""
    _, content = documents.read_toml(path)
    with naming(str(path)):
        return Rig.from_document(content, str(path))


def rig_called(name: str | Path) -> Rig:
    """A preset by its name, or a rig file. Raises InputError."""
    return PRESETS[str(name)]() if str(name) in PRESETS else read_rig(Path(name))


def _choose_rig(value: Any, info: ValidationInfo) -> str | Path:
    """A preset's name, or a rig file that is there and can be read."""
    if not isinstance(value, (str, Path)):
        raise ValueError(
            f"expected the name of a preset ({', '.join(PRESETS)}) or the path of a rig file, got "
            f"{shortened(value)}"
        )
    text = str(value)
    if text in PRESETS:
        return text
    path = resolve(Path(text), info, kind=f"rig file (presets: {', '.join(PRESETS)})")
    if not (info.context or {}).get("may_be_gone"):
        read_rig(path)
    return path


RigChoice = Annotated[str | Path, PlainValidator(_choose_rig), PlainSerializer(str, return_type=str)]
EffectTable = Annotated[dict[str, Any], BeforeValidator(lambda value: parse_effect(value).to_dict())]
Real = npt.NDArray[np.float64]


class _Table(Section):
    """An excitation of the simulated arm: what its voltage is at every sample."""

    @abstractmethod
    def signal(self, dt_s: float, rng: np.random.Generator) -> Real:
        """Voltage (T,). Raises ValueError where the numbers do not fit together."""


class Prbs(_Table):
    """A pseudo-random binary sequence: the voltage is plus or minus `amplitude_V`, V.

    Notes
    -----
    `register_length` and `hold_samples` set its period, (2^register_length - 1) hold_samples samples; a
    longer record repeats it. Values out of their bounds are refused when the file is read.
    """

    kind: Literal["prbs"] = Field(description="pseudo-random binary sequence")
    amplitude_V: float = Field(gt=0, description="largest voltage")
    samples: int = Field(ge=2, le=1_000_000, description="length of the record")
    register_length: int = Field(11, ge=2, le=20, description="period: 2^register_length - 1 changes")
    hold_samples: int = Field(1, ge=1, description="samples between possible changes of sign")

    def signal(self, dt_s: float, rng: np.random.Generator) -> Real:
        return excitation.prbs(self.register_length, self.hold_samples, self.amplitude_V, self.samples, rng)


class Multisine(_Table):
    """A sum of sines of equal amplitude and random phase, `rms_V` large, V, repeated for whole periods.

    Notes
    -----
    Lines lie between `from_Hz` and `to_Hz`, Hz, at multiples of one over the length of a period. A band
    without a line, or one beyond half of the sampling rate, is refused (ValueError) when the record is made.
    """

    kind: Literal["multisine"] = Field(description="sum of sines of random phase")
    rms_V: float = Field(gt=0, description="root mean square")
    period_samples: int = Field(ge=2, le=1_000_000, description="length of a period")
    periods: int = Field(1, ge=1, le=1000, description="whole periods of the record")
    from_Hz: float = Field(gt=0, description="lowest frequency")
    to_Hz: float = Field(gt=0, description="highest frequency")
    grid: Literal["full", "odd", "odd_random"] = Field(
        "full", description="excited lines: all, odd ones, odd ones of which one in four is left out"
    )
    phase_draws: int = Field(1, ge=1, le=1000, description="the draw with the lowest crest factor is kept")
    lead_in_samples: int = Field(
        0, ge=0, le=1_000_000, description="lead-in of the same signal before the whole periods"
    )
    lines_seed: int | None = Field(
        None, ge=0, description="odd_random: draws the lines, for records that share them"
    )

    def signal(self, dt_s: float, rng: np.random.Generator) -> Real:
        lines = excitation.multisine_lines(
            self.period_samples,
            dt_s,
            (self.from_Hz, self.to_Hz),
            self.grid,
            rng if self.lines_seed is None else np.random.default_rng(self.lines_seed),
        )
        return excitation.multisine(
            lines,
            self.period_samples,
            self.rms_V,
            rng,
            periods=self.periods,
            draws=self.phase_draws,
            lead_in_samples=self.lead_in_samples,
        )


class LogChirp(_Table):
    """A sine of `amplitude_V`, V, swept from `from_Hz` to `to_Hz`, Hz, by equal ratios in equal times.

    Notes
    -----
    The sweep takes the whole record. Frequencies beyond half of the sampling rate, or two equal ones, are
    refused (ValueError) when the record is made.
    """

    kind: Literal["log_chirp"] = Field(description="sweep, as long in each octave")
    amplitude_V: float = Field(gt=0, description="largest voltage")
    samples: int = Field(ge=2, le=1_000_000, description="length of the record")
    from_Hz: float = Field(gt=0, description="lowest frequency")
    to_Hz: float = Field(gt=0, description="highest frequency")

    def signal(self, dt_s: float, rng: np.random.Generator) -> Real:
        return excitation.log_chirp(self.from_Hz, self.to_Hz, self.amplitude_V, self.samples, dt_s)


class Doublet(_Table):
    """A pulse of `amplitude_V`, V, and its negative, each `pulse_s` long, s, after `start_s` of rest, s.

    Notes
    -----
    The voltage is 0 before and after; what lies beyond the end of the record is cut off.
    """

    kind: Literal["doublet"] = Field(description="a pulse and its negative")
    amplitude_V: float = Field(gt=0, description="largest voltage")
    samples: int = Field(ge=2, le=1_000_000, description="length of the record")
    start_s: float = Field(0.0, ge=0, description="rest before the motion")
    pulse_s: float = Field(gt=0, description="length of each of the two pulses")

    def signal(self, dt_s: float, rng: np.random.Generator) -> Real:
        return excitation.doublet(self.amplitude_V, self.start_s, self.pulse_s, self.samples, dt_s)


class BangBang(_Table):
    """A move at full voltage: `amplitude_V` one way, then the other, V, each for half of `slew_s`, s.

    Notes
    -----
    It begins after `start_s` of rest, s. The voltage is 0 before and after; what lies beyond the end of the
    record is cut off.
    """

    kind: Literal["bang_bang"] = Field(description="full voltage one way, then the other")
    amplitude_V: float = Field(gt=0, description="largest voltage")
    samples: int = Field(ge=2, le=1_000_000, description="length of the record")
    start_s: float = Field(0.0, ge=0, description="rest before the motion")
    slew_s: float = Field(gt=0, description="length of the move, half of it each way")

    def signal(self, dt_s: float, rng: np.random.Generator) -> Real:
        return excitation.bang_bang(self.amplitude_V, self.start_s, self.slew_s, self.samples, dt_s)


Excitation = Annotated[Prbs | Multisine | LogChirp | Doublet | BangBang, Field(discriminator="kind")]
