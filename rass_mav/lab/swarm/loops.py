"""Cycles of next hops, of which there must be none at any instant."""

from __future__ import annotations

from collections.abc import Sequence


def count_loops(next_hops: Sequence[int | None]) -> int:
    """Cycles in the graph of next hops (each node has at most one). Nodes outside the swarm have none."""
    loops = 0
    state = [0] * len(next_hops)
    for start in range(len(next_hops)):
        if state[start]:
            continue
        node: int | None = start
        mark = start + 1
        while node is not None and node < len(state) and not state[node]:
            state[node] = mark
            node = next_hops[node]
        if node is not None and node < len(state) and state[node] == mark:
            loops += 1
    return loops
