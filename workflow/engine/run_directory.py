"""One run = one directory, written stage by stage, resumable after a kill at any point.

    config.toml      the user's file, relative paths made absolute, so that a copy of it runs from anywhere
    config.json      what it states, checked, with absolute paths; a resumed run is compared with this
    manifest.json    versions, seed, SHA-256 of config and of every input file, timings, status
    stages/<name>.npz | .json
    figures/
    report.html
    model.json                     the identified response of one loop, with its ellipses
    controller.json .mat .c .h     and those of the reference filter, where there is one

A stage is done when its file is there and the input hash recorded *inside* it equals the hash of what the
stage would be given now (its share of the configuration, its input files, the content of the stages before
it). The file holds a digest of its content as well: one that was changed by anybody else is no result.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from platform import python_version
from typing import Any, Self, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from ident.data.foreign_files import path_as_typed
from workflow.engine import codec, documents, storage
from workflow.engine.code_version import code_digest
from workflow.engine.errors import InputError, naming
from workflow.engine.store import Store

# 9: settling with friction over sizes of the step.
# 10: config.json holds what was stated. Those of earlier layouts hold defaults, too, and do not tell which of
# them were stated: resumed, such a run would give another answer.
LAYOUT_VERSION = 10
T = TypeVar("T")
# Key of the input hash in a stage's file.
_INPUT_HASH = "_input_hash"
# Key of the digest of its content.
_DIGEST = "_sha256"
# Key of the result in a JSON file.
_RESULT = "result"
# Packages whose versions the manifest notes: numbers depend on them.
_PACKAGES = ("flexlink", "numpy", "scipy", "control", "casadi", "nlopt", "numba", "pydantic", "matplotlib")

# Formats in which a run keeps its controller.
CONTROLLER_SUFFIXES = (".json", ".mat", ".c", ".h")
# Files that a run keeps for other programs.
KEPT_FILES = (
    "model.json",
    *(f"controller{of}{suffix}" for of in ("", "_reference_filter") for suffix in CONTROLLER_SUFFIXES),
)


class _StageEntry(BaseModel):
    """What the manifest notes of a finished stage: its time, input hash and date.

    taken_over_from: the run that it was made in, where that is another one.
    """

    seconds: float
    input_sha256: str
    finished: str
    taken_over_from: str | None = None


class _Manifest(BaseModel):
    """manifest.json; what else is in it nobody reads."""

    layout: int
    status: str
    versions: dict[str, str]
    config_sha256: str
    inputs: dict[str, str]
    code_sha256: str = ""
    stages: dict[str, _StageEntry]
    c_code: dict[str, str] = {}


@dataclass(frozen=True)
class RunDirectory(Store):
    """A run's files. Make one with `begin_run` (to write) or `open` (to read)."""

    what = "run"
    manifest_name = "manifest.json"
    folders = ("stages", "figures")
    first_files = ("config.toml", "config.json")
    own_files = ("report.html", *KEPT_FILES)

    # -- opening ---------------------------------------------------------------------------------------------

    @classmethod
    def open(cls, path: Path) -> RunDirectory:
        """An existing run, for reading. Raises InputError when `path` holds no run."""
        run = cls(Path(path))
        if not run.path.is_dir():
            raise InputError(f"{path}: no such run directory")
        if not run.manifest_path.is_file():
            study = "; it is a study: open its study.html, or name a point: points/NUMBER"
            why = study if (run.path / "study.json").is_file() else " (manifest.json is missing)"
            raise InputError(f"{path}: not a run directory{why}")
        if run.manifest().get("layout") != LAYOUT_VERSION:
            raise InputError(f"{path}: written by another version of flexlink; start a new run")
        return run

    def begun_with(self) -> Mapping[str, Any]:
        """Configuration and digests of the input files. Raises InputError: of another version, or damaged."""
        RunDirectory.open(self.path)
        return {"config": self.config_document(), "inputs": self.manifest()["inputs"]}

    def begin_run(
        self,
        *,
        config_text: str,
        config: Mapping[str, Any],
        seed: int,
        inputs: Mapping[str, str],
        resume: bool = False,
        replace: bool = False,
    ) -> Self:
        """Make the directory with configuration and manifest, or take up the run that is there.

        Parameters
        ----------
        config_text : str
            Kept as config.toml.
        config : mapping
            What the configuration states, JSON-able.
        seed : int
        inputs : mapping of str to str
            Every input file as the user named it, with its SHA-256.
        resume, replace : bool
            Take up what is there, or start afresh (`Store.begin`). Hold the lock.

        Raises
        ------
        InputError
            One line, see `Store.begin`.
        """
        manifest = {
            "layout": LAYOUT_VERSION,
            "status": "running",
            "started": _now(),
            "seed": seed,
            "python": python_version(),
            "versions": package_versions(),
            "code_sha256": code_digest(),
            "config_sha256": hash_of(config),
            "inputs": dict(inputs),
            "stages": {},
        }
        first = {"config.toml": config_text.encode(), "config.json": storage.json_bytes(config)}
        begun_with = {"config": config, "inputs": dict(inputs)}
        return self.begin(begun_with, first, manifest, resume=resume, replace=replace)

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

    # -- stages ----------------------------------------------------------------------------------------------

    def stage_file(self, name: str) -> Path | None:
        """The file of a stage, if it is there."""
        for suffix in (".npz", ".json"):
            path = self.stages_path / f"{name}{suffix}"
            if path.is_file():
                return path
        return None

    def _finished(self, name: str) -> Path:
        path = self.stage_file(name)
        if path is None:
            raise InputError(f"{self.path}: stage {name} is not there; type: {_resumed(self.path)}")
        return path

    def stage_files(self, names: Iterable[str]) -> dict[str, bytes]:
        """Contents of stage files by file name; stages that are not there are left out."""
        return {path.name: path.read_bytes() for path in map(self.stage_file, names) if path is not None}

    def stage_digest(self, name: str) -> str:
        """SHA-256 of a finished stage's file: the input hash of the stages after it builds on this."""
        return storage.sha256_of_file(self._finished(name))

    def is_done(self, name: str, input_hash: str) -> bool:
        """True when the stage's file is there and was made from exactly this input."""
        path = self.stage_file(name)
        try:
            return path is not None and _stage_content(path)[0] == input_hash
        except InputError:
            return False  # damaged from outside

    def taken_over(self) -> dict[str, list[str]]:
        """Stages that came from other runs, by the run that each came from. Raises InputError: see
        `manifest`."""
        by_origin: dict[str, list[str]] = {}
        for name, entry in self.manifest()["stages"].items():
            if entry.get("taken_over_from"):
                by_origin.setdefault(entry["taken_over_from"], []).append(name)
        return by_origin

    def lost_stages(self) -> dict[str, str]:
        """Finished stages whose files are not as they were written, with what has become of them: "missing"
        or "damaged". Raises InputError: see `manifest`."""
        lost = {}
        for name, entry in self.manifest()["stages"].items():
            if self.stage_file(name) is None:
                lost[name] = "missing"
            elif not self.is_done(name, entry["input_sha256"]):
                lost[name] = "damaged"
        return lost

    def take_over(self, name: str, input_hash: str, earlier: Iterable[RunDirectory]) -> RunDirectory | None:
        """The run that has a stage made from exactly this input, whose file is in this run afterwards.

        Parameters
        ----------
        name : str
            Of the stage.
        input_hash : str
            Of what the stage would be given now.
        earlier : iterable of RunDirectory
            Other runs, asked in turn where this one has no such file; nothing in them is changed.

        Returns
        -------
        RunDirectory or None
            This run where the file was here already; None where nobody has it, or only a damaged one.
        """
        for run in (self, *earlier):
            if not run.is_done(name, input_hash):
                continue
            if run is not self:
                path = run._finished(name)
                self.write_stage(name, path.suffix, path.read_bytes())
            return run
        return None

    def save_stage(self, name: str, result: Any, input_hash: str) -> Path:
        """Write a stage's result atomically, replacing what was there under either suffix."""
        content, suffix = stage_bytes(result, input_hash)
        return self.write_stage(name, suffix, content)

    def write_stage(self, name: str, suffix: str, content: bytes) -> Path:
        """Write a stage's file from its content, which another process or another run made."""
        path = self.stages_path / f"{name}{suffix}"
        storage.write_bytes(path, content)
        (self.stages_path / f"{name}{'.npz' if suffix == '.json' else '.json'}").unlink(missing_ok=True)
        return path

    def load_stage(self, name: str, kind: type[T]) -> T:
        """The result of a finished stage. Raises InputError when it is not there or not readable."""
        path = self._finished(name)
        _, content = _stage_content(path)
        with naming(str(path)):
            if path.suffix == ".npz":
                return codec.from_arrays(kind, content)
            return codec.unpack(kind, content[_RESULT], {})

    def refuse_other_inputs(self, inputs: Mapping[str, str]) -> None:
        """Raise InputError where this run was made from other files than these (name to SHA-256)."""
        own_inputs = self.manifest()["inputs"]
        if dict(own_inputs) == dict(inputs):
            return
        changed = [name for name in inputs if name in own_inputs and own_inputs[name] != inputs[name]]
        if changed:
            why = f"{changed[0]} has changed since"
        else:
            # Without their folders, where that tells them apart.
            short = {Path(name).name for name in own_inputs} != {Path(name).name for name in inputs}
            why = (
                f"it was made from {_names(own_inputs, short=short)}, not from {_names(inputs, short=short)}"
            )
        raise InputError(f"--from {self.path}: {why}: no stage can be taken over; leave --from out")

    # -- manifest --------------------------------------------------------------------------------------------

    def manifest(self) -> dict[str, Any]:
        """Raises InputError where it is not as we write it."""
        document = storage.read_json(self.manifest_path)
        try:
            _Manifest.model_validate(document)
        except ValidationError as error:
            key = ".".join(map(str, error.errors()[0]["loc"]))
            # A message stays a line, whatever a damaged file holds.
            raise InputError(f"{self.manifest_path}: damaged at {key[:80]}; start a new run") from error
        return document

    def config_document(self) -> dict[str, Any]:
        """What the configuration stated that the run was begun with. Raises InputError where it was changed
        since."""
        path = self.path / "config.json"
        document = storage.read_json(path)
        try:
            same = hash_of(document) == self.manifest()["config_sha256"]
        except TypeError:
            # Content of another file, with keys that the codec keeps for itself.
            same = False
        if not same:
            raise InputError(f"{path}: damaged, or changed since the run began; start a new run")
        return document

    def record_stage(self, name: str, seconds: float, input_hash: str) -> None:
        """Note a finished stage's time in the manifest."""
        manifest = self.manifest()
        manifest["stages"][name] = {
            "seconds": round(seconds, 3),
            "input_sha256": input_hash,
            "finished": _now(),
        }
        storage.write_json(self.manifest_path, manifest)

    def record_taken_over(self, name: str, origin: RunDirectory, called: str | None = None) -> None:
        """Note in the manifest what `origin` notes about a stage that was taken over from there.

        called: what a user knows that run by; None: a directory that is gone afterwards, which is not named.
        Nothing is noted where `origin` has no such note, as of stages that another process made.
        """
        entry = origin.manifest()["stages"].get(name)
        if entry is None:
            return
        manifest = self.manifest()
        manifest["stages"][name] = dict(entry) if called is None else {**entry, "taken_over_from": called}
        storage.write_json(self.manifest_path, manifest)

    def record_status(self, status: str, **more: Any) -> None:
        """`running`, `complete`, `complete, not certified` or `failed: <one line>`; `more` beside it."""
        manifest = self.manifest() | more
        manifest["status"] = status
        manifest["updated"] = _now()
        storage.write_json(self.manifest_path, manifest)


