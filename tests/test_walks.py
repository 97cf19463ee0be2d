"""A datum, a beacon, a receipt, a frame and a setting take the walks through the modules that
docs/contribute/architecture.md describes."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from types import FrameType
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.agent.outgoing import Outgoing
from rass_mav.app.driver import Driver
from rass_mav.core.messages import Beacon, Message, Receipt
from rass_mav.link.udp import Peer, UdpLink

from .agent.build import make, said, step
from .test_architecture import FILES, PACKAGE, name

PAGE = (PACKAGE.parent / "docs" / "contribute" / "architecture.md").read_text(encoding="utf-8")


def walk(title: str) -> list[str]:
    """The modules that a walk on the page names, in its order. `wire` and the like are whole packages."""
    ((count, text),) = re.findall(rf"^\*\*{title}\*\* \((\d+) modules\)(.*?)(?=\n\n\*\*|\n\n## )", PAGE, re.M | re.S)
    modules = re.findall(r"`([a-z_.]+)`", text)
    assert len(modules) == int(count), "each is named once"
    return modules


def entered(run: Callable[[], Any]) -> set[str]:
    """The modules whose functions were called, as the page names them."""
    names: set[str] = set()

    def look(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            names.add(frame.f_globals.get("__name__", ""))

    before = sys.getprofile()
    sys.setprofile(look)
    try:
        run()
    finally:
        sys.setprofile(before)
    ours = {each.removeprefix("rass_mav.") for each in names if each.startswith("rass_mav.")}
    return {re.sub(r"^(wire|policy|store)\..*", r"\1", each) for each in ours}


class Field:
    """A drone that hears a base."""

    def __init__(self) -> None:
        self.drone, self.base = make(2, forward="immediate"), make(1, base=True, forward="immediate")
        self.now = 0.0
        for _ in range(6):
            self.turn()

    def turn(self) -> dict[type[Message], list[Outgoing]]:
        """Both have a turn. Returns what the base says, by its kind; the drone hears the beacons."""
        self.now += 1.0
        out: dict[type[Message], list[Outgoing]] = {}
        for outgoing in step(self.base, self.now):
            out.setdefault(type(said([outgoing], self.now)[0]), []).append(outgoing)
        hear(self.drone, out[Beacon], self.now)
        hear(self.base, step(self.drone, self.now), self.now)
        return out

    def datum(self) -> list[set[str]]:
        """A datum is created and handed over, taken, and confirmed: what each enters."""
        frames: list[Sequence[Outgoing]] = []

        def create() -> None:
            self.drone.node.put(b"reading", self.now)
            frames.append(self.drone.forward(self.now))

        created = entered(create)
        taken = entered(lambda: frames.append(hear(self.base, frames[0], self.now)))
        confirmed = entered(lambda: hear(self.drone, frames[1], self.now))
        assert not self.drone.node.holdings.custody
        return [created, taken, confirmed]


def hear(agent: Agent, frames: Sequence[Outgoing], now: float) -> list[Outgoing]:
    return [answer for outgoing in frames for answer in agent.peer_bytes(outgoing.frame, now)]


def test_every_module_that_is_named_exists() -> None:
    modules = {name(path).removesuffix(".py").replace("/", ".") for path in FILES}
    packages = {module.partition(".")[0] for module in modules}
    named = [module for title in ("A datum", "A beacon", "A receipt", "A frame", "A setting") for module in walk(title)]
    assert [module for module in named if module not in modules | packages] == []


def test_a_datum_goes_this_way() -> None:
    created, taken, confirmed = Field().datum()
    assert taken == set(walk("A datum"))
    [count] = re.findall(r"Its whole life.*?enters (\d+) modules", PAGE, re.S)
    assert len(created | taken | confirmed) == int(count)


def test_a_beacon_goes_this_way() -> None:
    field = Field()
    beacons: list[Outgoing] = []
    field.now += 1.0
    beacons += step(field.base, field.now)
    assert entered(lambda: hear(field.drone, beacons[:1], field.now)) == set(walk("A beacon"))


def test_a_receipt_goes_this_way() -> None:
    field = Field()
    field.datum()
    receipts: list[Outgoing] = []
    while not receipts:
        receipts = field.turn().get(Receipt, [])
    assert entered(lambda: hear(field.drone, receipts, field.now)) == set(walk("A receipt"))


async def test_a_frame_goes_this_way_to_the_link() -> None:
    field = Field()
    messages = field.drone.node.step(field.now + 1.0)
    link = UdpLink(("127.0.0.1", 0), peers=[Peer(("127.0.0.1", 9))])
    with ThreadPoolExecutor(1) as executor, closing(link):
        driver = Driver(field.drone, [link], None, lambda: field.now, executor)

        def send() -> None:
            driver._hand_out(field.drone.peers.frames_of_turn(messages, field.drone.store, field.now))

        assert entered(send) == set(walk("A frame"))


def test_a_setting_goes_this_way() -> None:
    *_, declared, read = walk("A setting")
    using = [path for path in FILES if re.search(r"\bneighbour_steps\b", path.read_text(encoding="utf-8"))]
    flying = {name(path).removesuffix(".py").replace("/", ".") for path in using if not name(path).startswith("lab")}
    assert flying == {declared, read}
