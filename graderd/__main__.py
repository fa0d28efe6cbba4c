"""``python -m graderd``: the same as the ``graderd`` command."""

import sys

from graderd.cli import main

if __name__ == "__main__":
    sys.exit(main())
