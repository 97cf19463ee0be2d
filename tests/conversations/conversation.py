"""Conversations between nodes, as text that a person reads and a test replays.

A file consists of commands, each followed by what it brings about: the messages that the nodes send to each other, and
what changes in their stores. `#` starts a comment. README.md lists the commands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

from rass_mav.core import messages as m
from rass_mav.core.datum import DatumId
from rass_mav.core.news.deletion_reports import fate_of
from rass_mav.wire import decode, encode
from tests.core.replica_net import Net


def names() -> Iterator[str]:
    """a, b, ... z, a1, b1, ..."""
    round = 0
    while True:
        for letter in "abcdefghijklmnopqrstuvwxyz":
            yield f"{letter}{round or ''}"
        round += 1


class Conversation:
    """The nodes of one file."""

    def __init__(self) -> None:
        self.risks: dict[int, float] = {}
        self.base = -1
        self.links: list[tuple[int, int]] = []
        self.settings: dict[str, Any] = {"mirror_until_receipt": True}
        self._net: Net | None = None
        self._names = names()
        self.data: dict[str, DatumId] = {}
        self.numbers: dict[int, int] = {}
        """Hand-over numbers are random: the first that is seen is #1."""
        self.lost: list[tuple[str, int | None, int]] = []
        """Kind, sender and how many more frames of these are lost."""
        self.lines: list[str] = []
        self.copies: dict[tuple[str, int], str] = {}
        self.beacons = False

    @property
    def net(self) -> Net:
        if self._net is None:
            self._net = Net(self.risks, self.links, base=self.base, **self.settings)
            self._net.loses = self._loses
        return self._net

    def run(self, command: str) -> list[str]:
        """Carry out a command; what it brought about, as lines."""
        word, *rest = command.split()
        self.lines = []
        getattr(self, f"do_{word}")(*rest)
        if self._net is not None:
            self._look()
        return self.lines

    # -- commands ------------------------------------------------------------------------------------------------------

    def do_nodes(self, *ids: str) -> None:
        for text in ids:
            id, _, what = text.partition(":")
            if what == "base":
                self.base = int(id)
            self.risks[int(id)] = 0.0 if what in ("", "base") else float(what)

    def do_links(self, *pairs: str) -> None:
        self.links += [_pair(pair) for pair in pairs]

    def do_set(self, *settings: str) -> None:
        for text in settings:
            key, _, value = text.partition("=")
            self.settings[key] = yaml.safe_load(value)

    def do_show(self, what: str) -> None:
        assert what == "beacons"
        self.beacons = True

    def do_step(self, count: str = "1") -> None:
        for step in range(int(count)):
            before = len(self.lines)
            self.net.step()
            self.show(self.net.said)
            self._look()
            if int(count) > 1 and len(self.lines) > before:
                self.lines.insert(before, f"step {step + 1}:")

    def do_quiet(self, count: str) -> None:
        """Steps of which nothing is shown, not even what changes: nodes get to know each other."""
        self.net.step(int(count))
        self._look()
        self.lines = []

    def do_put(self, node: str, size: str = "7") -> None:
        payload = (b"reading" * int(size))[: int(size)]
        self.net.said = []
        self._name(self.net.put(int(node), payload))
        self.show(self.net.said)

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

    def do_flip(self, node: str, name: str) -> None:
        """Flip a bit of a stored datum."""
        self.net.strike(int(node), self.data[name])

    def do_lose(self, kind: str, sender: str = "*", count: str = "1") -> None:
        self.lost.append((kind.lower(), None if sender == "*" else int(sender), int(count)))

    def do_repeat(self, node: str) -> None:
        """All that a node sent in the last command is heard once more."""
        again = [(int(node), message) for message in self.net.said if m.sender_of(message) == int(node)]
        self.net.said = []
        self.net.deliver([pair for pair in again if type(pair[1]) is not m.Beacon])
        self.show(self.net.said)

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
        for message in said:
            if type(message) is m.Beacon and not (self.beacons or message.answers):
                continue
            # What is said survives the wire.
            if type(message) is not m.Chunk:
                for payload in encode(message, self.net.now):
                    decode(payload, self.net.now)
            self.lines += _TEXTS[type(message)](self, message)

    def _look(self) -> None:
        """What has changed in the stores since the last look."""
        now: dict[tuple[str, int], str] = {}
        for i, node in self.net.nodes.items():
            for id in node.holdings:
                holding = node.holdings.get(id)
                assert holding is not None
                now[self._name(id), i] = holding.state.name.lower().replace("_", " ")
            if i == self.base:
                for id in self.data.values():
                    if node.archive is not None and id in node.archive:
                        now[self._name(id), i] = "arrived"
                    elif node.archive is not None and node.archive.is_lost(id):
                        now[self._name(id), i] = "reported lost"
        for name, i in sorted({*now, *self.copies}):
            before, after = self.copies.get((name, i)), now.get((name, i))
            if before != after:
                self.lines.append(f"  {name} at {i}: {before or '-'} -> {after or '-'}")
        self.copies = now

    def _name(self, id: DatumId) -> str:
        for name, known in self.data.items():
            if known == id:
                return name
        name = next(self._names)
        self.data[name] = id
        return name

    def number(self, number: int) -> str:
        return f"#{self.numbers.setdefault(number, len(self.numbers) + 1)}" if number else "no number"

    def ids(self, ids: Any) -> str:
        return ", ".join(self._name(id) for id in ids)

    def named(self, ids: dict[tuple[int, int], Callable[[int], bool]]) -> str:
        return ", ".join(name for name, id in self.data.items() if id[:2] in ids and ids[id[:2]](id.sequence))


