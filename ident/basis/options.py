"""Settings of an identification and of its uncertainty, checked when they are read."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Complex
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.settings import Settings

Algorithm = Literal[
    "GN_DIRECT_L",
    "GN_DIRECT",
    "GN_DIRECT_NOSCAL",
    "GN_DIRECT_L_NOSCAL",
    "GN_DIRECT_L_RAND",
    "GN_DIRECT_L_RAND_NOSCAL",
    "GN_ORIG_DIRECT",
    "GN_ORIG_DIRECT_L",
]


# Settings about which the data decide where nobody stated them, not even at their default. A stored
# configuration tells which of them were stated (`workflow.tasks.stage.Stage.settings`).
LEFT_OPEN = ("input_delay_samples", "integrators", "unstable_poles")


class IdentOptions(Settings):
    """Settings of the fit and of the pole search.

    What you know is kept and tested against the data (`ident.checks.prior_tests`). The data choose numbers of
    poles that are None, record length and sampling time the box of the search; bounds of yours also bind the
    refinement.
    """

    n_real: int | None = Field(None, ge=0, le=8, description="number of real poles; default: from the data")
    n_pairs: int | None = Field(None, ge=0, le=12, description="number of pole pairs; default: from the data")
    max_real: int = Field(
        4, ge=0, le=8, description="most real poles when their number is chosen from the data"
    )
    max_pairs: int = Field(
        5, ge=0, le=12, description="most pole pairs when their number is chosen from the data"
    )
    fixed_poles: tuple[tuple[float, float], ...] = Field(
        (),
        description="known poles in the z plane, not changed: a number for a real one, [real part, imaginary "
        "part] for a pair, as [0.9, [0.95, 0.2]]; from Python flexlink.Poles or complex numbers, too",
    )

    unstable_poles: tuple[tuple[float, float], ...] = Field(
        (),
        description="known poles outside the unit circle, each as real part, imaginary part >= 0",
    )
    integrators: int = Field(0, ge=0, le=3, description="known poles at z = 1, as exact input filters")
    feedthrough: bool = Field(
        False, description="direct term from the input to the output of the same sample"
    )
    input_delay_samples: int = Field(
        0,
        ge=0,
        description="known delay of the input [samples]; default: sought in the data of one input",
    )
    relative_degree: Annotated[int, Field(ge=1, le=6)] | Literal["auto"] | None = Field(
        None,
        description="known relative degree (1 to 6) of the continuous-time plant behind a "
        "zero-order hold (torque to angle: 2); tested and kept. auto: the largest of 1 to 3 that the data "
        "allow",
    )
    estimate_offset: bool | Literal["auto"] = Field(
        "auto", description="unknown constant on the output of each record; auto: kept if the data support it"
    )
    estimate_initial_state: bool | Literal["auto"] = Field(
        "auto", description="records need not start at rest; auto: kept if the data support it"
    )

    noise: Literal["white", "auto"] = Field(
        "white",
        description="model of the noise. white: plain least squares; auto: another one where the "
        "residuals are not white (dry friction, drift)",
    )

    algorithm: Algorithm = Field("GN_DIRECT_L", description="NLopt's variants of DIRECT")
    coordinates: Literal["log", "raw"] = Field(
        "log",
        description="log: log10 of decay, frequency and damping; raw: the paper's (x, beta, gamma), "
        "which often miss the best poles",
    )
    evaluations: int = Field(
        250, ge=20, le=1_000_000, description="cost evaluations of the first global search"
    )
    search_samples: int = Field(
        20_000, ge=100, description="longer data are searched on a part, then refined on all samples"
    )
    starts: int = Field(
        4,
        ge=1,
        le=20,
        description="points of a global search that are refined; five times as many if the first disagree",
    )

    omega_min_rad_s: float | None = Field(
        None, gt=0, description="lowest natural frequency of a pair [rad/s]"
    )
    omega_max_rad_s: float | None = Field(
        None, gt=0, description="highest natural frequency of a pair [rad/s]"
    )
    zeta_min: float | None = Field(None, gt=0, lt=0.98, description="smallest damping ratio of a pair")
    zeta_max: float | None = Field(None, gt=0, le=0.98, description="largest damping ratio of a pair")
    decay_min_per_s: float | None = Field(None, gt=0, description="slowest decay of a real pole, 1/s")
    decay_max_per_s: float | None = Field(None, gt=0, description="fastest decay of a real pole, 1/s")

    @field_validator("fixed_poles", "unstable_poles", mode="before")
    @classmethod
    def _numbers(cls, given: Any) -> Any:
        """`Poles` and complex numbers as parts; of a conjugate pair, the upper one."""
        poles = list(given.values) if isinstance(given, Poles) else given
        if not isinstance(poles, (list, tuple, np.ndarray)):
            raise ValueError(
                "expected a list, with a number for a real pole and [real part, imaginary part] for a pair: "
                "[0.9, [0.95, 0.2]]"
            )
        values = [complex(p) if isinstance(p, Complex) else p for p in poles]
        upper = [p for p in values if not isinstance(p, complex) or p.imag >= 0 or np.conj(p) not in values]
        return tuple(
            (p.real, p.imag) if isinstance(p, complex) else tuple(p) if isinstance(p, list) else p
            for p in upper
        )

    @model_validator(mode="after")
    def _consistent(self) -> IdentOptions:
        for low, high in (
            ("omega_min_rad_s", "omega_max_rad_s"),
            ("zeta_min", "zeta_max"),
            ("decay_min_per_s", "decay_max_per_s"),
        ):
            lowest, highest = getattr(self, low), getattr(self, high)
            if lowest is not None and highest is not None and not lowest < highest:
                raise ValueError(f"{low} must be below {high}; got {lowest} and {highest}")
            if self.coordinates == "raw" and not (lowest is None and highest is None):
                raise ValueError(f"{low} and {high} need coordinates = 'log'")
        self.fixed()
        self._refuse_impossible_relative_degree()
        return self

    def _refuse_impossible_relative_degree(self) -> None:
        if self.relative_degree is None:
            return
        if self.feedthrough:
            raise ValueError("relative_degree of 1 or more excludes a direct term; set feedthrough = false")
        for re, im in self.fixed_poles:
            if im == 0 and not re > 0:
                raise ValueError(
                    "relative_degree needs poles with a continuous-time counterpart; fixed_poles has "
                    f"[{re:.6g}, 0], expected a positive real part"
                )
        if isinstance(self.relative_degree, int) and None not in (self.n_real, self.n_pairs):
            order = self.fixed().order + (self.n_real or 0) + 2 * (self.n_pairs or 0)
            if order < self.relative_degree:
                raise ValueError(
                    f"relative_degree = {self.relative_degree} needs at least that many poles, integrators "
                    f"counted; got {order}"
                )

    # What somebody set when these settings were made. A copy that the program changes keeps it.
    _stated: frozenset[str] = PrivateAttr(default=frozenset())

    def model_post_init(self, context: Any) -> None:
        self._stated = frozenset(self.model_fields_set)

    def is_stated(self, key: str) -> bool:
        """Whether somebody set this key; what the program chose for a copy, from the data, nobody did."""
        return key in self._stated

    def fixed(self) -> Poles:
        """The fixed poles, mirror images of unstable ones last; ValueError if one is not inside the circle.

        Each integrator adds a pole at z = 0. Its filter z/(z - 1) puts a zero there; with the pole the
        numerator is as free as with the integrator among the poles.
        """
        real = [0.0] * self.integrators + [re for re, im in self.fixed_poles if im == 0]
        pairs = [complex(re, im) for re, im in self.fixed_poles if im != 0]
        return Poles(real, pairs).appended(self.unstable())  # type: ignore[arg-type]

    def unstable(self) -> Poles:
        """Mirror images of the unstable poles; ValueError if one is not outside the circle."""
        real = [1 / re for re, im in self.unstable_poles if im == 0]
        pairs = [1 / complex(re, -im) for re, im in self.unstable_poles if im != 0]
        return Poles(real, pairs)  # type: ignore[arg-type]

    def with_unstable(self, mirrored: Poles) -> IdentOptions:
        """The same with these unstable poles, given by their mirror images."""
        poles = [*mirrored.real, *mirrored.pairs]
        outside = tuple((float((1 / p).real), -float((1 / p).imag)) for p in poles)
        return self.model_copy(update={"unstable_poles": outside})

    def states(self, *names: str) -> bool:
        """Whether at least one of these settings was stated, be it at its default.

        Raises ValueError for a name that is not one of `LEFT_OPEN`: of others only the value counts.
        """
        strange = set(names) - set(LEFT_OPEN)
        if strange:
            raise ValueError(f"{min(strange)}: not one of {', '.join(LEFT_OPEN)}")
        return not self.model_fields_set.isdisjoint(names)

    @property
    def delay_left_to_data(self) -> bool:
        """Nobody stated a delay, not even that there is none."""
        return not self.states("input_delay_samples")

    def with_delay_stated(self) -> IdentOptions:
        """The same, the delay no longer sought: what is no record of one input and one output has none."""
        return self.model_copy(update={"input_delay_samples": self.input_delay_samples})

    def structure(self) -> Structure:
        """The structure these settings describe, before the data were asked: offset on, start from rest."""
        return Structure(
            integrators=self.integrators,
            input_delay_samples=self.input_delay_samples,
            feedthrough=self.feedthrough,
            estimate_offset=bool(self.estimate_offset),
            estimate_initial_state=self.estimate_initial_state is True,
            unstable=self.unstable(),
        )


class EmbeddingOptions(Settings):
    """Settings of the uncertainty estimate."""

    fir_length: int | None = Field(
        default=None,
        ge=1,
        description="taps of the kernel for unmodelled dynamics; default: 150, fewer for short records",
    )
    estimate_offset: bool = Field(default=True, description="a constant on each record's output")
    estimate_initial_state: bool = Field(
        default=True, description="free response of all poles in each record"
    )
    prior_missed_mode: float = Field(
        default=0.5,
        ge=0.0,
        lt=1.0,
        description="prior probability that the poles lack a lightly damped mode; 0: do not look for "
        "one. For records only, not for measured frequency responses",
    )
    coloured_noise: bool | Literal["auto"] = Field(
        default=False, description="whiten with an AR model of the residuals, three rounds"
    )
    max_ar_order: int = Field(
        default=8,
        ge=1,
        le=100,
        description="largest AR order of the noise model that BIC may choose; default: 8, or 32 where the "
        "residuals are not white behind that (coloured_noise = 'auto')",
    )
    order_given: bool | None = Field(
        default=None,
        description="the order was given, not chosen from these data; default: as in the "
        "identification of the same channel, else no",
    )

    @model_validator(mode="before")
    @classmethod
    def _order_asked_for(cls, stated: Any) -> Any:
        if isinstance(stated, Mapping) and "max_ar_order" in stated:
            return {"coloured_noise": True, **stated}
        return stated

    @property
    def no_remainder(self) -> float:
        """Prior probability that the poles explain everything."""
        return 0.0 if self.order_given else 0.5

    feedthrough: bool | None = Field(default=None, description="direct term; default: as in the model")
