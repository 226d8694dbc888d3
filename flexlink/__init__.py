"""flexlink from Python: from logs of a flexible-link arm to a certified controller.

    >>> import flexlink
    >>> from numpy.random import default_rng

Every name here is imported when it is first used, so that `import flexlink` itself costs nothing. Results
show in a line or a few what was found; `plot()` draws them, `to_control()` hands them to python-control.

Data        `Record`, `FrfRepeats`, `FrequencyUncertainty`, `band_limited`, `empirical_frf`
Models      `identify`, `identify_frf`, `identify_miso`, `uncertainty`, `GobfModel`, `Poles`, `IdentOptions`,
            `EmbeddingOptions`, `Identification`, `Uncertainty`, `pole_intervals`
Controllers `UncertainPlant`, `Specification`, `RationalWeight`, `synthesise`, `SynthesisOptions`, `certify`,
            `Certificate`, `Controller`, `simulate_loop`, `step_metrics`, `c_source`
Machines    `Rig`, `paper_link`, `effect`, `simulate`, `SampledArm`, `prbs`, `multisine`
Causes      `Case`, `Experiment`, `diagnose`, `Diagnosis`
Pictures    `plot`, `bode`, `compare`
Tables      `table`

`LoopRun`, `Simulation` and `SynthesisResult` are what `simulate_loop`, `simulate` and `synthesise` return.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flexlink.own_packages import find_own_first

if TYPE_CHECKING:
    from flexlink.causes import *
    from flexlink.design import *
    from flexlink.machines import *
    from flexlink.models import *
    from flexlink.pictures import *
    from flexlink.tables import *

_MODULES = {
    "models": (
        "EmbeddingOptions", "FrequencyUncertainty", "FrfRepeats", "GobfModel", "IdentOptions",
        "Identification", "Poles", "Record", "Uncertainty", "band_limited", "empirical_frf", "identify",
        "identify_frf", "identify_miso", "pole_intervals", "uncertainty",
    ),
    "design": (
        "Certificate", "Controller", "LoopRun", "RationalWeight", "Specification", "SynthesisOptions",
        "SynthesisResult", "UncertainPlant", "c_source", "certify", "simulate_loop", "step_metrics",
        "synthesise",
    ),
    "machines": (
        "Rig", "SampledArm", "Simulation", "effect", "multisine", "paper_link", "prbs", "simulate",
    ),
    "causes": (
        "Case", "Diagnosis", "Experiment", "diagnose",
    ),
    "pictures": (
        "bode", "compare", "plot",
    ),
    "tables": (
        "table",
    ),
}  # fmt: skip
_WHERE = {name: module for module, names in _MODULES.items() for name in names}

__all__ = sorted(_WHERE)

find_own_first()


def __getattr__(name: str) -> Any:
    """PEP 562: the module behind a name is imported when the name is first asked for."""
    if name not in _WHERE:
        raise AttributeError(f"module 'flexlink' has no attribute {name!r}")
    value = getattr(import_module(f"flexlink.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