def stage_bytes(result: Any, input_hash: str) -> tuple[bytes, str]:
    """Content and suffix of a stage's file: npz, or JSON for a result without arrays."""
    document, arrays = codec.pack(result)
    if arrays:
        content = {_INPUT_HASH: np.array(input_hash), **codec.to_arrays(result)}
        return storage.npz_bytes({**content, _DIGEST: np.array(_digest(content))}), ".npz"
    plain = {_INPUT_HASH: input_hash, _RESULT: document}
    text = json.dumps({**plain, _DIGEST: _digest(plain)}, indent=1, ensure_ascii=False)
    return (text + "\n").encode("utf-8"), ".json"


def _resumed(path: Path) -> str:
    """The command that resumes the run in a directory."""
    return f"flexlink run --out {path_as_typed(path)} --resume"


def _stage_content(path: Path) -> tuple[str, dict[str, Any]]:
    """Input hash and content of a stage's file. Raises InputError where it is not as it was written."""
    content = storage.read_npz(path) if path.suffix == ".npz" else documents.read_json(path)
    recorded = str(content.pop(_DIGEST, None))
    if _INPUT_HASH not in content or recorded != _digest(content):
        raise InputError(
            f"{path}: changed since it was written; to compute it again, type: {_resumed(path.parents[1])}"
        )
    return str(content[_INPUT_HASH]), content


