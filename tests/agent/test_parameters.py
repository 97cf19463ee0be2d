"""Settings as parameters: the rules of the file, 32 bits, and a memory."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rass_mav.agent.settings import AgentSettings
from rass_mav.errors import ConfigError
from rass_mav.mavlink.component import single
from rass_mav.policy.settings import kinds
from rass_mav.station.parameters import (
    INDEX,
    PARAMETERS,
    changed,
    recall,
    remember,
)
from rass_mav.store.memory import MemoryStore
from rass_mav.wire.measurement import shortest
from tests.agent.build import settings_of
from tests.some import some


def settings(**sections: Any) -> AgentSettings:
    # Most parameters are weights of this policy.
    return settings_of(7, **{**sections, "policy": {"name": "rass", **sections.get("policy", {})}})


def value_of(about: AgentSettings, name: str) -> float:
    return PARAMETERS[INDEX[name]].read(about)


def set_to(about: AgentSettings, name: str, value: float) -> AgentSettings:
    return changed(about, PARAMETERS[INDEX[name]], single(value))


def test_names_fit_the_wire_and_every_policy_has_a_number() -> None:
    assert all(1 <= len(p.name) <= 16 and p.name.isascii() and p.name.startswith("RASS_") for p in PARAMETERS)
    assert len(INDEX) == len(PARAMETERS)
    numbers = {kind.name: kind.number for kind in kinds().values()}
    assert len(set(numbers.values())) == len(numbers)
    # Known to ground stations by now.
    known = {"rass": 0, "rass-literal": 1, "hop-count": 2, "stigmergy": 3, "survival": 4}
    assert known.items() <= numbers.items()


floats = st.floats(width=32, allow_nan=False, allow_infinity=False)


@given(floats)
def test_the_shortest_decimal_is_the_same_in_32_bits(value: float) -> None:
    assert single(shortest(value)) == value


@given(st.integers(-9999, 9999), st.integers(0, 3))
def test_what_a_person_writes_comes_back_as_written(digits: int, places: int) -> None:
    written = round(digits / 10**places, places)
    assert shortest(single(written)) == written


@given(
    st.sampled_from(["rass", "survival"]),
    st.sampled_from(PARAMETERS),
    floats | st.integers(-3, 70000).map(float) | st.floats(width=32),
)
def test_any_value_is_taken_as_it_is_or_refused_by_name(policy: str, parameter: Any, value: float) -> None:
    before = settings(policy={"name": policy})
    try:
        after = changed(before, parameter, value)
    except ConfigError as error:
        said = str(error)
    else:
        said = ""
    if said:
        assert said.startswith(parameter.name + ": ")
        assert "\n" not in said
        return
    assert single(parameter.read(after)) == value
    others = {p.name for p in PARAMETERS if p.read(after) != p.read(before)} - {parameter.name}
    assert not others or parameter.name == "RASS_POLICY"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("RASS_ALPHA", -1.0, "RASS_ALPHA: expected a number >= 0, got -1.0"),
        ("RASS_ALPHA", float("nan"), "RASS_ALPHA: expected a finite number, got nan"),
        ("RASS_STEP_S", 0.0, "RASS_STEP_S: expected 0.05 to 60, got 0"),
        ("RASS_POLICY", 1.5, "RASS_POLICY: expected a whole number, got 1.5"),
        ("RASS_NODE_ID", 8.0, "RASS_NODE_ID: cannot be set"),
        ("RASS_BANDWIDTH", 0.0, "RASS_BANDWIDTH: expected 1 to 65535, got 0"),
        ("RASS_RISK_LOW", 5.0, "RASS_RISK_LOW: risk.high: expected a number above risk.low (5), got 1"),
        ("RASS_POLICY", 3.0, "RASS_POLICY: changes to and from stigmergy only in the configuration file"),
    ],
)
def test_a_wrong_value_is_refused_in_words(name: str, value: float, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        set_to(settings(), name, value)
    assert str(caught.value) == said


def test_an_unknown_policy_is_refused_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="0 rass, 1 rass-literal, 2 hop-count"):
        set_to(settings(), "RASS_POLICY", 99.0)


def test_both_weights_cannot_be_zero_and_hop_count_has_none() -> None:
    with pytest.raises(ConfigError, match="must not both be 0"):
        set_to(set_to(settings(), "RASS_ALPHA", 0.0), "RASS_BETA", 0.0)
    with pytest.raises(ConfigError, match="policy hop-count has no such weight"):
        set_to(settings(policy={"name": "hop-count"}), "RASS_ALPHA", 3.0)


def test_weights_that_the_file_leaves_open_are_the_policys_own() -> None:
    about = settings()
    assert (value_of(about, "RASS_ALPHA"), value_of(about, "RASS_BETA")) == (1.0, 10.0)
    literal = set_to(about, "RASS_POLICY", 1.0)
    assert (value_of(literal, "RASS_ALPHA"), value_of(literal, "RASS_BETA")) == (10.0, 1.0)
    survival = set_to(about, "RASS_POLICY", 4.0)
    assert (value_of(survival, "RASS_HOP_COST"), value_of(survival, "RASS_ALPHA")) == pytest.approx((0.05, 0.0))
    assert (value_of(about, "RASS_RISK_GAIN"), value_of(survival, "RASS_RISK_GAIN")) == pytest.approx((1.0, 0.1))
    # Set to the same as another node has in its file: their potentials must be comparable.
    assert set_to(about, "RASS_ALPHA", 0.1).policy.make().tag == settings(policy={"alpha": 0.1}).policy.make().tag


def kept(store: MemoryStore, configured: AgentSettings, **values: float) -> AgentSettings:
    about = configured
    for name, value in values.items():
        about = set_to(about, name, value)
        remember(store, configured, PARAMETERS[INDEX[name]], single(value))
    return about


def test_a_weight_is_remembered_under_a_policy_without_weights() -> None:
    store, configured = MemoryStore(1), settings()
    about = kept(store, configured, RASS_ALPHA=5.0, RASS_POLICY=2.0)
    assert recall(store, configured) == (about, [])
    assert about.policy.alpha == 5.0


def test_what_was_set_holds_at_the_next_start_in_any_order() -> None:
    store, configured = MemoryStore(1), settings(risk={"low": -5.0, "high": 300.0})
    about = kept(store, configured, RASS_RISK_HIGH=1000.0, RASS_RISK_LOW=400.0, RASS_ALPHA=2.5, RASS_POLICY=1.0)
    assert recall(store, configured) == (about, [])


def test_a_key_changed_in_the_file_since_then_wins() -> None:
    store = MemoryStore(1)
    kept(store, settings(policy={"alpha": 2.0}), RASS_ALPHA=3.0, RASS_BETA=4.0)
    again, left_out = recall(store, settings(policy={"alpha": 5.0}))
    assert (again.policy.alpha, again.policy.beta, left_out) == (5.0, 4.0, [])


def test_what_no_longer_fits_is_left_out_and_told() -> None:
    store = MemoryStore(1)
    kept(store, settings(policy={"beta": 1.0}), RASS_ALPHA=0.0)
    again, left_out = recall(store, settings(policy={"alpha": 1.0, "beta": 0.0}))
    assert again.policy.alpha == 1.0
    assert len(left_out) == 1
    assert left_out[0].startswith("RASS_ALPHA: ")


def test_a_store_keeps_the_bits_of_any_pair() -> None:
    store = MemoryStore(1)
    kept(store, settings(risk={"low": -1e30, "high": -1.5}), RASS_RISK_LOW=-3e38)
    number = some(store.get_meta("param.RASS_RISK_LOW"))
    assert -(1 << 63) <= number < 1 << 63
    assert struct.unpack("<ff", number.to_bytes(8, "little", signed=True))[1] == single(-3e38)
