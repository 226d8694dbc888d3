"""`flexlink` and `python -m flexlink`: the command line, whatever the current folder holds."""

import sys

from workflow.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
