"""The simulated arm of two joints as a configuration describes it: records at operating points, and the
machine around one of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from ident.data.record import Record
from plant import TwoLinkMachine, multisine, multisine_lines, two_link_arm
from workflow.engine.randomness import stage_rng
from workflow.joints.config import JointsConfig, OperatingPoint, TwoJointSource
from workflow.tasks.simulated_rig import made_one_by_one


def simulated_points(
    config: JointsConfig,
    called: str,
    progress: Callable[[float, str], None] = lambda share, name: None,
) -> list[Record]:
    """The record of every operating point of the simulated arm.

    Parameters
    ----------
    config : JointsConfig
        Its source is the simulated arm of two joints.
    called : str
        What a complaint calls the configuration.
    progress : callable
        Called with the share that is done and the name of the point that is next.

    Raises
    ------
    InputError
        One line that names the point.
    """
    source = config.source
    # Nobody asks where the records are files.
    assert isinstance(source, TwoJointSource)
    make = partial(simulate_point, config, source)
    return made_one_by_one(source.points, make, f"{called}: source.points", progress)


def simulate_point(config: JointsConfig, source: TwoJointSource, point: OperatingPoint) -> Record:
    """The record of an operating point: independent multisines at both motors, from rest."""
    draw = partial(stage_rng, config.run.seed, "records", point.name)
    machine = machine_at(source, point, draw("noise"), coulomb_Nm=source.coulomb_Nm)
    period = source.samples
    rng = draw("excitation")
    lines = multisine_lines(period, source.dt_s, source.band_Hz)
    u = np.column_stack([multisine(lines, period, rms, rng) for rms in source.rms_V])
    return Record(
        u,
        machine.run(u),
        source.dt_s,
        name=point.name,
        input_names=tuple(joint.input for joint in config.joints),
        output_names=tuple(joint.output for joint in config.joints),
        input_units=("V",) * 2,
        output_units=("rad",) * 2,
    )


def machine_at(
    source: TwoJointSource,
    point: OperatingPoint,
    rng: np.random.Generator,
    *,
    coulomb_Nm: tuple[float, float],
    extra_kg: float = 0.0,
) -> TwoLinkMachine:
    """The simulated two-link arm around an operating point.

    coulomb_Nm: dry friction of both joints; extra_kg: payload beyond that of the point; rng: of the noise.
    """
    arm = two_link_arm(point.payload_kg + extra_kg, coulomb_Nm, source.gravity_m_s2)
    return TwoLinkMachine(arm, (point.shoulder_rad, point.elbow_rad), source.dt_s, source.noise_rad, rng)
