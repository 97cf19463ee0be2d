"""Settings of the air between the nodes of a mock swarm, and presets of radios (docs/evaluation/air.md)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple

from rass_mav.config.sections import Count, Fraction, Meta, NonNegative, Positive, Section
from rass_mav.link.budget import DATAGRAM_BYTES, Budget
from rass_mav.link.settings import AirtimeSection

AirKind = Literal["none", "csma", "tdma"]
Mac = Literal["broadcast", "unicast"]
Capture = Literal["first", "none"]
Preset = Literal["wifi-6m", "wifi-1m", "sik-64k", "sik-250k", "lora", "esp-now"]


class Channel(NamedTuple):
    """The properties of a radio channel."""

    air: AirKind
    bitrate: float
    """Bits per second on the air."""
    overhead_s: float
    """Time on the air of a frame besides its bytes, seconds: preamble and the like."""
    overhead_bytes: int
    """Bytes that the radio and its protocols add to a MAVLink frame."""
    slot_s: float
    """csma: a slot of the backoff; tdma: the slot in which a node may send; seconds."""
    gap_s: float = 0.0
    """csma: how long the air must be free before a node sends or counts backoff slots; tdma: the silence at the end of
    a slot; seconds."""
    window: int = 0
    """csma: the backoff is uniform in 0 .. `window` slots."""
    slots: int | None = None
    """tdma: slots in a round, node k has slot k mod `slots`; None: as many as nodes, at most 30."""
    queue_bytes: int = 65536
    """Bytes of frames that wait in a radio; frames beyond that are dropped."""
    datagram_bytes: int = 0
    """Frames that are sent at once share a datagram of at most this many bytes; 0: each goes alone."""
    mac: Mac = "broadcast"
    """csma: whether a datagram for one node is acknowledged, and repeated if it is not."""
    rates: tuple[tuple[float, float], ...] = ()
    """Of datagrams for one node: bits per second, and how much stronger they must arrive than at `bitrate`, dB."""
    capture: Capture = "none"
    """csma: what a receiver gets of frames that overlap."""
    budget: Budget | None = None
    """The driver's pacer; None: frames are handed to the radio at once."""
    reports: bool = False
    """Whether the radio reports its buffer to the driver once a second (RADIO_STATUS)."""

    def airtime(self, size: int, bitrate: float | None = None) -> float:
        """How long a MAVLink frame of `size` bytes takes on the air, seconds. `bitrate`: None: the usual one."""
        return self.overhead_s + 8.0 * (self.overhead_bytes + size) / (bitrate or self.bitrate)

    @property
    def sifs_s(self) -> float:
        """What is between a frame and its acknowledgement: the gap (DIFS) less two slots (IEEE 802.11-2020, 10.3.7),
        seconds."""
        return self.gap_s - 2.0 * self.slot_s

    @property
    def answer_s(self) -> float:
        """How long the air is taken after a datagram for one node, seconds."""
        return self.sifs_s + self.ack_s if self.mac == "unicast" else 0.0

    @property
    def ack_s(self) -> float:
        """How long an acknowledgement takes on the air, seconds."""
        return self.overhead_s + 8.0 * _ACK_BYTES / self.bitrate


# IEEE 802.11-2020. In ad-hoc mode broadcast frames have the lowest basic rate, no acknowledgement and the smallest
# window. 64 bytes: MAC header 24 and check sequence 4, LLC and SNAP 8, IPv4 20, UDP 8.
_WIFI_BYTES = 64
# 9.3.1.4: frame control 2, duration 2, receiver 6, check sequence 4.
_ACK_BYTES = 14
# Table 17-18 (receiver performance, 20 MHz): -82 dBm at 6 Mbit/s, up to -65 dBm at 54 Mbit/s.
_OFDM_RATES = (
    (6e6, 0.0), (9e6, 1.0), (12e6, 3.0), (18e6, 5.0), (24e6, 8.0), (36e6, 12.0), (48e6, 16.0), (54e6, 17.0),
)  # fmt: skip


