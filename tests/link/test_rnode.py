"""A LoRa modem with the RNode firmware: its framing, its airtime, and a link to an emulated one."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.config.loading import convert
from rass_mav.core.messages import Urgency
from rass_mav.errors import ConfigError
from rass_mav.link import rnode
from rass_mav.link.airtime import Pacer
from rass_mav.link.base import MAX_INBOX
from rass_mav.link.budget import FRAME_BYTES
from rass_mav.link.kiss import Command, Unframer, framed
from rass_mav.link.lora import on_air_s, packet_s
from rass_mav.link.rnode import MAX_WAITING, PACKET_BYTES, RNodeLink
from rass_mav.link.settings import LinkSection, RNodeSection
from tests.patience import PATIENCE_S
from tests.some import some

from .link_helpers import Ear
from .rnode_modem import CHANNEL, DETECT, ERROR, LIMIT, READY, SPREADING, STATE, Modem, join, kiss

EU = {"frequency_mhz": 869.525, "region": "eu868"}

# -- framing -----------------------------------------------------------------------------------------------------------


def test_a_frame_on_the_line() -> None:
    assert framed(0x01, bytes.fromhex("c0db33dc")) == bytes.fromhex("c0 01 dbdc dbdd 33 dc c0")
    assert list(Unframer(508).feed(bytes.fromhex("c0 00 dbdd dbdc 01 c0"))) == [Command(0, b"\xdb\xc0\x01")]


@given(
    st.lists(st.tuples(st.integers(0, 0xBF), st.binary(max_size=508)), max_size=5),
    st.lists(st.integers(0, 3000), max_size=6),
    st.binary(max_size=30).filter(lambda noise: b"\xc0" not in noise),
)
def test_frames_come_through_in_pieces_that_end_anywhere(
    frames: list[tuple[int, bytes]], cuts: list[int], noise: bytes
) -> None:
    """Also after what a board prints while it starts."""
    line = noise + b"".join(framed(code, data) for code, data in frames)
    ends = sorted({min(cut, len(line)) for cut in cuts} | {0, len(line)})
    unframer = Unframer(508)
    heard = [command for begin, end in pairwise(ends) for command in unframer.feed(line[begin:end])]
    assert heard == frames
    assert unframer.malformed == 0


@given(st.lists(st.binary(max_size=200) | st.just(b"\xc0\x00" + b"\xdb" * 9), max_size=20))
def test_any_bytes_are_frames_or_nothing(pieces: list[bytes]) -> None:
    unframer = Unframer(64)
    for piece in pieces:
        assert all(len(command.data) <= 64 for command in unframer.feed(piece))
    # Whatever came before, a frame that follows is found.
    assert Command(7, b"x") in list(unframer.feed(b"\xc0" + framed(7, b"x")))


def test_what_never_ends_is_not_kept() -> None:
    unframer = Unframer(508)
    for _ in range(1000):
        assert not list(unframer.feed(b"\xc0\x00" if _ == 0 else b"a" * 1000))
    assert unframer.malformed == 1
    assert list(unframer.feed(b"\xc0" + framed(0, b"then"))) == [Command(0, b"then")]


# -- the air -----------------------------------------------------------------------------------------------------------


def modem(**keys: object) -> RNodeSection:
    return convert({**EU, **keys}, RNodeSection, "rnode")


@pytest.mark.parametrize(
    ("factor", "bandwidth", "size", "seconds"),
    [
        # As the airtime calculators for LoRaWAN have it: 51 bytes of payload are 64 on the air, after 8 symbols.
        (7, 125, 64, 0.118016),
        (10, 125, 64, 0.698368),
        (12, 125, 64, 2.793472),
        (7, 250, 64, 0.059008),
        (7, 125, 145, 0.235776),
    ],
)
def test_the_time_on_the_air_is_that_of_the_application_note(
    factor: int, bandwidth: float, size: int, seconds: float
) -> None:
    section = modem(spreading_factor=factor, bandwidth_khz=bandwidth)
    assert on_air_s(section, size, 8) == pytest.approx(seconds, abs=1e-6)


@given(st.integers(5, 12), st.sampled_from([62.5, 125, 250, 500]), st.integers(5, 8), st.integers(1, PACKET_BYTES - 1))
def test_more_bytes_take_no_less_time(factor: int, bandwidth: float, rate: int, size: int) -> None:
    section = modem(spreading_factor=factor, bandwidth_khz=bandwidth, coding_rate=rate)
    assert 0.0 < packet_s(section, size) <= packet_s(section, size + 1)
    # 254 bytes and the modem's own fill a packet of LoRa; one more takes a second one, with its own preamble.
    assert packet_s(section, 255) - packet_s(section, 254) > packet_s(section, 1) * 0.9


def test_the_pacer_gets_what_the_air_carries_and_the_region_allows() -> None:
    budget = some(link_of(EU).budget)
    assert budget.bytes_s == pytest.approx(FRAME_BYTES / 0.2726, rel=0.01)
    assert (budget.duty, budget.burst_frames) == (0.1, 8)
    assert some(link_of({**EU, "frequency_mhz": 868.1}).budget).duty == 0.01
    assert some(link_of({**EU, "frequency_mhz": 869.525, "bandwidth_khz": 250}).budget).duty == 0.1
    assert some(link_of({"frequency_mhz": 915, "region": "us915", "bandwidth_khz": 500}).budget).duty == 0.3
    assert some(link_of(EU, airtime={"duty": 0.05}).budget).duty == 0.05


@pytest.mark.no_cover
def test_in_an_hour_no_node_sends_longer_than_the_region_allows() -> None:
    """With full queues and nobody else in range, by the time on the air of each frame alone."""
    section = link_of(EU)
    pacer = Pacer(some(section.budget), random.Random(1), now=0.0, step_s=1.0)
    now, on_air = 0.0, 0.0
    while now < 3600.0:
        for urgency in (Urgency.BEACON, Urgency.DATA, Urgency.BULK):
            pacer.push(bytes(73 if urgency is Urgency.BEACON else FRAME_BYTES), 1, urgency, now)
        pacer.meet({1})
        while (queued := pacer.pop(now)) is not None:
            on_air += packet_s(some(section.rnode), len(queued.frame))
        now = max(now + 0.1, some(pacer.next_at(now)))
    assert 0.05 * 3600 < on_air < 0.1 * 3600 * 1.05


def link_of(rnode: dict[str, object], **keys: object) -> LinkSection:
    raw = {"type": "rnode", "device": "/dev/ttyUSB0,115200", "rnode": rnode, **keys}
    section = convert(raw, LinkSection, "link")
    section.check("link")
    return section


@pytest.mark.parametrize(
    ("rnode", "keys", "said"),
    [
        (None, {}, r"link\.rnode: missing, expected at least frequency_mhz and region"),
        (EU, {"device": None}, r"link\.device: missing, expected the modem's port"),
        ({**EU, "frequency_mhz": 869.3}, {}, r"link\.rnode\.frequency_mhz: expected the signal within 863 to 865, .*"),
        ({**EU, "bandwidth_khz": 500}, {}, r"link\.rnode\.frequency_mhz: expected the signal within"),
        ({**EU, "frequency_mhz": 868.1, "power_dbm": 20}, {}, r"power_dbm: expected 14 or less at 868\.1 MHz in eu868"),
        (
            {"frequency_mhz": 915, "region": "us915"}, {},
            r"bandwidth_khz: expected 500 or more in us915, where a narrower signal must hop, got 125",
        ),
        (
            {**EU, "frequency_mhz": 868.1}, {"airtime": {"duty": 0.3}},
            r"link\.airtime\.duty: expected 0\.01 or less at 868\.1 MHz in eu868, got 0\.3",
        ),
        (EU, {"radio": "sik"}, r"link\.radio: expected null with type rnode, which is a radio itself"),
    ],
)  # fmt: skip
def test_what_a_region_or_the_modem_does_not_allow(
    rnode: dict[str, object] | None, keys: dict[str, object], said: str
) -> None:
    raw = {"type": "rnode", "device": "/dev/ttyUSB0,115200", "rnode": rnode, **keys}
    section = convert(raw, LinkSection, "link")
    with pytest.raises(ConfigError, match=said):
        section.check("link")


def test_an_air_that_hardly_carries_a_beacon_is_remarked() -> None:
    (remark,) = link_of({**EU, "frequency_mhz": 868.1, "spreading_factor": 10}).remarks("links[0]")
    assert remark.works
    assert "bytes/s for the whole swarm" in remark.text
    assert not link_of(EU).remarks("links[0]")


# -- the link ----------------------------------------------------------------------------------------------------------


class Bench:
    """Modems and links, which are taken down together."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: list[tuple[RNodeLink, Modem]] = []

    def pair(self, name: str, *, plugged: bool = True, firmware: tuple[int, int] = (1, 86), **keys: object) -> Pair:
        modem = Modem(self._folder / name, firmware=firmware)
        if plugged:
            modem.plug()
        section = link_of({**EU, **keys}, device=f"{modem.device.path},115200")
        link = section.open(None)
        assert isinstance(link, RNodeLink)
        self._open.append((link, modem))
        return Pair(link, modem)

    async def end(self) -> None:
        for link, modem in self._open:
            link.close()
            if modem.device.path.exists():
                modem.unplug()


