"""The link within one process."""

from __future__ import annotations

import pytest

from rass_mav.core.messages import BROADCAST

from .link_helpers import Ear
from .loopback import LoopbackHub


async def test_only_connected_endpoints_hear_and_a_learned_one_is_addressed_alone() -> None:
    hub = LoopbackHub()
    a, b, c, far = (hub.endpoint(name) for name in ("a", "b", "c", "far"))
    hub.connect(a, b)
    hub.connect(a, c)
    ears = {link.name: Ear(link) for link in (a, b, c, far)}
    a.send(b"all", BROADCAST)
    a.learn(7, ("b", 0))
    a.send(b"to 7", 7)
    assert await ears["b"].frames(2) == [b"all", b"to 7"]
    assert await ears["c"].frames(1) == [b"all"]
    assert far.receive() == []
    hub.disconnect(a, b)
    assert not a.reaches(7)
    a.send(b"all again", 7)
    assert await ears["c"].frames(2) == [b"all", b"all again"]
    assert b.receive() == []


async def test_a_full_inbox_drops_and_counts() -> None:
    hub = LoopbackHub()
    a, b = hub.endpoint("a"), hub.endpoint("b", capacity=3)
    hub.connect(a, b)
    for index in range(5):
        a.send(bytes([index]), BROADCAST)
    ear = Ear(b)
    assert await ear.frames(3) == [b"\0", b"\1", b"\2"]
    assert b.counters() == (0, 3, 2, 0, 0)
    assert a.counters().sent == 5


def test_a_closed_endpoint_is_gone() -> None:
    hub = LoopbackHub()
    a, b = hub.endpoint("a"), hub.endpoint("b")
    hub.connect(a, b)
    b.close()
    a.send(b"x", BROADCAST)
    assert a.counters().sent == 0
    with pytest.raises(ValueError, match="already"):
        hub.endpoint("a")
