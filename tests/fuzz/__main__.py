"""Coverage-guided fuzzing: `python -m tests.fuzz TARGET [--seconds N] [--runs N]` (docs/development.md).

Needs atheris, which there is for x86-64 Linux only. What it finds interesting is kept in tests/fuzz/corpus/TARGET; a
finding is written to the present directory as crash-..., and is to become a test.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import atheris

CORPUS = Path(__file__).parent / "corpus"


def main() -> None:
    """Run one target until the time or the runs are over, or something is found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz")
    parser.add_argument("target")
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--runs", type=int, default=-1)
    parser.add_argument("--scratch", help="where new inputs go; default: the corpus itself")
    options = parser.parse_args()
    with atheris.instrument_imports(include=["rass_mav"]):
        from .targets import TARGETS
    logging.disable(logging.CRITICAL)
    corpus = CORPUS / options.target
    corpus.mkdir(parents=True, exist_ok=True)
    places = [options.scratch, str(corpus)] if options.scratch else [str(corpus)]
    arguments = [
        sys.argv[0], *places, f"-max_total_time={options.seconds}", f"-runs={options.runs}", "-timeout=20",
        "-max_len=4096", "-print_final_stats=1", "-verbosity=0",
    ]  # fmt: skip
    atheris.Setup(arguments, TARGETS[options.target])
    atheris.Fuzz()


if __name__ == "__main__":
    main()
