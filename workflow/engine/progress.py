"""What a long computation tells whoever watches it; no terminal is involved here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol


class Progress(Protocol):
    """Called by the pipeline; every method returns at once and must not raise."""

    def plan(self, stages: Sequence[tuple[str, float]]) -> None:
        """Names of the stages to come with the seconds each is expected to take."""

    def start(self, stage: str) -> None:
        """A stage begins."""

    def update(self, stage: str, fraction: float, message: str = "") -> None:
        """The running stage has done this share of its work, 0 to 1."""

    def finish(self, stage: str, seconds: float, *, taken_up: bool) -> None:
        """A stage is done; `taken_up` means its result was there from an earlier run."""


class Silence:
    """Nobody watches."""

    def plan(self, stages: Sequence[tuple[str, float]]) -> None:
        pass

    def start(self, stage: str) -> None:
        pass

    def update(self, stage: str, fraction: float, message: str = "") -> None:
        pass

    def finish(self, stage: str, seconds: float, *, taken_up: bool) -> None:
        pass
