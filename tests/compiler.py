"""C code of the product, compiled as a library."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")

needs_compiler = pytest.mark.skipif(
    COMPILER is None, reason="no C compiler (cc, gcc or clang) on this machine"
)


def compiled(source: str, folder: Path) -> ctypes.CDLL:
    """As C99, where every warning is an error."""
    (folder / "code.c").write_text(source)
    command = [
        str(COMPILER),
        "-std=c99",
        "-O2",
        "-ffp-contract=off",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-pedantic",
    ]
    command += ["-shared", "-fPIC", str(folder / "code.c"), "-o", str(folder / "code.so")]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(folder / "code.so"))
