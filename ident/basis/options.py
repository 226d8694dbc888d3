"""Settings of an identification and of its uncertainty, checked when they are read.

`IdentOptions` holds what a user knows or limits (numbers of poles, fixed poles, delay, integrators, bounds)
and how the search works; `EmbeddingOptions` holds those of the uncertainty estimate. pydantic checks each
value, the validators here what concerns several of them. A setting that was stated is kept apart from one at
its default, because the data decide about the latter: see `is_stated` and `states`. Ranges of the fields
(`ge`, `le`) keep out typing errors; what they bound is said in the description that the user reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Complex
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from ident.basis.poles import Poles
from ident.basis.structure import Structure
from ident.data.settings import Settings

# Algorithms of NLopt by its own names: DIRECT and its locally biased variant DIRECT-L, with or without
# scaling of the box, randomised, and Gablonsky's original code.
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

    Examples
    --------
    >>> options = flexlink.IdentOptions(n_real=0, n_pairs=1, omega_max_rad_s=100.0)
    >>> flexlink.identify(example_record(), options).model.poles.order
    2
    """

    # Most numbers that may be stated (8, 12), and that are chosen from the data (4, 5): chosen for arms, with
    # a few lags and up to five modes below the Nyquist frequency. A search takes longer with the number of
    # pairs.
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
    # Three integrators are torque to angle and one of a controller in the plant.
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
    # Effort of a search. The numbers are chosen: more cost time, and fewer are noticed, as refined starts
    # that disagree are followed by more of them.
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

    # Bounds of damping ratios end at .98, `ident.basis.coordinates.ZETA_LIMIT`: beyond, a pair is two real
    # poles.
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
        """Poles as pairs (real part, imaginary part), before pydantic checks them.

        `given` may be `Poles`, or a list of numbers and of such pairs: of a conjugate pair of complex numbers
        the upper one remains. What is neither stays as it is, for pydantic to refuse. Raises ValueError where
        it is no list; a tuple of pairs comes back. Where poles lie is checked in `_consistent`.
        """
        poles = list(given.values) if isinstance(given, Poles) else given
        if not isinstance(poles, (list, tuple, np.ndarray)):
            raise ValueError(
                "expected a list, with a number for a real pole and [real part, imaginary part] for a pair: "
                "[0.9, [0.95, 0.2]]"
            )
        # Numbers first, so that the partner of a pair is found whichever type it came in.
        values = [complex(pole) if isinstance(pole, Complex) else pole for pole in poles]
        parts: list[Any] = []
        for value in values:
            if isinstance(value, complex):
                is_lower_of_pair = value.imag < 0 and np.conj(value) in values
                if not is_lower_of_pair:
                    parts.append((value.real, value.imag))
            elif isinstance(value, list):
                parts.append(tuple(value))
            else:
                parts.append(value)
        return tuple(parts)

    @model_validator(mode="after")
    def _consistent(self) -> IdentOptions:
        """These settings, which do not contradict one another.

        Raises ValueError where two do, or a known pole is on the wrong side of the unit circle.
        """
        for low, high in (
            ("omega_min_rad_s", "omega_max_rad_s"),
            ("zeta_min", "zeta_max"),
            ("decay_min_per_s", "decay_max_per_s"),
        ):
            lowest = getattr(self, low)
            highest = getattr(self, high)
            if lowest is not None and highest is not None and not lowest < highest:
                raise ValueError(f"{low} must be below {high}; got {lowest} and {highest}")
            # The box of the raw coordinates is the whole circle: it has no side for a frequency or a decay.
            is_stated = lowest is not None or highest is not None
            if self.coordinates == "raw" and is_stated:
                raise ValueError(f"{low} and {high} need coordinates = 'log'")
        for re, im in self.unstable_poles:
            if re == 0 and im == 0:
                raise ValueError(
                    "unstable_poles has 0, which is inside the unit circle; expected |z| above 1: name a "
                    "known pole inside the circle in fixed_poles, or leave it out"
                )
        # Raises ValueError where a known pole is on the wrong side of the unit circle.
        self.fixed()
        self._refuse_impossible_relative_degree()
        return self

    def _refuse_impossible_relative_degree(self) -> None:
        """Raise ValueError where the stated relative degree and another setting exclude each other.

        Those are a direct term, a fixed real pole that is not above 0, and numbers of poles that are too few.
        """
        # Nobody asked for conditions.
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
        # Where the data choose a number of poles, they choose one that is large enough.
        n_real = self.n_real
        n_pairs = self.n_pairs
        if isinstance(self.relative_degree, int) and n_real is not None and n_pairs is not None:
            order = self.fixed().order + n_real + 2 * n_pairs
            if order < self.relative_degree:
                raise ValueError(
                    f"relative_degree = {self.relative_degree} needs at least that many poles, integrators "
                    f"counted; got {order}"
                )

    # What somebody set when these settings were made. A copy that the program changes keeps it.
    _stated: frozenset[str] = PrivateAttr(default=frozenset())

    def model_post_init(self, context: Any) -> None:
        """Remember which settings were stated; pydantic calls it once the fields are checked."""
        self._stated = frozenset(self.model_fields_set)

    def is_stated(self, key: str) -> bool:
        """Whether somebody set this key; not what the program chose from the data, for a copy.

        False for a name that is no setting.
        """
        return key in self._stated

    def fixed(self) -> Poles:
        """Fixed poles of the basis: zeros of the integrators, known poles, mirror images of unstable ones.

        In that order within each type. Raises ValueError if one is not inside the circle, which is found when
        the settings are made.

        Each integrator adds a pole at z = 0. Its filter z/(z - 1) puts a zero there; with the pole the
        numerator is as free as with the integrator among the poles.
        """
        of_integrators = [0.0] * self.integrators
        known_real = [re for re, im in self.fixed_poles if im == 0]
        real = of_integrators + known_real
        pairs = [complex(re, im) for re, im in self.fixed_poles if im != 0]
        return Poles(real, pairs).appended(self.unstable())  # type: ignore[arg-type]

    def unstable(self) -> Poles:
        """Mirror images 1 / conj(p) of the unstable poles p, inside the circle.

        Raises ValueError if |p| is not above 1; p = 0 was refused when the settings were made.
        """
        real = [1 / re for re, im in self.unstable_poles if im == 0]
        pairs = [1 / complex(re, -im) for re, im in self.unstable_poles if im != 0]
        return Poles(real, pairs)  # type: ignore[arg-type]

    def with_unstable(self, mirrored: Poles) -> IdentOptions:
        """Copy of these settings with the unstable poles whose mirror images are `mirrored`.

        The copy is not checked again; a mirror image at zero, of no pole, would be infinite.
        """
        outside = []
        for image in (*mirrored.real, *mirrored.pairs):
            inverse = 1 / image
            # The pole is 1 / conj(image), above the axis as its image is.
            outside.append((float(inverse.real), -float(inverse.imag)))
        return self.model_copy(update={"unstable_poles": tuple(outside)})

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
        """Whether nobody stated a delay, not even that there is none."""
        return not self.states("input_delay_samples")

    def with_delay_stated(self) -> IdentOptions:
        """Copy of these settings whose delay counts as stated, and is no longer sought.

        For data that are no records of one input and one output: nothing seeks a delay there.
        """
        return self.model_copy(update={"input_delay_samples": self.input_delay_samples})

    def structure(self) -> Structure:
        """Structure that these settings describe before the data were asked: offset on, start from rest."""
        return Structure(
            integrators=self.integrators,
            input_delay_samples=self.input_delay_samples,
            feedthrough=self.feedthrough,
            estimate_offset=bool(self.estimate_offset),
            estimate_initial_state=self.estimate_initial_state is True,
            unstable=self.unstable(),
        )


