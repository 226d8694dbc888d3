"""What a long computation tells whoever watches it; no terminal is involved here."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial


class Progress:
    """Called by whatever takes long; every method returns at once and must not raise. Here nobody watches."""

    def plan(self, stages: Sequence[tuple[str, float]]) -> None:
        """Names of the stages to come with the seconds each is expected to take."""

    def note(self, line: str) -> None:
        """Said at once."""

    def start(self, stage: str) -> None:
        """A stage begins."""

    def update(self, stage: str, fraction: float, message: str = "") -> None:
        """The running stage has done this share of its work, 0 to 1."""

    def finish(self, stage: str, seconds: float, *, taken_up: bool) -> None:
        """A stage is done; `taken_up` means its result was there from an earlier run."""

    @contextmanager
    def stage(self, name: str, *, taken_up: bool = False) -> Iterator[Callable[..., None]]:
        """A stage from start to finish, which is not told where it fails; gives its `update`."""
        started = time.monotonic()
        self.start(name)
        yield partial(self.update, name)
        self.finish(name, time.monotonic() - started, taken_up=taken_up)
