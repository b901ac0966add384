r"""The page's two commands.

    python -m web export     models, tables, normalisers, weights and the demonstration, as the page reads them
    python -m web serve      the built page on this machine
"""

import sys

from plumbing.cli import UserError, run_main
from web import export, serve

COMMANDS = {"export": export.main, "serve": serve.main}


def main(argv):
    """Run one command.  Test: tests/web/test_web.py::test_commands"""
    if argv and argv[0] in ("-h", "--help"):
        print(__doc__)
        return 0
    if not argv or argv[0] not in COMMANDS:
        given = repr(argv[0]) if argv else "nothing"
        raise UserError(f"python -m web {given}: no such command; valid: {', '.join(COMMANDS)} (--help tells more)")
    return COMMANDS[argv[0]](argv[1:])


if __name__ == "__main__":
    run_main(main, sys.argv[1:])
