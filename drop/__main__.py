"""DROP on the command line.

    python -m drop DEMO [--prior nearest] [--motion builtin] [--seed 0] [--png OUT | --video OUT]     drop/demos.py
    python -m drop train | evaluate | rollout | ship                                                  drop/train.py
"""

from drop import demos, train
from plumbing.cli import run_main


def main(argv=None):
    """A demonstration of §8, or a command on the learned priors.

    Test      tests/drop/test_drop_demos.py::test_command, tests/drop/test_drop_vae.py::test_command"""
    argv = list(argv or [])
    return (train if argv and argv[0] in train.COMMANDS else demos).main(argv)


if __name__ == "__main__":
    run_main(main)
