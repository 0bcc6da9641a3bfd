"""`python -m pixel2catch`: the command `pixel2catch`, for launchers that start modules, such as torchrun."""

import sys

from pixel2catch.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