def _sik(byte_s: float, bytes_s: float) -> Channel:
    """A SiK radio with the multipoint firmware, by the timing rules of its firmware: `byte_s` seconds a byte on the
    air, `bytes_s` bytes a second at its serial port."""
    # A packet without content takes 13 bytes and 13 ticks of 16 us; its trailer has 4 bytes, its content at most 248.
    empty_s = 13 * byte_s + 13 * 16e-6
    window_s = 3 * (empty_s + 248 * byte_s)
    return Channel(
        "tdma", 8.0 / byte_s, empty_s, 4, window_s + 2 * empty_s, 2 * empty_s, queue_bytes=1024,
        budget=AirtimeSection(bytes_s=bytes_s).budget(shared=True), reports=True,
    )  # fmt: skip


#: The channels by preset. docs/evaluation/air.md names the sources.
PRESETS: dict[str, Channel] = {
    # Table 17-21 (OFDM, 20 MHz): slot 9 us, SIFS 16 us, window 15; DIFS = SIFS + 2 slots; preamble and signal 20 us.
    "wifi-6m": Channel(
        "csma", 6e6, 20e-6, _WIFI_BYTES, 9e-6, 34e-6, 15, datagram_bytes=DATAGRAM_BYTES, rates=_OFDM_RATES,
        capture="first",
    ),
    # Table 15-5 (DSSS): slot 20 us, SIFS 10 us, window 31; long preamble and header 192 us.
    "wifi-1m": Channel(
        "csma", 1e6, 192e-6, _WIFI_BYTES, 20e-6, 50e-6, 31, datagram_bytes=DATAGRAM_BYTES, capture="first"
    ),
    # ticks of 16 us a byte: 9 at 64 kbit/s, 3 at 250 kbit/s.
    "sik-64k": _sik(9 * 16e-6, 5760.0),
    "sik-250k": _sik(3 * 16e-6, 11520.0),
    # Spreading factor 7, 250 kHz, coding rate 4/5: 0.512 ms a symbol, 5 symbols for 28 bits; 16 symbols of preamble.
    "lora": Channel(
        "csma", 28 / (5 * 512e-6), 31.1 * 512e-6, 0, 12e-3, 0.0, 7, queue_bytes=2048,
        budget=AirtimeSection(bytes_s=1367.0).budget(shared=True),
    ),
    # ESP-NOW broadcasts of DroneBridge for ESP32 at 115,200 bit/s: medium access of wifi-1m, the slowest rate for long
    # range. 43 bytes of ESP-NOW around 35 of DroneBridge (header, AES-GCM, length), 215 in a packet; 6 packets wait.
    "esp-now": Channel(
        "csma", 250e3, 192e-6, 43 + 35, 20e-6, 50e-6, 31, queue_bytes=6 * 215, datagram_bytes=215,
        budget=AirtimeSection(bytes_s=11520.0).budget(shared=True),
    ),
}  # fmt: skip


