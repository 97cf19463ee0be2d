"""Reduces the memory of a node's process: a Pi Zero has 512 MiB for everything."""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec

#: Python's bindings of OpenSSL, and the modules that load them if available. These modules also work without them.
_BINDINGS = ("ssl", "_hashlib")
_LOADERS = ("asyncio", "hashlib", "hmac")
#: Python's own digests, with which `hashlib` works without OpenSSL: one of each group must exist. (Some systems omit
#: them. Then `hashlib` would complain about each missing one.)
_DIGESTS = (("_md5",), ("_sha1",), ("_sha2", "_sha256"), ("_sha2", "_sha512"), ("_sha3",), ("_blake2",))


def load_without_openssl() -> None:
    """Load asyncio and hashlib, but not OpenSSL, which both load where it is installed. This saves 4 MiB.

    A node opens no TLS connections, and signs short frames: Python's own SHA-256 takes 0.72 us for one, that of OpenSSL
    0.68 us. Both modules work without OpenSSL, because Python may be built without it. Code that imports `ssl` later
    gets it, but asyncio then refuses TLS connections.

    Call it at the start of a process that only runs a node. It does nothing if one of these modules is loaded already,
    or if Python has no digests of its own.
    """
    if any(name in sys.modules for name in (*_BINDINGS, *_LOADERS)):
        return
    if not all(any(find_spec(name) for name in names) for names in _DIGESTS):
        return
    for name in _BINDINGS:
        # None makes the import fail, as if the module did not exist.
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        for name in _LOADERS:
            importlib.import_module(name)
    finally:
        for name in _BINDINGS:
            del sys.modules[name]
