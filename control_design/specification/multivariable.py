"""What a loop of several joints has to do: one `Specification` per joint, and the controller's structure.

A joint is an output and an actuator with the same number. A matrix design reads of it what can be said of one
channel: bandwidth, modulus margin, effort, limits. `weights` makes diagonal weights of them, one per
requirement; `pattern` says which entries of the controller may differ from zero. `gram` is what the worst
case needs of a diagonal weight.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.weights import RationalWeight
from control_design.specification.requirement import constant_weight
from control_design.specification.specification import Specification, SpecificationError
from ident.data.settings import Settings

# Keys of a joint's specification that a matrix design reads; every other key is refused.
_KEYS_OF_A_JOINT = {
    "bandwidth_rad_s",
    "integrator",
    "low_frequency_rejection",
    "modulus_margin",
    "effort_limit",
    "effort_rolloff_rad_s",
    "input_limit",
    "rate_limit",
    "sensitivity_weight",
    "effort_weight",
    "computational_delay_samples",
}


class ChannelWeights(NamedTuple):
    """Diagonal weight of one requirement.

    signal: "y", a weight on S with one entry per output, or "u", on K S with one per actuator. weights: the
    entries W(s), None where nothing is asked of a channel.
    """

    signal: str
    weights: tuple[RationalWeight | None, ...]


class MultivariableSpecification(Settings):
    """Requirements on a loop with several inputs and outputs.

    joints[i] says what is asked of output i (bandwidth, modulus margin, integrator) and of actuator i
    (effort, limits); with more outputs than actuators, or fewer, the longer of the two counts.

    The weighted sensitivity is W1 S with W1 = diag of the joints' tracking weights, the effort W3 K S alike,
    the modulus m S with m = diag of the modulus margins: each in the largest singular value, by itself.
    Keys of a joint that no matrix design reads are refused.

    Examples
    --------
    >>> joint = flexlink.Specification(modulus_margin=0.3, effort_limit=1.0)
    >>> asked = flexlink.MultivariableSpecification(joints=(joint, joint), controller_order=2)
    >>> len(asked.joints)
    2
    """

    joints: tuple[Specification, ...] = Field(min_length=1, description="one specification per joint")
    structure: Literal["full", "decentralised"] | tuple[tuple[bool, ...], ...] = Field(
        default="full", description="which entries of K (actuators x sensors) may differ from zero"
    )
    # Chosen, default and limit: 6 is an integrator and a pair of poles for each of two joints.
    controller_order: int = Field(default=6, ge=0, le=40, description="number of controller states")
    # Chosen: lighter pairs would ring by themselves; as light as a lightly damped arm.
    controller_damping: float = Field(
        default=0.02, gt=0, le=1, description="smallest damping ratio of the controller's own pole pairs"
    )

    @model_validator(mode="after")
    def _only_keys_that_are_read(self) -> MultivariableSpecification:
        """Return self; ValueError for a key that no matrix design reads, or delays that differ."""
        for number, joint in enumerate(self.joints):
            unread = sorted(joint.model_fields_set - _KEYS_OF_A_JOINT)
            if unread:
                raise ValueError(f"joints[{number}]: {unread[0]} is not part of a design for several joints")
        delays = {joint.computational_delay_samples for joint in self.joints}
        if len(delays) > 1:
            raise ValueError("computational_delay_samples must be the same for all joints")
        return self

    @property
    def computational_delay_samples(self) -> int:
        """Samples between measuring and applying the commands, the same for all joints.

        Validation has made sure of both: one joint at least, one delay.
        """
        return self.joints[0].computational_delay_samples

    def pattern(self, inputs: int, outputs: int) -> Boolean:
        """Entries of K that may differ from zero, (U, Y), for U inputs and Y outputs of the plant.

        Raises
        ------
        SpecificationError
            The number of joints is not max(U, Y), or the structure has another shape or no entry.
        """
        n_joints = max(inputs, outputs)
        if len(self.joints) != n_joints:
            raise SpecificationError(
                f"{n_joints} joints needed for {inputs} inputs and {outputs} outputs; got {len(self.joints)}"
            )
        if self.structure == "full":
            return np.ones((inputs, outputs), dtype=bool)
        if self.structure == "decentralised":
            if inputs != outputs:
                raise SpecificationError(
                    f"decentralised needs as many inputs as outputs; got {inputs}, {outputs}"
                )
            return np.eye(inputs, dtype=bool)
        stated = np.array(self.structure, dtype=bool)
        if stated.shape != (inputs, outputs) or not stated.any():
            raise SpecificationError(
                f"structure must be ({inputs}, {outputs}) and not empty; got {stated.shape}"
            )
        return stated

    def weights(self, inputs: int, outputs: int) -> dict[str, ChannelWeights]:
        """Weights of the requirements "tracking", "effort" and "modulus" that are asked of some channel.

        inputs, outputs: numbers U and Y of the plant; joints beyond them are left out.

        W(s) of each channel, s in rad/s. Not checked: the number of joints, which `pattern` refuses; of too
        few the missing channels have no entry.
        """
        # Tracking and modulus margin are about outputs, effort about actuators.
        at_outputs = self.joints[:outputs]
        at_inputs = self.joints[:inputs]
        tracking = tuple(joint.tracking_weight() for joint in at_outputs)
        effort = tuple(joint.limit_weight() for joint in at_inputs)
        modulus = tuple(constant_weight(joint.modulus_margin) for joint in at_outputs)
        by_requirement = {
            "tracking": ChannelWeights("y", tracking),
            "effort": ChannelWeights("u", effort),
            "modulus": ChannelWeights("y", modulus),
        }
        # A requirement that no channel asks for is left out; the modulus margin is always asked.
        asked = {}
        for name, channels in by_requirement.items():
            if any(weight is not None for weight in channels.weights):
                asked[name] = channels
        return asked

    def limits(self, inputs: int) -> tuple[tuple[float | None, ...], tuple[float | None, ...]]:
        """Input limits and rate limits of the U actuators, in input units (per second); None: no limit.

        inputs: U; with fewer joints the missing ones have no entry (`pattern` refuses that).
        """
        at_inputs = self.joints[:inputs]
        input_limits = tuple(joint.input_limit for joint in at_inputs)
        rate_limits = tuple(joint.rate_limit for joint in at_inputs)
        return input_limits, rate_limits


def gram(weights: tuple[RationalWeight | None, ...], s: Complex) -> Real:
    """W^H W (F, n, n) of a diagonal of n weights at complex s (F,); zero where a weight is None.

    s in rad/s. No weight at all is numpy's ValueError; inf at a pole of a weight.
    """
    squares: list[Real] = []
    for weight in weights:
        if weight is None:
            squares.append(np.zeros(s.size))
        else:
            squares.append(np.abs(weight.at(s)) ** 2)
    diagonals = np.stack(squares, axis=-1)
    return np.asarray(diagonals[..., None] * np.eye(len(weights)))
