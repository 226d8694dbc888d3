"""One line per method, the same in every figure of the page, in the house colours.

The controller's and the closed loop's colours are free here, since the page has neither: green is OE and
vermilion is what the paper did. Dashes differ too (ARX thin, ARMAX thick, OE dash-dotted, as in the paper),
so that a grey print reads.
"""

from __future__ import annotations

from typing import Any

from workflow.figures import style

PAPER_WAY = style.ACHIEVED
OUR_WAY = style.MODEL

METHOD_LINES: dict[str, dict[str, Any]] = {
    "GOBF": {"color": style.MODEL, "lw": 1.6},
    "ARX": {"color": style.HIGHLIGHT, "lw": 1.2, "ls": (0, (3, 2))},
    "ARMAX": {"color": style.LIMIT, "lw": 2.0, "ls": (0, (6, 3))},
    "OE": {"color": style.PREDICTED, "lw": 1.6, "ls": (0, (6, 2, 1.5, 2))},
}
TRUTH_LINE: dict[str, Any] = {"color": style.REFERENCE, "lw": 3.0, "alpha": 0.35}
RECIPE_LINE: dict[str, Any] = {"color": PAPER_WAY, "lw": 1.2, "ls": (0, (2, 2))}
