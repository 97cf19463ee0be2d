"""A network of one's own for a test: real interfaces, up and down, that nobody else on this computer sees."""

from __future__ import annotations

import contextlib
import ctypes
import os
import pickle
import shutil
import subprocess
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import pytest

from .patience import PATIENCE_S

T = TypeVar("T")

_CLONE_NEWUSER = 0x10000000
_CLONE_NEWNET = 0x40000000
#: In place of a Wi-Fi interface that has joined its network: a cable with both ends up.
JOINED = (
    "link set lo up",
    "link add wlan0 type veth peer name air",
    "link set wlan0 up",
    "link set air up",
    "addr add 192.168.4.7/24 brd + dev wlan0",
)
#: The same before it has joined: the other end is down.
NOT_JOINED = (*JOINED, "link set air down")
#: Switched off. It keeps its address, and loses its routes.
DOWN = (*JOINED, "link set wlan0 down")


def ip(*commands: str) -> None:
    """Run commands of ip(8). When the other end goes down, the kernel takes a moment to notice: waits for that."""
    for command in commands:
        _ip(command)
        if command == "link set air down":
            deadline = time.monotonic() + PATIENCE_S
            while "NO-CARRIER" not in _ip("link show wlan0"):
                assert time.monotonic() < deadline, "the kernel notices no lost carrier"


def _ip(command: str) -> str:
    return subprocess.run(["ip", *command.split()], check=True, capture_output=True, text=True).stdout


def in_namespace(setup: Sequence[str], work: Callable[[], T]) -> T:
    """What `work` returns (something that can be pickled), called in a child process that has a network of its own.

    `setup`: commands of ip(8). Skips the test where the system lets nobody have such a network.
    """
    if shutil.which("ip") is None:
        pytest.skip("needs ip(8), of the package iproute2")
    inside, outside = os.getuid(), os.getgid()
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        # The child uses no lock that another thread of ours could hold.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        os.close(reader)
        try:
            answer = _alone(inside, outside, setup, work)
        except BaseException:  # noqa: BLE001 - the parent raises it
            answer = "failed", traceback.format_exc()
        with os.fdopen(writer, "wb") as pipe:
            pickle.dump(answer, pipe)
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    kind, value = pickle.loads(said)
    if kind == "skip":
        pytest.skip(value)
    assert kind == "done", value
    result: T = value
    return result


def _alone(user: int, group: int, setup: Sequence[str], work: Callable[[], T]) -> tuple[str, T | str]:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWUSER | _CLONE_NEWNET):
        return "skip", f"no network namespaces here: {os.strerror(ctypes.get_errno())}"
    try:
        with contextlib.suppress(FileNotFoundError):
            Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
        ip(*setup)
    except (OSError, subprocess.CalledProcessError) as error:
        return "skip", f"no interfaces in a network namespace here: {error}"
    return "done", work()
