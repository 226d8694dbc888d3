"""What a loop of several joints has to do: one `Specification` per joint, and the controller's structure."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from control_design.plants.ellipses import Boolean, Complex, Real
from control_design.plants.weights import RationalWeight
from control_design.specification.requirement import constant_weight
from control_design.specification.specification import Specification, SpecificationError
from ident.data.settings import Settings

_READ = {
    "bandwidth_rad_s", "integrator", "low_frequency_rejection", "modulus_margin", "effort_limit",
    "effort_rolloff_rad_s", "input_limit", "rate_limit", "sensitivity_weight", "effort_weight",
    "computational_delay_samples",
}  # fmt: skip


class MultivariableSpecification(Settings):
    """joints[i] says what is asked of output i (bandwidth, modulus margin, integrator) and of actuator i
    (effort, limits); with more outputs than actuators, or fewer, the longer of the two counts.

    The weighted sensitivity is W1 S with W1 = diag of the joints' tracking weights, the effort W3 K S alike,
    the modulus m S with m = diag of the modulus margins: each in the largest singular value, by itself.
    Keys of a joint that no matrix design reads are refused.
    """

    joints: tuple[Specification, ...] = Field(min_length=1, description="one specification per joint")
    structure: Literal["full", "decentralised"] | tuple[tuple[bool, ...], ...] = Field(
        default="full", description="which entries of K (actuators x sensors) may differ from zero"
    )
    controller_order: int = Field(default=6, ge=0, le=40, description="number of controller states")
    controller_damping: float = Field(
        default=0.02, gt=0, le=1, description="smallest damping ratio of the controller's own pole pairs"
    )

    @model_validator(mode="after")
    def _read_keys_only(self) -> MultivariableSpecification:
        for number, joint in enumerate(self.joints):
            left = sorted(joint.model_fields_set - _READ)
            if left:
                raise ValueError(f"joints[{number}]: {left[0]} is not part of a design for several joints")
        if len({joint.computational_delay_samples for joint in self.joints}) > 1:
            raise ValueError("computational_delay_samples must be the same for all joints")
        return self

    @property
    def computational_delay_samples(self) -> int:
        return self.joints[0].computational_delay_samples

    def pattern(self, inputs: int, outputs: int) -> Boolean:
        """Entries of K that may differ from zero, (U, Y)."""
        if len(self.joints) != max(inputs, outputs):
            raise SpecificationError(
                f"{max(inputs, outputs)} joints needed for {inputs} inputs and {outputs} outputs; "
                f"got {len(self.joints)}"
            )
        if self.structure == "full":
            return np.ones((inputs, outputs), dtype=bool)
        if self.structure == "decentralised":
            if inputs != outputs:
                raise SpecificationError(
                    f"decentralised needs as many inputs as outputs; got {inputs}, {outputs}"
                )
            return np.eye(inputs, dtype=bool)
        found = np.array(self.structure, dtype=bool)
        if found.shape != (inputs, outputs) or not found.any():
            raise SpecificationError(
                f"structure must be ({inputs}, {outputs}) and not empty; got {found.shape}"
            )
        return found

    def weights(self, inputs: int, outputs: int) -> dict[str, tuple[str, tuple[RationalWeight | None, ...]]]:
        """By requirement: "y" (on S) or "u" (on K S) and a weight per channel (None: not asked)."""
        joints = self.joints
        found: dict[str, tuple[str, tuple[RationalWeight | None, ...]]] = {
            "tracking": ("y", tuple(joint.tracking_weight() for joint in joints[:outputs])),
            "effort": ("u", tuple(joint.limit_weight() for joint in joints[:inputs])),
            "modulus": ("y", tuple(constant_weight(joint.modulus_margin) for joint in joints[:outputs])),
        }
        return {name: each for name, each in found.items() if any(w is not None for w in each[1])}

    def limits(self, inputs: int) -> tuple[tuple[float | None, ...], tuple[float | None, ...]]:
        """Input and rate limit of every actuator."""
        used = self.joints[:inputs]
        return tuple(joint.input_limit for joint in used), tuple(joint.rate_limit for joint in used)


def gram(weights: tuple[RationalWeight | None, ...], s: Complex) -> Real:
    """W^H W (F, n, n) of a diagonal weight at complex s (F,)."""
    sizes = [np.zeros(s.size) if w is None else np.abs(w.at(s)) ** 2 for w in weights]
    return np.asarray(np.stack(sizes, axis=-1)[..., None] * np.eye(len(weights)))
