"""Skeleton-aware networks on the command line: python -m skeletal COMMAND (skeletal/play.py)."""

from plumbing.cli import run_main
from skeletal.play import main

if __name__ == "__main__":
    run_main(main)
