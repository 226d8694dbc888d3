"""A specification with keys that a user typed in place of those of an earlier run or of a draft."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from control_design.specification import GIVES_WAY
from workflow.config.run_config import AnyConfig, RunConfig
from workflow.config.settings import check
from workflow.engine.errors import InputError


def with_typed(specification: Mapping[str, Any], typed: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of [specification] with typed ones in their place, hard where no limit is typed beside them.

    Parameters
    ----------
    specification : mapping of str to value
        As it is stated, JSON-able.
    typed : mapping of str to value
        Keys of `Specification`; not checked here. None: the key is left out.

    Returns
    -------
    dict
        A copy in the same order, new keys at the end. A typed value takes along what the key may give way to
        (`GIVES_WAY`): who types one value means that value.
    """
    changed = {key: value for key, value in {**specification, **typed}.items() if value is not None}
    # What only shapes a requirement goes with it.
    if "effort_limit" not in changed:
        changed.pop("effort_rolloff_rad_s", None)
    if "mode_peak_ratio" not in changed and "mode_damping" not in changed:
        changed.pop("mode_band_rad_s", None)
    for key, limit in GIVES_WAY.items():
        if key in typed and limit not in typed:
            changed.pop(limit, None)
    return changed


def config_with_typed(config: AnyConfig, typed: Mapping[str, Any], source: str) -> AnyConfig:
    """The configuration with typed keys of [specification].

    Parameters
    ----------
    config : AnyConfig
    typed : mapping of str to value
    source : str
        What a complaint begins with.

    Returns
    -------
    AnyConfig
        The one given where nothing is typed.

    Raises
    ------
    InputError
        The keys do not fit together, or the run is of several joints, each of which has a specification.
    """
    if not typed:
        return config
    if not isinstance(config, RunConfig):
        raise InputError(
            f"{source}: several joints: write the change into a copy of its config.toml, --config"
        )
    document = config.to_document()
    document["specification"] = with_typed(document["specification"], typed)
    return check(type(config), document, source=source, context={"may_be_gone": True})
