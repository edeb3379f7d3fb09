"""The `d2` command, `python -m d2_plugin`: Ctrl-C ends it with one sentence from the first import on."""

from __future__ import annotations

import signal
import sys


def main() -> int:
    """Run the command of `sys.argv`; returns its exit code."""
    try:
        from d2_plugin.commands.cli import main as run

        return run()
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second one would tear this sentence
        if sys.stderr is not None:
            sys.stderr.write("d2: stopped: continue with the same command\n")
        return 130
    finally:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # the interpreter's own end prints a traceback else


if __name__ == "__main__":
    sys.exit(main())