class Pair(Ear):
    """A link, what it hears, and its modem."""

    link: RNodeLink

    def __init__(self, link: RNodeLink, modem: Modem) -> None:
        super().__init__(link)
        self.modem = modem

    async def so(self, condition: Callable[[], bool]) -> None:
        """Wait until something is so, of the link or of its modem."""

        async def wait() -> None:
            while not condition():
                self.heard += self.link.receive()
                await asyncio.sleep(0)

        await asyncio.wait_for(wait(), PATIENCE_S)

    async def ready(self) -> None:
        await self.so(lambda: not self.link.trouble)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    # So long does a test have to wait for what the link does after a pause.
    monkeypatch.setattr(rnode, "ANSWER_S", 0.05)
    monkeypatch.setattr(rnode, "AGAIN_S", 0.05)
    bench = Bench(tmp_path)
    yield bench
    asyncio.run(bench.end())


async def test_the_modem_is_set_up_as_the_configuration_says(bench: Bench) -> None:
    one = bench.pair("ttyUSB0", spreading_factor=9, power_dbm=17)
    await one.ready()
    assert one.modem.on
    assert {code: data.hex() for code, data in one.modem.settings.items()} == {
        1: "33d3e608", 2: "0001e848", 3: "11", 4: "09", 5: "05", LIMIT: "03e8",  # 10.00 % of an hour
    }  # fmt: skip
    assert one.modem.asked[0] == DETECT
    assert one.modem.asked.index(STATE) > one.modem.asked.index(SPREADING)
    assert one.link.report()["modem"]["firmware"] == "1.86"


