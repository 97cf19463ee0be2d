"""All that a node's keys do for it. A node without keys does not load this module, which needs PyNaCl."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple

from rass_mav.core.seals import NoSeals
from rass_mav.core.store import Store
from rass_mav.trust.keys.keyring import Keyring
from rass_mav.trust.keys.word import GroundWord
from rass_mav.trust.letters import Letters
from rass_mav.trust.pairs import PairTags
from rass_mav.trust.seals import DataKeys
from rass_mav.trust.tags import NoTags


class Trust(NamedTuple):
    """What a node's keys do for it. It outlives the node's lives."""

    letters: Letters
    """Bring the keys of its links."""
    tags: Callable[[Store, random.Random, float], NoTags]
    """Prove its words to other nodes. Called for each life, with its store, its generator and the seconds of a step."""
    seals: Callable[[Store], NoSeals]
    """What its keys do to data. Called for each life with its store."""
    word: GroundWord | None
    """Of the ground, without which no base is believed; None: all are."""


def trust_of(
    keyring: Keyring, rng: random.Random, step_s: float, kept: Iterable[bytes] = (), *, accept_open: bool = False
) -> Trust:
    """What the keys of a keyring do, all of it.

    :param rng: chooses among letters.
    :param step_s: length of a step, seconds.
    :param kept: letters of earlier lives (`Letters`).
    :param accept_open: at a base, data that nobody has sealed count as made by the node that they name.
    """
    letters = Letters(keyring, rng, step_s, kept)
    return Trust(
        letters,
        partial(PairTags, keyring.own, letters.is_out),
        DataKeys(keyring, letters.serials, accept_open=accept_open),
        GroundWord(keyring),
    )
