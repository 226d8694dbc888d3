"""A look in matplotlib's words as one of SVG: dashes, markers, colours."""

from __future__ import annotations

from typing import Any

import numpy as np

from workflow.figures.description import Area, Curve, Look, Mark, Rule, Span

# Dashes and gaps in widths of the line, as of matplotlib.
_DASHES: dict[str, tuple[float, ...]] = {"--": (3.7, 1.6), "-.": (6.4, 1.6, 1.0, 1.6), ":": (1.0, 1.65)}
# Width of a line whose look says nothing of it [pt], as of matplotlib.
_LINE_WIDTH = 1.5
# Size of a marker whose look says nothing of it [pt], as of matplotlib.
_MARKER_SIZE = 6.0
# Colours that drawings call by name.
_NAMED_COLOURS = {"white": "#fff", "black": "#000"}
# Ratio of the inner to the outer radius of a five-pointed star.
_STAR = 0.381966
# Markers that are lines and have no inside.
_OPEN = ("x", "|", "_")


def colour_of(look: Look) -> str:
    """The colour of a line, or of the inside of an area."""
    return _hex(look.get("color", look.get("facecolor", "#000")))


def is_line(look: Look) -> bool:
    """Whether points are joined."""
    return str(look.get("ls", "-")) not in ("none", "None", "")


def stroke(look: Look) -> str:
    """Declarations of a line's look."""
    width = float(look.get("lw", _LINE_WIDTH))
    declarations = [f"fill:none;stroke:{colour_of(look)};stroke-width:{width:g}"]
    dashes = look.get("ls", "-")
    pattern = dashes[1] if isinstance(dashes, tuple) else _DASHES.get(str(dashes), ())
    if pattern:
        # Patterns are in widths of the line.
        lengths = [f"{width * part:.3g}" for part in pattern]
        declarations.append("stroke-dasharray:" + " ".join(lengths))
    elif look.get("solid_capstyle") != "butt":
        declarations.append("stroke-linecap:square")
    return ";".join(declarations + _opacity(look))


def filling(look: Look) -> str:
    """Declarations of an area's look."""
    declarations = [f"fill:{colour_of(look)}"]
    width = float(look.get("lw", 1.0))
    edge = look.get("edgecolor", look.get("color"))
    if width > 0 and edge:
        declarations.append(f"stroke:{_hex(edge)};stroke-width:{width:g}")
    return ";".join(declarations + _opacity(look))


def marker(look: Look) -> tuple[str, str]:
    """Declarations of a marker's look, and its outline around the origin, y down."""
    kind = str(look["marker"])
    size = float(look.get("ms", _MARKER_SIZE))
    edge = _hex(look.get("mec", colour_of(look)))
    face = "none" if kind in _OPEN else _hex(look.get("mfc", colour_of(look)))
    width = float(look.get("mew", 1.0))
    declarations = [f"fill:{face}"]
    if width > 0:
        declarations.append(f"stroke:{edge};stroke-width:{width:g}")
    return ";".join(declarations + _opacity(look)), _outline(kind, size / 2)


def key(mark: Mark) -> tuple[Any, ...]:
    """What a mark looks like: in this house the same thing looks the same in every panel."""
    if isinstance(mark, Area | Span):
        return "area", colour_of(mark.look), mark.look.get("alpha")
    if isinstance(mark, Curve | Rule):
        look = mark.look
        return "line", colour_of(look), str(look.get("ls")), look.get("marker"), look.get("mfc")
    return ("words",)


def _hex(colour: Any) -> str:
    return _NAMED_COLOURS.get(str(colour), str(colour))


def _opacity(look: Look) -> list[str]:
    alpha = float(look.get("alpha", 1.0))
    return [f"opacity:{alpha:.3g}"] if alpha < 1 else []


def _outline(kind: str, radius: float) -> str:
    """A path around the origin; matplotlib's names and sizes of markers."""
    if kind in ("o", "."):
        radius = radius if kind == "o" else radius / 2
        return f"M{radius:g} 0A{radius:g} {radius:g} 0 1 1 {radius:g} -.001z"
    if kind == "*":
        # Ten corners from the top, every second one nearer to the middle.
        number = np.arange(10)
        turn = -np.pi / 2 + np.pi / 5 * number
        radii = np.where(number % 2, _STAR, 1.0)
        corners = radii * np.exp(1j * turn)
    elif kind == "P":
        # A cross of five squares: an arm's three outer edges, turned to all four sides.
        arm = np.array([-1 / 3 - 1j, 1 / 3 - 1j, 1 / 3 - 1j / 3])
        corners = np.concatenate([arm * 1j**turns for turns in range(4)])
    else:
        corners = {
            "s": np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j]),
            "D": np.sqrt(2) * np.array([1, 1j, -1, -1j]),
            "^": np.array([-1j, 1 + 1j, -1 + 1j]),
            "v": np.array([1j, 1 - 1j, -1 - 1j]),
            "x": np.array([-1 - 1j, 1 + 1j, -1 + 1j, 1 - 1j]),
            "|": np.array([-1j, 1j]),
            "_": np.array([-1, 1]) + 0j,
        }[kind]
    points = [f"{radius * corner.real:.3g} {radius * corner.imag:.3g}" for corner in corners]
    if kind == "x":
        return f"M{points[0]}L{points[1]}M{points[2]}L{points[3]}"
    end = "" if kind in _OPEN else "z"
    return "M" + "L".join(points) + end
