"""Coverage-guided fuzzing: `python -m tests.fuzz TARGET [--seconds N] [--scratch DIR]`
(docs/contribute/testing.md).

`all`: one target after the other. `--merge DIR` takes inputs over from a scratch directory into the corpus instead.

Needs atheris, which there is for x86-64 Linux only. A finding is written to the present directory as crash-..., and is
to become a test.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path

import atheris

CORPUS = Path(__file__).parent / "corpus"


def main() -> None:
    """Run one target, or all, until the time is over or something is found."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz")
    parser.add_argument("target")
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    parser.add_argument("--runs", type=int, default=-1, help="likewise; the corpus counts too")
    parser.add_argument("--scratch", default="build/fuzz", help="where new inputs go, in a directory TARGET")
    parser.add_argument("--merge", metavar="DIR", help="take over from DIR the fewest that reach what all reach")
    options, others = parser.parse_known_args()
    with atheris.instrument_imports(include=["rass_mav"]):
        from .targets import TARGETS
    logging.disable(logging.CRITICAL)
    if options.target != "all":
        run(TARGETS[options.target], options, others)
    for target in TARGETS.values():
        # To import all that is fuzzed takes longer than a short run; and a run ends its process.
        child = os.fork()
        if not child:
            run(target, options, others)
        if os.waitpid(child, 0)[1]:
            sys.exit(f"{target.__name__}: something was found")


def run(target: Callable[[bytes], None], options: argparse.Namespace, others: list[str]) -> None:
    """Hand over to libFuzzer. Does not return."""
    corpus = CORPUS / target.__name__
    corpus.mkdir(parents=True, exist_ok=True)
    # libFuzzer merges in processes of its own, which it starts in this way, with arguments of its own.
    arguments = [f"{sys.executable} -m tests.fuzz {target.__name__}"]
    arguments += ["-timeout=20", "-max_len=4096", "-len_control=0", "-print_final_stats=1"]
    if others:
        arguments += others
    elif options.merge:
        # What counts is code that is reached, not how often: the tests run all of these.
        arguments += ["-set_cover_merge=1", "-use_counters=0", str(corpus), str(Path(options.merge, target.__name__))]
    else:
        arguments += [f"-max_total_time={options.seconds}", f"-runs={options.runs}"]
        # libFuzzer writes to the first directory, and reads all.
        scratch = Path(options.scratch, target.__name__)
        scratch.mkdir(parents=True, exist_ok=True)
        arguments += [str(scratch), str(corpus)]
    atheris.Setup(arguments, target)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