async def test_frames_of_one_turn_share_a_packet_and_arrive_whole(bench: Bench) -> None:
    one, other = bench.pair("ttyUSB0"), bench.pair("ttyUSB1")
    join(one.modem, other.modem)
    await one.ready()
    await other.ready()
    frames = [bytes([0xC0, 0xDB, n]) * 50 for n in range(4)]
    for frame in frames:
        one.link.send(frame, 2)
    assert [len(packet) for packet in await other.frames(2)] == [450, 150]
    assert b"".join(one.modem.sent) == b"".join(frames)
    assert one.link.counters()[:4] == (2, 0, 0, 0)
    assert other.link.counters().received == 2
    said = other.link.report()["modem"]
    assert (said["rssi_dbm"], said["snr_db"]) == (-80, -2.5)
    other.link.send(b"back", 1)
    assert (await one.frames(1)) == [b"back"]


async def test_a_modem_that_is_full_gets_the_next_packet_when_it_has_space(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = bench.pair("ttyUSB0")
    await one.ready()
    monkeypatch.setattr(rnode, "ANSWER_S", PATIENCE_S)
    monkeypatch.setattr(rnode, "FULL_S", 0.001)
    one.modem.full = True
    packets = [bytes([n]) * 500 for n in range(MAX_WAITING + 3)]
    for packet in packets:
        one.link.send(packet, 2)
        await asyncio.sleep(0)
    await one.so(lambda: one.modem.asked.count(READY) >= 3)
    # The first one was under way before it said so. Of those that wait the oldest gave way.
    assert one.modem.sent == packets[:1]
    one.modem.full = False
    await one.so(lambda: len(one.modem.sent) == 1 + MAX_WAITING)
    assert one.modem.sent[1:] == packets[-MAX_WAITING:]
    assert one.link.counters().dropped_out == 2


async def test_a_modem_that_never_says_that_it_is_ready_is_used_all_the_same(bench: Bench) -> None:
    one = bench.pair("ttyUSB0")
    await one.ready()
    one.modem._obey = lambda code, data: one.modem.sent.append(data) if code == 0 else None  # type: ignore[method-assign]
    for n in range(3):
        one.link.send(bytes([n]) * 400, 2)
    await one.so(lambda: len(one.modem.sent) == 3)


async def test_a_modem_that_is_pulled_out_and_one_that_restarts_are_set_up_again(bench: Bench) -> None:
    one = bench.pair("ttyUSB0", plugged=False)
    await one.so(lambda: "no such file" in one.link.trouble.lower())
    for _ in range(2):
        one.modem.plug()
        await one.ready()
        assert one.modem.on
        one.modem.unplug()
        await one.so(lambda: bool(one.link.trouble))
        one.link.send(b"lost", 2)
    assert one.link.counters().dropped_out == 2
    one.modem.plug()
    await one.ready()
    one.modem.restart()
    await one.so(lambda: one.modem.on)
    await one.ready()
    one.link.send(b"here", 2)
    await one.so(lambda: one.modem.sent == [b"here"])


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda modem: setattr(modem, "most_power", 10), "power: asked for 14 dBm, the modem has 10"),
        (lambda modem: setattr(modem, "firmware", (1, 40)), "firmware 1.40 is too old, expected 1.52 or newer"),
        (lambda modem: setattr(modem, "works", False), "its radio chip does not start"),
        (
            lambda modem: setattr(modem, "mute", True),
            "the modem does not answer: check that it runs the RNode firmware",
        ),
        (lambda modem: setattr(modem, "_set", lambda *_: None), "the modem does not report its frequency"),
    ],
)
async def test_what_is_wrong_with_a_modem_is_told_until_it_is_right(
    bench: Bench, spoil: Callable[[Modem], None], said: str
) -> None:
    one = bench.pair("ttyUSB0", plugged=False)
    spoil(one.modem)
    one.modem.plug()
    await one.so(lambda: said in one.link.trouble)
    one.link.send(b"nothing leaves", 2)
    assert one.modem.sent == []
    one.modem.most_power, one.modem.works, one.modem.mute, one.modem.firmware = 22, True, False, (1, 86)
    one.modem.__dict__.pop("_set", None)
    await one.ready()


