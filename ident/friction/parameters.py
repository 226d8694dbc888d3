"""What a fit of friction in a loop may change: the arm, the law of its friction and the observer, by name.

`FrictionParameters` are the numbers of a `FrictionFit` whose arm has each pole once. A descent
(`ident.friction.descent`) sees them as one vector: `pack` makes it, `unpack` reads one, `of` takes the
numbers out of a fit and `onto` puts them into it. A part that a fit does not have is None, and has no place
in the vector.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.linalg import qr

from ident.basis.coordinates import ZETA_LEAST
from ident.basis.functions import basis_response
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.plausible_modes import AT_BOUND
from ident.data.arrays import BoolArray, ComplexArray, RealArray, real_rows
from ident.friction.arm import FrictionLaw, SteppedArm
from ident.friction.gauss_newton import FrictionFit
from ident.friction.observer import correction_of
from ident.friction.spring import Spring

# Shortest lag of a drive that is one, samples: less moves no arm by a hundredth of what it moves in a sample.
LEAST_LAG_SAMPLES = 0.1
# Angles in a sample, rad, from which anchors of the response are chosen: above slow poles, whose moves would
# otherwise take the faster response along, to near the Nyquist frequency; about fifty in a decade.
_ANCHOR_ANGLES = (0.02, 3.0)
# Their number.
_N_ANCHOR_ANGLES = 100
# Parts that a fit may have or not, none of them below zero.
NOT_NEGATIVE = ("stribeck_excess", "drive_lag_samples", "level_at_load")
# Damping ratio at most, whatever the options say: at 1 a pair is two real poles.
_LARGEST_ZETA = 0.99
# Frequency of a pair at most, as a share of the Nyquist frequency, whatever the options say: beyond it a pair
# would be named by its image.
_HIGHEST_SHARE = 0.95
# Decay of a real pole at most, in units of the step: e^-4 of it is left after a sample, 2 %.
_FASTEST_DECAY_PER_STEP = 4.0


@dataclass(frozen=True, eq=False)
class ResponseAnchors:
    """Frequencies at which the response of an arm stands for its coefficients.

    Coefficients change by a tenth with a slow pole that moves by a twentieth of its distance from the circle,
    though the arm hardly does. Numbers of its response stay: steps of a fit are straight in them.

    Attributes
    ----------
    z : ndarray of complex, shape (B,)
        Points on the unit circle; one that stands twice has both of its parts told.
    reference : ndarray of complex, shape (B,)
        What the arm's basis answers there at the start: responses are told relative to it.
    is_imaginary : ndarray of bool, shape (B,)
        The imaginary part is told; otherwise the real one.
    """

    z: ComplexArray
    reference: ComplexArray
    is_imaginary: BoolArray

    @classmethod
    def of(cls, model: GobfModel) -> ResponseAnchors:
        """Anchors of a model with B coefficients: of a grid the B numbers that are told apart best."""
        angle = np.geomspace(*_ANCHOR_ANGLES, _N_ANCHOR_ANGLES)
        z = np.exp(1j * angle)
        basis = basis_response(model.poles, z)
        reference = basis @ model.coefficients
        rows = real_rows(basis / reference[:, None])
        # A column of the transposed matrix is a number; pivots are the most independent ones.
        chosen = qr(rows.T, mode="r", pivoting=True)[1][: model.order]
        place = chosen % angle.size
        return cls(z[place], reference[place], chosen >= angle.size)

    def rows(self, poles: Poles) -> RealArray:
        """Matrix (B, B) from coefficients on poles to the numbers of the response."""
        responses = basis_response(poles, self.z) / self.reference[:, None]
        return np.where(self.is_imaginary[:, None], responses.imag, responses.real)


@dataclass(frozen=True, eq=False)
class FrictionParameters:
    """Numbers of an arm with friction that a fit changes; None: not part of this fit.

    Attributes
    ----------
    responses : ndarray, shape (B,)
        Of the arm at its anchors, relative to those of the start.
    log_decays : ndarray, shape (R,)
        Logarithms of the decay rates of its real poles, 1/s.
    log_frequencies, log_dampings : ndarray, shape (P,) each
        Logarithms of frequency, rad/s, and damping ratio of its pairs.
    log_observer_ratio : float
        Logarithm of `FrictionFit.ratio`.
    bias : float
        Constant force, units of the input.
    coulomb_level : float
        At the shaft, units of the input.
    log_presliding : float
        Logarithm of the deflection before sliding, output units.
    stribeck_excess : float or None
        Of the friction at rest over the level, units of the input.
    log_stribeck_speed : float or None
        Logarithm of the speed over which the excess falls, output units per second.
    drive_lag_samples : float or None
        Of the drive.
    level_at_load : float or None
        Coulomb friction beyond the first spring, units of the input.
    anchors : ResponseAnchors
        Where the responses are told; stays.

    Notes
    -----
    Poles at zero and mirror images of unstable poles are part of the structure and stay.
    """

    anchors: ResponseAnchors
    responses: RealArray
    log_decays: RealArray
    log_frequencies: RealArray
    log_dampings: RealArray
    log_observer_ratio: float
    bias: float
    coulomb_level: float
    log_presliding: float
    stribeck_excess: float | None = None
    log_stribeck_speed: float | None = None
    drive_lag_samples: float | None = None
    level_at_load: float | None = None

    @classmethod
    def of(cls, fit: FrictionFit) -> FrictionParameters:
        """Parameters of a fit whose arm has each pole once, and which has an observer."""
        moving_real, moving_pairs = _moving(fit)
        poles = fit.model.poles
        dt_s = fit.model.dt_s
        decays = -np.log(poles.real[moving_real]) / dt_s
        rates = np.log(poles.pairs[moving_pairs]) / dt_s
        frequencies = np.abs(rates)
        has_stribeck = bool(np.isfinite(fit.law.fall))
        anchors = ResponseAnchors.of(fit.model)
        return cls(
            anchors=anchors,
            responses=anchors.rows(poles) @ fit.model.coefficients,
            log_decays=np.log(decays),
            log_frequencies=np.log(frequencies),
            log_dampings=np.log(-rates.real / frequencies),
            log_observer_ratio=float(np.log(fit.ratio)),
            bias=fit.bias,
            coulomb_level=fit.law.level,
            log_presliding=float(np.log(fit.law.presliding)),
            stribeck_excess=fit.law.excess if has_stribeck else None,
            log_stribeck_speed=float(np.log(fit.law.fall)) if has_stribeck else None,
            drive_lag_samples=fit.lag if fit.lag > 0 else None,
            level_at_load=fit.beyond if fit.spring is not None else None,
        )

    def onto(self, fit: FrictionFit) -> FrictionFit:
        """A fit with these parameters, its observer and its spring made for them.

        Parameters
        ----------
        fit : FrictionFit
            With the structure that the parameters belong to, its arm with each pole once.

        Returns
        -------
        FrictionFit

        Raises
        ------
        ValueError or LinAlgError
            A pole is not inside the unit circle, or no observer follows the arm.
        """
        moving_real, moving_pairs = _moving(fit)
        dt_s = fit.model.dt_s
        real = fit.model.poles.real.copy()
        real[moving_real] = np.exp(-np.exp(self.log_decays) * dt_s)
        zeta = np.exp(self.log_dampings)
        swing = -zeta + 1j * np.sqrt(1 - zeta**2)
        pairs = fit.model.poles.pairs.copy()
        pairs[moving_pairs] = np.exp(np.exp(self.log_frequencies) * swing * dt_s)

        # What depends on the arm is made anew where the arm has changed: most steps of a derivative are of
        # other parameters.
        arm = fit.arm
        same_poles = np.array_equal(real, fit.model.poles.real) and np.array_equal(
            pairs, fit.model.poles.pairs
        )
        if not same_poles:
            arm = SteppedArm.of(Poles(real, pairs), fit.arm.structure, dt_s, doubled=False)
        coefficients = np.asarray(np.linalg.solve(self.anchors.rows(arm.poles), self.responses))
        same_arm = same_poles and np.array_equal(coefficients, fit.model.coefficients)
        model = fit.model
        spring = fit.spring
        if not same_arm:
            model = replace(fit.model, poles=arm.poles, coefficients=coefficients)
            if spring is not None:
                spring = Spring.of(model) or spring
        ratio = fit.ratio
        correction = fit.correction
        if not same_arm or self.log_observer_ratio != np.log(fit.ratio):
            ratio = float(np.exp(self.log_observer_ratio))
            correction = correction_of(arm, coefficients, ratio)

        law = FrictionLaw(self.coulomb_level, float(np.exp(self.log_presliding)))
        if self.stribeck_excess is not None and self.log_stribeck_speed is not None:
            fall = float(np.exp(self.log_stribeck_speed))
            law = replace(law, excess=self.stribeck_excess, fall=fall)
        return replace(
            fit,
            model=model,
            arm=arm,
            coefficients=coefficients,
            law=law,
            spring=spring,
            correction=correction,
            ratio=ratio,
            bias=self.bias,
            beyond=0.0 if self.level_at_load is None else self.level_at_load,
            lag=0.0 if self.drive_lag_samples is None else self.drive_lag_samples,
        )

    @property
    def names(self) -> list[str]:
        """Name of the part that each place of the vector belongs to."""
        names = []
        for part in fields(self):
            value = getattr(self, part.name)
            if value is not None and part.name != "anchors":
                names += [part.name] * np.size(value)
        return names

    def pack(self) -> RealArray:
        """The vector (N,) of all parameters, in the order of the fields."""
        values = []
        for part in fields(self):
            value = getattr(self, part.name)
            if value is not None and part.name != "anchors":
                values.append(np.atleast_1d(value))
        return np.concatenate(values)

    def unpack(self, vector: RealArray) -> FrictionParameters:
        """Parameters of the same structure with the numbers of a vector (N,) that `pack` could have made."""
        values: dict[str, RealArray | float | None] = {}
        place = 0
        for part in fields(self):
            value = getattr(self, part.name)
            if isinstance(value, np.ndarray):
                values[part.name] = vector[place : place + value.size]
                place += value.size
            elif value is not None and part.name != "anchors":
                values[part.name] = float(vector[place])
                place += 1
        return replace(self, **values)  # type: ignore[arg-type]

    def limits(
        self,
        options: IdentOptions,
        *,
        least_level: float,
        largest_ratio: float,
        largest_fall: float,
        dt_s: float,
    ) -> tuple[RealArray, RealArray]:
        """Smallest and largest values (N,) of all parameters.

        Parameters
        ----------
        options : IdentOptions
            With what is stated of the arm's poles.
        least_level : float
            Which the level at the shaft stays above, units of the input: only then its logarithm and shares
            of it are numbers.
        largest_ratio : float
            Of force to noise of the position that means anything (`FrictionFit.ratio`).
        largest_fall : float
            Stribeck speed above which the excess is no longer told from the level, output units per second.
        dt_s : float
            Step of the records, s.

        Returns
        -------
        tuple of ndarray, shape (N,) each
            Infinite where there is no limit. A parameter that begins outside is the limit itself.
        """
        vector = self.pack()
        names = np.array(self.names)
        lowest = np.full(vector.size, -np.inf)
        highest = np.full(vector.size, np.inf)
        lowest[names == "coulomb_level"] = least_level
        lowest[np.isin(names, NOT_NEGATIVE)] = 0.0
        highest[names == "log_observer_ratio"] = np.log(largest_ratio)
        highest[names == "log_stribeck_speed"] = np.log(largest_fall)

        def bounded(name: str, least: float | None, most: float | None, end: float) -> None:
            """Limits of logarithms between what is stated (None: nothing) and an end that always holds."""
            if least:
                lowest[names == name] = np.log(least)
            highest[names == name] = np.log(end if most is None else min(most, end))

        bounded(
            "log_decays", options.decay_min_per_s, options.decay_max_per_s, _FASTEST_DECAY_PER_STEP / dt_s
        )
        nyquist = np.pi / dt_s
        bounded("log_frequencies", options.omega_min_rad_s, options.omega_max_rad_s, _HIGHEST_SHARE * nyquist)
        bounded("log_dampings", options.zeta_min or ZETA_LEAST, options.zeta_max, _LARGEST_ZETA)
        return np.minimum(lowest, vector), np.maximum(highest, vector)


def has_least_damping(zeta: RealArray, options: IdentOptions) -> BoolArray:
    """Which damping ratios (P,) are the least that a pair may have, where neither it nor the number of pairs
    was stated: such a pair follows a line in a disturbance, such as a drive's cogging, and is no mode."""
    if options.zeta_min is not None or options.n_pairs is not None:
        return np.zeros(zeta.shape, np.bool_)
    return np.asarray(zeta <= ZETA_LEAST * AT_BOUND)


def _moving(fit: FrictionFit) -> tuple[BoolArray, BoolArray]:
    """Masks (R,) and (P,) of the real poles and pairs of a fit that may move: no delays, no mirror images."""
    images = fit.arm.structure.unstable.values
    real = [bool(pole > 0 and not np.any(images == pole)) for pole in fit.model.poles.real]
    pairs = [not np.any(images == pole) for pole in fit.model.poles.pairs]
    return np.array(real, np.bool_), np.array(pairs, np.bool_)
