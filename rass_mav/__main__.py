"""`python -m rass_mav` is `rass-mav`."""

import sys

from rass_mav.cli import main

if __name__ == "__main__":
    sys.exit(main())