def _digest(content: Mapping[str, Any]) -> str:
    """SHA-256 of what a stage's file holds: arrays, or values of JSON."""
    digest = hashlib.sha256()
    for name in sorted(content):
        value = content[name]
        if isinstance(value, np.ndarray):
            about = f"{value.dtype.str}{value.shape}"
            data = np.ascontiguousarray(value).tobytes()
        else:
            about = ""
            data = json.dumps(value, sort_keys=True).encode()
        digest.update(f"{name}\0{about}\0{len(data)}\0".encode() + data)
    return digest.hexdigest()


def _names(files: Iterable[str], *, short: bool) -> str:
    """Files in a complaint, without their folders where they are to be short; "no file" without any."""
    return ", ".join(Path(name).name if short else name for name in files) or "no file"


def package_versions() -> dict[str, str]:
    """Versions of what the numbers depend on, as far as it is installed."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def hash_of(document: Mapping[str, Any]) -> str:
    """SHA-256 of a JSON-able document, independent of the order of its keys."""
    text = json.dumps(codec.pack(document)[0], sort_keys=True, ensure_ascii=False)
    return storage.sha256_of_bytes(text.encode("utf-8"))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def default_directory(name: str, parent: Path = Path("runs")) -> Path:
    """`runs/<name>-<local date and time>`; a number is appended while that is taken."""
    base = parent / f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    candidate = base
    number = 1
    while candidate.exists():
        number += 1
        candidate = base.with_name(f"{base.name}-{number}")
    return candidate
