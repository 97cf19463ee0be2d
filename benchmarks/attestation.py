"""What a node with keys computes: processor time of a signature, and of a chain of announcements.

python -m benchmarks.attestation
"""

from __future__ import annotations

import time
from collections.abc import Callable

from benchmarks.tables import spread, table
from rass_mav.trust.chains import LENGTH, hashed
from rass_mav.trust.keys.attestation import Attestation
from rass_mav.trust.keys.identity import Ground
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.secret import Secret
from rass_mav.wire.attestation import Anchor, body_of

ROUNDS, TIMES = 5, 200


def milliseconds(work: Callable[[int], object], times: int) -> list[float]:
    """Processor time of one call, in each round. No two calls have the same number."""
    found = []
    for turn in range(ROUNDS):
        begun = time.process_time()
        for index in range(times):
            work(turn * times + index)
        found.append(round(1000 * (time.process_time() - begun) / times, 5))
    return found


def measure() -> dict[str, list[float]]:
    """Milliseconds, by what is computed."""
    ground = Ground(Secret(bytes(range(32))))
    attestation = Attestation(Keyring(ground.node(1), ground))
    bodies = [body_of(Anchor(1, 1, index, 0, bytes(8))) for index in range(ROUNDS * TIMES)]
    signatures = [attestation.anchor(body) for body in bodies]
    return {
        "a signature, verified": milliseconds(lambda n: attestation.anchors(bodies[n], signatures[n]), TIMES),
        "a signature, made": milliseconds(lambda n: attestation.anchor(bodies[n]), TIMES),
        f"a whole chain of announcements ({LENGTH:,} hashes)": milliseconds(
            lambda n: hashed(b"saltsalt", n.to_bytes(8, "little"), LENGTH), 5
        ),
    }


def show(results: dict[str, list[float]]) -> str:
    """The table."""
    return table(["", "processor time, ms"], [[name, spread(times, 4)] for name, times in results.items()])


def main() -> None:
    """Measure and print."""
    print(show(measure()))


if __name__ == "__main__":
    main()
