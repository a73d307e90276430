"""`python -m odomap` is the command `odomap`."""

import sys

from odomap.cli import main

if __name__ == "__main__":
    sys.exit(main())
