"""`python -m workflow` is `flexlink`."""

from __future__ import annotations

import sys

from workflow.engine import interrupts


def main() -> int:
    """The command line, from loading it to its end: an interrupt is one line at any moment."""
    try:
        interrupts.watch()
        from workflow.cli import main as command  # half a second

        code = command()
        interrupts.ignore()  # all is done and said
    except KeyboardInterrupt:  # while it was loaded
        sys.stderr.write("flexlink: interrupted\n")
        return interrupts.exit_code()
    return code


if __name__ == "__main__":
    sys.exit(main())