class RadioSection(Section):
    """The radio medium. Loss, duplication and overtaking are drawn separately for each receiver.

    What is null comes from the preset.
    """

    range_m: Positive = 3.0
    """Nodes at most this far away hear a frame, metres."""
    loss: Fraction = 0.0
    """Probability that a receiver loses a frame."""
    duplicate: Fraction = 0.0
    """Probability that a receiver gets a frame twice."""
    reorder: Fraction = 0.0
    """Probability that a frame is overtaken by others, up to one step's worth."""
    latency_steps: Annotated[int, Meta(ge=0, le=1000)] = 0
    """0: a frame arrives before the next step, and so do answers; L: at the beginning of the L-th step after."""
    preset: Preset | None = None
    """A radio whose properties hold where this section does not set them. It does not set `range_m`."""
    air: AirKind | None = None
    """none: frames take no time, and any number fits; csma: a node sends when it hears no other; tdma: each node sends
    in its own slots; null: that of the preset, without one none."""
    bitrate: Positive | None = None
    """Bits per second on the air."""
    overhead_s: NonNegative | None = None
    """Time on the air of a frame besides its bytes, seconds."""
    overhead_bytes: Annotated[int, Meta(ge=0)] | None = None
    """Bytes that the radio and its protocols add to a MAVLink frame."""
    slot_s: Positive | None = None
    """csma: a slot of the backoff; tdma: the slot in which a node may send; seconds."""
    gap_s: NonNegative | None = None
    """csma: how long the air must be free before a node sends; tdma: the silence at the end of a slot; seconds."""
    window: Annotated[int, Meta(ge=0)] | None = None
    """csma: a node waits 0 to this many slots before it sends."""
    slots: Count | None = None
    """tdma: slots in a round; node k has slot k mod slots; null: as many as nodes, at most 30."""
    sense: Annotated[float, Meta(ge=1)] = 1.0
    """csma: how far away a node notices that another sends, in ranges; below 2 some are hidden from each other."""
    capture: Capture | None = None
    """csma: what a receiver gets of overlapping frames. first: the one that began first, unless another began in the
    same slot; none: nothing; null: as the preset."""
    mac: Mac | None = None
    """csma: broadcast: every frame is sent once, to all in range; unicast: a frame for one node is acknowledged, and
    repeated if it is not; null: as the preset."""
    overhear: bool = True
    """Whether nodes overhear frames sent to others with `mac` unicast."""
    path_loss: Positive | None = None
    """Exponent of the path loss: frames get lost with the distance, half of them at `range_m`; null: none within
    `range_m`, all beyond."""
    shadowing_db: NonNegative = 0.0
    """With `path_loss`: standard deviation of the loss of the single links, fixed for a run."""
    queue_bytes: Count | None = None
    """Bytes of frames that wait in a radio; frames beyond that are dropped."""
    airtime: AirtimeSection | None = None
    """What a node's driver lets through to the radio; null: that of the preset."""

    def mistakes(self) -> Iterator[str]:
        """Checks across several keys."""
        if self.shadowing_db and self.path_loss is None:
            yield "radio.shadowing_db: expected 0 unless radio.path_loss is given"
        for key in ("duplicate", "reorder", "latency_steps"):
            if getattr(self, key) and self.takes_time:
                yield f"radio.{key}: expected 0 with radio.air {self.kind}"
        if self.takes_time and self.preset is None:
            for key in ("bitrate", "slot_s"):
                if getattr(self, key) is None:
                    yield f"radio.{key}: expected a number > 0 with radio.air {self.kind} and no radio.preset"
        if not self.takes_time:
            return
        channel = self.channel
        if channel.air != "csma" and channel.capture != "none":
            yield f"radio.capture: expected none with radio.air {channel.air}"
        if channel.mac == "unicast" and (channel.air != "csma" or channel.sifs_s < 0.0):
            yield "radio.mac: expected broadcast unless radio.air is csma and radio.gap_s at least two radio.slot_s"
        if self.channel.air == "tdma" and self.channel.gap_s >= self.channel.slot_s:
            yield f"radio.gap_s: expected less than radio.slot_s ({self.channel.slot_s:g}), got {self.channel.gap_s:g}"

    @property
    def kind(self) -> AirKind:
        """How nodes share the air."""
        return self.air or (PRESETS[self.preset].air if self.preset else "none")

    @property
    def takes_time(self) -> bool:
        """Whether frames take time."""
        return self.kind != "none"

    @property
    def channel(self) -> Channel:
        """The channel, where frames take time."""
        base = PRESETS[self.preset] if self.preset else Channel(self.kind, 1.0, 0.0, 0, 1.0)
        if self.bitrate is not None:
            base = base._replace(rates=())
        given = {key: getattr(self, key) for key in _KEYS if getattr(self, key) is not None}
        if self.airtime is not None:
            given["budget"] = self.airtime.budget(shared=base.reports)
        return base._replace(air=self.kind, **given)


_KEYS = (
    "bitrate", "overhead_s", "overhead_bytes", "slot_s", "gap_s", "window", "slots", "queue_bytes", "capture", "mac",
)  # fmt: skip
