"""Motion capture on the command line: python -m mocap inspect PATH..., or fetch NAME."""

from mocap.inspect import main
from plumbing.cli import run_main

if __name__ == "__main__":
    run_main(main)
