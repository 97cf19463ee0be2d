"""What makes a node's process smaller: a Pi Zero has 512 MiB for everything."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec

#: Python's bindings of OpenSSL, and who loads them where they are. All of these can do without.
_BINDINGS = ("ssl", "_hashlib")
_LOADERS = ("asyncio", "hashlib", "hmac")
#: Python's own digests, by which `hashlib` can do without OpenSSL: one of each group must be there. (Some systems leave
#: them out; then `hashlib` would complain of each that it misses.)
_DIGESTS = (("_md5",), ("_sha1",), ("_sha2", "_sha256"), ("_sha2", "_sha512"), ("_sha3",), ("_blake2",))


def load_without_openssl() -> None:
    """Load asyncio and hashlib, but not OpenSSL, which both load where it is installed: 4 MiB of a node.

    A node makes no TLS connections, and signs short frames: Python's own SHA-256 takes 0.72 us for one, that of OpenSSL
    0.68 us. Both modules are made to work without OpenSSL, since Python may be built without it. Others who import
    `ssl` later get it, but asyncio then refuses TLS connections.

    For the start of a process that does nothing but run a node. Nothing happens if one of these modules is loaded
    already, or if Python has no digests of its own.
    """
    if any(name in sys.modules for name in (*_BINDINGS, *_LOADERS)):
        return
    if not all(any(find_spec(name) for name in names) for names in _DIGESTS):
        return
    for name in _BINDINGS:
        # None makes the import fail, as if it were not there.
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        for name in _LOADERS:
            importlib.import_module(name)
    finally:
        for name in _BINDINGS:
            del sys.modules[name]
