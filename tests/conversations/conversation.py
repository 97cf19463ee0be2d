"""Conversations between nodes, as text that a person reads and a test replays.

A file consists of commands, each followed by what it brings about: the messages that the nodes send to each other, and
what changes in their stores. `#` starts a comment. README.md lists the commands.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from itertools import count, groupby
from pathlib import Path
from random import Random
from typing import Any

import yaml

from rass_mav.core import messages as m
from rass_mav.core.custody.holdings import Holding, State
from rass_mav.core.datum import REASONS, TERMS, USUAL, Datum, DatumId, Fate, Kind, Terms, make_datum
from rass_mav.core.exchange import mark
from rass_mav.core.news.deletion_reports import fate_of
from rass_mav.core.news.statements import make_sequence_mark
from rass_mav.core.node import Node
from rass_mav.core.policy import POTENTIAL_BASE, POTENTIAL_ONE
from rass_mav.wire import decode, encode
from tests.core.books import check_node
from tests.core.build import beacon, loss, statement
from tests.core.durable import DurableStore
from tests.core.replica_net import Net
from tests.some import some

#: Bytes of a chunk.
CHUNK = 123


def names() -> Iterator[str]:
    """a, b, ... z, a1, b1, ..."""
    for round in count():
        for letter in "abcdefghijklmnopqrstuvwxyz":
            yield f"{letter}{round or ''}"


class Conversation:
    """The nodes of one file."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._begin()

    def _begin(self) -> None:
        self.risks: dict[int, float] = {}
        self.base = -1
        self.links: list[tuple[int, int]] = []
        self.settings: dict[str, Any] = {"mirror_until_receipt": True}
        self.own: dict[int, dict[str, Any]] = {}
        self._net: Net | None = None
        self._names = names()
        self.data: dict[str, DatumId] = {}
        self.contents: dict[str, Datum] = {}
        """Those that no node has created."""
        self.numbers: dict[int, int] = {}
        """Hand-over numbers are random: the first that is seen is #1."""
        self.handles: dict[int, int] = {}
        """The same for handles of transfers."""
        self.kept: list[str] = []
        """What somebody goes on saying."""
        self.sums: dict[int, int] = {}
        """The checksum of what was handed over under a number."""
        self.lost: list[tuple[str, int | None, float]] = []
        """Kind, sender and how many more frames of these are lost."""
        self.copies: dict[tuple[str, int], str] = {}
        self.shown: set[str] = set()
        self.count = count(1)

    @property
    def net(self) -> Net:
        if self._net is None:
            self._net = Net(self.risks, self.links, base=self.base, own=self.own, **self.settings)
            self._net.loses = self._loses
        return self._net

    def run(self, command: str) -> list[str]:
        """Carry out a command; what it brought about, as lines."""
        word, _, rest = command.partition(" ")
        self.lines = []
        if word == "say":
            self.do_say(rest)
        else:
            getattr(self, f"do_{word}")(*rest.split())
        if self._net is not None:
            self._look()
            for node in self._net.nodes.values():
                check_node(node)
        return self.lines

    # -- commands ------------------------------------------------------------------------------------------------------

    def do_nodes(self, *ids: str) -> None:
        """Those of a new conversation, if one is over."""
        if self._net is not None:
            self._begin()
        for text in ids:
            id, _, what = text.partition(":")
            if what == "base":
                self.base = int(id)
            self.risks[int(id)] = 0.0 if what in ("", "base") else float(what)

    def do_links(self, *pairs: str) -> None:
        self.links += [_pair(pair) for pair in pairs]

    def do_set(self, *settings: str) -> None:
        of = self.settings
        for text in settings:
            key, equals, value = text.partition("=")
            if equals:
                of[key] = yaml.safe_load(value)
            else:
                of = self.own.setdefault(int(key), {})

    def do_show(self, what: str) -> None:
        assert what in ("beacons", "routes")
        self.shown.add(what)

    def do_step(self, count: str = "1") -> None:
        for step in range(int(count)):
            before = len(self.lines)
            self._step()
            self.show(self.net.said)
            self._look()
            if int(count) > 1 and len(self.lines) > before:
                self.lines.insert(before, f"step {step + 1}:")

    def do_quiet(self, count: str) -> None:
        """Steps of which nothing is shown, not even what changes: nodes get to know each other."""
        for _ in range(int(count)):
            self._step()
        self._look()
        self.lines = []

    def _step(self) -> None:
        """At the next whole second, after what somebody goes on saying."""
        for text in self.kept:
            self.do_say(text)
        self.net.now = float(int(self.net.now))
        self.net.step()

    def do_keep(self, *words: str) -> None:
        """`keep saying ...`: before each step from now on; `keep silent` ends it."""
        self.kept = [] if words[0] == "silent" else [*self.kept, " ".join(words[1:])]

    def do_wait(self, seconds: str) -> None:
        self.net.now += float(seconds)

    def do_put(self, node: str, *what: str) -> None:
        """`what`: a number of bytes, `x5` for five data, `share` or `part` of a file, and terms."""
        size, times, kind = 7, 1, 0
        what, terms = _terms(what)
        for word in what:
            if word.startswith("x"):
                times = int(word[1:])
            elif word.isdigit():
                size = int(word)
            else:
                kind = Kind[word.upper()]
        for _ in range(times):
            self.net.said = []
            self._name(self.net.put(int(node), (b"reading" * size)[:size], kind, terms))
            self.net.stores[int(node)].commit()
            self.show(self.net.said)

    def do_datum(self, name: str, word: str, of: str, *more: str) -> None:
        """`datum x of 9`: one that node 9, which is far away, has created; or that it has not, if it is a node here.
        `datum y like x`: another content under the same id. `datum y damaged x`: with the checksum of x.
        `datum y copy x aged 9`: the same, said to be 9 s older. `more`: bytes, and terms."""
        more, terms = _terms(more)
        kind, head = TERMS if terms != USUAL else 0, terms.pack()
        if word == "of":
            store = self.net.stores.get(int(of))
            number = sum(one.id.origin == int(of) for one in self.contents.values())
            id = DatumId(int(of), 77, number) if store is None else DatumId(int(of), store.epoch, store.assigned + 3)
            payload = head + Random(f"{id}").randbytes(int(more[0] if more else 7))
            self.contents[name] = make_datum(id, kind, self.net.now, payload)
            self.data[name] = id
            return
        true = self.content(of)
        payload = true.payload[::-1]
        self.contents[name] = {
            "damaged": lambda: true._replace(payload=payload),
            "like": lambda: make_datum(true.id, kind, true.created, head + payload),
            "copy": lambda: true._replace(created=true.created - float(more[1])),
        }[word]()

    def do_cut(self, *pairs: str) -> None:
        for pair in pairs:
            self.net.links.discard(frozenset(_pair(pair)))

    def do_join(self, *pairs: str) -> None:
        for pair in pairs:
            self.net.links.add(frozenset(_pair(pair)))

    def do_off(self, *nodes: str) -> None:
        self.net.off |= set(map(int, nodes))

    def do_on(self, *nodes: str) -> None:
        """After a restart: the store is as the disk had it."""
        for node in map(int, nodes):
            self.net.off.discard(node)
            self.net.stores[node] = self.net.stores[node].crashed()
            self.net.start(node)

    def do_wipe(self, node: str) -> None:
        """A new card, and on again."""
        self.net.stores[int(node)] = DurableStore(epoch=5000 + next(self.count))
        self.net.start(int(node))

    def do_erase(self, node: str, name: str) -> None:
        """A copy disappears from a node's disk, and the node restarts."""
        self.net.nodes[int(node)].store.remove(self.data[name], Fate.PASSED_ON)
        self.net.stores[int(node)].close()
        self.do_on(node)

    def do_flip(self, node: str, *data: str) -> None:
        """Flip a bit of stored data."""
        for name in data:
            self.net.strike(int(node), self.data[name])

    def do_lose(self, kind: str, sender: str = "*", count: str = "1") -> None:
        if kind == "nothing":
            self.lost = []
        else:
            left = float("inf") if count == "always" else int(count)
            self.lost.append((kind.lower(), None if sender == "*" else int(sender), left))

    def do_repeat(self, node: str) -> None:
        """All that a node sent in the last command is heard once more."""
        again = [(int(node), message) for message in self.net.said if m.sender_of(message) == int(node)]
        self.net.said = []
        self.net.deliver([pair for pair in again if type(pair[1]) is not m.Beacon])
        self.show(self.net.said)

    def do_say(self, text: str) -> None:
        """Somebody says something, in whosever name: it is heard by its target, or by all nodes. Shown are the
        answers."""
        if found := re.fullmatch(r"\? > (\w+): (.*) of (\w+) under handle (\d+)( and asks)?", text):
            for chunk in self._chunks(*found.groups()):
                self._hear(text, chunk)
        else:
            message = self._meant(text)
            if type(message) is not m.Beacon:
                [payload] = encode(message, self.net.now)
                message = decode(payload, self.net.now) or message
            self._hear(text, message)

    def _hear(self, text: str, message: m.Message) -> None:
        hearer = re.match(r"\d+ > (\d+): beacon", text)
        target = int(hearer[1]) if hearer else getattr(message, "target", m.BROADCAST)
        speaker = m.sender_of(message)
        self.net.said = []
        for id, node in self.net.nodes.items():
            if id not in self.net.off and (id == target or (target not in self.net.nodes and id != speaker)):
                answers = node.receive(message, self.net.now)
                self.net.stores[id].commit()
                moves = self.net.forwarded(node)
                self.net.deliver([(id, answer) for answer in node.needed(answers, moves) + moves])
        self.show(self.net.said)

    def do_count(self, node: str, *keys: str) -> None:
        """Figures of a node."""
        of = self.net.nodes[int(node)]
        figures = {**of.figures(), **of.store.counters()}
        self.lines += [f"  {key} at {node}: {figures.get(key, 0)}" for key in keys]

    def do_known(self, name: str) -> None:
        """Which nodes know that a datum has arrived, or that it was reported lost."""
        id = self.data[name]
        for what, knows in (
            ("arrived", lambda node: id in node.custody_store.arrived),
            ("is lost", lambda node: node.receipts.is_reported_lost(id)),
        ):
            found = [str(i) for i, node in self.net.nodes.items() if knows(node)]
            self.lines += [f"  {name} {what}, as known to {' '.join(found)}"] if found else []

    def do_free(self, node: str) -> None:
        """How many data a node has space for, as its beacon says."""
        self.lines.append(f"  free at {node}: {self.net.nodes[int(node)].holdings.free()}")

    def do_where(self) -> None:
        """Who has custody of what."""
        for name, id in self.data.items():
            self.lines.append(f"  {name}: " + " ".join(map(str, self.net.custody(id))))

    def do_neighbours(self, node: str) -> None:
        found = map(str, self.net.nodes[int(node)].routing.neighbours)
        self.lines.append(f"  neighbours of {node}: {' '.join(found) or 'none'}")

    # -- what is shown -------------------------------------------------------------------------------------------------

    def _loses(self, message: m.Message) -> bool:
        for index, (kind, sender, left) in enumerate(self.lost):
            if left and type(message).__name__.lower() == kind and sender in (None, m.sender_of(message)):
                self.lost[index] = kind, sender, left - 1
                who = m.sender_of(message)
                self.lines.append(f"  (lost: {kind}{'' if who is None else f' of {who}'})")
                return True
        return False

    def show(self, said: list[m.Message]) -> None:
        for handle, messages in groupby(said, lambda message: message.handle if type(message) is m.Chunk else None):
            if handle is not None:
                chunks = [message for message in messages if type(message) is m.Chunk]
                self.lines.append(f"? > {chunks[0].target}: {_pieces(self, handle, chunks)}")
                continue
            for message in messages:
                if type(message) is m.Beacon and not ("beacons" in self.shown or message.answers):
                    continue
                # What is said survives the wire.
                for payload in encode(message, self.net.now):
                    decode(payload, self.net.now)
                if type(message) is m.Offer:
                    self.sums[message.number] = message.crc
                self.lines += _TEXTS[type(message)](self, message)

    def _look(self) -> None:
        """What has changed in the stores since the last look."""
        now: dict[tuple[str, int], str] = {}
        for i, node in self.net.nodes.items():
            for id, fate in node.store.losses():
                now[self._name(id), i] = "reported lost" if i == self.base else f"lost ({fate.value})"
            for id in node.overheard:
                now[self._name(id, node.overheard[id].crc), i] = "overheard"
            for id in node.holdings:
                holding = some(node.holdings.get(id))
                lost = now.pop((self._name(id), i), "")
                state = _state(node, holding)
                now[self._name(id, holding.crc), i] = f"{state}, and {lost}" if lost.startswith("lost") else state
            if node.archive is not None:
                for id in [id for id in self.data.values() if id in node.archive]:
                    stored = node.store.get(id)
                    intact = stored is None or stored.intact
                    now[self._name(id, stored and stored.crc), i] = "arrived" if intact else "arrived, damaged"
                for info in node.store.apart():
                    now[self._name(info.id, info.crc), i] = "kept apart"
            for alarm, times in node.alarms.counts.items():
                now[f"alarm {alarm.name}", i] = str(times)
            if "routes" in self.shown:
                routing = node.routing
                now["route", i] = "none" if routing.distance == m.NO_ROUTE else f"none, {routing.distance} hops away"
                if routing.route is not None and routing.next_hop is not None:
                    now["route", i] = f"{routing.hops} hops to {routing.route.base} by {routing.next_hop}"
        for name, i in sorted({*now, *self.copies}):
            before, after = self.copies.get((name, i)), now.get((name, i))
            if before != after:
                self.lines.append(f"  {name} at {i}: {before or '-'} -> {after or '-'}")
        self.copies = now

    def _name(self, id: DatumId, crc: int | None = None) -> str:
        for name, content in self.contents.items():
            if content.id == id and crc in (None, content.crc):
                return name
        for name, known in self.data.items():
            if known == id:
                return name
        name = next(name for name in self._names if name not in self.data)
        self.data[name] = id
        return name

    def handle(self, handle: int) -> str:
        if handle not in self.handles:
            self.handles[handle] = next(n for n in count(1) if n not in self.handles.values())
        return f"handle {self.handles[handle]}"

    def number(self, number: int) -> str:
        if number and number not in self.numbers:
            self.numbers[number] = next(n for n in count(1) if n not in self.numbers.values())
        return f"#{self.numbers[number]}" if number else "no number"

    def ids(self, ids: Iterable[DatumId]) -> str:
        return ", ".join(self._name(id) for id in ids)

    def named(self, ids: dict[tuple[int, int], Callable[[int], bool]]) -> str:
        return ", ".join(name for name, id in self.data.items() if id[:2] in ids and ids[id[:2]](id.sequence))

    # -- what is said by command ---------------------------------------------------------------------------------------

    def _meant(self, text: str) -> m.Message:
        """The message that a text means: the same words as it would be shown in."""
        for pattern, read in _READ.items():
            found = re.fullmatch(pattern, text)
            if found is not None:
                return read(self, *found.groups())
        raise AssertionError(f"nobody says: {text}")

    def content(self, name: str) -> Datum:
        """A datum by its name: a copy that some node has, or one that no node has created."""
        if name in self.contents:
            return self.contents[name]
        copies = [store.get(self.data[name]) for store in self.net.stores.values()]
        return next(copy for copy in copies if copy is not None and copy.intact)

    def _chunks(self, target: str, which: str, name: str, label: str, asks: str | None) -> Iterator[m.Chunk]:
        """`which`: chunks 0-4 7, all chunks, all chunks but 3, false chunk 3."""
        payload, whole = self.content(name).payload, range(-(-len(self.content(name).payload) // CHUNK))
        named = {n for a, b in re.findall(r"(\d+)(?:-(\d+))?", which) for n in range(int(a), int(b or a) + 1)}
        for position in [n for n in whole if (n not in named if "all" in which else n in named)]:
            piece = payload[position * CHUNK : (position + 1) * CHUNK]
            yield m.Chunk(_target(target), self.real_handle(label), position, bool(asks),
                          bytes(len(piece)) if "false" in which else piece)  # fmt: skip

    def real_handle(self, label: str) -> int:
        found = [handle for handle, known in self.handles.items() if known == int(label)]
        self.handles.setdefault(found[0] if found else 700 + int(label), int(label))
        return found[0] if found else 700 + int(label)

    def real(self, label: str) -> int:
        """The number behind a label."""
        for number, known in self.numbers.items():
            if known == int(label):
                return number
        number = 1_000_000 + int(label)
        self.numbers[number] = int(label)
        return number

    def life(self, node: int) -> int:
        return self.net.stores[node].life if node in self.net.stores else 9


def _terms(words: tuple[str, ...]) -> tuple[tuple[str, ...], Terms]:
    """The words before them, and the terms: `priority 9`, `lasting 6`."""
    text = " ".join(words)
    priority, lasting = re.search(r"priority (\d+)", text), re.search(r"lasting (\d+)", text)
    terms = Terms(int(priority[1]) if priority else USUAL.priority, int(lasting[1]) if lasting else None)
    return tuple(re.sub(r"(priority|lasting) \d+", "", text).split()), terms


def _pair(text: str) -> tuple[int, int]:
    a, b = text.split("-")
    return int(a), int(b)


def _state(node: Node, holding: Holding) -> str:
    text = holding.state.name.lower().replace("_", " ")
    backed = holding.partner if holding.state is State.CUSTODY else holding.holder
    if holding.state is State.REPLICA and holding.partner is not None:
        text += f" for {holding.partner.id}"
    if backed is not None:
        text += f", backed by {backed.id}"
    stored = node.store.get(holding.id)
    return text if stored is not None and stored.intact else f"{text}, damaged"


def _to(message: Any) -> str:
    target = getattr(message, "target", m.BROADCAST)
    return f"{message.sender} > {'all' if target == m.BROADCAST else target}"


def _answers(of: Conversation, answer: m.Committed) -> str:
    parts = []
    if answer.committed:
        parts.append("committed " + ", ".join(of.number(number) for number, _ in answer.committed))
    if answer.refused:
        parts.append("refused " + ", ".join(map(of.number, answer.refused)))
    return "; ".join(parts)


def _beacon(of: Conversation, b: m.Beacon) -> list[str]:
    route = "no route" if b.hops == m.NO_ROUTE else f"{b.hops} hops to {b.base}"
    wanted = f", wants a newer number of {b.wanted_base}" if b.flags & m.BEACON_WANTED else ""
    answers = "".join(f"; to {answer.target}: {_answers(of, answer)}" for answer in b.answers)
    return [f"{b.sender} > all: beacon, {route}{wanted}{answers}"]


def _data(of: Conversation, d: m.Data) -> list[str]:
    what = "hands over" if not d.replica else "replica of" if d.distance is None else "distant replica of"
    of.sums.update({h.number: h.datum.crc for h in d.handovers})
    return [f"{_to(d)}: {what} {of._name(h.datum.id, h.datum.crc)} {of.number(h.number)}" for h in d.handovers]


def _entries(of: Conversation, receipt: m.Receipt) -> list[str]:
    def covers(entry: m.ReceiptEntry) -> Callable[[int], bool]:
        first, run, bitmap = entry.first, entry.run, entry.bitmap
        return lambda n: first <= n < first + run or (n >= first + run and bool(bitmap >> (n - first - run) & 1))

    lines = []
    for lost in (False, True):
        of_pairs = {(e.origin, e.epoch): covers(e) for e in receipt.entries if e.lost is lost}
        if of_pairs:
            lines.append(f"{receipt.base} states: {'reported lost' if lost else 'arrived'}: {of.named(of_pairs)}")
    return lines


def _ranges(numbers: Iterable[int]) -> str:
    """0-4 7"""
    found: list[list[int]] = []
    for n in sorted(set(numbers)):
        if found and found[-1][1] == n - 1:
            found[-1][1] = n
        else:
            found.append([n, n])
    return " ".join(str(a) if a == b else f"{a}-{b}" for a, b in found)


def _whole(next_index: int, bitmap: int) -> str:
    beyond = (next_index + 1 + bit for bit in range(bitmap.bit_length()) if bitmap >> bit & 1)
    return f"chunks {_ranges([*range(next_index), *beyond])}" if next_index or bitmap else "no chunk"


def _pieces(of: Conversation, handle: int, chunks: list[m.Chunk]) -> str:
    positions = _ranges(chunk.position for chunk in chunks if chunk.data)
    asks = any(not chunk.data for chunk in chunks)
    return f"chunks {positions} of {of.handle(handle)}" if not asks else f"what has arrived of {of.handle(handle)}?"


_TEXTS: dict[type, Callable[[Conversation, Any], list[str]]] = {
    m.Beacon: _beacon,
    m.Data: _data,
    m.Committed: lambda of, c: [f"{_to(c)}: {_answers(of, c)}"],
    m.Offer: lambda of, o: [f"{_to(o)}: offers {of.ids([o.id])} {of.number(o.number)}, {o.size} bytes"],
    m.Accept: lambda of, a: [
        f"{_to(a)}: accepts {of.number(a.number)} under {of.handle(a.handle)}; has {_whole(a.next_index, a.bitmap)}"
    ],
    m.Sack: lambda of, s: [f"{_to(s)}: of {of.handle(s.handle)} has {_whole(s.next_index, s.bitmap)}"],
    m.Receipt: _entries,
    m.SequenceMark: lambda of, g: [f"{g.origin} has assigned {g.assigned} numbers"],
    m.DeletionReport: lambda of, n: [
        f"{_to(n)}: {of.ids([e.id])} is lost ({fate_of(e.reason).value}) {of.number(e.number)}" for e in n.entries
    ],
    m.CopyStatuses: lambda of, w: [f"{_to(w)}: {of.ids([e.id])} {m.CopyStatus(e.status).name}" for e in w.entries],
}


def _target(text: str) -> int:
    return m.BROADCAST if text == "all" else int(text)


def _read_data(of: Conversation, sender: str, target: str, what: str, data: str) -> m.Message:
    handed = []
    for name, label, taken_as in re.findall(r"(\w+) #(\d+)(?: taken as #(\d+))?", data):
        number = int(label) << 16 | mark(of.real(taken_as)) if taken_as else of.real(label)
        content = of.content(name)
        of.sums[number] = content.crc
        handed.append(m.Handover(number, content))
    return m.Data(int(sender), _target(target), tuple(handed), what == "replica of")


def _read_offer(of: Conversation, sender: int, target: str, name: str, label: str) -> m.Message:
    d, number = of.content(name), of.real(label)
    of.sums[number] = d.crc
    return m.Offer(sender, _target(target), number, d.id, d.kind, d.created, d.hops, d.crc, len(d.payload), CHUNK)


def _read_answer(of: Conversation, sender: str, target: str, word: str, labels: str, wrong: str | None) -> m.Message:
    numbers = [of.real(label) for label in re.findall(r"#(\d+)", labels)]
    pairs = tuple((number, of.sums.get(number, 0) ^ bool(wrong)) for number in numbers)
    taken, refused = (pairs, ()) if word == "committed" else ((), tuple(numbers))
    return m.Committed(int(sender), _target(target), taken, refused)


def _read_statuses(of: Conversation, sender: str, target: str, entries: str) -> m.Message:
    found = re.findall(r"(\w+) ([A-Z_]+)", entries)
    return m.CopyStatuses(
        int(sender),
        _target(target),
        tuple(m.CopyStatusEntry(of.data[name], m.CopyStatus[word]) for name, word in found),
    )


def _read_beacon(of: Conversation, sender: str, more: str) -> m.Message:
    """`more`: 2 hops to 0 (number 7), fitter, base, free 0, life 5, unfit, wants 8 of 0."""
    policy = next(iter(of.net.nodes.values())).policy.tag
    values: dict[str, Any] = {"policy": policy, "potential": 0 if "unfit" in more else 1}
    route = None
    if found := re.search(r"(\d+) hops to (\d+)(?: \(number (\d+)\))?", more):
        hops, base = int(found[1]), int(found[2])
        route = m.Route(base, of.life(base), int(found[3] or 1), hops)
    if "fitter" in more:
        values["potential"] = POTENTIAL_ONE
    if "base" in more:
        values |= {"flags": m.BEACON_BASE, "free": m.UNBOUNDED_FREE, "potential": POTENTIAL_BASE}
    if found := re.search(r"wants (\d+) of (\d+)", more):
        values |= {"flags": m.BEACON_WANTED, "wanted": (int(found[2]), int(found[1]))}
    for key in ("free", "life"):
        if found := re.search(rf"{key} (\d+)", more):
            values[key] = int(found[1])
    return beacon(int(sender), next(of.count), route, **values)


def _read_statement(of: Conversation, base: str, what: str, listed: str) -> m.Message:
    ids = [of.data[name] for name in listed.split(", ")]
    serial = 10_000 + next(of.count)
    return statement(*ids, base=int(base), life=of.life(int(base)), serial=serial, lost=what == "reported lost")


def _reason(word: str) -> int:
    return REASONS[Fate(word)]


_TO = r"(\d+) > (\w+): "
#: What the messages look like that a command may say.
_READ: dict[str, Callable[..., m.Message]] = {
    _TO + r"(hands over|replica of) (.+)": _read_data,
    _TO + r"(committed|refused) ((?:#\d+(?:, )?)+)( with another checksum)?": _read_answer,
    _TO + r"offers (\w+) #(\d+)": lambda of, sender, target, name, label: _read_offer(
        of, int(sender), target, name, label
    ),
    _TO
    + r"accepts #(\d+) under handle (\d+)(?:; has chunks 0-(\d+))?": lambda of, sender, target, label, handle, last: (
        m.Accept(int(sender), int(target), of.real(label), of.real_handle(handle), int(last) + 1 if last else 0)
    ),
    _TO + r"of handle (\d+) has (?:no chunk|chunks 0-(\d+))": lambda of, sender, target, handle, last: m.Sack(
        int(sender), int(target), of.real_handle(handle), int(last) + 1 if last else 0, 0
    ),
    _TO + r"(\w+) is lost \((\w+)\) #(\d+)": lambda of, sender, target, name, why, label: m.DeletionReport(
        int(sender), _target(target), (loss(of.real(label), of.data[name], _reason(why)),)
    ),
    _TO + r"(\w+ [A-Z_]+(?:, \w+ [A-Z_]+)*)": _read_statuses,
    r"(\d+) > \w+: beacon(.*)": _read_beacon,
    r"(\d+) states: (arrived|reported lost): (.+)": _read_statement,
    r"(\d+) has assigned (\d+) numbers": lambda of, origin, assigned: make_sequence_mark(
        int(origin), of.net.stores[int(origin)].epoch if int(origin) in of.net.stores else 77, int(assigned)
    ),
}


class Block:
    """A command, with the comments before it, and what it is expected to bring about."""

    def __init__(self, comments: list[str], command: str) -> None:
        self.comments, self.command = comments, command
        self.expected: list[str] = []


def read(path: Path) -> list[Block]:
    """The blocks of a file."""
    blocks: list[Block] = []
    comments: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("> "):
            blocks.append(Block(comments, line[2:]))
            comments = []
        elif line.startswith("#") or not line:
            comments.append(line)
        else:
            blocks[-1].expected.append(line)
    return blocks


def written(blocks: list[Block]) -> str:
    """The text of a file."""
    lines: list[str] = []
    for block in blocks:
        lines += [*block.comments, f"> {block.command}", *block.expected]
    return "\n".join(lines) + "\n"
