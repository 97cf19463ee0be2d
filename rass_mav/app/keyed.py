"""The keys of a running node: from their file, in its agent, and what of them is kept on its disk."""

from __future__ import annotations

import random
import secrets
from concurrent.futures import Executor
from functools import partial
from typing import Any

from rass_mav.agent.agent import Agent
from rass_mav.config.keys import AboutKeys
from rass_mav.errors import StoreCopiedError
from rass_mav.link.vehicle import VehiclePort
from rass_mav.mavlink.messages import CRITICAL
from rass_mav.station.clones import Clones
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.trust import trust_of

from .config import RunConfig
from .driver import Driver
from .keyfiles import KeyFiles, kept_key_updates
from .signing import KeptTimestamp, sign, signed_from, signing_key


class NodeKeys:
    """What a node with keys has besides others, through all lives of its store."""

    def __init__(self, config: RunConfig) -> None:
        """Raises `KeysError`."""
        assert config.keys is not None
        self._config = config
        self._file = config.keys.file
        keyring = self._load()
        stored = kept_key_updates(config.store_path, keyring)
        rng = random.Random(secrets.randbits(128))
        self.trust = trust_of(keyring, rng, stored, accept_open=config.keys.accept_open)
        """For the agent."""
        self._about = keyring.own.about
        self._autopilot_key = signing_key(keyring) if config.autopilot.signing else None
        self._timestamps: KeptTimestamp | None = None
        self._anew = False

    def _load(self) -> Keyring:
        keyring = self._config.open_keys()
        assert keyring is not None
        return keyring

    def join(self, agent: Agent, vehicle: VehiclePort | None, executor: Executor) -> None:
        """In a new life: take the key file again when it changes, keep key updates, and sign what leaves for an
        autopilot with MAVLink signing."""
        key_updates, store = self.trust.key_updates, self._config.store_path
        agent.services.append(KeyFiles(key_updates, self._file, store, self._load, executor, agent.tell_ground))
        if vehicle is not None and self._autopilot_key is not None:
            signing = signed_from(agent.store, self._autopilot_key)
            self._timestamps = KeptTimestamp(agent.store, signing)
            agent.services.append(self._timestamps)
            sign(agent, vehicle, signing)

    def watch_numbers(self, driver: Driver) -> None:
        """Begin a new epoch when another node seals data under the numbers of this one: it cannot do so in an epoch
        that is drawn now. Once is enough, so that nobody can bring it about again and again."""
        if not self._anew:
            driver.agent.services.append(Clones(driver.agent, partial(self._begin_anew, driver)))

    def _begin_anew(self, driver: Driver) -> None:
        self._anew = True
        driver.agent.tell_ground(CRITICAL, "RASS: another node has a copy of this store, never copy a drone's card")
        driver.fail(StoreCopiedError("another node runs on a copy of this store"))

    def note(self) -> None:
        """Before the store is closed: what must be durable."""
        if self._timestamps is not None:
            self._timestamps.note()

    def about(self) -> AboutKeys:
        """What everybody may know of the keys, with the link key in use."""
        return {**self._about, "link_key": self.trust.key_updates.link.number}

    def key_updates(self, now: float) -> dict[str, Any]:
        """For `status`."""
        return self.trust.key_updates.report(now)
