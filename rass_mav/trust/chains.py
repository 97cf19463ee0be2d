"""Hash chains over the announcements of bases: no node claims to be nearer to a base than what it has heard.

A chain has an element for each announcement number and each hop count. Hashing an element gives that of one hop more or
of the number before. A node that has heard a route can announce it with one hop more, and no node can go the other way.
The ground signs the end of each chain (its anchor). docs/reference/protocol-keys.md ("Chains of
announcements") has the rules.
"""

from __future__ import annotations

from hashlib import blake2s

from rass_mav.wire.attestation import Anchor

#: Announcement numbers in a chain, and hop counts that it tells apart: more hops count as the last of them.
NUMBERS, HOPS = 64, 32
#: Hashes from the beginning of a chain to its end.
LENGTH = NUMBERS * HOPS
#: Elements that are remembered of one chain, besides one for each number.
_MAX_ELEMENTS = 512
_PERSON = b"rasshops"


def hashed(salt: bytes, element: bytes, times: int) -> bytes:
    """An element so many places further in the chain with this salt."""
    for _ in range(times):
        element = blake2s(element, digest_size=8, salt=salt, person=_PERSON).digest()
    return element


def place(index: int, hops: int) -> int:
    """Where in a chain the element is of the number that is `index` after the first one: hashes from the beginning."""
    return (NUMBERS - 1 - index) * HOPS + min(hops, HOPS - 1)


class Chain:
    """What a node knows of one chain: all elements from some place on."""

    __slots__ = ("_salt", "anchor", "elements", "newest", "signed")

    def __init__(self, anchor: Anchor, salt: bytes, signed: bytes = b"") -> None:
        """`anchor`: its signature is good. `salt`: of this chain. `signed`: the anchor as it travels."""
        self.anchor = anchor
        self.signed = signed
        self.newest = LENGTH
        """The place of the first element known; `LENGTH`: only the anchor is."""
        self._salt = salt
        self.elements: dict[int, bytes] = {LENGTH: anchor.element}

    def index(self, number: int) -> int | None:
        """Which of its numbers an announcement number is, from 0; None: none."""
        index = (number - self.anchor.first) & 0xFFFF
        return index if index < NUMBERS else None

    @property
    def number(self) -> int | None:
        """The latest announcement number of which an element is known; None: none is."""
        if self.newest == LENGTH:
            return None
        return (self.anchor.first + NUMBERS - 1 - self.newest // HOPS) & 0xFFFF

    def cost(self, at: int) -> int:
        """Hashes that it takes to verify an element that is claimed to be at a place, if it would be new."""
        return max(0, self.newest - at)

    def verify(self, at: int, element: bytes) -> bool:
        """Whether an element is the one at a place. If it is, it is known from now on."""
        if at >= self.newest:
            return self.element(at) == element
        found, last, between = element, at, {at: element}
        # By whole numbers, which others will ask for.
        for to in (*range((at // HOPS + 1) * HOPS, self.newest, HOPS), self.newest):
            found = hashed(self._salt, found, to - last)
            between[to] = found
            last = to
        if found != self.elements[self.newest]:
            return False
        self.elements.update(between)
        self.newest = at
        return True

    def element(self, at: int) -> bytes:
        """The element at a place that is not before the first one known."""
        elements = self.elements
        if at not in elements:
            if len(elements) > NUMBERS + _MAX_ELEMENTS:
                for other in [other for other in elements if other % HOPS and other != self.newest]:
                    del elements[other]
            # Elements are known at all whole numbers from the first one on.
            last = max(at // HOPS * HOPS, self.newest)
            elements[at] = hashed(self._salt, elements[last], at - last)
        return elements[at]


class OwnChain:
    """A chain of this node, a base."""

    __slots__ = ("_elements", "anchor")

    def __init__(self, base: int, base_life: int, serial: int, first: int, seed: bytes, salt: bytes) -> None:
        """`first`: its first announcement number. `seed`: the element of its last number, secret until then."""
        elements = [seed]
        for _ in range(NUMBERS):
            elements.append(hashed(salt, elements[-1], HOPS))
        self.anchor = Anchor(base, base_life, serial, first, elements.pop())
        self._elements = elements[::-1]

    def element(self, number: int) -> bytes | None:
        """What the base shows with an announcement number; None: this chain does not have it."""
        index = (number - self.anchor.first) & 0xFFFF
        return self._elements[index] if index < NUMBERS else None