async def test_whatever_the_line_says_the_link_goes_on(bench: Bench) -> None:
    one = bench.pair("ttyUSB0")
    await one.ready()
    rng = random.Random(3)
    for _ in range(50):
        code = rng.choice([*range(0x10), *range(0x20, 0x2A), CHANNEL, ERROR, READY, 0x50, 0x99])
        one.modem.raw(rng.choice([rng.randbytes(40), kiss(code, rng.randbytes(rng.randrange(12))), b"\xc0\xdb\xc0"]))
        await asyncio.sleep(0)
    one.modem.raw(b"\xc0")
    one.modem.restart()
    await one.so(lambda: one.modem.on)
    await one.ready()
    one.heard.clear()
    one.modem.hear(b"and on")
    await one.until(lambda heard: any(packet.data == b"and on" for packet in heard))


async def test_packets_wait_outside_while_the_driver_is_behind(bench: Bench) -> None:
    one = bench.pair("ttyUSB0")
    await one.ready()
    for _ in range(40):
        one.modem.raw(kiss(0, b"x") * 100)
        await asyncio.sleep(0)
    # Nobody has taken any. What came in one piece is kept together.
    assert len(one.link._packets) < MAX_INBOX + 8192 // 4
    before = len(one.heard)
    await one.until(lambda heard: len(heard) > before)
