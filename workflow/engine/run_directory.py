"""One run = one directory, written stage by stage, resumable after a kill at any point.

    config.toml      the user's file, byte for byte
    config.json      the same with every default filled in; this is what a resumed run is compared with
    manifest.json    versions, seed, SHA-256 of config and of every input file, timings, status
    stages/<name>.npz | .json
    figures/
    report.html
    controller.json .c .h     and those of the reference filter, where there is one

A stage is done when its file is there and the input hash recorded *inside* it equals the hash of what the
stage would be given now (its share of the configuration, its input files, the content of the stages before
it). File and hash appear in one rename, so there is no instant at which one is there without the other.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from platform import python_version
from typing import Any, TypeVar

import numpy as np

from workflow.engine import codec, storage
from workflow.engine.errors import InputError, naming

LAYOUT_VERSION = 3  # 3: results by codec
T = TypeVar("T")
_INPUT_HASH = "_input_hash"
_RESULT = "result"
_PACKAGES = ("flexlink", "numpy", "scipy", "control", "casadi", "nlopt", "numba", "pydantic", "matplotlib")


# The manifest goes first when a run is deleted: what is left by a kill in between is then no run any more.
CONTROLLER_FILES = tuple(
    f"controller{of}{suffix}" for of in ("", "_reference_filter") for suffix in (".json", ".c", ".h")
)
_OWN_ENTRIES = (
    "manifest.json",
    "config.toml",
    "config.json",
    "stages",
    "figures",
    "report.html",
    *CONTROLLER_FILES,
    "lock",
)


@dataclass(frozen=True)
class RunDirectory:
    """A run's files. Make one with `begin` (to write) or `open` (to read)."""

    path: Path

    # -- opening ---------------------------------------------------------------------------------------------

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """An existing run, for reading. Raises InputError when `path` holds no run."""
        run = cls(Path(path))
        if not run.path.is_dir():
            raise InputError(f"{path}: no such run directory")
        if not run.manifest_path.is_file():
            raise InputError(f"{path}: not a run directory (manifest.json is missing)")
        if run.manifest().get("layout") != LAYOUT_VERSION:
            raise InputError(f"{path}: written by another version of flexlink; start a new run")
        return run

    @classmethod
    def check_free(cls, path: Path, *, resume: bool = False, replace: bool = False) -> None:
        """Refuse, before any work is done, a place where the run could not be written; nothing is left there.

        Raises InputError: not writable, not a directory, not empty with neither `resume` nor `replace`, or
        holding something that is no run (which is never replaced).
        """
        path = Path(path)
        try:
            ancestor = path.absolute()
            while not ancestor.exists():
                ancestor = ancestor.parent
            if not ancestor.is_dir():
                raise InputError(f"cannot write {path}: {ancestor} is not a directory")
            # Permission bits do not tell of read-only file systems, nor bind the administrator: try.
            trial = ancestor / f".flexlink.{os.getpid()}{storage.TEMPORARY_SUFFIX}"
            trial.mkdir()
            trial.rmdir()
            entries = {entry.name for entry in path.iterdir()} if path.is_dir() else set()
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror or error}") from error
        entries = {name for name in entries if not name.endswith(storage.TEMPORARY_SUFFIX)}
        strangers = sorted(entries - set(_OWN_ENTRIES))
        if strangers and "manifest.json" not in entries:
            what = "not a run directory" if resume or replace else "not empty"
            raise InputError(f"{path}: {what} (it holds {strangers[0]!r}); choose another --out")
        if entries and not (resume or replace):
            raise InputError(
                f"{path}: not empty, an earlier run is there; choose another --out, continue it with "
                "--resume or start it afresh with --replace"
            )

    @classmethod
    def begin(
        cls,
        path: Path,
        *,
        config_text: str,
        config: Mapping[str, Any],
        seed: int,
        inputs: Mapping[str, str],
        resume: bool = False,
        replace: bool = False,
    ) -> RunDirectory:
        """Create the directory, or with `resume` take up the run that is there, or with `replace` start it
        afresh.

        `config` is the resolved configuration (JSON-able), `inputs` maps every input file as the user named
        it to its SHA-256. Raises InputError: see `check_free`; on resuming also a changed configuration
        (naming the key) or a changed input file (naming the file).
        """
        path = Path(path)
        cls.check_free(path, resume=resume, replace=replace)
        run = cls(path)
        if replace and (path / "lock").is_file():
            with run.locked():  # never under the hands of a living run
                run.discard()
        elif replace:
            run.discard()
        try:
            path.mkdir(parents=True, exist_ok=True)
            run.stages_path.mkdir(exist_ok=True)
            run.figures_path.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"cannot write {path}: {error.strerror or error}") from error
        if run.manifest_path.is_file():
            run._check_same(config, inputs)
            return run
        storage.write_text(path / "config.toml", config_text)
        storage.write_json(path / "config.json", config)
        # The manifest comes last: a directory without it holds nothing worth keeping and is begun afresh.
        storage.write_json(
            run.manifest_path,
            {
                "layout": LAYOUT_VERSION,
                "status": "running",
                "started": _now(),
                "seed": seed,
                "python": python_version(),
                "versions": package_versions(),
                "config_sha256": hash_of(config),
                "inputs": dict(inputs),
                "stages": {},
            },
        )
        return run

    def _check_same(self, config: Mapping[str, Any], inputs: Mapping[str, str]) -> None:
        RunDirectory.open(self.path)
        changed = first_difference(storage.read_json(self.path / "config.json"), _plain(config))
        if changed:
            raise InputError(
                f"{self.path}: cannot resume, the configuration changed at {changed}; choose another --out"
            )
        recorded = self.manifest()["inputs"]
        for name in sorted({*recorded, *inputs}):
            if recorded.get(name) != inputs.get(name):
                raise InputError(
                    f"{self.path}: cannot resume, the input file {name} changed since the run began"
                )

    def locked(self) -> AbstractContextManager[None]:
        """Hold the directory against a second writer."""
        return storage.locked(self.path, "run", self.stages_path, self.figures_path)

    def discard(self) -> None:
        """Delete what flexlink wrote here, and the directory itself if nothing else is in it."""
        if not self.path.is_dir():
            return
        for name in _OWN_ENTRIES:
            entry = self.path / name
            if entry.is_dir():
                shutil.rmtree(entry)
            else:
                entry.unlink(missing_ok=True)
        if not any(self.path.iterdir()):
            self.path.rmdir()

    # -- places ----------------------------------------------------------------------------------------------

    @property
    def stages_path(self) -> Path:
        return self.path / "stages"

    @property
    def figures_path(self) -> Path:
        return self.path / "figures"

    @property
    def report_path(self) -> Path:
        return self.path / "report.html"

    @property
    def manifest_path(self) -> Path:
        return self.path / "manifest.json"

    # -- stages ----------------------------------------------------------------------------------------------

    def stage_file(self, name: str) -> Path | None:
        """The file of a stage, if it is there."""
        for suffix in (".npz", ".json"):
            path = self.stages_path / f"{name}{suffix}"
            if path.is_file():
                return path
        return None

    def stage_digest(self, name: str) -> str:
        """SHA-256 of a finished stage's file: the input hash of the stages after it builds on this."""
        path = self.stage_file(name)
        if path is None:
            raise InputError(f"{self.path}: stage {name} is not there; run flexlink run --resume first")
        return storage.sha256_of_file(path)

    def is_done(self, name: str, input_hash: str) -> bool:
        """True when the stage's file is there and was made from exactly this input."""
        path = self.stage_file(name)
        return path is not None and _recorded_hash(path) == input_hash

    def save_stage(self, name: str, result: Any, input_hash: str) -> Path:
        """Write a stage's result atomically, replacing what was there under either suffix."""
        return self.write_stage(name, *stage_bytes(result, input_hash))

    def write_stage(self, name: str, content: bytes, suffix: str) -> Path:
        """The same from the file's content, which another process made."""
        path = self.stages_path / f"{name}{suffix}"
        storage.write_bytes(path, content)
        (self.stages_path / f"{name}{'.npz' if suffix == '.json' else '.json'}").unlink(missing_ok=True)
        return path

    def load_stage(self, name: str, kind: type[T]) -> T:
        """The result of a finished stage. Raises InputError when it is not there or not readable."""
        path = self.stage_file(name)
        if path is None:
            raise InputError(f"{self.path}: stage {name} is not there; run flexlink run --resume first")
        with naming(str(path)):
            if path.suffix == ".npz":
                return codec.from_arrays(kind, storage.read_npz(path))
            document = json.loads(storage.read_text(path))
            return codec.unpack(kind, document.get(_RESULT), {})

    # -- manifest --------------------------------------------------------------------------------------------

    def manifest(self) -> dict[str, Any]:
        return storage.read_json(self.manifest_path)

    def config_document(self) -> dict[str, Any]:
        """The resolved configuration the run was begun with."""
        return storage.read_json(self.path / "config.json")

    def record_stage(self, name: str, seconds: float, input_hash: str) -> None:
        """Note a finished stage's time in the manifest."""
        manifest = self.manifest()
        manifest["stages"][name] = {
            "seconds": round(seconds, 3),
            "input_sha256": input_hash,
            "finished": _now(),
        }
        storage.write_json(self.manifest_path, manifest)

    def record_status(self, status: str) -> None:
        """`running`, `complete`, `complete, not certified` or `failed: <one line>`."""
        manifest = self.manifest()
        manifest["status"] = status
        manifest["updated"] = _now()
        storage.write_json(self.manifest_path, manifest)