class EmbeddingOptions(Settings):
    """Settings of the uncertainty estimate.

    Examples
    --------
    >>> found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    >>> spread = flexlink.uncertainty(found, flexlink.EmbeddingOptions(coloured_noise=False))
    >>> spread.at([20.0]).level
    0.95
    """

    fir_length: int | None = Field(
        default=None,
        ge=1,
        description="taps of the kernel for unmodelled dynamics; default: 150, fewer for short records",
    )
    estimate_offset: bool = Field(default=True, description="a constant on each record's output")
    estimate_initial_state: bool = Field(
        default=True, description="free response of all poles in each record"
    )
    # One half: as likely as not, before the data are asked. Below 1, as odds are formed with it.
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
    # Eight coefficients hold drift, friction and sensor noise together; chosen. The limit of 100 keeps out
    # typing errors.
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
        """Stated settings, with coloured noise where a largest order of it was stated, and it was not.

        What is no mapping comes back as it is, for pydantic to refuse.
        """
        if isinstance(stated, Mapping) and "max_ar_order" in stated:
            return {"coloured_noise": True, **stated}
        return stated

    @property
    def no_remainder(self) -> float:
        """Prior probability that the poles explain everything.

        0 where the order was given: nothing in the data then says that it is enough. Where the data chose it,
        both cases count alike before the data are asked.
        """
        return 0.0 if self.order_given else 0.5

    feedthrough: bool | None = Field(default=None, description="direct term; default: as in the model")
