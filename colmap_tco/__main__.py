"""``python -m colmap_tco`` is ``colmap-tco``."""

import sys

from colmap_tco.cli import main

if __name__ == "__main__":
    sys.exit(main())
