"""Labels under seal: a salted hash is published before any diagnosis starts, the labels opened after it.

    seal/labels.json     labels and salt, readable by the owner only (mode 0600 in a directory 0700)
    commitment.json      SHA-256 over salt and labels; changing a single label afterwards is noticed

While cases are diagnosed the labels are in no file at all (`off_disk`). The processes that diagnose get a
case folder only, and are kept out of the directory of the run (`validation.blind.worker`).
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from workflow.engine.errors import InputError
from workflow.engine.storage import read_json, write_json, write_text

# Where the labels are.
SEAL_DIRECTORY = "seal"
# Their file.
LABELS = "labels.json"
# File of the published hash.
COMMITMENT = "commitment.json"
# How anybody may check it.
_ALGORITHM = "SHA-256 over salt (hex) and labels (JSON, keys sorted, no blanks)"


def canonical(labels: Sequence[Mapping[str, Any]]) -> str:
    """The one text of these labels that is hashed."""
    return json.dumps(list(labels), sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


def commitment(salt: str, labels: Sequence[Mapping[str, Any]]) -> str:
    return hashlib.sha256(f"{salt}\n{canonical(labels)}".encode()).hexdigest()


def private_directory(path: Path) -> Path:
    """A directory only its owner can look into."""
    path.mkdir(mode=0o700, exist_ok=True)
    os.chmod(path, 0o700)
    return path


def write_private(path: Path, text: str) -> None:
    """Mode 0600 from the first byte on: written under a private directory, then set."""
    write_text(path, text)
    os.chmod(path, 0o600)


def close_seal(directory: Path, labels: Sequence[Mapping[str, Any]]) -> str:
    """Write labels and commitment; the commitment comes last, so that its presence means a closed seal."""
    salt = secrets.token_hex(32)
    folder = private_directory(directory / SEAL_DIRECTORY)
    # Through JSON once, so that what is hashed now is what will be read.
    plain = json.loads(canonical(labels))
    write_private(folder / LABELS, json.dumps({"salt": salt, "labels": plain}, indent=1) + "\n")
    digest = commitment(salt, plain)
    write_json(directory / COMMITMENT, {"sha256": digest, "algorithm": _ALGORITHM, "n_labels": len(plain)})
    return digest


@contextmanager
def off_disk(directory: Path) -> Iterator[None]:
    """Hold the labels in memory alone while the block runs. Of a run that is killed in it the salt is left:
    the cases are drawn again from their seed, and the commitment tells whether the labels are the same
    (`renew_seal`)."""
    path = directory / SEAL_DIRECTORY / LABELS
    sealed = read_json(path)
    write_private(path, json.dumps({"salt": sealed["salt"]}) + "\n")
    try:
        yield
    finally:
        write_private(path, json.dumps(sealed, indent=1) + "\n")


def has_labels(directory: Path) -> bool:
    """Whether a closed seal holds its labels; false where a run was killed while they were off the disk."""
    return "labels" in read_json(directory / SEAL_DIRECTORY / LABELS)


def renew_seal(directory: Path, labels: Sequence[Mapping[str, Any]]) -> None:
    """Put labels that were drawn again beside the salt that is left."""
    path = directory / SEAL_DIRECTORY / LABELS
    sealed = {"salt": read_json(path)["salt"], "labels": json.loads(canonical(labels))}
    write_private(path, json.dumps(sealed, indent=1) + "\n")


def open_seal(directory: Path) -> list[dict[str, Any]]:
    """The labels, after checking them against the published hash.

    Raises InputError if either file is missing or they do not belong together.
    """
    published = read_json(directory / COMMITMENT)
    sealed = read_json(directory / SEAL_DIRECTORY / LABELS)
    labels = sealed.get("labels")
    salt = sealed.get("salt")
    if not isinstance(labels, list) or not isinstance(salt, str):
        raise InputError(f"{directory / SEAL_DIRECTORY / LABELS}: expected labels and salt")
    if not hmac.compare_digest(commitment(salt, labels), str(published.get("sha256"))):
        raise InputError(
            f"{directory}: the seal is broken: the labels are not those whose hash was published in "
            f"{COMMITMENT} before the diagnosis"
        )
    return labels
