"""`python -m workflow` is `flexlink`."""

import sys

from workflow.cli import main

sys.exit(main())
