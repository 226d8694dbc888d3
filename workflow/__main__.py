"""`python -m workflow` is `flexlink`."""

from __future__ import annotations

import atexit
import codecs
import gc
import io
import os
import resource
import sys
from contextlib import suppress

from workflow.engine import interrupts


def main() -> int:
    """The command line, from loading it to its end: an interrupt is one line at any moment."""
    try:
        usable_streams()
        refusal = too_little_memory()
        if refusal:
            sys.stderr.write(f"flexlink: {refusal}\n")
            return 2
        interrupts.watch(later=True)
        # What is imported stays: looking through it for garbage takes a seventh of the imports' time.
        gc.set_threshold(50_000)
        # Half a second, until the command line itself knows what continues.
        from workflow.cli import main as command

        code = command()
        # All is done and said.
        interrupts.ignore()
    except KeyboardInterrupt:
        # While the command line was loaded.
        sys.stderr.write(f"flexlink: {interrupts.words()}\n")
        code = interrupts.exit_code()
    if interrupts.came():
        # CPython ends itself with SIGINT once a KeyboardInterrupt passed through exec("..."), handled or not.
        atexit._run_exitfuncs()
        with suppress(OSError):
            sys.stdout.flush()
        os._exit(code)
    return code


# What pages and tables draw with, for a terminal that knows other characters only; else '?'.
_PLAIN = dict(zip("▁▂▃▄▅▆▇█µμ–−·×", "_.-=+*%#uu-- x", strict=True)) | {
    "°": "deg",
    "±": "+-",
    "…": "...",
    "≤": "<=",
    "≥": ">=",
    "²": "^2",
    "³": "^3",
    "→": "->",
}


# What the libraries alone take of the address space; with less OpenBLAS tries for ever to get its buffers.
_LEAST_MIB = 600


def too_little_memory() -> str:
    """What to do where `ulimit -v` leaves less than the libraries need; else empty."""
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    # The limit is in bytes.
    if soft == resource.RLIM_INFINITY or soft >= _LEAST_MIB << 20:
        return ""
    wanted = f"flexlink needs {_LEAST_MIB}: ulimit -v {_LEAST_MIB << 10}"
    return f"ulimit -v leaves {soft >> 20} MiB of memory, {wanted}"


class _ForgivingStream(io.TextIOWrapper):
    """A stream whose loss ends no computation: of standard error any, of standard output a reader that has
    left. Files are written all the same, and the exit code tells."""

    forgiven: type[OSError] = OSError

    def write(self, text: str) -> int:
        with suppress(self.forgiven):
            super().write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(self.forgiven):
            super().flush()


def usable_streams() -> None:
    """Streams that are closed go nowhere; one that is not UTF-8 gets what it has no character for in others.

    A descriptor that is closed would go to the next file that is opened, which gets what a library prints.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        with suppress(OSError):
            try:
                os.fstat(number)
            except OSError:
                nowhere = os.open(os.devnull, os.O_RDONLY if number == 0 else os.O_WRONLY)
                if nowhere != number:
                    os.dup2(nowhere, number)
                    os.close(nowhere)
            if getattr(sys, name) is None:
                mode = "r" if number == 0 else "w"
                setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))
    codecs.register_error("flexlink", _plainer)
    for name, forgiven in (("stdout", BrokenPipeError), ("stderr", OSError)):
        old = getattr(sys, name)
        if not isinstance(old, io.TextIOWrapper):
            continue
        encoding = old.encoding
        by_line = old.line_buffering or name == "stderr"
        errors = "flexlink" if old.errors in ("strict", "surrogateescape") else old.errors
        stream = _ForgivingStream(old.detach(), encoding, errors, line_buffering=by_line)
        stream.forgiven = forgiven
        setattr(sys, name, stream)


def _plainer(error: UnicodeError) -> tuple[str, int]:
    """What is written in place of characters that a stream does not have, and where it goes on."""
    assert isinstance(error, UnicodeEncodeError)
    return "".join(_PLAIN.get(c, "?") for c in error.object[error.start : error.end]), error.end


if __name__ == "__main__":
    sys.exit(main())
