"""Two complete sets of the mavlink modules: one with the compiled CRC, one as on a board without it."""

from __future__ import annotations

import importlib
import sys
from types import SimpleNamespace

import pytest

import rass_mav.mavlink

PACKAGE = "rass_mav.mavlink"
MODULES = ("crc", "frames", "tunnel", "signing", "messages", "telemetry")


def _load() -> SimpleNamespace:
    return SimpleNamespace(**{name: importlib.import_module(f"{PACKAGE}.{name}") for name in MODULES})


@pytest.fixture(scope="session", params=["fastcrc", "fallback"])
def room(request: pytest.FixtureRequest) -> SimpleNamespace:
    """The modules of `rass_mav.mavlink` as attributes, with each implementation of the CRC."""
    usual = _load()
    if request.param == "fastcrc":
        pytest.importorskip("fastcrc")
        assert usual.crc.HAVE_FASTCRC
        return usual
    with pytest.MonkeyPatch.context() as patch:
        # None makes an import fail, as where fastcrc is not installed. Afterwards the usual modules are back.
        patch.setitem(sys.modules, "fastcrc", None)
        patch.setitem(sys.modules, "fastcrc.crc16", None)
        patch.setattr(rass_mav, "mavlink", rass_mav.mavlink)
        for name in [name for name in sys.modules if name == PACKAGE or name.startswith(PACKAGE + ".")]:
            patch.delitem(sys.modules, name)
        fresh = _load()
    assert not fresh.crc.HAVE_FASTCRC
    return fresh
