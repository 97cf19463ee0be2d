"""An autopilot with MAVLink signing: the node's key for it, and what the store keeps of the timestamps."""

from __future__ import annotations

import math
from pathlib import Path

from rass_mav.agent.agent import Agent, VehicleService
from rass_mav.core.store import Store
from rass_mav.errors import StoreError
from rass_mav.link.vehicle import VehiclePort
from rass_mav.mavlink.frames import FLAG_SIGNED
from rass_mav.mavlink.signedport import SignedPort
from rass_mav.mavlink.signing import SigningKey
from rass_mav.store.reader import SqliteReader
from rass_mav.trust.keys.autopilot import autopilot_key
from rass_mav.trust.keys.keyring import Keyring

#: Seconds between two notes of the timestamp. Frames that were recorded after the last note can be repeated to a node
#: that has just been started, until it hears its autopilot.
NOTE_S = 60.0
# The store keeps the next timestamp under this name.
_KEY = "autopilot_timestamp"


def signing_key(keyring: Keyring) -> SigningKey:
    """What the node and its autopilot sign with."""
    return SigningKey(autopilot_key(keyring.own.secret).reveal())


def signed_from(store: Store, key: SigningKey) -> SignedPort:
    """For a node that runs on this store."""
    return SignedPort(key, store.get_meta(_KEY) or 0)


def last_timestamp(store: Path) -> int:
    """Where the node of this store will continue; 0: there is no store, or it cannot be read."""
    try:
        with SqliteReader(store) as reader:
            return reader.meta().get(_KEY, 0)
    except StoreError:
        return 0


def sign(agent: Agent, vehicle: VehiclePort, signing: SignedPort) -> None:
    """Let an agent sign what it sends to its autopilot, and take nothing else from there."""
    agent.vehicle_writer.flags = FLAG_SIGNED
    agent.vehicle_reader.check = signing
    vehicle.sign = signing.sign


class KeptTimestamp(VehicleService):
    """A service of the agent: notes the next timestamp in the store."""

    def __init__(self, store: Store, signing: SignedPort) -> None:
        self._store = store
        self._signing = signing
        self._note_at = -math.inf

    def step(self, now: float) -> None:
        """Once a step."""
        # The store is asked: it may have rolled back the last note.
        if now >= self._note_at and self._store.get_meta(_KEY) != self._signing.next:
            self._note_at = now + NOTE_S
            self.note()

    def note(self) -> None:
        """Durable with the next commit."""
        self._store.set_meta(_KEY, self._signing.next)
