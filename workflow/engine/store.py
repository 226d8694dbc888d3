"""A directory that one command fills, and another call continues (--resume) or starts afresh (--replace).

It is known by its manifest, which is written last when it is begun and deleted last when it is replaced: a
directory without one holds nothing worth keeping and is begun afresh, if all in it is ours. Nothing of
anybody else is ever touched.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from workflow.engine import storage
from workflow.engine.errors import InputError, cannot, naming, shortened


@dataclass(frozen=True)
class Store:
    """Files of a command in one directory.

    Attributes
    ----------
    path : Path
    what : str
        What they are called in complaints.
    manifest_name : str
        The file by which the directory is known.
    folders, first_files, own_files : tuples of str
        Names of folders, of files that are there from the beginning, and of all others.
    """

    path: Path

    what: ClassVar[str]
    manifest_name: ClassVar[str]
    folders: ClassVar[tuple[str, ...]] = ()
    first_files: ClassVar[tuple[str, ...]] = ()
    own_files: ClassVar[tuple[str, ...]] = ()

    @property
    def manifest_path(self) -> Path:
        return self.path / self.manifest_name

    def own_entries(self) -> Sequence[str]:
        """Names that are ours here, besides manifest and lock."""
        return (*self.folders, *self.first_files, *self.own_files)

    def held(self) -> set[str]:
        """What is in the directory, leftovers of killed writers and the lock aside. Raises InputError where
        nothing can be written there."""
        with cannot("write", self.path):
            ancestor = self.path.absolute()
            while not os.path.lexists(ancestor):
                ancestor = ancestor.parent
            if not ancestor.is_dir():
                raise InputError(f"cannot write {self.path}: {ancestor} is not a directory")
            storage.try_out(ancestor / "flexlink")
            entries = {entry.name for entry in self.path.iterdir()} if self.path.is_dir() else set()
        return {name for name in entries if not name.endswith(storage.TEMPORARY_SUFFIX) and name != "lock"}

    def refuse_unless_free(self, *, resume: bool = False, replace: bool = False) -> bool:
        """Refuse, before any work is done, a place that cannot be written; nothing is left there.

        Returns whether there is something to continue. Raises InputError: not writable, not a directory, not
        empty with neither `resume` nor `replace`, or holding something else (which is never replaced).
        """
        if resume and replace:
            raise InputError("--resume and --replace contradict each other")
        held = self.held()
        has_manifest = self.manifest_name in held
        strangers = held if has_manifest else held - set(self.own_entries())
        if strangers and not has_manifest:
            what = f"no {self.what} is there" if resume or replace else "not empty"
            raise InputError(f"{self.path}: {what} (it holds {min(strangers)!r}); choose another --out")
        if not has_manifest and not any(any((self.path / name).iterdir()) for name in held & {*self.folders}):
            # Folders of a command that ended before it had begun do not count.
            held -= {*self.folders}
        if held and not (resume or replace):
            raise InputError(
                f"{self.path}: not empty, an earlier {self.what} is there; choose another --out, continue it "
                "with --resume or start it afresh with --replace"
            )
        return has_manifest

    @contextmanager
    def writing(self, *, resume: bool = False, replace: bool = False) -> Iterator[None]:
        """Hold the directory, made where it is absent, from before it is begun or continued: two commands
        never mix in it. Raises InputError: see `refuse_unless_free`; also where another process writes."""
        self.refuse_unless_free(resume=resume, replace=replace)
        existed = self.path.is_dir()
        with naming(f"cannot write {self.path}"):
            self.path.mkdir(parents=True, exist_ok=True)
        with self.locked():
            try:
                yield
            except BaseException:
                if not existed and not self.manifest_path.is_file():
                    with suppress(OSError):
                        self.discard()
                raise

    def begun_with(self) -> Mapping[str, Any]:
        """What a command that continues is held to."""
        return storage.read_json(self.manifest_path)

    def begin(
        self,
        begun_with: Mapping[str, Any],
        first_files: Mapping[str, bytes] | None = None,
        manifest: Mapping[str, Any] | None = None,
        *,
        resume: bool = False,
        replace: bool = False,
    ) -> Self:
        """Make the directory with its first files and, last, its manifest (default: begun_with), JSON-able;
        or with `resume` take up what is there. Hold the lock.

        Raises InputError: see `prepare`; on resuming also what differs from what it was begun with.
        """
        if not self.prepare(resume=resume, replace=replace):
            document = begun_with if manifest is None else manifest
            self.write({**(first_files or {}), self.manifest_name: storage.json_bytes(document)})
            return self
        changed = first_difference(self.begun_with(), begun_with)
        if changed:
            raise InputError(
                f"{self.path}: cannot resume, changed since the {self.what} began: {changed}; choose another "
                "--out or start it afresh with --replace"
            )
        return self

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write files by their names in the directory: all of them or none. Raises InputError."""
        storage.write_together({self.path / name: content for name, content in files.items()})

    def discard_if_empty(self) -> None:
        """Take back what `begin` wrote if nothing was added: a corrected input may come. Hold the lock."""
        empty = {name for name in self.folders if not any((self.path / name).iterdir())}
        if self.held() <= {*empty, *self.first_files, self.manifest_name}:
            self.discard()

    def prepare(self, *, resume: bool = False, replace: bool = False) -> bool:
        """Make the directory and its folders; with `replace` what is there is deleted first (hold the lock).

        Returns whether an earlier one is there now, to be continued. Raises InputError: see
        `refuse_unless_free`.
        """
        has_earlier = self.refuse_unless_free(resume=resume, replace=replace)
        if replace:
            self.clear()
        with cannot("write", self.path):
            for folder in ("", *self.folders):
                (self.path / folder).mkdir(parents=True, exist_ok=True)
        return has_earlier and not replace

    def locked(self) -> AbstractContextManager[None]:
        """Hold the directory against a second writer."""
        return storage.locked(self.path, self.what, *(self.path / folder for folder in self.folders))

    def discard(self) -> None:
        """Delete what is ours, and the directory itself if nothing else is in it (hold the lock)."""
        if not self.path.is_dir():
            return
        self.clear()
        if {entry.name for entry in self.path.iterdir()} <= {"lock"}:
            (self.path / "lock").unlink(missing_ok=True)
            self.path.rmdir()

    def clear(self) -> None:
        """Delete what is ours but the lock."""
        for name in (*self.own_entries(), self.manifest_name):
            entry = self.path / name
            if entry.is_dir():
                shutil.rmtree(entry)
            else:
                entry.unlink(missing_ok=True)


def first_difference(old: Any, new: Any) -> str | None:
    """Dotted key of the first difference between two JSON-able values with both values, or None."""
    before = dict(_leaves(old))
    after = dict(_leaves(new))
    for key in before | after:
        # repr tells 1 from 1.0 and True, and nan from nan is no difference.
        if key not in before or key not in after or repr(before[key]) != repr(after[key]):
            was = shortened(before[key]) if key in before else "absent"
            now = shortened(after[key]) if key in after else "absent"
            return f"{key} (was {was}, now {now})"
    return None


def _leaves(value: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of every plain value in a JSON-able one; what is empty has none."""
    inner: list[tuple[str, Any]] = []
    if isinstance(value, Mapping):
        inner = [(f"{where}.{key}" if where else str(key), item) for key, item in value.items()]
    elif isinstance(value, list):
        inner = [(f"{where}[{index}]", item) for index, item in enumerate(value)]
    else:
        yield where, value
    for name, item in inner:
        yield from _leaves(item, name)