def _pair(text: str) -> tuple[int, int]:
    a, b = text.split("-")
    return int(a), int(b)


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
    answers = "".join(f"; to {answer.target}: {_answers(of, answer)}" for answer in b.answers)
    return [f"{b.sender} > all: beacon, {route}{answers}"]


def _data(of: Conversation, d: m.Data) -> list[str]:
    what = "hands over" if not d.replica else "replica of" if d.distance is None else "distant replica of"
    lines = [f"{_to(d)}: {what} {of.ids([h.datum.id])} {of.number(h.number)}" for h in d.handovers]
    return lines + [f"  on the same frame, to {answer.target}: {_answers(of, answer)}" for answer in d.answers]


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


_TEXTS: dict[type, Callable[[Conversation, Any], list[str]]] = {
    m.Beacon: _beacon,
    m.Data: _data,
    m.Committed: lambda of, c: [f"{_to(c)}: {_answers(of, c)}"],
    m.Offer: lambda of, o: [f"{_to(o)}: offers {of.ids([o.id])} {of.number(o.number)}, {o.size} bytes"],
    m.Accept: lambda of, a: [f"{_to(a)}: accepts {of.number(a.number)} from chunk {a.next_index}"],
    m.Chunk: lambda of, c: [f"? > {c.target}: " + (f"chunk {c.position}" if c.data else "what has arrived?")],
    m.Sack: lambda of, s: [f"{_to(s)}: has all chunks below {s.next_index}"],
    m.Receipt: _entries,
    m.SequenceMark: lambda of, g: [f"{g.origin} has assigned {g.assigned} numbers"],
    m.Summary: lambda of, d: [f"{d.base} summarises: {len(d.marks)} arrived lately"],
    m.DeletionReport: lambda of, n: [
        f"{_to(n)}: {of.ids([e.id])} is lost ({fate_of(e.reason).value}) {of.number(e.number)}" for e in n.entries
    ],
    m.PassedOn: lambda of, p: [f"{_to(p)}: passed on {of.ids(p.ids)}"],
    m.CopyStatuses: lambda of, w: [f"{_to(w)}: {of.ids([e.id])} {m.CopyStatus(e.status).name}" for e in w.entries],
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
