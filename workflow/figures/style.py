"""The house style: one colour per meaning, units on every axis.

Colours are from the Okabe-Ito palette (told apart with every common colour-vision deficiency) and every
meaning has a line style of its own as well, so a grey print still reads.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np

from workflow.figures.description import Panel, Picture, Real

# What sensors said.
MEASURED = "#6b6b6b"
# Identified model, open loop.
MODEL = "#0072B2"
# Ellipses and the bands made of them.
UNCERTAIN = "#56B4E9"
# Controller, and the loop as computed from the model.
PREDICTED = "#009E73"
# The loop as it ran on the machine.
ACHIEVED = "#D55E00"
# What was asked for.
REFERENCE = "#111111"
# Specification and hard limits.
LIMIT = "#8B2E7F"
# The one point the sentence below the picture speaks of.
HIGHLIGHT = "#E69F00"
# Records by their role.
SHADE = {"estimation": "#0072B2", "validation": "#E69F00", "repeat": "#6b6b6b"}

# A measured signal.
MEASURED_LINE: dict[str, Any] = {"color": MEASURED, "lw": 0.9}
# The identified model.
MODEL_LINE: dict[str, Any] = {"color": MODEL, "lw": 1.4}
# The computed loop.
PREDICTED_LINE: dict[str, Any] = {"color": PREDICTED, "lw": 1.5}
# The loop that ran.
ACHIEVED_LINE: dict[str, Any] = {"color": ACHIEVED, "lw": 1.1}
# A reference, or a level.
REFERENCE_LINE: dict[str, Any] = {"color": REFERENCE, "lw": 1.0, "ls": (0, (4, 2))}
# A limit.
LIMIT_LINE: dict[str, Any] = {"color": LIMIT, "lw": 1.3, "ls": (0, (6, 2, 1.5, 2))}
# A reference that is held from sample to sample.
REFERENCE_STEPS: dict[str, Any] = REFERENCE_LINE | {"drawstyle": "steps-post"}
# A band of the uncertainty.
BAND: dict[str, Any] = {"color": UNCERTAIN, "alpha": 0.42, "lw": 0}
# All runs on a machine.
ACHIEVED_BAND: dict[str, Any] = {"color": ACHIEVED, "alpha": 0.22, "lw": 0}
# A single point that matters.
STAR: dict[str, Any] = {"ls": "none", "marker": "*", "mfc": HIGHLIGHT, "mec": "black"}

Drawing = Callable[..., Picture | None]
D = TypeVar("D", bound=Drawing)


def plain(text: object, longest: int = 60) -> str:
    """Somebody else's text as it may safely be drawn: on one line, what cannot be printed as a box, and cut
    with an ellipsis where it is longer than `longest`."""
    one_line = " ".join(str(text).split())
    if len(one_line) > longest:
        one_line = one_line[: longest - 1] + "\u2026"
    return "".join(letter if letter.isprintable() else "\u25a1" for letter in one_line)


def two_lines(name: object, unit: str) -> str:
    """Axis label `name`, `[unit]`; a unit nobody stated is said to be as logged, never guessed."""
    return f"{plain(name, 18)}\n[{plain(unit, 16) if unit else 'as logged'}]"


def ratio_unit(output_unit: str, input_unit: str) -> str:
    """Unit of a gain."""
    return f"{output_unit or '?'} / {input_unit or '?'}" if output_unit or input_unit else "as logged"


# Drawings by the module that makes them. A page loads those it draws with and no other: the drawings of a run
# need the whole design, those of one log next to nothing.
_DRAWINGS_OF: dict[str, tuple[str, ...]] = {
    "workflow.excite.drawing": ("excitation",),
    "workflow.figures.bode": ("bode", "response", "bode-loop", "distortion"),
    "workflow.figures.closed_loop": (
        "closed-loop",
        "measured-sensitivity",
        "closed-loop-conditions",
        "friction-in-the-loop",
    ),
    "workflow.figures.gap_answer": (
        *("gap_probabilities", "gap_waterfall", "gap_partial"),
        *("gap_overview", "gap_next", "gap_controller"),
    ),
    "workflow.figures.gap_records": ("gap_measured", "gap_traces", "gap_spectra"),
    "workflow.figures.gap_where": ("gap_bands", "gap_regimes", "gap_dependences"),
    "workflow.joints.pictures": (
        *("joint-steps", "matrix-response", "singular-values"),
        *("joint-requirements", "joint-validation", "mode-shapes"),
    ),
    "workflow.figures.nyquist": ("nyquist",),
    "workflow.figures.overview": ("overview",),
    "workflow.figures.pole_search": ("error-surface", "order"),
    "workflow.figures.poles": ("poles",),
    "workflow.figures.records": ("records",),
    "workflow.figures.sensitivity": ("sensitivities",),
    "workflow.figures.validation": ("validation", "residuals", "repeats"),
    "workflow.look.drawing": ("log",),
    "workflow.study.page": ("pareto",),
}
# The module of each drawing: the table above, the other way round.
_MODULE_OF = {name: module for module, names in _DRAWINGS_OF.items() for name in names}
# Drawings of the modules that are loaded.
_LOADED: dict[str, Drawing] = {}


def drawing(name: str) -> Callable[[D], D]:
    """Name of a drawing, by which a template asks for it: `figure("nyquist", run)`.

    It takes typed results; None means there is nothing to draw. Raises ValueError for a name that is not
    listed above under its module.
    """

    def register(draw: D) -> D:
        if draw.__module__ != _MODULE_OF.get(name):
            raise ValueError(f"_DRAWINGS_OF has no {name!r} of {draw.__module__}: list it there")
        _LOADED[name] = draw
        return draw

    return register


class _Drawings(Mapping[str, Drawing]):
    """Every drawing by its name; its module is loaded when it is asked for."""

    def __getitem__(self, name: str) -> Drawing:
        importlib.import_module(_MODULE_OF[name])
        return _LOADED[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULE_OF)

    def __len__(self) -> int:
        return len(_MODULE_OF)


def drawings() -> Mapping[str, Drawing]:
    """Every drawing by its name. KeyError: none is called so."""
    return _Drawings()


def tag_below(panel: Panel, x: float, text: str) -> None:
    """A dotted vertical line at data position x, with a small word at its foot, inside the panel."""
    panel.axvline(x, color="#888888", lw=0.8, ls=":")
    panel.words(plain(text, 20), x, 0.02, across_y=True, offset=(2.0, 1.0), clipped=True)


def decibels(gain: Any) -> Real:
    """20 log10 of gains above 0."""
    return np.asarray(20 * np.log10(np.maximum(gain, 1e-300)))
