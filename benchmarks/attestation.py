"""What it costs a node to verify the ground's word, here and on a Raspberry Pi Zero.

    python -m benchmarks.attestation
    python -m benchmarks.attestation --slower 50 --statements 200

A Pi Zero is not measured: it counts as `--slower` times as slow as this computer.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

if __name__ == "__main__":
    # As a script, the top of the checkout is not on the path.
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from rass_mav.trust.attestations import MAX_VERIFIED
from rass_mav.trust.chains import LENGTH, hashed
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.trust.statement_signatures import hash_of
from rass_mav.wire.attestation import Anchor, body_of


def seconds(work: Callable[[int], object], times: int, runs: int = 5) -> float:
    """Processor time of one call, the best of some runs."""
    best = float("inf")
    for run in range(runs):
        begun = time.process_time()
        for index in range(times):
            work(run * times + index)
        best = min(best, (time.process_time() - begun) / times)
    return best


def main() -> None:
    """Measure, and print what follows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--slower", type=float, default=100.0, help="how many times as slow a Pi Zero is (default 100)")
    parser.add_argument("--statements", type=int, default=100, help="statements that a node learns again (default 100)")
    given = parser.parse_args()
    ground = Ground(Secret(bytes(range(32))))
    word = Attestation(Keyring(ground.node(1), ground))
    bodies = [body_of(Anchor(1, 1, index, 0, bytes(8))) for index in range(1000)]
    signatures = [word.anchor(body) for body in bodies]
    # Each is another one, so nothing is remembered.
    verify = seconds(lambda index: word.anchors(bodies[index], signatures[index]), 200)
    sign = seconds(lambda index: word.anchor(bodies[index]), 200)
    hop = seconds(lambda index: hashed(b"saltsalt", index.to_bytes(8, "little"), LENGTH), 5) / LENGTH
    hash = seconds(lambda index: hash_of(bodies[index], index), 200)
    # An anchor, all of its chain, and a statement signature for every statement: in most cases one is for two.
    away = verify + LENGTH * hop + given.statements * (verify + hash)
    for name, here in (
        ("a signature, verified", verify),
        ("a signature, made", sign),
        ("a hash of a chain", hop),
        ("a hash of a statement", hash),
        ("a whole chain and its anchor", verify + LENGTH * hop),
        (f"the most signatures in a step ({MAX_VERIFIED})", MAX_VERIFIED * verify),
        (f"after 24 hours: a route, and {given.statements} statements", away),
    ):
        print(f"{name:50} {1e3 * here:9.4f} ms here {1e3 * given.slower * here:9.2f} ms on a Pi Zero")


if __name__ == "__main__":
    main()
