"""The files of a diagnosis of one or several cases.

    diagnose.json              inputs and options; a resumed diagnosis is held to them
    <case>.json .html          the answer, for programs and for people
    <case>.rig.toml            repaired rig; <case>.effects.toml the effects to add, where there are any
    <case>.xml                 repaired MuJoCo model, of a case that names one
    <case>.next.csv            voltage of the experiment to run next, where one is proposed
    index.html fleet.csv       overview of several cases; a row with everything for each
    timings.json               seconds per case; the only file that differs from run to run

The JSON file of a case is written last and names the hashes of the others and of itself: a case whose JSON
file stands, made from the same inputs by the same code, is done.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from workflow.engine import codec, storage
from workflow.engine.errors import InputError
from workflow.engine.store import Store

# The first; a directory of another one is not resumed.
LAYOUT_VERSION = 1
MANIFEST = "diagnose.json"
_ENDINGS = (".json", ".html", ".rig.toml", ".effects.toml", ".next.csv", ".xml")


def answer_text(document: Mapping[str, Any]) -> str:
    """An answer as its JSON file has it, with the hash of the rest in it."""
    hashed = {key: value for key, value in document.items() if key != "sha256"}
    sha256 = storage.sha256_of_bytes(codec.plain_text(hashed).encode())
    return codec.plain_text({**hashed, "sha256": sha256})


@dataclass(frozen=True)
class DiagnosisDirectory(Store):
    """Where answers are kept. Make one with `begin`."""

    what = "diagnosis"
    manifest_name = MANIFEST
    own_files = ("index.html", "fleet.csv", "timings.json")

    def own_entries(self) -> Sequence[str]:
        """Files of the cases that the manifest names, and the overview."""
        if not self.manifest_path.is_file():
            return self.own_files
        cases = storage.read_json(self.manifest_path).get("inputs", {})
        # A manifest that somebody else wrote must not name a path elsewhere.
        named = [case for case in cases if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", case)]
        return (*(f"{case}{ending}" for case in named for ending in _ENDINGS), *self.own_files)

    def save(self, case: str, files: Mapping[str, bytes]) -> None:
        """Write all files of a case, its JSON file last, and the timings.

        Files of an earlier answer that this one does not have are deleted.
        """
        answer = f"{case}.json"
        (self.path / answer).unlink(missing_ok=True)
        for ending in _ENDINGS:
            if f"{case}{ending}" not in files:
                (self.path / f"{case}{ending}").unlink(missing_ok=True)
        names = sorted(files, key=lambda name: name == answer)
        self.write({name: files[name] for name in names})

    def finished(self, case: str, made_from: Mapping[str, Any]) -> dict[str, Any] | None:
        """The answer to a case if it is there, whole and made from this; else None."""
        document = self.document(f"{case}.json")
        if document.get("made_from") != made_from:
            return None
        # The file holds the hash of itself: an edited answer is not what was computed.
        if answer_text(document) != (self.path / f"{case}.json").read_text("utf-8"):
            return None
        for name, digest in document.get("files", {}).items():
            file = self.path / name
            if not file.is_file() or storage.sha256_of_file(file) != digest:
                return None
        return document

    def document(self, name: str) -> dict[str, Any]:
        """A JSON file of ours; empty where it is not there or cannot be read."""
        try:
            return storage.read_json(self.path / name)
        except InputError:
            return {}
