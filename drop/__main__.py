"""DROP on the command line.

    python -m drop DEMO [--prior nearest] [--motion builtin] [--seed 0] [--png OUT | --video OUT]     drop/demos.py
    python -m drop energies | ablations | failures                                                    drop/figures.py
    python -m drop score [--json OUT]                                                                 drop/score.py
    python -m drop train | evaluate | rollout | ship                                                  drop/train.py
"""

from drop import demos, figures, score, train
from plumbing.cli import run_main


def main(argv=None):
    """A demonstration of §8, a figure, or a command on the learned priors; the first word says which.

    Test      tests/drop/test_drop_demos.py::test_command, tests/drop/test_drop_vae.py::test_command,
              tests/drop/test_drop_figures.py::test_command"""
    argv = list(argv or [])
    for module in (train, figures, score):
        if argv and argv[0] in module.COMMANDS:
            return module.main(argv)
    return demos.main(argv, others=(*figures.COMMANDS, *score.COMMANDS, *train.COMMANDS))


if __name__ == "__main__":
    run_main(main)
