"""The command `pixel2catch`, and `python -m pixel2catch`. Ctrl-C while it loads prints no traceback."""

import signal
import sys

PREVIOUS = signal.getsignal(signal.SIGINT)
signal.signal(signal.SIGINT, PREVIOUS if PREVIOUS is signal.SIG_IGN else signal.SIG_DFL)

from pixel2catch.cli.main import main  # noqa: E402 (Python's own handler raises, wherever it is)

signal.signal(signal.SIGINT, PREVIOUS)

if __name__ == "__main__":
    sys.exit(main())
