"""A small made-up arm as the typed objects a run leaves behind, for tests of pictures and page."""

from __future__ import annotations

import numpy as np

from ident.model import GobfModel
from ident.poles import Poles
from ident.record import Record
from ident.uncertainty import ResponsePosterior

DT_S = 0.01


def model(output: str = "hub_angle_rad", *, integrators: int = 1) -> GobfModel:
    """A hub with one real pole and two lightly damped modes."""
    poles = Poles.from_continuous(decay_per_s=[6.0], omega_rad_s=[14.0, 62.0], zeta=[0.02, 0.015], dt_s=DT_S)
    coefficients = np.array([0.02, 0.004, -0.006, 0.003, 0.002])
    return GobfModel(
        poles, coefficients, DT_S, integrators=integrators, input_name="voltage_V", output_name=output
    )


def posterior(of: GobfModel, relative: float = 0.03) -> ResponsePosterior:
    """Independent coefficient errors of this relative size on the doubled basis."""
    doubled = of.poles.doubled()
    mean = np.zeros(doubled.order)
    n_real = of.poles.real.size
    mean[:n_real] = 0.0
    # A doubled basis orders real poles twice, then every pair twice; the first copy of each spans the model
    # only together with what stands before it, so the mean is taken by projection on the circle.
    omega = np.linspace(0.5, np.pi / DT_S, 600)
    from ident.basis import basis_response

    z = np.exp(1j * omega * DT_S)
    rows, wanted = basis_response(doubled, z), basis_response(of.poles, z) @ of.coefficients
    mean = np.linalg.lstsq(
        np.vstack([rows.real, rows.imag]), np.concatenate([wanted.real, wanted.imag]), rcond=None
    )[0]
    factor = np.diag(np.full(mean.size, relative * np.abs(of.coefficients).max()))
    return ResponsePosterior(
        poles=doubled,
        mean=mean,
        covariance_factor=factor,
        dt_s=DT_S,
        fir_length=0,
        has_feedthrough=False,
        integrators=of.integrators,
        input_delay_samples=0,
        input_name=of.input_name,
        output_name=of.output_name,
    )


def record(
    of: list[GobfModel],
    name: str,
    seed: int,
    *,
    samples: int = 900,
    units: bool = True,
    input_name: str = "voltage_V",
) -> Record:
    """Square-wave excitation, outputs of the models with a little white noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 12 + 1), 12)[:samples] * 2.0
    y = np.column_stack([m.simulate(u) for m in of])
    y = y + 0.02 * y.std(axis=0) * rng.standard_normal(y.shape)
    return Record(
        name=name,
        input=u[:, None],
        output=y,
        dt_s=DT_S,
        input_names=(input_name,),
        output_names=tuple(m.output_name for m in of),
        input_units=("V",) if units else (),
        output_units=tuple("rad" if "rad" in m.output_name else "m" for m in of) if units else (),
    )
