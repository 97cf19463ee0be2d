"""What the commands say of an interface that is away, down, or has joined no network."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from rass_mav.cli import main
from rass_mav.link.backlog import WAITING_FRAME_BYTES
from rass_mav.link.udp import Peer, UdpLink
from tests.namespaces import DOWN, JOINED, NOT_JOINED, in_namespace, ip

from .app_nodes import RunningNode

LINK = {"listen": "0.0.0.0:14600", "broadcast": "192.168.4.255:14600"}
NO_NETWORK = (*JOINED, "addr flush dev wlan0")
NOWHERE = "192.168.4.255 is the broadcast address of no interface"


def said(*arguments: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = main(arguments)
    return code, out.getvalue(), err.getvalue()


@pytest.mark.parametrize(
    ("setup", "text"),
    [
        (JOINED, ""),
        (NO_NETWORK, f"links[0].broadcast: {NOWHERE} (there is lo 127.0.0.1"),
        (NOT_JOINED, "links[0]: wlan0 has no carrier; "),
        (DOWN, "links[0]: wlan0 is down; sudo ip link set wlan0 up"),
    ],
    ids=["joined", "no network", "not joined", "down"],
)
def test_check_warns_of_what_does_not_fit_this_computer(setup: tuple[str, ...], text: str, tmp_path: Path) -> None:
    node = RunningNode(tmp_path, 7, node={"role": "base"}, links=[LINK])
    path = str(tmp_path / node.config)
    code, out, err = in_namespace(setup, partial(said, "check", path))
    assert (code, out) == (0, f"{path}: ok (base, node 7)\n")
    assert err.startswith(f"{path}: warning: {text}" if text else "")
    assert len(err.splitlines()) == bool(text)
    code, out, _ = in_namespace(setup, partial(said, "check", path, "--json"))
    answer = json.loads(out)
    assert (code, answer["ok"], answer["config"]["node"]["id"]) == (0, True, 7)
    assert [warning.startswith(text) for warning in answer["warnings"]] == ([True] if text else [])


def test_a_node_goes_on_without_its_network_and_finds_it_later(tmp_path: Path) -> None:
    def work() -> tuple[list[Any], list[list[str]], str]:
        os.chdir(tmp_path)
        node = RunningNode(tmp_path, 1, node={"role": "base"}, links=[LINK]).start(forked=False)
        links, lines = [], []
        try:
            for change in ("", "addr add 192.168.4.7/24 dev wlan0", "link set air down", "link set wlan0 down"):
                if change:
                    ip(change)
                [link] = node.status()["links"]
                links.append((link["interfaces"], link["trouble"]))
                shown = said("status", node.config)[1].splitlines()
                lines.append([line for line in shown if "link udp" in line])
            node.signal(signal.SIGTERM)
        finally:
            node.end()
        return links, lines, node.log()

    links, lines, log = in_namespace(NO_NETWORK, work)
    wlan0: Callable[..., dict[str, Any]] = partial(dict, name="wlan0")
    assert links == [
        ([], NOWHERE),
        ([wlan0(up=True, carrier=True)], None),
        ([wlan0(up=True, carrier=False)], "wlan0 has no carrier"),
        ([wlan0(up=False, carrier=False)], "wlan0 is down"),
    ]
    assert [line[-1].rpartition("; ")[2] for line in lines[1:]] == ["wlan0 up", "wlan0 no carrier", "wlan0 down"]
    assert [line[:-1] for line in lines] == [
        [f"WARNING: link udp:0.0.0.0:14600: {trouble}"] if trouble else [] for _, trouble in links
    ], "what is wrong stands first"
    [warning] = [line for line in log.splitlines() if NOWHERE in line]
    assert " WARNING " in warning
    assert "links[0].broadcast" in warning


def test_a_link_says_how_much_waits_in_its_interface() -> None:
    """Nobody has the neighbour's address, so what is sent to it stays there for some seconds."""

    async def waiting() -> list[int]:
        link = UdpLink(("192.168.4.7", 0), peers=[Peer(("192.168.4.9", 14600), 9)])
        link.start(lambda: None)
        found = [link.waiting]
        for _ in range(3):
            link.send(bytes(145), 9)
            counted = link.waiting
            await asyncio.sleep(0)  # it leaves, and the system counts it
            found += [counted, link.waiting]
        link.close()
        return found

    found = in_namespace(JOINED, lambda: asyncio.run(waiting()))
    assert found[0] == 0
    for number, bytes_ in enumerate(found):
        frames = (number + 1) // 2
        assert frames * WAITING_FRAME_BYTES / 2 <= bytes_ <= frames * WAITING_FRAME_BYTES * 2
