"""`python -m workflow` is `flexlink`."""

from __future__ import annotations

import atexit
import os
import sys
from contextlib import suppress

from workflow.engine import interrupts


def main() -> int:
    """The command line, from loading it to its end: an interrupt is one line at any moment."""
    try:
        interrupts.watch(later=True)
        from workflow.cli import main as command  # half a second, then it knows what continues

        code = command()
        interrupts.ignore()  # all is done and said
    except KeyboardInterrupt:  # just now
        sys.stderr.write(f"flexlink: {interrupts.words()}\n")
        code = interrupts.exit_code()
    if interrupts.came():
        # CPython ends itself with SIGINT once a KeyboardInterrupt passed through exec("..."), handled or not.
        atexit._run_exitfuncs()
        with suppress(OSError):
            sys.stdout.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
