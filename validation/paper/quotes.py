"""What the paper reports and what it leaves open, as read from `quotes.toml`.

K. Ziaei, D. W. L. Wang, Application of orthonormal basis functions for identification of flexible-link
manipulators, Control Engineering Practice 14 (2006) 99-106.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reported:
    """One figure of the paper: its title here, what the paper says of it, and where."""

    number: int
    title: str
    place: str
    says: str


# What the paper says, figure by figure.
_QUOTES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
# The paper.
SOURCE = " ".join(_QUOTES["source"].split())
# Its figures.
REPORTED = tuple(Reported(**item | {"says": " ".join(item["says"].split())}) for item in _QUOTES["figures"])
# (what the paper does not print, what we chose)
OPEN_CHOICES = tuple((item["missing"], " ".join(item["chosen"].split())) for item in _QUOTES["choices"])