def stage_bytes(result: Any, input_hash: str) -> tuple[bytes, str]:
    """Content and suffix of a stage's file: npz, or JSON for a result without arrays."""
    document, arrays = codec.pack(result)
    if arrays:
        own = {_INPUT_HASH: np.array(input_hash), **codec.to_arrays(result)}
        return storage.npz_bytes(own), ".npz"
    text = json.dumps({_INPUT_HASH: input_hash, _RESULT: document}, indent=1, ensure_ascii=False)
    return (text + "\n").encode("utf-8"), ".json"


def package_versions() -> dict[str, str]:
    """Versions of what the numbers depend on; packages that are not installed as distributions are left
    out."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def hash_of(document: Mapping[str, Any]) -> str:
    """SHA-256 of a JSON-able document, independent of the order of its keys."""
    text = json.dumps(_plain(document), sort_keys=True, ensure_ascii=False)
    return storage.sha256_of_bytes(text.encode("utf-8"))


def first_difference(old: Any, new: Any, where: str = "") -> str | None:
    """Dotted key of the first difference between two JSON-able values with both values, or None."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in [*old, *(key for key in new if key not in old)]:
            inner = f"{where}.{key}" if where else str(key)
            if key not in new:
                return f"{inner} (was {_short(old[key])}, now absent)"
            if key not in old:
                return f"{inner} (was absent, now {_short(new[key])})"
            found = first_difference(old[key], new[key], inner)
            if found:
                return found
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (left, right) in enumerate(zip(old, new, strict=True)):
            found = first_difference(left, right, f"{where}[{index}]")
            if found:
                return found
        return None
    # repr tells 1 from 1.0 and True, and nan from nan is no difference.
    return None if repr(old) == repr(new) else f"{where} (was {_short(old)}, now {_short(new)})"


def _recorded_hash(path: Path) -> str | None:
    try:
        if path.suffix == ".json":
            return str(storage.read_json(path).get(_INPUT_HASH))
        return str(storage.read_npz(path, only=_INPUT_HASH)[_INPUT_HASH])
    except InputError:
        return None  # damaged from outside: treat as not done


def _plain(document: Any) -> Any:
    return storage.encode(document)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def default_directory(name: str, parent: Path = Path("runs")) -> Path:
    """`runs/<name>-<local date and time>`; a number is appended while that is taken."""
    base = parent / f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    candidate, number = base, 1
    while candidate.exists():
        number += 1
        candidate = base.with_name(f"{base.name}-{number}")
    return candidate
